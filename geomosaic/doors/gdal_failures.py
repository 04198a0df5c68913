"""GDAL's failures as exceptions, those it only logs while it closes a file included."""

from __future__ import annotations

import errno
import shutil
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from geomosaic.doors.bindings import gdal, ogr, osr

gdal.UseExceptions()
ogr.UseExceptions()
osr.UseExceptions()

Progress = Callable[[int, int], None]
_LITTLE_BYTES = 1 << 20


@contextmanager
def gdal_failures(path: Path) -> Iterator[None]:
    """Raises `OSError` (with `ENOSPC` where the disk is full) if GDAL failed to write `path` in the block.

    Datasets must be closed within the block: that is when GDAL notices a full disk.
    """
    failures: list[str] = []

    def note(level: int, _number: int, text: str) -> None:
        if level >= gdal.CE_Failure:
            failures.append(" ".join(text.split()))

    gdal.PushErrorHandler(note)
    try:
        yield
    except RuntimeError as error:
        failures.append(" ".join(str(error).split()))
    finally:
        gdal.PopErrorHandler()
    if failures:
        full = "No space left" in failures[0] or shutil.disk_usage(path.parent).free < _LITTLE_BYTES
        raise OSError(errno.ENOSPC if full else errno.EIO, failures[0])


def close(dataset: Any) -> None:
    """The dataset's end, which may raise: left to Python's own `del`, what it raises is printed and lost.

    GDAL before 3.8 has no `Dataset.Close`.
    """
    if hasattr(dataset, "Close"):
        dataset.Close()
    else:
        dataset.__swig_destroy__(dataset)


class GdalProgress:
    """A callback for GDAL that reports percent and may stop it by raising.

    GDAL can't carry an exception through; `reraise` does so once it has returned. A signal to stop that
    comes while GDAL is at work is answered in the same way.
    """

    def __init__(self, progress: Progress | None) -> None:
        self._progress = progress
        self._raised: BaseException | None = None

    def __call__(self, fraction: float, _text: str, _data: object) -> int:
        """GDAL's contract: 1 to go on, 0 to stop."""
        try:
            if self._progress is not None and self._raised is None:
                self._progress(round(100.0 * fraction), 100)
        except BaseException as error:
            self._raised = error
        return int(self._raised is None)

    @contextmanager
    def reraise(self) -> Iterator[None]:
        """Puts the exception that stopped GDAL in the place of GDAL's own."""
        with self._signals_kept():
            try:
                yield
            except OSError:
                if self._raised is None:
                    raise
        if self._raised is not None:
            raise self._raised

    @contextmanager
    def _signals_kept(self) -> Iterator[None]:
        """What a signal's handler raises is kept: raised in GDAL's callback it would be lost or printed."""
        before: dict[int, Any] = {}

        def keep(number: int, frame: FrameType | None) -> None:
            try:
                before[number](number, frame)
            except BaseException as error:
                self._raised = error

        if threading.current_thread() is threading.main_thread():
            handled = [n for n in (signal.SIGINT, signal.SIGTERM) if callable(signal.getsignal(n))]
            before |= {number: signal.signal(number, keep) for number in handled}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


@contextmanager
def gdal_options(options: Mapping[str, str]) -> Iterator[None]:
    """GDAL's configuration options, in this thread and as long as the block lasts."""
    for key, value in options.items():
        gdal.SetThreadLocalConfigOption(key, value)
    try:
        yield
    finally:
        for key in options:
            gdal.SetThreadLocalConfigOption(key, None)
