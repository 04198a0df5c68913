"""Who does the work: this process, local processes or Dask, all in the shape of `concurrent.futures`."""

from __future__ import annotations

import importlib
import logging
import os
import pickle
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

from geomosaic import __version__
from geomosaic.errors import GeomosaicError, InputError
from geomosaic.pipeline.carrier import CarryingExecutor, RunFiles
from geomosaic.pipeline.hashes import FileHashes
from geomosaic.pipeline.worker_process import (
    TASKS,
    WorkerProcesses,
    safe_and_single,
    start_worker,
    without_interrupts,
    workers_environment,
)

DASK_TIMEOUT_S = 10.0
DASK_PATIENCE_S = 30.0
"""How long a cluster may be without any worker: as long as one takes to be started anew."""


def _guarded(version: str, function: Callable[[Any], Any], item: Any) -> tuple[Any, int, int]:
    """(result, process id, peak memory of that process in bytes); runs in the worker."""
    if version != __version__:
        mine, fix = (
            f"the worker on {socket.gethostname()} has geomosaic {__version__}",
            f"install geomosaic {version} there",
        )
        raise InputError(f"{mine}, the run {version}", fix=fix)
    cv2 = sys.modules.get("cv2")
    if cv2 is not None:
        cv2.setNumThreads(1)
    TASKS.begun += 1
    try:
        return function(item), os.getpid(), peak_memory_bytes()
    except Exception as error:
        error.add_note(f"in a worker process:\n{traceback.format_exc()}")
        raise _portable(error) from None
    finally:
        TASKS.done += 1


def _portable(error: Exception) -> Exception:
    """The error, or what it says where it can't be pickled: it would break the pool."""
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301  made here
    except Exception:
        said = GeomosaicError(f"{type(error).__name__}: {error}")
        said.__notes__ = error.__notes__
        return said
    return error


def peak_memory_bytes() -> int:
    """The peak memory of this process; 0 where the system doesn't say.

    By Linux's own figure of this program's memory: the one that every system keeps of a process begins with
    the memory of the program that started it.
    """
    try:
        status = Path("/proc/self/status").read_text()
        return int(status.partition("VmHWM:")[2].split(maxsplit=1)[0]) * 1024
    except (OSError, IndexError):
        pass
    try:
        import resource
    except ImportError:
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _present_memory_bytes(pid: int) -> int:
    """What a process holds now; 0 where the system doesn't say."""
    try:
        pages = Path(f"/proc/{pid}/statm").read_text().split()[1]
    except (OSError, IndexError):
        return 0
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


class _Here(Executor):
    """Does each task at once in this process."""

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(function(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


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
        self._deserted_s: float | None = None
        self._processes = WorkerProcesses()
        self._pool: Executor | None = None
        self._files: RunFiles | None = None
        self._submitting = threading.Lock()  # it changes how processes start for a moment

    def serve(self, folder: Path, hashes: FileHashes) -> None:
        """Sends files to Dask's workers that do not see the run's disk: its own, and those it reads."""
        self._files = RunFiles(folder, hashes)

    def new_step(self) -> None:
        """Files of the run may have changed: workers elsewhere ask for them anew."""
        if isinstance(self._pool, CarryingExecutor):
            self._pool.new_step()

    @property
    def elsewhere(self) -> bool:
        """Whether tasks run in other processes."""
        return self._dask is not None or self.workers > 1

    def _executor(self) -> Executor:
        if self._pool is None:
            if self._dask is not None:
                self._pool = self._dask_executor(self._dask)
            elif self.workers == 1:
                self._pool = _Here()
            else:
                self._pool = ProcessPoolExecutor(
                    self.workers, self._processes, start_worker, (workers_environment(),)
                )
        return self._pool

    def _dask_executor(self, address: str) -> Executor:
        try:
            distributed: Any = importlib.import_module("distributed")
        except ImportError as error:
            raise InputError("Dask is not installed", fix="pip install 'geomosaic-ortho[dask]'") from error
        try:
            self._client = distributed.Client(address, timeout=DASK_TIMEOUT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(
                f"no Dask scheduler answers at {address}", fix="start one or leave out --dask"
            ) from error
        for name in ("distributed", "distributed.client"):  # whose lines are tracebacks when a cluster dies
            logging.getLogger(name).setLevel(logging.CRITICAL)
        self.check()
        if self._files is not None:
            return CarryingExecutor(self._client, self._files)
        executor: Executor = self._client.get_executor(pure=False)
        return executor

    def memory_bytes(self) -> int:
        """What this process and the workers on this machine hold now."""
        pids = [os.getpid(), *(p.pid for p in self._processes.started if p.pid is not None)]
        return sum(map(_present_memory_bytes, pids))

    def check(self) -> None:
        """Counts who is at work on Dask: workers come and go. To be asked while no result comes.

        Raises: `GeomosaicError` where none is left for long.
        """
        if self._client is None:
            return
        try:
            threads = sum(self._client.nthreads().values())
        except (OSError, ValueError) as error:
            raise self._scheduler_gone() from error
        self.workers = max(1, threads)
        if threads:
            self._deserted_s = None
        elif self._deserted_s is None:
            self._deserted_s = time.monotonic()
        elif time.monotonic() - self._deserted_s > DASK_PATIENCE_S:
            raise GeomosaicError(f"no Dask worker is left at {self._dask}{_AGAIN}")

    def _scheduler_gone(self) -> GeomosaicError:
        return GeomosaicError(f"the Dask scheduler at {self._dask} is gone{_AGAIN}")

    def submit(self, function: Callable[[Any], Any], item: Any) -> Future[Any]:
        """A future of what `result` understands."""
        if self._pool is None and self._dask is None and self.workers > 1:
            with self._submitting, safe_and_single():
                resource_tracker.ensure_running()  # its start lets interrupts through again
        try:
            with self._submitting, without_interrupts(), safe_and_single():
                return self._executor().submit(_guarded, __version__, function, item)
        except BrokenProcessPool as error:
            raise _died() from error

    def result(self, future: Future[Any]) -> Any:
        """The function's result, or its exception raised here."""
        try:
            result, pid, peak = future.result()
        except BrokenProcessPool as error:
            raise _died() from error
        except CancelledError as error:
            raise self._scheduler_gone() from error
        except Exception as error:
            if type(error).__name__ != "KilledWorker":
                raise
            raise GeomosaicError(
                "workers died over the same work, most likely for lack of memory; give them more"
            ) from error
        self.peak_memory_bytes[pid] = max(peak, self.peak_memory_bytes.get(pid, 0))
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


_AGAIN = "; start it anew and run again: finished work is kept"


def _died() -> GeomosaicError:
    return GeomosaicError("a worker process died, most likely for lack of memory; run with --workers 1")
