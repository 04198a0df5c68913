"""What a command takes: wall and processor time, the peak memory of all its processes together, disk."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import psutil

SAMPLE_S = 0.1
MOST_SHARE = 0.05
"""Of one processor, for sampling: the shares of large processes' pages take tenths of a second to count."""


@dataclass(frozen=True)
class Taken:
    """What a command took.

    processor_s: user and system, of all processes that were waited for. peak_mb: the largest sum over the
    process tree of the memory of each, shared pages by shares (PSS), sampled every 0.1 s or more.

    code: its exit code. stopped: why it was ended before its time, empty where it wasn't. said: its words.
    """

    wall_s: float
    processor_s: float
    peak_mb: float
    code: int
    stopped: str
    said: str

    @property
    def failed(self) -> str:
        """Why there is no result, or nothing."""
        if self.stopped or self.code == 0:
            return self.stopped
        return f"exit code {self.code}: {(self.said.strip().splitlines() or ['nothing said'])[-1][:200]}"


def measured(
    command: Sequence[str | Path],
    log: Path,
    *,
    most_s: float = 7200.0,
    most_mb: float = 16_000.0,
    env: dict[str, str] | None = None,
) -> Taken:
    """Runs a command to its end, or until it takes more than most_s or holds more than most_mb.

    What it says goes to the file `log`.
    """
    start = time.perf_counter()
    with log.open("wb") as file:
        process = subprocess.Popen(list(map(str, command)), stdout=file, stderr=subprocess.STDOUT, env=env)
        peak_mb, stopped = 0.0, ""
        used_s: dict[int, float] = {}
        pause_s = SAMPLE_S
        while True:
            with suppress(subprocess.TimeoutExpired):
                process.wait(pause_s)
                break
            began = time.thread_time()
            peak_mb = max(peak_mb, used_mb(process.pid))
            used_s |= processors_s(process.pid)
            pause_s = max(SAMPLE_S, (time.thread_time() - began) / MOST_SHARE)
            if time.perf_counter() - start > most_s:
                stopped = f"stopped after {most_s:.0f} s"
            elif peak_mb > most_mb:
                stopped = f"stopped at {peak_mb / 1e3:.1f} GB"
            if stopped:
                _end(process)
                break
    wall_s = time.perf_counter() - start
    said = log.read_text(errors="replace")
    return Taken(wall_s, sum(used_s.values()), peak_mb, process.returncode, stopped, said)


def processors_s(pid: int) -> dict[int, float]:
    """Seconds of processors that a process and each of those below it have taken so far, by number: sampled,
    since not all of them are waited for by whoever measures."""
    used = {}
    with suppress(psutil.Error):
        root = psutil.Process(pid)
        for one in [root, *root.children(recursive=True)]:
            with suppress(psutil.Error):
                times = one.cpu_times()
                used[one.pid] = times.user + times.system
    return used


def used_mb(pid: int) -> float:
    """What a process and all below it hold, in MB."""
    used = 0
    with suppress(psutil.Error):
        root = psutil.Process(pid)
        for one in [root, *root.children(recursive=True)]:
            with suppress(psutil.Error):
                used += one.memory_full_info().pss
    return used / 1e6


def _end(process: subprocess.Popen[bytes]) -> None:
    with suppress(psutil.Error):
        for child in psutil.Process(process.pid).children(recursive=True):
            with suppress(psutil.Error):
                child.kill()
    process.kill()
    process.wait()


def on_disk(folder: Path) -> float:
    """Bytes that a folder's files take, those of several names once; vanished files count nothing."""
    sizes = {}
    for base, _, names in os.walk(folder):
        for name in names:
            with suppress(FileNotFoundError):
                is_now = (Path(base) / name).lstat()
                sizes[is_now.st_ino] = 512 * is_now.st_blocks
    return float(sum(sizes.values()))
