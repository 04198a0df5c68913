"""Results that are too large for memory at once: made by a stage's workers, or by whoever asks for them."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any, Generic, Protocol, TypeVar

from geomosaic import spread
from geomosaic.constants import tuned

Item = TypeVar("Item")
Result = TypeVar("Result")
Made = TypeVar("Made", covariant=True)
_LATEST = tuned(12, "results", "kept in memory: fewer are made again along Hilbert's curve; more take memory")


class SpooledResult(Protocol[Made]):
    """A result that is somewhere, or can be made."""

    def load(self) -> Made: ...

    def look(self) -> Made:
        """As load, where it is wanted again and again, in parts."""


class Spooler(spread.Spread, Protocol):
    """As `pipeline.Context` does it."""

    def spooled(
        self, name: str, function: Callable[[Item], Result], items: Iterable[Item], keys: Sequence[Any]
    ) -> AbstractContextManager[Sequence[SpooledResult[Result]]]:
        """As `map`, but each result is loaded when it is wanted. Nobody asks for items where all results are
        there from before."""


class _Later(Generic[Item, Result]):
    """A result that is made when it is wanted; what was looked at lately is kept."""

    def __init__(self, function: Callable[[Item], Result], item: Item, at_once: InProcessSpooler) -> None:
        self._function, self._item, self._at_once = function, item, at_once
        self._lock = threading.Lock()
        self._made: tuple[Result] | None = None

    def load(self) -> Result:
        """See `SpooledResult`."""
        return self._at_once.made(self._function, self._item)

    def look(self) -> Result:
        """See `SpooledResult`."""
        with self._lock:
            made = self._made or (self.load(),)
            self._made = made
        self._at_once.looked_at(self)
        return made[0]

    def forget(self) -> None:
        """It is made again if it is wanted again."""
        self._made = None


class InProcessSpooler(spread.AtOnce):
    """In this process: spooled results are made when they are loaded, and again if they are loaded again."""

    def __init__(self) -> None:
        self._latest: OrderedDict[int, _Later[Any, Any]] = OrderedDict()
        self._lock = threading.Lock()

    def looked_at(self, one: _Later[Any, Any]) -> None:
        """Keeps it, and forgets what wasn't looked at for longest."""
        with self._lock:
            self._latest[id(one)] = one
            self._latest.move_to_end(id(one))
            while len(self._latest) > _LATEST:
                self._latest.popitem(last=False)[1].forget()

    @contextmanager
    def spooled(
        self, name: str, function: Callable[[Item], Result], items: Iterable[Item], keys: Sequence[Any]
    ) -> Iterator[Sequence[SpooledResult[Result]]]:
        """See `Spooler`."""
        yield [_Later(function, item, self) for item in items]
