"""What recording costs: a run with the recording and without, by turns, and the recording's size by topic.

    make bench-recording

It counts single-threaded processor time of whole runs, as others may be at work on the machine. The limits
are 5 % of the time and 1 MB a frame at the level `normal`. Two runs of the same differ by that much where
others are at work. So a last run at `normal` counts what its threads spend within the recorder's calls and
cutting chips.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import resource
import shutil
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path

from mcap.records import Message

from geomosaic.recording.file.mcapfile import items, opened
from tools.bench.result_rows import ResultRow, RowKind, add_options, write_rows
from tools.docs.results_page import RECORDED

MOST_SHARE = 0.05
MOST_MB_A_FRAME = 1.0
ROWS = {
    "time": RowKind(
        RECORDED,
        "time of the recorder, share of the run",
        f"{100.0 * MOST_SHARE:.0f} %",
        "{percent:.1f} %",
    ),
    "size": RowKind(
        RECORDED,
        "size a frame at `normal`",
        f"{MOST_MB_A_FRAME:.0f} MB",
        "{mb:.2f} MB",
    ),
}
_GEOMOSAIC = [sys.executable, "-c", "from geomosaic.cli.main import main; import sys; sys.exit(main())"]


def processor_s(arguments: list[str]) -> float:
    """Processor time of a command and its children, with one thread each."""
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1")
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([*_GEOMOSAIC, *arguments], check=True, capture_output=True, env={**os.environ, **one})
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def within_s(arguments: list[str]) -> tuple[float, float]:
    """Seconds of processor that a run spends within what only a recording needs, and in all."""
    code = "import sys; from tools.bench import bench_recording; bench_recording.counted(sys.argv[1:])"
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1")
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        check=True, capture_output=True, text=True, env={**os.environ, **one}, cwd=Path(__file__).parents[2],
    )  # fmt: skip
    inside, whole = json.loads(done.stdout.splitlines()[-1])
    return inside, whole


def counted(arguments: list[str]) -> None:
    """Runs a command, and prints both. A call within a call counts once."""
    from geomosaic.cli.main import main as command
    from geomosaic.recording.file.writer import STAGE_CALLS, Recorder
    from geomosaic.stages import chips

    here = threading.local()
    spent: list[float] = []

    def count(owner: object, name: str) -> None:
        call = getattr(owner, name)

        @functools.wraps(call)
        def timed(*positional: object, **named: object) -> object:
            if getattr(here, "inside", False):
                return call(*positional, **named)
            here.inside, started = True, time.thread_time()
            try:
                return call(*positional, **named)
            finally:
                here.inside = False
                spent.append(time.thread_time() - started)

        setattr(owner, name, timed)

    runs = ("begin_run", "inputs", "stage_started", "stage_finished", "artefact", "close", "_beat")
    for name in (*STAGE_CALLS, *runs):
        count(Recorder, name)
    for name in ("__init__", "record"):
        count(chips.Chips, name)
    if command(arguments):
        raise SystemExit("the run failed")
    print(json.dumps([sum(spent), time.process_time()]))


def sizes(recording: Path) -> Counter[str]:
    """Bytes of all messages by topic, before they are compressed."""
    found: Counter[str] = Counter()
    with opened(recording) as file:
        for item in items(recording, file):
            if isinstance(item.record, Message):
                found[item.topic] += len(item.record.data)
    return found


def main() -> int:
    """Exit code 1 if a limit is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/bench-recording"))
    parser.add_argument("--frames", type=Path, help="a folder of frames [a simulated survey of 24]")
    parser.add_argument("--rounds", type=int, default=3, help="runs of each level")
    parser.add_argument("--levels", default="off,summary,normal,full")
    add_options(parser)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    frames = given.frames
    if frames is None:
        frames = given.out / "survey" / "frames"
        if not frames.exists():
            flown = ["--lines", "4", "--frames-per-line", "6", "--width-px", "1336", "--height-px", "1002"]
            processor_s(["simulate", "frames", str(given.out / "survey"), *flown, "--seed", "1"])
    spent: dict[str, list[float]] = {level: [] for level in given.levels.split(",")}
    for k in range(given.rounds):
        for level in spent:
            run = given.out / f"run-{level}"
            shutil.rmtree(run, ignore_errors=True)
            command = ["mosaic", str(frames), "-o", str(run), "--workers", "1", "--record", level]
            spent[level].append(processor_s(command))
            print(f"round {k + 1}, {level}: {spent[level][-1]:.2f} s", flush=True)
    count = json.loads((given.out / f"run-{next(iter(spent))}" / "run.json").read_text())["frames"]["total"]
    without = min(spent["off"])
    failed = False
    results: list[ResultRow] = []
    print(f"\n{count} frames, least of {given.rounds} runs\n\n| level | s | more | MB a frame |")
    print("|---|---|---|---|")
    for level, seconds in spent.items():
        recording = given.out / f"run-{level}" / "run.mcap"
        mb = recording.stat().st_size / 1e6 / count if recording.exists() else 0.0
        share = min(seconds) / without - 1.0
        print(f"| {level} | {min(seconds):.2f} | {100.0 * share:+.1f} % | {mb:.2f} |")
        if level == "normal":
            results.append(ROWS["size"].row(mb <= MOST_MB_A_FRAME, mb=mb))
        failed = failed or (level == "normal" and (share > MOST_SHARE or mb > MOST_MB_A_FRAME))
    if "normal" in spent:
        run = given.out / "run-normal"
        shutil.rmtree(run, ignore_errors=True)
        places = [str(path.absolute()) for path in (frames, run)]
        inside, whole = within_s(["mosaic", places[0], "-o", places[1], "--workers", "1"])
        more = 100.0 * inside / (whole - inside)
        results.append(ROWS["time"].row(more <= 100.0 * MOST_SHARE, percent=more))
        print(f"\nwithin the recorder: {inside:.2f} s of {whole:.2f}, {more:+.1f} %")
        print("\n| topic | KB |\n|---|---|")
        for topic, size in sizes(given.out / "run-normal" / "run.mcap").most_common(12):
            print(f"| {topic} | {size / 1e3:.0f} |")
    write_rows(given, results)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
