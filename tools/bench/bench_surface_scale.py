"""What the dense surface takes by the number of frames and of large ones, and whether it is the same whoever
works on it."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

from tools.bench.bench_real_table import Row
from tools.bench.bench_speed_measure import Taken, measured
from tools.bench.bench_surface_rows import ROWS
from tools.bench.result_rows import ResultRow

GEOMOSAIC = Path(sys.executable).with_name("geomosaic")
BLOCKS = {20: (4, 5), 60: (6, 10), 200: (10, 20)}
"""Lines and frames in each by the number of frames."""
FLIGHT = ["--width-px", "400", "--height-px", "300", "--relief-m", "10", "--buildings-stand",
          "--buildings", "2", "--forward-overlap", "0.7", "--side-overlap", "0.6"]  # fmt: skip
TOWN = ["--buildings-stand", "--trees-stand", "--buildings", "2", "--hipped-roofs", "--bridges", "--relief-m",
        "10", "--forward-overlap", "0.7", "--side-overlap", "0.6"]  # fmt: skip
LARGE = ["--width-px", "3660", "--height-px", "2740", "--ground-pixel-m", "0.03", "--lines", "10",
         "--frames-per-line", "16", "--heading-deg", "0"]  # fmt: skip
"""160 frames of 10 MP, lines along the map's grid: 16 million cells of 4 px."""
LARGE_S, LARGE_MB = 90.0, 1500.0
BEFORE = ("survey.read", "matching.flying_height", "projection.ground", "placement.pos", "matching.sift",
          "adjustment.solve")  # fmt: skip
STAGE = "surface.dense"
MOST_GROWTH = 1.25
"""Of a frame's processor time with more frames: at the rim of small blocks fewer frames overlap."""


def scale(out: Path, seed: int = 31) -> list[Row]:
    """Processor time and memory of surface.dense on small frames, one process; the same bytes by two."""
    rows: list[Row] = []
    first_s = 0.0
    for frames, (lines, per_line) in BLOCKS.items():
        survey, run = out / f"scale-{frames}", out / f"scale-{frames}-run"
        if not (survey / "truth" / "truth.json").is_file():
            size = ["--lines", lines, "--frames-per-line", per_line, "--seed", seed]
            called(out, "simulate", "frames", survey, *FLIGHT, *size)
        _run(out, survey, run, *BEFORE)
        taken, again = (_run(out, survey, run, *BEFORE, STAGE) for _ in range(2))
        frame_s = (taken.processor_s - again.processor_s) / frames
        first_s = first_s or frame_s
        surface = json.loads((run / "run.json").read_text(encoding="utf-8"))["metrics"]["surface"]
        text = (
            f"{frame_s:.2f} processor s a frame, {taken.peak_mb:.0f} MB at most; cells of "
            f"{surface['cell_m']:.2f} m, {100.0 * surface['matched']:.0f} % matched"
        )
        wanted = f"{MOST_GROWTH} times that of {min(BLOCKS)}" if frames > min(BLOCKS) else ""
        rows.append((f"{frames} frames of 0.12 MP: {STAGE}", text, wanted, frame_s <= MOST_GROWTH * first_s))
        if frames == min(BLOCKS):
            rows.append(_same_by_two(out, run))
    return rows


def large(out: Path, results: list[ResultRow], seed: int = 908) -> list[Row]:
    """Time and memory of surface.dense on 160 large frames, with as many workers as there are cores; adds to
    results."""
    survey, run = out / "large", out / "large-run"
    if not (survey / "truth" / "truth.json").is_file():
        called(out, "simulate", "frames", survey, *TOWN, *LARGE, "--seed", seed)
    cores = os.cpu_count() or 1
    _run(out, survey, run, *BEFORE, workers=cores)
    taken = _run(out, survey, run, *BEFORE, STAGE, workers=cores)
    run_summary = json.loads((run / "run.json").read_text(encoding="utf-8"))
    seconds, surface = run_summary["timings_s"][STAGE], run_summary["metrics"]["surface"]
    text = (
        f"{seconds:.1f} s, {taken.peak_mb:.0f} MB at most; cells of {surface['cell_m']:.3f} m, "
        f"{100.0 * surface['matched']:.0f} % matched"
    )
    good = seconds <= LARGE_S and taken.peak_mb <= LARGE_MB
    figures = {"seconds": seconds, "peak_mb": taken.peak_mb, "most_s": LARGE_S, "most_mb": LARGE_MB}
    results.append(ROWS["large"].row(good, **figures))
    return [(f"160 frames of 10 MP: {STAGE}", text, f"{LARGE_S:.0f} s, {LARGE_MB:.0f} MB", good)]


def _same_by_two(out: Path, run: Path) -> Row:
    other = out / f"{run.name}-by-two"
    called(out, "replay", run, "-o", other, "--from", STAGE, "--until", STAGE, "--workers", 2, "--overwrite")
    same = _surface_of(run) == _surface_of(other)
    return "one process and two", "the same bytes" if same else "other bytes", "the same", same


def _surface_of(run: Path) -> bytes:
    run_summary = json.loads((run / "run.json").read_text(encoding="utf-8"))
    return (run / run_summary["artefacts"]["surface"]["file"]).read_bytes()


def _run(out: Path, survey: Path, run: Path, *stages: str, workers: int = 1) -> Taken:
    """A recipe of these stages in the run's folder, which keeps what it has."""
    params = {
        "frames": str((survey / "frames").absolute()),
        "pos": str((survey / "pos.csv").absolute()),
        "camera": str((survey / "cameras.json").absolute()),
    }
    recipe = out / f"{run.name}.yaml"
    steps = [{"stage": id, "params": params if id == "survey.read" else {}} for id in stages]
    recipe.write_text(json.dumps({"name": "scale", "stages": steps}), encoding="utf-8")
    return called(out, "run", recipe, "-o", run, "--workers", workers, "--overwrite")


def called(out: Path, *command: object) -> Taken:
    """A command of geomosaic's; what it says goes to OUT/said.log. Ends the bench if it fails."""
    taken = measured([GEOMOSAIC, *map(str, command)], out / "said.log")
    if taken.failed:
        raise SystemExit(f"geomosaic {' '.join(map(str, command))}: {taken.failed}")
    return taken
