"""What the dense surface takes by the number of frames, and whether it is the same whoever works on it."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from bench_real_table import Row
from bench_speed_measure import Taken, measured

GEOMOSAIC = Path(sys.executable).with_name("geomosaic")
BLOCKS = {20: (4, 5), 60: (6, 10), 200: (10, 20)}
"""Lines and frames in each by the number of frames."""
FLIGHT = ["--width-px", "400", "--height-px", "300", "--relief-m", "10", "--buildings-stand",
          "--buildings", "2", "--forward-overlap", "0.7", "--side-overlap", "0.6"]  # fmt: skip
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


def _same_by_two(out: Path, run: Path) -> Row:
    other = out / f"{run.name}-by-two"
    called(out, "replay", run, "-o", other, "--from", STAGE, "--until", STAGE, "--workers", 2, "--overwrite")
    same = _surface_of(run) == _surface_of(other)
    return "one process and two", "the same bytes" if same else "other bytes", "the same", same


def _surface_of(run: Path) -> bytes:
    told = json.loads((run / "run.json").read_text(encoding="utf-8"))
    return (run / told["artefacts"]["surface"]["file"]).read_bytes()


def _run(out: Path, survey: Path, run: Path, *stages: str) -> Taken:
    """A recipe of these stages in the run's folder, which keeps what it has; one process."""
    params = {
        "frames": str((survey / "frames").absolute()),
        "pos": str((survey / "pos.csv").absolute()),
        "camera": str((survey / "cameras.json").absolute()),
    }
    recipe = out / f"{run.name}.yaml"
    steps = [{"stage": id, "params": params if id == "survey.read" else {}} for id in stages]
    recipe.write_text(json.dumps({"name": "scale", "stages": steps}), encoding="utf-8")
    return called(out, "run", recipe, "-o", run, "--workers", 1, "--overwrite")


def called(out: Path, *command: object) -> Taken:
    """A command of geomosaic's; what it says goes to OUT/said.log. Ends the bench if it fails."""
    taken = measured([GEOMOSAIC, *map(str, command)], out / "said.log")
    if taken.failed:
        raise SystemExit(f"geomosaic {' '.join(map(str, command))}: {taken.failed}")
    return taken
