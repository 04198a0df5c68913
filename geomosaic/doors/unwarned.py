"""Warnings of one kind left out of the whole process while a block lasts, in whatever thread."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager


@contextmanager
def unwarned(kind: type[Warning]) -> Iterator[None]:
    """Warnings of a kind do not show while the block lasts. `warnings.catch_warnings` of two threads would
    put back each other's filters."""
    _filters.begin(kind)
    try:
        yield
    finally:
        _filters.end()


class _Filters:
    """Of all blocks that are on, in whatever threads, the first catches warnings, and the last puts back what
    was there."""

    def __init__(self) -> None:
        self._lock, self._on, self._before = threading.Lock(), 0, ExitStack()

    def begin(self, kind: type[Warning]) -> None:
        with self._lock:
            if not self._on:
                self._before.enter_context(warnings.catch_warnings())
            warnings.simplefilter("ignore", kind)
            self._on += 1

    def end(self) -> None:
        with self._lock:
            self._on -= 1
            if not self._on:
                self._before.close()


_filters = _Filters()
