"""Dask without a shared disk: the same bytes, whoever dies or is slow, and what two workers bring.

    python -m tools.bench.bench_cluster [--frames 24] [--seed 1] [--s3-server moto_server]
                                        [--out out/bench-cluster] [--results docs/results/cluster]

A simulated flight is mosaicked on this machine, then by Dask workers. Each worker has a file system of its
own, in which the frames and the run folder are empty (needs root). Cases: four workers; one of them killed
and one stopped for half of each second; the scheduler killed, then the same command with a new one. With a
server of S3 (`pip install 'moto[server]'` in any environment) the frames come from it by `fetch`, and the
results go back to it by `push`. Last, one worker against two, on matching, surface and composition. Exit code
1 if a case's mosaic, sources or positions differ by a byte from those of this machine.
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.survey import simulate_frames
from tools.bench.bench_flights import PROGRAM, commit
from tools.trials.dask_team import can_hide, dask_team

RESULTS = ("mosaic.tif", "sources.tif", "positions.csv")
SPREAD = ("matching.sift", "surface.dense", "mosaic.compose")
PORT = 5057
STORE = {
    "AWS_S3_ENDPOINT": f"127.0.0.1:{PORT}", "AWS_HTTPS": "NO", "AWS_VIRTUAL_HOSTING": "FALSE",
    "AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b", "AWS_REGION": "us-east-1",
}  # fmt: skip
Row = dict[str, Any]


def digests(run: Path) -> dict[str, str]:
    """The hashes of a run's results."""
    return {name: hashlib.blake2b((run / name).read_bytes()).hexdigest() for name in RESULTS}


def program(*words: object) -> int:
    """A command to its end: its exit code."""
    return subprocess.run([*map(str, (PROGRAM, *words))], capture_output=True, check=False).returncode


class ClusterCase:
    """A run that is watched, and hit when one of its stages begins."""

    def __init__(self, frames: Path, run: Path, *words: object) -> None:
        self.words = ["mosaic", frames, "-o", run, "--surface", "dense", "--ortho", "terrain", *words]
        self.run = run

    def done(self, at: str = "", hit: Callable[[], None] | None = None) -> tuple[int, str, float]:
        """Exit code, last line, seconds."""
        started = time.monotonic()
        command = [*map(str, (PROGRAM, *self.words))]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        last = ""
        assert process.stderr is not None
        for line in process.stderr:
            last = line.strip() or last
            if hit is not None and at in line:
                hit, _ = None, hit()
        return process.wait(), last, time.monotonic() - started


@contextmanager
def halting(process: subprocess.Popen[bytes]) -> Iterator[None]:
    """A worker that is stopped for half of each second."""
    over = threading.Event()

    def halt() -> None:
        while not over.wait(0.5):
            process.send_signal(signal.SIGSTOP)
            over.wait(0.5)
            process.send_signal(signal.SIGCONT)

    thread = threading.Thread(target=halt, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def undisturbed(folder: Path, frames: Path, run: Path) -> Row:
    """Four workers."""
    with dask_team(folder / "dask", workers=4, hidden=folder / "far") as team:
        code, last, seconds = ClusterCase(frames, run, "--dask", team.address).done()
    return {"case": "four workers", "exit_code": code, "said": last, "seconds": seconds}


def killed_and_slow(folder: Path, frames: Path, run: Path) -> Row:
    """One worker of four dies while pairs are matched, another one is slow."""
    with dask_team(folder / "dask", workers=4, hidden=folder / "far") as team, halting(team.workers[0]):
        code, last, seconds = ClusterCase(frames, run, "--dask", team.address).done("Match frames", team.kill)
    return {"case": "four workers, one killed, one slow", "exit_code": code, "said": last, "seconds": seconds}


def without_scheduler(folder: Path, frames: Path, run: Path) -> Row:
    """The scheduler dies while tones are evened; the same command goes on with another one."""
    with dask_team(folder / "dask", workers=4, hidden=folder / "far") as team:
        code, last, seconds = ClusterCase(frames, run, "--dask", team.address).done(
            "Even the tones", team.scheduler.kill
        )
    shutil.rmtree(folder / "dask")
    with dask_team(folder / "dask", workers=4, hidden=folder / "far") as team:
        again, _, more = ClusterCase(frames, run, "--dask", team.address).done()
    ended = f"{last} (exit code {code})"
    return {
        "case": "scheduler killed, started anew",
        "exit_code": again,
        "said": ended,
        "seconds": seconds + more,
    }


def stages_s(run: Path) -> dict[str, float]:
    """Seconds of the stages that workers do."""
    timings = json.loads((run / "run.json").read_text())["timings_s"]
    return {stage: timings[stage] for stage in SPREAD}


def scaling(folder: Path, frames: Path) -> Row:
    """One worker against two, without shared disk."""
    seconds = {}
    for count in (1, 2):
        run = folder / "far" / f"by-{count}"
        with dask_team(folder / f"dask-{count}", workers=count, hidden=folder / "far") as team:
            code, last, _ = ClusterCase(frames, run, "--dask", team.address).done()
        if code:
            raise SystemExit(f"{count} workers: {last}")
        seconds[count] = stages_s(run)
    return {stage: round(seconds[1][stage] / seconds[2][stage], 2) for stage in SPREAD} | {"seconds": seconds}


@contextmanager
def s3(server: str) -> Iterator[None]:
    """A server of S3 on this machine, with GDAL's options for it in the environment."""
    process = subprocess.Popen(
        [server, "-p", str(PORT)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    before = dict(os.environ)
    os.environ.update(STORE)
    try:
        for bucket in ("flights", "maps"):
            for _ in range(60):
                made = subprocess.run(
                    ["curl", "-sf", "-X", "PUT", f"http://127.0.0.1:{PORT}/{bucket}"], check=False
                )
                if made.returncode == 0:
                    break
                time.sleep(0.5)
            else:
                raise SystemExit(f"{server} does not answer")
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)
        process.kill()
        process.wait()


def by_store(folder: Path, survey: Path, server: str) -> Row:
    """Frames from the store, results back to it, four workers."""
    from geomosaic.doors.addresses import parsed
    from geomosaic.doors.remote import store

    with s3(server):
        for path in sorted((survey / "frames").iterdir()):
            store(path, parsed(f"s3://flights/one/{path.name}"))
        frames, run = folder / "far" / "fetched", folder / "far" / "by-store"
        fetched = program("fetch", "s3://flights/one/", "-o", frames)
        row = undisturbed(folder, frames, run)
        pushed = program("push", run, "s3://maps/one/")
        back = folder / "back"
        got = program("fetch", "s3://maps/one/", "-o", back)
        codes = [fetched, pushed, got]
        same = (back / "mosaic.tif").read_bytes() == (run / "mosaic.tif").read_bytes()
    code = max(*codes, row["exit_code"])
    return row | {"case": "frames from S3, results to S3", "exit_code": code, "came_back": same}


def main() -> int:
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--frames", type=int, default=24, help="four lines of a quarter of them")
    ask.add_argument("--seed", type=int, default=1)
    ask.add_argument(
        "--s3-server", default=shutil.which("moto_server") or "", help="command of moto's server"
    )
    ask.add_argument("--out", type=Path, default=Path("out/bench-cluster"))
    ask.add_argument("--results", type=Path, default=Path("docs/results/cluster"))
    asked = ask.parse_args()
    if not can_hide():
        print("bench-cluster: skipped: only root may hide folders from workers (unshare --mount)")
        return 0
    out = asked.out.resolve()
    shutil.rmtree(out, ignore_errors=True)
    plan = SurveyPlan(
        lines=4, frames_per_line=asked.frames // 4, width_px=1600, height_px=1200, seed=asked.seed,
        relief_m=3.0, height_above_ground_m=60.0, position_sd_m=0.4, height_sd_m=0.4,
    )  # fmt: skip
    (out / "far").mkdir(parents=True)
    frames = simulate_frames(out / "far" / "survey", plan).frames
    code, last, seconds = ClusterCase(frames, out / "here", "--workers", "2").done()
    if code:
        raise SystemExit(last)
    rows = [
        {"case": "this machine, two workers", "exit_code": 0, "said": "", "seconds": seconds, "same": True}
    ]
    truth = digests(out / "here")
    for case in (undisturbed, killed_and_slow, without_scheduler):
        run = out / "far" / case.__name__
        row = case(out, frames, run)
        row["same"] = row["exit_code"] == 0 and digests(run) == truth
        rows.append(row)
        shutil.rmtree(out / "dask", ignore_errors=True)
    if asked.s3_server:
        row = by_store(out, out / "far" / "survey", asked.s3_server)
        row["same"] = row["exit_code"] == 0 and row["came_back"]
        rows.append(row)
        shutil.rmtree(out / "dask", ignore_errors=True)
    measured = {
        "title": "Dask without a shared disk",
        "command": f"make bench-cluster SEED={asked.seed}",
        "date": datetime.date.today().isoformat(),
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}",
        "commit": commit(),
        "seed": asked.seed,
        "frames": asked.frames,
        "rows": rows,
        "two_over_one": scaling(out, frames),
    }
    write(measured, asked.results)
    return 0 if all(row["same"] for row in rows) else 1


def write(measured: Row, results: Path) -> None:
    """RESULTS.json and RESULTS.md."""
    results.parent.mkdir(parents=True, exist_ok=True)
    results.with_suffix(".json").write_text(json.dumps(measured, indent=1) + "\n")
    faster = measured["two_over_one"]
    lines = [
        f"# {measured['title']}",
        "",
        f"`{measured['command']}`, {measured['date']}, {measured['machine']}, commit {measured['commit']}. "
        f"{measured['frames']} simulated frames of 1600 x 1200 pixels.",
        "",
        "| case | exit code | same bytes as on one machine | seconds | said |",
        "|---|---|---|---|---|",
        *(
            f"| {row['case']} | {row['exit_code']} | {('no', 'yes')[row['same']]} | {row['seconds']:.0f} |"
            f" {row['said'] if 'killed, started' in row['case'] else ''} |"
            for row in measured["rows"]
        ),
        "",
        "| stage | target | one worker's time over that of two |",
        "|---|---|---|",
        *(f"| {stage} | 1.7 | {faster[stage]} |" for stage in SPREAD),
    ]
    results.with_suffix(".md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    sys.exit(main())
