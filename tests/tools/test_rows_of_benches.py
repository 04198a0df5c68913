"""Rows of results from made-up measurements, in the words of docs/results.md."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from tools.bench import (
    bench_accuracy_rows,
    bench_bundle,
    bench_composition,
    bench_monte_carlo,
    bench_real_rows,
    bench_scale_rows,
    bench_speed_rows,
    bench_strips_rows,
    bench_surface_rows,
)
from tools.bench.bench_accuracy import CASES
from tools.bench.bench_real_halves import Halves
from tools.bench.bench_scale import TARGETS
from tools.bench.bench_speed_table import Result
from tools.bench.bench_surface_judge import SurfaceErrors
from tools.bench.bench_surface_roofs import Roofs
from tools.bench.result_rows import ResultRow
from tools.fuzz.fuzz_rows import result_row as fuzz_row
from tools.trials import chaos
from tools.trials.chaos_world import Trial


def asked(rows: list[ResultRow]) -> dict[str, tuple[str, str, bool | None]]:
    return {row.what: (row.target, row.value, row.met) for row in rows}


def accuracy_row(case: str, **more: Any) -> dict[str, Any]:
    row = {"case": case, "seed": 1, "good": True, "after_px": 0.046, "jumps_px": 0.19, "absolute_m": 0.977}
    row |= {"slope_mm": -0.2, "slope_sd_mm": 1.0, "named": 14, "wrong": 14, "sigma_px": 0.02}
    named = {"frame-turned": (8, 8), "yaw-wrong": (8, 8), "position-wrong": (0, 0)}
    return row | {"named_by_code": named} | more


def test_accuracy() -> None:
    bounds = {c.name: (c.after_px, c.jumps_px) for c in CASES}
    rows = [accuracy_row(case) for case in bounds]
    found = asked(bench_accuracy_rows.result_rows(rows, bounds))
    assert found["simulated surveys within their bounds (seed 1)"] == ("all", "19 of 19", True)
    flat = found["flat ground: shape after a similarity, jumps"]
    assert flat == ("0.15, 0.5 px", "0.046, 0.19 px", True)
    line = found["line of 200 frames: growth of the error along it"]
    assert line == ("0 mm a frame", "-0.2 ± 1.0 mm", True)
    assert ("all", "8 of 8 and 8 of 8", True) in found.values()
    assert len(found) == len(bench_accuracy_rows.ROWS)
    rows = [accuracy_row("flat", good=False, after_px=0.3), accuracy_row("flat", seed=2)]
    found = asked(bench_accuracy_rows.result_rows(rows, bounds))
    assert found["flat ground: shape after a similarity, jumps"][1:] == ("0.300, 0.19 px", False)
    assert len(found) == 2


def strips_row(case: str, method: str, rms_px: float, **more: Any) -> dict[str, Any]:
    figures = {"lines": 1000, "rms_px": rms_px, "misplaced": rms_px > 1.0}
    row = {"case": case, "method": method, "figures": figures, "coverage": (0.93, 0.95)}
    return row | {"measured_above": 0} | more


def test_strips() -> None:
    aims = bench_strips_rows.AIMS_PX
    methods = ("joint", "whole_scene", "piecewise_linear", "image_registration")
    rows = [strips_row(case, m, 0.01 if m == "joint" else 2.4) for case in aims for m in methods]
    found = asked(bench_strips_rows.result_rows(rows, len(rows)))
    clear = found["RMSE of `joint`, clear ground; errors within the stated 90 %"]
    assert clear == ("0.05 px", "0.010 px; 94 %", True)
    lines = found["lines called measured that are off by more than 1 px, 5 scenes"]
    assert lines == ("none", "none", True)
    assert ("", "2.40, 2.40, 2.40 px", None) in found.values()
    low = "resampled, low contrast 40 %"
    faint = [strips_row(low, "joint", 0.6, coverage=(0.88, 0.88))]
    ((what, row),) = asked(bench_strips_rows.result_rows(faint, 1)).items()
    assert what.startswith("RMSE of `joint`, low contrast on 40 %, another sampling")
    assert row == ("0.3 px; 85 to 95 %", "0.60 px; 88 %", False)
    short = [strips_row("5 m, clouds 30 %, ground as bright", "joint", 0.1, measured_above=9415)]
    found = asked(bench_strips_rows.result_rows(short, 160))
    assert ("160; none", "1; 9,415 lines", False) in found.values()
    assert ("none", "9,415 lines", False) in found.values()
    mixed = [strips_row("mixed", m, 0.1) for m in ("whole_scene", "piecewise_linear", "joint")]
    assert ("", "0, 0, 0 %", None) in asked(bench_strips_rows.result_rows(mixed, 3)).values()
    means = [strips_row(case, "mean_offset", 1.64) for case in bench_strips_rows.RESAMPLED_AIMS_PX]
    assert ("", "1.64, 1.64, 1.64 px", None) in asked(bench_strips_rows.result_rows(means, 3)).values()


def test_speed() -> None:
    stages = {"mosaic.seams": 1.0, "mosaic.compose": 6.0, "export.cog": 2.0, "matching.sift": 9.0}
    flight = bench_speed_rows.Measured(
        "18 real frames", "18 real frames of 9 MP", 18, 6.8, stages, 23.3, 1146.0
    )
    ours = Result("geomosaic", {"wall_s": 23.3})
    peers = [
        Result("OpenCV Stitcher, SCANS", {"wall_s": 8.1, "peak_mb": 1190.0, "frames_used": 8}),
        Result("pyOrthomosaic 0.9.3, 2D", {"wall_s": 152.9, "ssim": 0.332, "frames_used": 18}),
        Result("stitching 0.7.0, affine", failed="left out"),
    ]
    assert asked(bench_speed_rows.result_rows(flight, ours, peers)) == {
        "18 real frames of 9 MP, over the floor": ("2.5", "3.43 (23.3 s)", False),
        "18 real frames: composition and COG alone, over the floor": ("1.3", "1.32", False),
        "18 real frames: peak memory": ("1500 MB", "1146 MB", True),
        "18 real frames: OpenCV's Stitcher (uses 8)": ("slower", "8.1 s, 1190 MB", False),
        "18 real frames: pyOrthomosaic 0.9.3, 2D": ("slower", "152.9 s, SSIM 0.332", True),
    }


def test_scale() -> None:
    def run(frames: int, processor_s: float) -> dict[str, Any]:
        row = {"frames": frames, "tied": frames, "peak_mb": 4810.0, "disk": 14.9}
        return row | {"processor_s": processor_s, "wall_s": processor_s}

    results = {
        "targets": TARGETS,
        "runs": [run(500, 1000.0), run(2000, 4200.0)],
        "growth": {"wall": 1.05, "processors": 1.05},
        "plan": {"windows": 49506, "frames": 6944, "seconds": {"all": 17.6}},
    }
    assert asked(bench_scale_rows.result_rows(results)) == {
        "time a frame, 2,000 frames over 500": ("1.25", "1.05", True),
        "time of the processors a frame, 2,000 frames over 500": ("1.25", "1.05 (2.1 s and 2.0 s)", True),
        "2,000 frames of 0.3 MP from pixels: frames tied": ("all", "2,000", True),
        "2,000 frames of 0.3 MP: peak memory of all processes": ("4 GB (for 5,000)", "4.81 GB", False),
        "2,000 frames of 0.3 MP: run folder over the raw mosaic": ("1.5", "14.9", False),
        "49,506 windows over 6,944 frames planned": ("60 s", "17.6 s", True),
    }


def town(seed: int) -> bench_surface_rows.Town:
    cells = {
        name: SurfaceErrors(**{f.name: 0.2 for f in fields(SurfaceErrors)})
        for name in ("ground", "roofs", "edges", "trees")
    }
    shown = {f.name: 0.9 for f in fields(Roofs)}
    tiles = {"ties": np.array([0.5, 0.5, np.nan]), "auto": np.array([0.6, 0.493, 0.0])}
    return bench_surface_rows.Town(
        seed,
        {"ground": 0.13, "roofs": 0.31},
        cells,
        cells,
        dict.fromkeys(("ties", "dense"), Roofs(**shown)),
        tiles,
    )


def test_surface() -> None:
    rows = bench_surface_rows.town_rows([town(7), town(11)], small=False)
    found = asked(rows)
    assert found["ground, NMAD of two towns"] == ("1.2 px", "0.13, 0.13 px", True)
    edges = found["edges off by more than 1 m (StereoSGBM: 20.0, 20.0 %)"]
    assert edges == ("25 %", "20.0, 20.0 %", True)
    assert found["roof corners in the mosaic, RMSE"] == ("2 px", "0.90, 0.90 px", True)
    ((what, row),) = [(w, r) for w, r in found.items() if "--surface auto" in w]
    assert what.startswith("towns 7 and 11, `--surface auto`: tiles of the mosaic that change;")
    value = "2 of 2 and 2 of 2, nearer by 0.046 and 0.046; 1 and 1 (by 0.007)"
    assert row == ("none farther", value, False)
    small = asked(bench_surface_rows.town_rows([town(k) for k in range(4)], small=True))
    assert small["four unseen towns: trees off by more than 1 m"][2] is False
    assert len(small) == 4 and any("--surface auto" in what for what in small)
    assert not bench_surface_rows.town_rows([], small=False)


def test_real_halves() -> None:
    figures = {"rmse_px": 3.38, "median_px": 1.5, "p90_px": 4.0}
    rows = bench_real_rows.halves_rows(Halves([], figures, figures | {"rmse_px": 0.9}))
    assert [(r.target, r.value, r.met) for r in rows] == [
        ("1 px", "3.38 px (median 1.50)", False),
        ("1 px", "0.90 px (median 1.50)", True),
    ]


def test_monte_carlo() -> None:
    def case(yaw: float, seeds: int = 30) -> dict[str, Any]:
        row: dict[str, Any] = {"nees": {"pose": 1.07, "yaw": yaw}, "nees_se": 0.1}
        return row | {"seeds": [*range(seeds)], "absolute_ratio": 0.99, "after_ratio": 1.11}

    rows = bench_monte_carlo.result_rows({"flat": case(1.43), "line of 200": case(1.2)})
    assert asked(rows) == {
        "normalised squared error of the poses, flat block, 30 seeds": ("0.8 to 1.25", "1.07 ± 0.10", True),
        "normalised squared error of the poses, line of 200 frames": ("0.8 to 1.25", "1.07 ± 0.10", True),
        "normalised squared error of the yaw, flat block and line": ("0.8 to 1.25", "1.43 and 1.20", False),
        "error over the Cramér-Rao bound: absolute, shape, flat block": ("1", "0.99, 1.11", None),
    }
    assert not bench_monte_carlo.result_rows({"flat": case(1.0, seeds=1)})


def test_composition() -> None:
    ways = (*bench_composition.WAYS, bench_composition.FRAMES, bench_composition.CLEAN)
    rows = [{"seed": 11, "way": w, "ssim": 0.9676, "seams_grey": {"difference_mean": 1.56}} for w in ways]
    found = asked(bench_composition.result_rows(rows))
    assert found["SSIM against the true ortho, default settings"] == ("0.985", "0.9676", False)
    assert ("", "1.56 and 1.56 grey levels", None) in found.values()
    assert ("", "0.968 and 0.968; 0.968", None) in found.values()


@pytest.mark.parametrize(
    ("frames", "took_s", "row"),
    [
        (1000, 29.2, ("60 s, 2 GB", "29.2 s, 0.59 GB", True)),
        (5000, 160.2, ("159 s, 3.28 GB", "160 s, 0.59 GB", False)),
        (40, 3.0, ("", "3.0 s, 0.59 GB", None)),
    ],
)
def test_bundle(frames: int, took_s: float, row: tuple[str, str, bool | None]) -> None:
    found = asked([bench_bundle.result_row(frames, 298_843, took_s, 0.59)])
    assert found == {f"adjustment of {frames:,} frames, 298,843 observations": row}


def test_chaos_and_fuzz() -> None:
    trials = [Trial(k, "frames", "1", "bundle") for k in range(3)]
    trials[0].problems.append("traceback after term")
    trials[1].seconds["ctrl-c"] = 0.67
    assert [(r.value, r.met) for r in chaos.result_rows(trials)] == [
        ("0 of 3", True),
        ("1 of 3", False),
        ("0.67 s", True),
    ]
    flights = [Trial(k, "flight", "1", "bundle") for k in range(10)]
    assert [(r.target, r.value, r.met) for r in chaos.result_rows(flights)] == [
        ("all; none", "10 of 10; none", True)
    ]
    row = fuzz_row(None, 10, 11_200)
    assert row is not None and row.value == "10 of 11,200" and row.met is False
    assert fuzz_row("raster", 0, 5) is None
