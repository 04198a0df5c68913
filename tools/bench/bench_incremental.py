"""One more flight line in a finished survey: what `--incremental` takes, and how near a whole run it comes.

    python -m tools.bench.bench_incremental [--lines 20] [--per-line 50] [--width 480] [--height 360]
                                            [--seed 1] [--workers 2] [--out DIR] [--results FILE]
    python -m tools.bench.bench_incremental --frames FOLDER --added 12

A block of so many lines and one more is simulated twice: with positions as RTK gives them (2 cm) and as
consumers' GNSS does (1.5 m). Exposures differ by 5 %. All lines but the last are run whole, then the last one
is added and the run goes on by `--incremental`; a whole run of all is timed too. Times are those of the
processors, since other programs may run. By GNSS the whole run may place the map elsewhere, by less than it
is known to: one affine transform of all is found and taken off. Shifts are those of squares of 64 x 64
pixels, by least squares from the whole run's mosaic to the other; grey levels are of pixels that both show.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import re
import shlex
import shutil
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.windows import from_bounds

from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.survey import simulate_frames
from tools.bench.bench_flights import PROGRAM, commit
from tools.bench.bench_speed_measure import Taken, measured

POSITIONS = {"RTK, 2 cm": (0.02, 0.03), "GNSS, 1.5 m": (1.5, 2.0)}
TARGET_SHARE, TARGET_PX, TARGET_GREY = 0.1, 0.1, 1.0
TARGETS = {"share_of_time": TARGET_SHARE, "shift_px": TARGET_PX, "grey": TARGET_GREY}
IMAGES = {".jpg", ".jpeg", ".tif", ".tiff"}
SQUARE_PX = 64
ALIGN_PX = 2000
EXPOSURE_SD = 0.05
LEAST_GRADIENT = 4.0
"""Grey levels a pixel of a square's mean gradient, below which it shows no shift."""
Row = dict[str, Any]


@dataclass(frozen=True)
class Flight:
    """Frames in a folder, the last of which are added, and options that say where they are."""

    name: str
    folder: Path
    added: int
    words: tuple[str | Path, ...] = ()


def run(frames: Path, flight: Flight, target: Path, workers: int, *more: str) -> Taken:
    """A mosaic of a folder of the flight's frames."""
    given = [*flight.words, "--workers", workers]
    log = target.with_suffix(".log")
    taken = measured(list(map(str, [PROGRAM, "mosaic", frames, "-o", target, *given, *more])), log)
    if taken.failed:
        raise SystemExit(f"{target}: {taken.failed}; see {log}")
    return taken


def linked(frames: Sequence[Path], to: Path) -> Path:
    """Frames as links in a folder, with those that it has."""
    to.mkdir(parents=True, exist_ok=True)
    for frame in frames:
        (to / frame.name).symlink_to(frame)
    return to


def case(flight: Flight, out: Path, workers: int) -> Row:
    """Frames added to a finished survey, against a whole run of all."""
    frames = sorted(path for path in flight.folder.iterdir() if path.suffix.lower() in IMAGES)
    before = len(frames) - flight.added
    shutil.rmtree(out, ignore_errors=True)
    folder = linked(frames[:before], out / "frames")
    first = run(folder, flight, out / "run", workers)
    linked(frames[before:], folder)
    added = run(folder, flight, out / "run", workers, "--incremental")
    whole = run(folder, flight, out / "whole", workers)
    summary, of_whole = (json.loads((out / r / "run.json").read_text()) for r in ("run", "whole"))
    row = {
        "positions": flight.name,
        "frames_before": before,
        "frames_added": flight.added,
        "share_of_time": added.processor_s / whole.processor_s,
        "share_of_wall_time": added.wall_s / whole.wall_s,
        "reused": summary["metrics"]["reused"],
        **differences(out / "run", out / "whole"),
        "stages_s": {
            stage: [summary["timings_s"][stage], seconds] for stage, seconds in of_whole["timings_s"].items()
        },
    }
    for key, taken in (("first", first), ("added", added), ("whole", whole)):
        row[key] = {k: v for k, v in asdict(taken).items() if k in ("wall_s", "processor_s", "peak_mb")}
    return row


def differences(one: Path, other: Path) -> Row:
    """Between the mosaics of two runs, where both show something."""
    with rasterio.open(one / "mosaic.tif") as a, rasterio.open(other / "mosaic.tif") as b:
        west, south = max(a.bounds.left, b.bounds.left), max(a.bounds.bottom, b.bounds.bottom)
        east, north = min(a.bounds.right, b.bounds.right), min(a.bounds.top, b.bounds.top)
        at = [
            from_bounds(west, south, east, north, r.transform).round_offsets().round_lengths() for r in (a, b)
        ]
        first, second = (r.read(window=w).astype(np.float32) for r, w in zip((a, b), at, strict=True))
        valid = np.logical_and(*(r.dataset_mask(window=w) > 0 for r, w in zip((a, b), at, strict=True)))
    second, valid, moved_px = in_place(first, second, valid)
    off = np.abs(first - second).max(axis=0)[valid]
    shifts = list(shifts_px(first.mean(axis=0), second.mean(axis=0), valid))
    return {
        "place_px": moved_px,
        "shift_px": float(np.quantile(shifts, 0.95)),
        "shift_median_px": float(np.median(shifts)),
        "grey": float(off.mean()),
        "share_over_1_grey": float((off > TARGET_GREY).mean()),
    }


def in_place(
    one: NDArray[np.float32], other: NDArray[np.float32], valid: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.bool_], float]:
    """The other mosaic (bands, rows, cols) by the affine transform that brings it onto the first, and what
    both then show. Third is the most that it moves a pixel, 0 below the target. The transform maximises
    the enhanced correlation coefficient (Evangelidis and Psarakis 2008)."""
    small = 1.0 / max(1.0, max(valid.shape) / ALIGN_PX)
    a, b, seen = (
        cv2.resize(i, None, fx=small, fy=small, interpolation=cv2.INTER_AREA)
        for i in (one.mean(axis=0), other.mean(axis=0), valid.astype(np.uint8))
    )
    (across, down), _ = cv2.phaseCorrelate(a * (seen > 0), b * (seen > 0), None)
    begun = np.array([[1.0, 0.0, across], [0.0, 1.0, down]], dtype=np.float32)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-7)
    _, found = cv2.findTransformECC(a, b, begun, cv2.MOTION_AFFINE, stop, seen, 5)
    found = np.asarray(found, dtype=np.float64)
    middle = (1.0 / small - 1.0) / 2.0
    found[:, 2] = found[:, 2] / small + found[:, :2] @ [middle, middle] - middle
    rows, cols = valid.shape
    corners = np.array([[0.0, 0.0], [cols, 0.0], [0.0, rows], [cols, rows]])
    moved_px = float(np.linalg.norm(corners @ (found[:, :2] - np.eye(2)).T + found[:, 2], axis=1).max())
    if moved_px < TARGET_PX:
        return other, valid, 0.0
    how = cv2.WARP_INVERSE_MAP | cv2.INTER_LANCZOS4
    warped = np.stack([cv2.warpAffine(band, found, (cols, rows), flags=how) for band in other])
    there = cv2.warpAffine(valid.astype(np.float32), found, (cols, rows), flags=how)
    return np.clip(warped, 0.0, 255.0), valid & (there > 0.999), moved_px


def shifts_px(one: NDArray[Any], other: NDArray[Any], valid: NDArray[np.bool_]) -> Iterator[float]:
    """Of squares that both show and that have texture."""
    down, across = np.gradient(other)
    for row in range(0, valid.shape[0] - SQUARE_PX, SQUARE_PX):
        for col in range(0, valid.shape[1] - SQUARE_PX, SQUARE_PX):
            here = np.s_[row : row + SQUARE_PX, col : col + SQUARE_PX]
            slopes = np.column_stack([across[here].ravel(), down[here].ravel()])
            if valid[here].all() and np.abs(slopes).mean() > LEAST_GRADIENT:
                step = np.linalg.lstsq(slopes, (other[here] - one[here]).ravel(), rcond=None)[0]
                yield float(np.hypot(*step))


def simulated(asked: argparse.Namespace) -> Iterator[Flight]:
    """Blocks of so many lines and one more, by how good their positions are."""
    for k, name in enumerate(asked.positions):
        plan = SurveyPlan(
            lines=asked.lines + 1, frames_per_line=asked.per_line, width_px=asked.width,
            height_px=asked.height, seed=asked.seed, position_sd_m=POSITIONS[name][0],
            height_sd_m=POSITIONS[name][1], exposure_sd=EXPOSURE_SD,
        )  # fmt: skip
        survey = asked.out.resolve() / str(k) / "survey"
        shutil.rmtree(survey.parent, ignore_errors=True)
        simulate_frames(survey, plan)
        of = f"{asked.width} x {asked.height} px, {name}"
        words = ("--pos", survey / "pos.csv", "--camera", survey / "cameras.json")
        yield Flight(of, survey / "frames", asked.per_line, words)


def main(argv: list[str] | None = None) -> int:
    """Runs what is asked for and merges the results."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (
        *(("lines", 20), ("per-line", 50), ("width", 480)),
        *(("height", 360), ("seed", 1), ("workers", 2), ("added", 10)),
    ):
        ask.add_argument(f"--{name}", type=int, default=default)
    ask.add_argument("--positions", nargs="*", choices=POSITIONS, default=list(POSITIONS))
    ask.add_argument("--frames", type=Path, help="a real flight in place of simulated ones")
    ask.add_argument("--out", type=Path, default=Path("out/bench-incremental"))
    ask.add_argument("--results", type=Path, default=Path("docs/results/incremental"))
    asked = ask.parse_args(argv)
    if asked.frames is None:
        flights = simulated(asked)
    else:
        name = asked.frames.parent.name if asked.frames.name == "images" else asked.frames.name
        flights = iter([Flight(f"real, {name}", asked.frames.resolve(), asked.added)])
    given = shlex.join(map(str, sys.argv[1:] if argv is None else argv))
    made = {
        "command": re.sub(r" --(?:out|results) \S+", "", f"python -m tools.bench.bench_incremental {given}"),
        "date": datetime.date.today().isoformat(),
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}",
        "commit": commit(),
        "seed": asked.seed,
    }
    rows = []
    for k, flight in enumerate(flights):
        rows.append({**case(flight, asked.out.resolve() / str(k) / "case", asked.workers), **made})
        print(json.dumps(rows[-1]), flush=True)
    merge(rows, asked.results)
    return 0 if all(r[key] <= most for r in rows for key, most in TARGETS.items()) else 1


def merge(new: Sequence[Row], to: Path) -> None:
    """RESULTS.json and RESULTS.md: new rows replace those of as many frames of the same flight."""
    to.parent.mkdir(parents=True, exist_ok=True)
    path = to.with_suffix(".json")
    before = json.loads(path.read_text())["rows"] if path.exists() else []
    by_flight = {(r["positions"], r["frames_before"], r["frames_added"]): r for r in (*before, *new)}
    rows = list(by_flight.values())
    of = {"title": "Frames added by --incremental", "command": "make bench-incremental"}
    results = {**of, "date": max(r["date"] for r in rows), "targets": TARGETS, "rows": rows}
    path.write_text(json.dumps(results, indent=1) + "\n")
    lines = [
        f"# {results['title']}",
        "",
        "`make bench-incremental`; machine, date, command, commit and seed are in the JSON. Other programs "
        "ran; times are of the processors.",
        "",
        f"| | target | {' | '.join(r['positions'] for r in rows)} |",
        f"|---|---|{'---|' * len(rows)}",
    ]

    def line(name: str, target: object, cells: Sequence[object]) -> None:
        lines.append(f"| {name} | {target} | {' | '.join(map(str, cells))} |")

    def verdict(value: float, most: float) -> str:
        return f"{value:.3f}" if value <= most else f"**{value:.3f}**"

    line("frames before + added", "", [f"{r['frames_before']} + {r['frames_added']}" for r in rows])
    line("share of a whole run's time", 0.1, [verdict(r["share_of_time"], TARGET_SHARE) for r in rows])
    line(
        "its seconds",
        "",
        [f"{r['added']['processor_s']:.0f} of {r['whole']['processor_s']:.0f}" for r in rows],
    )
    line("place of the whole map, px", "", [f"{r.get('place_px', 0.0):.2f}" for r in rows])
    line("shift, 95 % of the squares, px", 0.1, [verdict(r["shift_px"], TARGET_PX) for r in rows])
    line("difference, mean, grey levels", 1, [verdict(r["grey"], TARGET_GREY) for r in rows])
    line("pixels off by more than 1 grey level", "", [f"{100 * r['share_over_1_grey']:.1f} %" for r in rows])
    for what in ("frames", "tiles"):
        kept = [f"{r['reused'].get(what, 0)} of {r['reused'].get(f'{what}_of', 0)}" for r in rows]
        line(f"{what} of the run before", "", kept)
    line("adjustment from the solution before", "", [r["reused"].get("adjustment") for r in rows])
    to.with_suffix(".md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    sys.exit(main())
