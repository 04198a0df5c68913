"""Whether time and memory grow with the frames and no faster: 50 to 5,000 frames from pixels to mosaic.

    python -m tools.bench.bench_scale [--frames 50 100 ...] [--seed 1] [--no-plan]
                                      [--out DIR] [--results FILE]

The largest block, of frames of 640 x 480 px, is simulated and kept in OUT; smaller ones are rectangles cut
out of it, whose frames are the same. Each goes through the whole command; what a frame takes by stage
is read from run.json, its memory sampled over all processes, its run folder every ten seconds. What a run
takes however few frames it has is in it, so that figures may fall. A larger block has more overlapping pairs
a frame, since fewer frames lie at its rim: they are listed too.

Then the composition's planning of 50,000 windows over 7,000 frames (bench_scale_plan.py), in a process of its
own; `make bench-bundle` adjusts by observations alone. RESULTS.json and RESULTS.md hold the tables,
RESULTS.svg a plot. Exit code 1 if a target is missed.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import rasterio

from geomosaic.report.plots import Axis, Series, line_plot
from tools.bench.bench_flights import PROGRAM, commit
from tools.bench.bench_scale_rows import result_rows
from tools.bench.bench_speed_measure import measured, on_disk
from tools.bench.result_rows import add_options, write_rows

BLOCKS = {
    50: (5, 10), 100: (10, 10), 200: (10, 20), 500: (20, 25), 1000: (25, 40), 2000: (40, 50), 5000: (50, 100)
}  # fmt: skip
"""Lines and frames in each by the number of frames."""
FLIGHT = ["--width-px", "640", "--height-px", "480"]
TARGETS = {"growth": 1.25, "peak_gb": 4.0, "disk": 1.5, "plan_s": 60.0}
"""Time of a frame over that of a smaller run, memory of all processes, the run folder over the raw mosaic."""
MOST_S = 4.0 * 3600.0
LOOK_S = 10.0


@dataclass(frozen=True)
class ScaleRun:
    """One block through the whole command; disk: the largest run folder over the raw mosaic."""

    frames: int
    tied: int
    pairs: int
    wall_s: float
    processor_s: float
    peak_mb: float
    disk: float
    stages_s: dict[str, float]

    @property
    def frame_s(self) -> float:
        """What a frame takes."""
        return self.wall_s / self.frames


@dataclass(frozen=True)
class ScaleFlight:
    """A simulated flight, every other line of which is flown back, and the frames in each line."""

    folder: Path
    per_line: int

    def cut_out(self, lines: int, per_line: int, to: Path) -> Path:
        """The first frames of the first lines, as hard links."""
        shutil.rmtree(to, ignore_errors=True)
        to.mkdir(parents=True)
        for line in range(lines):
            for k in range(per_line):
                number = line * self.per_line + (k if line % 2 == 0 else self.per_line - 1 - k) + 1
                os.link(self.folder / "frames" / f"F{number:04d}.jpg", to / f"F{number:04d}.jpg")
        return to


def fly(out: Path, seed: int, frames: int) -> ScaleFlight:
    """The flight of so many frames, simulated if it isn't there yet."""
    lines, per_line = BLOCKS[frames]
    folder = out / f"flight-{lines}x{per_line}-{seed}"
    if not (folder / "done").exists():
        shutil.rmtree(folder, ignore_errors=True)
        size = ["--lines", lines, "--frames-per-line", per_line, "--seed", seed]
        subprocess.run(
            list(map(str, [PROGRAM, "simulate", "frames", folder, *FLIGHT, *size])),
            check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        (folder / "done").touch()
    return ScaleFlight(folder, per_line)


@contextmanager
def folder_watched(folder: Path) -> Iterator[list[float]]:
    """The bytes on disk of a folder that another process fills, every ten seconds and at the end."""
    sizes: list[float] = []
    ended = threading.Event()

    def look() -> None:
        while not ended.wait(LOOK_S):
            sizes.append(on_disk(folder))

    watcher = threading.Thread(target=look)
    watcher.start()
    try:
        yield sizes
    finally:
        ended.set()
        watcher.join()
        sizes.append(on_disk(folder))


def run(frames: int, flight: ScaleFlight, out: Path) -> ScaleRun:
    """A block of so many frames, in a new run folder, which is deleted afterwards but for run.json."""
    of = flight.cut_out(*BLOCKS[frames], out / "frames")
    target = out / f"run-{frames}"
    shutil.rmtree(target, ignore_errors=True)
    log = out / f"run-{frames}.log"
    command = [PROGRAM, "mosaic", of, "-o", target, "--camera", flight.folder / "cameras.json"]
    with folder_watched(target) as sizes:
        taken = measured(command, log, most_s=MOST_S)
    if taken.failed:
        raise SystemExit(f"{frames} frames: {taken.failed}; see {log}")
    summary = json.loads((target / "run.json").read_text())
    with rasterio.open(target / "mosaic.tif") as mosaic:
        raw = mosaic.width * mosaic.height * mosaic.count
    shutil.copy(target / "run.json", out / f"run-{frames}.json")
    shutil.rmtree(target)
    shutil.rmtree(of)
    return ScaleRun(
        frames,
        summary["frames"]["tied"],
        summary["metrics"].get("matching", {}).get("pairs_tied", 0),
        taken.wall_s,
        taken.processor_s,
        taken.peak_mb,
        max(sizes) / raw,
        summary["timings_s"],
    )


def growth(frame_s: list[float]) -> float:
    """The largest of what a frame takes over what it takes in any smaller run; 1 for a single one."""
    grown = [b / min(frame_s[:k]) for k, b in enumerate(frame_s) if k]
    return max(grown, default=1.0)


def table(runs: list[ScaleRun]) -> list[str]:
    """Milliseconds a frame by stage, a column a run, and how far each grows; misses are bold."""
    heads = [f"{r.frames} frames" for r in runs]
    lines = [f"| ms a frame | {' | '.join(heads)} | growth |", f"|---|{'---:|' * (len(runs) + 1)}"]

    def row(name: str, values: list[float], most: float = float("inf")) -> None:
        cells = " | ".join(f"{1e3 * v:.1f}" for v in values)
        lines.append(f"| {name} | {cells} | {_bold(f'{growth(values):.2f}', growth(values) <= most)} |")

    for stage in {name: None for r in runs for name in r.stages_s}:
        values = [r.stages_s.get(stage, 0.0) / r.frames for r in runs]
        if max(values) >= 1e-4:
            row(stage, values)
    row("whole", [r.frame_s for r in runs], TARGETS["growth"])
    row("whole, of processors", [r.processor_s / r.frames for r in runs], TARGETS["growth"])
    for name, cells in (
        ("peak memory, GB", [_bold(f"{r.peak_mb / 1e3:.2f}", _fits(r)) for r in runs]),
        ("run folder over raw mosaic", [_bold(f"{r.disk:.2f}", r.disk <= TARGETS["disk"]) for r in runs]),
        ("pairs a frame", [f"{r.pairs / r.frames:.2f}" for r in runs]),
        ("tied", [_bold(f"{r.tied}", r.tied == r.frames) for r in runs]),
    ):
        lines.append(f"| {name} | {' | '.join(cells)} | |")
    return lines


def _fits(run: ScaleRun) -> bool:
    return run.peak_mb <= 1e3 * TARGETS["peak_gb"]


def _bold(text: str, good: bool) -> str:
    return text if good else f"**{text}**"


def plot(runs: list[ScaleRun]) -> str:
    """What a frame takes by the number of frames: whole, and the three stages that take longest."""
    frames = [r.frames for r in runs]
    longest = sorted(runs[-1].stages_s, key=lambda name: -runs[-1].stages_s[name])[:3]
    series = [Series("whole", frames, [1e3 * r.frame_s for r in runs])]
    series += [
        Series(name, frames, [1e3 * r.stages_s.get(name, 0.0) / r.frames for r in runs]) for name in longest
    ]
    axes = Axis("frames", powers=True), Axis("time a frame", "ms")
    return line_plot(series, *axes, label="What a frame takes by the number of frames")


def plan(out: Path) -> dict[str, Any]:
    """The planning of 50,000 windows: `bench_scale_plan`."""
    script = Path(__file__).parent / "bench_scale_plan.py"
    taken = measured([sys.executable, script], out / "plan.log")
    if taken.failed:
        raise SystemExit(f"the planning: {taken.failed}; see {out / 'plan.log'}")
    planned: dict[str, Any] = json.loads(taken.said)
    return planned


def main() -> int:
    """Runs what is asked for and writes the results."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--frames", type=int, nargs="+", choices=BLOCKS, default=list(BLOCKS))
    ask.add_argument("--seed", type=int, default=1)
    ask.add_argument("--no-plan", action="store_true", help="leave the planning of 50,000 windows out")
    ask.add_argument("--out", type=Path, default=Path("out/bench-scale"))
    ask.add_argument("--results", type=Path, default=Path("docs/results/scale"))
    add_options(ask)
    asked = ask.parse_args()
    out = asked.out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    flight = fly(out, asked.seed, max(asked.frames))
    runs = []
    for frames in sorted(asked.frames):
        runs.append(run(frames, flight, out))
        print("\n".join(table(runs)), flush=True)
    frames_given = " ".join(map(str, sorted(asked.frames)))
    results = {
        "title": "From pixels to the mosaic, by the number of frames",
        "command": f"python -m tools.bench.bench_scale --frames {frames_given} --seed {asked.seed}",
        "date": datetime.date.today().isoformat(),
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}",
        "commit": commit(),
        "seed": asked.seed,
        "targets": TARGETS,
        "growth": {
            "wall": growth([r.frame_s for r in runs]),
            "processors": growth([r.processor_s / r.frames for r in runs]),
        },
        "runs": [asdict(r) for r in runs],
        "plan": None if asked.no_plan else plan(out),
    }
    write(results, table(runs), asked.results)
    asked.results.with_suffix(".svg").write_text(plot(runs))
    write_rows(asked, result_rows(results))
    return int("**" in asked.results.with_suffix(".md").read_text())


def write(results: dict[str, Any], lines: list[str], to: Path) -> None:
    """RESULTS.json and RESULTS.md."""
    to.parent.mkdir(parents=True, exist_ok=True)
    to.with_suffix(".json").write_text(json.dumps(results, indent=1) + "\n")
    targets, planned = results["targets"], results["plan"]
    page = [
        f"# {results['title']}",
        "",
        f"`{results['command']}`, {results['date']}, {results['machine']}, commit {results['commit']}. "
        "Simulated frames of 640 x 480 px.",
        "",
        f"Targets: growth {targets['growth']}, memory {targets['peak_gb']:g} GB over all processes, "
        f"run folder {targets['disk']} times the raw mosaic. What misses its target is bold.",
        "",
        *lines,
    ]
    if planned:
        seconds = sum(planned["seconds"].values())
        page += [
            "",
            f"Planning {planned['windows']} windows over {planned['frames']} frames: "
            f"{_bold(f'{seconds:.1f} s', seconds <= targets['plan_s'])} of {targets['plan_s']:g} s, "
            f"{planned['peak_mb'] / 1e3:.2f} GB.",
        ]
    to.with_suffix(".md").write_text("\n".join(page) + "\n")


if __name__ == "__main__":
    sys.exit(main())
