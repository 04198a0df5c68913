"""Whether time and memory grow with the frames and no faster: 50 to 1,000 frames from pixels to mosaic.

    python -m tools.bench.bench_scale [--out DIR] [--frames 50 100 ...] [--no-bundle] [--no-plan]

One flight of 25 lines of 40 frames of 640 x 480 px is simulated and kept in OUT; smaller ones are rectangles
cut out of it, whose frames are the same. Each goes through the whole command; what a frame takes by stage
is read from run.json, its memory sampled over all processes. What a run takes however few frames it has is
in it, so that figures may fall; they are not to grow by more than a quarter. A larger block has more
overlapping pairs a frame, since fewer frames lie at its rim: they stand beside.

Then the adjustment of 5,000 frames by 1,500,000 observations (bench_bundle.py), and the composition's
planning of 50,000 windows over 7,000 frames (bench_scale_plan.py), each in a process of its own. The
table goes to standard output and OUT/scale.json, a plot to OUT/scale.svg. Exit code 1 if a bound is missed.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from geomosaic.report.plots import Axis, Series, line_plot
from tools.bench.bench_speed_measure import measured

GEOMOSAIC = Path(sys.executable).with_name("geomosaic")
TOOLS = Path(__file__).parent
LINES, PER_LINE = 25, 40
BLOCKS = {50: (5, 10), 100: (10, 10), 200: (10, 20), 400: (20, 20), 1000: (25, 40)}
"""Lines and frames in each by the number of frames."""
FLIGHT = ["--width-px", "640", "--height-px", "480"]
MOST_GROWTH, MOST_GB = 1.25, 2.0
BUNDLE = ["--lines", "50", "--per-line", "100", "--observations", "1500000"]
BUNDLE_MOST_S, BUNDLE_MOST_GB = 600.0, 6.0
PLAN_MOST_S = 60.0


@dataclass(frozen=True)
class Run:
    """One block through the whole command."""

    frames: int
    tied: int
    pairs: int
    wall_s: float
    processor_s: float
    peak_mb: float
    stages_s: dict[str, float]

    @property
    def frame_s(self) -> float:
        """What a frame takes."""
        return self.wall_s / self.frames


def fly(out: Path, seed: int) -> Path:
    """The flight, simulated if it isn't there yet."""
    flight = out / f"flight-{LINES}x{PER_LINE}-{seed}"
    if not (flight / "done").exists():
        shutil.rmtree(flight, ignore_errors=True)
        size = ["--lines", LINES, "--frames-per-line", PER_LINE, "--seed", seed]
        subprocess.run(
            list(map(str, [GEOMOSAIC, "simulate", "frames", flight, *FLIGHT, *size])),
            check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        (flight / "done").touch()
    return flight


def cut_out(flight: Path, lines: int, per_line: int, to: Path) -> Path:
    """The first frames of the first lines, every other of which is flown back, as hard links."""
    shutil.rmtree(to, ignore_errors=True)
    to.mkdir(parents=True)
    for line in range(lines):
        for k in range(per_line):
            number = line * PER_LINE + (k if line % 2 == 0 else PER_LINE - 1 - k) + 1
            os.link(flight / "frames" / f"F{number:04d}.jpg", to / f"F{number:04d}.jpg")
    return to


def run(frames: int, flight: Path, out: Path) -> Run:
    """A block of so many frames, in a new run folder, which is deleted afterwards but for run.json."""
    of = cut_out(flight, *BLOCKS[frames], out / "frames")
    target = out / f"run-{frames}"
    shutil.rmtree(target, ignore_errors=True)
    taken = measured(
        [GEOMOSAIC, "mosaic", of, "-o", target, "--camera", flight / "cameras.json"],
        out / f"run-{frames}.log",
    )
    if taken.failed:
        raise SystemExit(f"{frames} frames: {taken.failed}; see {out / f'run-{frames}.log'}")
    told = json.loads((target / "run.json").read_text())
    shutil.copy(target / "run.json", out / f"run-{frames}.json")
    shutil.rmtree(target)
    shutil.rmtree(of)
    pairs = told["metrics"].get("matching", {}).get("pairs_tied", 0)
    return Run(
        frames,
        told["frames"]["tied"],
        pairs,
        taken.wall_s,
        taken.processor_s,
        taken.peak_mb,
        told["timings_s"],
    )


def growth(frame_s: list[float]) -> float:
    """The largest of what a frame takes over what it takes in any smaller run; 1 for a single one."""
    grown = [b / min(frame_s[:k]) for k, b in enumerate(frame_s) if k]
    return max(grown, default=1.0)


def table(runs: list[Run]) -> list[str]:
    """Milliseconds a frame by stage, a column a run, and how far each grows."""
    heads = [f"{r.frames} frames" for r in runs]
    lines = [f"| ms a frame | {' | '.join(heads)} | growth | |", f"|---|{'---:|' * (len(runs) + 1)}---|"]

    def row(name: str, values: list[float], good: bool | None = None) -> None:
        cells = " | ".join(f"{1e3 * v:.1f}" for v in values)
        verdict = "" if good is None else "ok" if good else "MISSED"
        lines.append(f"| {name} | {cells} | {growth(values):.2f} | {verdict} |")

    for stage in {name: None for r in runs for name in r.stages_s}:
        values = [r.stages_s.get(stage, 0.0) / r.frames for r in runs]
        if max(values) >= 1e-4:
            row(stage, values)
    whole = [r.frame_s for r in runs]
    row("whole", whole, growth(whole) <= MOST_GROWTH)
    row("whole, of processors", [r.processor_s / r.frames for r in runs])
    peaks = [r.peak_mb / 1e3 for r in runs]
    for name, cells, good in (
        ("peak memory, GB", [f"{p:.2f}" for p in peaks], max(peaks) <= MOST_GB),
        ("pairs a frame", [f"{r.pairs / r.frames:.2f}" for r in runs], None),
        ("tied", [f"{r.tied} of {r.frames}" for r in runs], all(r.tied == r.frames for r in runs)),
    ):
        verdict = "" if good is None else "ok" if good else "MISSED"
        lines.append(f"| {name} | {' | '.join(cells)} | | {verdict} |")
    return lines


def plot(runs: list[Run]) -> str:
    """What a frame takes by the number of frames: whole, and the three stages that take longest."""
    frames = [r.frames for r in runs]
    longest = sorted(runs[-1].stages_s, key=lambda name: -runs[-1].stages_s[name])[:3]
    series = [Series("whole", frames, [1e3 * r.frame_s for r in runs])]
    series += [
        Series(name, frames, [1e3 * r.stages_s.get(name, 0.0) / r.frames for r in runs]) for name in longest
    ]
    axes = Axis("frames", powers=True), Axis("time a frame", "ms")
    return line_plot(series, *axes, label="What a frame takes by the number of frames")


def bundle(out: Path, extra: list[str]) -> dict[str, Any]:
    """The adjustment by observations alone; seconds are the method's, memory the whole process's."""
    taken = measured([sys.executable, TOOLS / "bench_bundle.py", "--whole", *extra], out / "bundle.log")
    seconds = re.search(r"^whole\s+([\d.]+)", taken.said, re.MULTILINE)
    if seconds is None:
        raise SystemExit(f"the adjustment: {taken.failed or 'said no time'}; see {out / 'bundle.log'}")
    good = float(seconds[1]) <= BUNDLE_MOST_S and taken.peak_mb <= 1e3 * BUNDLE_MOST_GB
    return {"seconds": float(seconds[1]), "peak_mb": taken.peak_mb, "said": taken.said, "good": good}


def plan(out: Path) -> dict[str, Any]:
    """The planning of 50,000 windows: `bench_scale_plan`."""
    taken = measured([sys.executable, TOOLS / "bench_scale_plan.py"], out / "plan.log")
    if taken.failed:
        raise SystemExit(f"the planning: {taken.failed}; see {out / 'plan.log'}")
    told = json.loads(taken.said)
    return {**told, "peak_mb": taken.peak_mb, "good": sum(told["seconds"].values()) <= PLAN_MOST_S}


def main() -> int:
    """Runs what is asked for and prints the table as it stands at the end."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--out", type=Path, default=Path("out/bench-scale"))
    ask.add_argument("--frames", type=int, nargs="*", choices=BLOCKS, default=list(BLOCKS))
    ask.add_argument("--seed", type=int, default=1)
    ask.add_argument("--no-bundle", action="store_true", help="leave the adjustment of 5,000 frames out")
    ask.add_argument("--no-plan", action="store_true", help="leave the planning of 50,000 windows out")
    asked = ask.parse_args()
    out = asked.out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    results: dict[str, Any] = {}
    good = True
    if asked.frames:
        flight = fly(out, asked.seed)
        runs = [run(frames, flight, out) for frames in sorted(asked.frames)]
        lines = table(runs)
        print("\n".join(lines), flush=True)
        results["runs"] = [asdict(r) for r in runs]
        (out / "scale.svg").write_text(plot(runs))
        good &= not any("MISSED" in line for line in lines)
    if not asked.no_plan:
        results["plan"] = told = plan(out)
        good &= told["good"]
        print(
            f"\nplanning {told['windows']} windows over {told['frames']} frames: "
            f"{sum(told['seconds'].values()):.1f} s, {told['peak_mb'] / 1e3:.2f} GB "
            f"({', '.join(f'{k} {v:.1f} s' for k, v in told['seconds'].items())}), "
            f"at most {PLAN_MOST_S:.0f} s: {'ok' if told['good'] else 'MISSED'}",
            flush=True,
        )
    if not asked.no_bundle:
        results["bundle"] = told = bundle(out, BUNDLE)
        good &= told["good"]
        print(
            f"\n{told['said'].strip()}\nadjustment {told['seconds']:.0f} s, {told['peak_mb'] / 1e3:.2f} GB, "
            f"at most {BUNDLE_MOST_S:.0f} s and {BUNDLE_MOST_GB:.0f} GB: {'ok' if told['good'] else 'MISSED'}"
        )
    (out / "scale.json").write_text(json.dumps(results, indent=1))
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
