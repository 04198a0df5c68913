"""How worker processes start: with one thread, their parent's environment, and nothing of its state.

A worker process is started with its thread limits in the environment, so that numpy finds them.
"""

from __future__ import annotations

import multiprocessing
import multiprocessing.util
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import forkserver, resource_tracker
from multiprocessing.context import SpawnContext
from types import ModuleType
from typing import Any, Final

from geomosaic.constants import tuned
from geomosaic.pipeline.memory_release import release_memory

ALGEBRA_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""How many threads numpy and scipy start, read when they are first imported."""

_WORKERS_ENVIRONMENT = (*ALGEBRA_THREADS, "OPENCV_FOR_THREADS_NUM", "PYTHONSAFEPATH")
"""What is 1 for processes that are started: threads, and that no module is taken from the current folder."""

_REST_S = tuned(2.0, "s", "idle time before a worker frees its caches: less drops them between tasks")


@dataclass
class _Tasks:
    """How many a worker has begun and done."""

    begun: int = 0
    done: int = 0


TASKS = _Tasks()


def start_worker(environment: dict[str, str]) -> None:
    """Gives a new worker its parent's present environment, since what it is forked from may be older. The
    worker ends with its parent, however that ends, and gives back its memory whenever it is at rest."""
    os.environ.update(environment)
    for name in os.environ.keys() - environment.keys():
        del os.environ[name]
    from geomosaic.pipeline import stored_result  # where there are workers; every command imports this module

    parent = multiprocessing.parent_process()
    if parent is not None:

        def follow() -> None:
            done, given_back = 0, 0
            while parent.is_alive():
                parent.join(_REST_S)
                if done == TASKS.done == TASKS.begun > given_back:
                    stored_result.forget_all()
                    release_memory()
                    given_back = done
                done = TASKS.done
            os._exit(1)

        threading.Thread(target=follow, daemon=True).start()


_FIRST = "geomosaic.pipeline.fork_server"
_FORKS: Final = "forkserver" in multiprocessing.get_all_start_methods()


def prepare_workers(modules: Iterable[str]) -> None:
    """Starts the process that workers are forked from, where the system can. It imports what they need while
    this process goes on, and they share its memory. Later calls do nothing."""
    if _FORKS:
        multiprocessing.get_context("forkserver").set_forkserver_preload([_FIRST, *modules])
        with safe_and_single():
            resource_tracker.ensure_running()  # its start lets interrupts through again
        with without_interrupts(), safe_and_single():
            forkserver.ensure_running()


_CONTEXT: Any = multiprocessing.get_context("forkserver" if _FORKS else "spawn")


class _Process(_CONTEXT.Process):  # type: ignore[misc]
    """A process that doesn't run its parent's script anew: what workers do lies in modules."""

    def start(self) -> None:
        """As every process, but for the script."""
        script = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            super().start()
        finally:
            sys.modules["__main__"] = script


class WorkerProcesses(SpawnContext):
    """Processes with nothing of this one's state, remembered so that they can be ended."""

    def __init__(self) -> None:
        super().__init__()
        self.started: list[Any] = []

    def Process(self, *args: Any, **kwargs: Any) -> Any:  # type: ignore[override]  # noqa: N802
        process = _Process(*args, **kwargs)
        self.started.append(process)
        return process


def workers_environment() -> dict[str, str]:
    """This process's environment with `_WORKERS_ENVIRONMENT`."""
    return {**os.environ, **dict.fromkeys(_WORKERS_ENVIRONMENT, "1")}


def _started(path: bytes, args: Sequence[Any], passfds: Sequence[int]) -> int:
    """Starts a program as `multiprocessing.util.spawnv_passfds` does, with the workers' environment."""
    process = subprocess.Popen(  # noqa: S603 - this interpreter
        [*args],
        executable=path,
        env=workers_environment(),
        pass_fds=tuple(map(int, passfds)),
        restore_signals=False,
    )
    process.returncode = 0  # multiprocessing waits for it, not this object
    return process.pid


@contextmanager
def safe_and_single() -> Iterator[None]:
    """A process started in here has one thread, whatever it imports before its first task, and imports
    nothing from the current folder, where strangers' files may lie.

    It is handed its environment, and this process's own stays as it is. C libraries read that in other
    threads at any time, and a variable that is set or deleted meanwhile ends the process (getenv(3),
    setenv(3)).
    """
    before = multiprocessing.util.spawnv_passfds
    multiprocessing.util.spawnv_passfds = _started
    try:
        yield
    finally:
        multiprocessing.util.spawnv_passfds = before


@contextmanager
def without_interrupts() -> Iterator[None]:
    """Ctrl-C waits, and a process started in here never hears of it: only the parent answers."""
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
