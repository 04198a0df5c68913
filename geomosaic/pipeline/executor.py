"""Who does the work: this process, local processes or Dask, all in the shape of `concurrent.futures`.

This module imports nothing heavy, so that a new worker process sets its thread limits before numpy.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.context import SpawnContext
from typing import Any

from geomosaic.errors import GeomosaicError, InputError

_THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


DASK_TIMEOUT_S = 10.0


@dataclass(frozen=True)
class _Failure:
    """An exception on its way home: many can't be pickled whole."""

    kind: type[BaseException]
    args: tuple[Any, ...]
    state: dict[str, Any]
    trace: str

    def error(self) -> BaseException:
        error = self.kind.__new__(self.kind, *self.args)
        error.args = self.args
        error.__dict__.update(self.state)
        error.add_note(f"in a worker process:\n{self.trace}")
        return error


def _guarded(function: Callable[[Any], Any], item: Any) -> tuple[Any, int, int]:
    """(result or failure, process id, peak memory of that process in bytes); runs in the worker."""
    cv2 = sys.modules.get("cv2")
    if cv2 is not None:
        cv2.setNumThreads(1)
    try:
        result = function(item)
    except Exception as error:
        result = _Failure(type(error), error.args, dict(error.__dict__), traceback.format_exc())
    return result, os.getpid(), peak_memory_bytes()


def peak_memory_bytes() -> int:
    """The most memory this process ever held; 0 where the system doesn't tell."""
    try:
        import resource
    except ImportError:
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


class _Here(Executor):
    """Does each task at once in this process."""

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(function(*args, **kwargs))
        return future


def _start_worker() -> None:
    """Limits a new worker to one thread and lets it die with its parent, however that dies."""
    os.environ.update(dict.fromkeys(_THREAD_LIMITS, "1"))
    parent = multiprocessing.parent_process()
    if parent is not None:

        def follow() -> None:
            parent.join()
            os._exit(1)

        threading.Thread(target=follow, daemon=True).start()


class _Processes(SpawnContext):
    """Spawned processes, remembered so that they can be ended."""

    def __init__(self) -> None:
        super().__init__()
        self.started: list[Any] = []

    def Process(self, *args: Any, **kwargs: Any) -> Any:  # type: ignore[override]  # noqa: N802
        process = multiprocessing.get_context("spawn").Process(*args, **kwargs)
        self.started.append(process)
        return process


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Ctrl-C waits, and a process started in here never hears of it: only the parent answers."""
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class Workers:
    """Runs module-level functions on items, wherever that is.

    `workers` processes on this machine (1: no other process), or the Dask cluster at `dask`
    (`tcp://host:port`). Nothing is started before the first task. Use as a context manager; leaving it
    by an exception ends the processes at once.
    """

    def __init__(self, workers: int = 1, dask: str | None = None) -> None:
        self.workers = max(1, workers)
        self.peak_memory_bytes: dict[int, int] = {}
        self._dask = dask
        self._client: Any = None
        self._processes = _Processes()
        self._pool: Executor | None = None

    def _executor(self) -> Executor:
        if self._pool is None:
            if self._dask is not None:
                self._pool = self._dask_executor(self._dask)
            elif self.workers == 1:
                self._pool = _Here()
            else:
                self._pool = ProcessPoolExecutor(self.workers, self._processes, _start_worker)
        return self._pool

    def _dask_executor(self, address: str) -> Executor:
        try:
            distributed: Any = importlib.import_module("distributed")
        except ImportError as error:
            raise InputError("Dask is not installed", mend="pip install 'geomosaic[dask]'") from error
        try:
            self._client = distributed.Client(address, timeout=DASK_TIMEOUT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(
                f"no Dask scheduler answers at {address}", mend="start one or leave --dask away"
            ) from error
        self.workers = max(1, sum(self._client.nthreads().values()))
        executor: Executor = self._client.get_executor(pure=False)
        return executor

    def submit(self, function: Callable[[Any], Any], item: Any) -> Future[Any]:
        """A future of what `result` understands."""
        try:
            with _without_interrupts():
                return self._executor().submit(_guarded, function, item)
        except BrokenProcessPool as error:
            raise _died() from error

    def result(self, future: Future[Any]) -> Any:
        """The function's result, or its exception raised here."""
        try:
            result, pid, peak = future.result()
        except BrokenProcessPool as error:
            raise _died() from error
        self.peak_memory_bytes[pid] = max(peak, self.peak_memory_bytes.get(pid, 0))
        if isinstance(result, _Failure):
            raise result.error()
        return result

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if self._pool is not None:
            if error is not None:
                for process in self._processes.started:
                    process.kill()
            self._pool.shutdown(wait=error is None)
        if self._client is not None:
            self._client.close()


def _died() -> GeomosaicError:
    return GeomosaicError("a worker process died, most likely for want of memory; try fewer with --workers 1")
