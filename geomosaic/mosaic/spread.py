"""Who makes what a composition needs of each frame: the stage's workers, or whoever asks for it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
Made = TypeVar("Made", covariant=True)


class Kept(Protocol[Made]):
    """A result that is somewhere, or can be made."""

    def load(self) -> Made: ...


class Spread(Protocol):
    """As `pipeline.Context` does it: functions of a module's own applied to items, by whoever is free."""

    def map(
        self, name: str, function: Callable[[Item], Result], items: Sequence[Item], keys: Sequence[Any]
    ) -> list[Result]:
        """Results in the items' order. keys: tell the items of a name apart."""

    def spooled(
        self, name: str, function: Callable[[Item], Result], items: Sequence[Item], keys: Sequence[Any]
    ) -> AbstractContextManager[Sequence[Kept[Result]]]:
        """The same where results are too large to be held at once: each is loaded when it is wanted."""


@dataclass(frozen=True)
class _Later(Generic[Item, Result]):
    function: Callable[[Item], Result]
    item: Item

    def load(self) -> Result:
        return self.function(self.item)


@dataclass(frozen=True)
class AtOnce:
    """In this process: spooled results are made when they are loaded, and again if they are loaded again."""

    check_cancelled: Callable[[], None] | None = None

    def map(
        self, name: str, function: Callable[[Item], Result], items: Sequence[Item], keys: Sequence[Any]
    ) -> list[Result]:
        """See `Spread`."""
        found = []
        for item in items:
            if self.check_cancelled is not None:
                self.check_cancelled()
            found.append(function(item))
        return found

    @contextmanager
    def spooled(
        self, name: str, function: Callable[[Item], Result], items: Sequence[Item], keys: Sequence[Any]
    ) -> Iterator[Sequence[Kept[Result]]]:
        """See `Spread`."""
        yield [_Later(function, item) for item in items]
