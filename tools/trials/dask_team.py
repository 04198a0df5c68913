"""A Dask scheduler and its workers as processes of their own on loopback, to be hit."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LONGEST_S = 60.0


def can_hide() -> bool:
    """Whether this user may start workers that do not see all folders."""
    return shutil.which("unshare") is not None and not subprocess.run(
        ["unshare", "--mount", "mount", "-t", "tmpfs", "none", "/mnt"], capture_output=True, check=False
    ).returncode  # fmt: skip


class Team:
    """One scheduler, and workers of one thread without anybody who starts them again.

    hidden: a folder that is empty for the workers, as on other machines.
    """

    def __init__(self, folder: Path, workers: int = 2, hidden: Path | None = None) -> None:
        self.folder = folder
        self._hidden = hidden
        self._file = folder / "scheduler.json"
        self.scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        self._processes = [self.scheduler]
        self.workers: list[subprocess.Popen[bytes]] = []
        deadline = time.monotonic() + LONGEST_S
        while not (self._file.is_file() and self._file.stat().st_size):
            if time.monotonic() > deadline:
                raise TimeoutError((folder / "dask.log").read_text())
            time.sleep(0.05)
        self.address = str(json.loads(self._file.read_text())["address"])
        for _ in range(workers):
            self.join()

    def join(self) -> None:
        """One more worker, which may come at any time."""
        quiet = ("--no-nanny", "--no-dashboard", "--nthreads", "1", "--host", "127.0.0.1")
        process = self._start("worker", *quiet, "--local-directory", str(self.folder))
        self._processes.append(process)
        self.workers.append(process)

    def wait(self) -> None:
        """Until all workers are at hand."""
        from distributed import Client

        with Client(self.address, timeout=LONGEST_S, set_as_default=False) as client:
            client.wait_for_workers(len(self.workers), timeout=LONGEST_S)

    def kill(self) -> None:
        """A worker dies as for want of memory."""
        worker = self.workers.pop()
        worker.send_signal(signal.SIGKILL)
        worker.wait()

    def close(self) -> None:
        """All of them end."""
        for process in self._processes:
            process.kill()
            process.wait()

    def _start(self, what: str, *words: str) -> subprocess.Popen[bytes]:
        argv = [sys.executable, "-m", "dask", what, "--scheduler-file", str(self._file), *words]
        if self._hidden is not None and what == "worker":
            hide = 'mount -t tmpfs none "$0" && exec "$@"'
            argv = ["unshare", "--mount", "sh", "-c", hide, str(self._hidden), *argv]
        with (self.folder / "dask.log").open("ab") as log:
            environment = os.environ | {
                "PYTHONPATH": os.pathsep.join(sys.path), "DASK_TEMPORARY_DIRECTORY": str(self.folder)
            }  # fmt: skip
            return subprocess.Popen(argv, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment)


@contextmanager
def dask_team(folder: Path, workers: int = 2, hidden: Path | None = None) -> Iterator[Team]:
    """A team for a block."""
    folder.mkdir(parents=True, exist_ok=True)
    team = Team(folder, workers, hidden)
    try:
        team.wait()
        yield team
    finally:
        team.close()
