"""Who does what can be done side by side: a stage's workers, or this process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


class Spread(Protocol):
    """As `pipeline.Context` does it."""

    def map(
        self,
        name: str,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        keys: Sequence[Any] | None = None,
    ) -> list[Result]:
        """Results in the items' order, of a module's own function. keys: tell the items of a name apart
        that is asked for once; else they are told apart by what they hold."""


class AtOnce:
    """In this process, one after the other; check_cancelled raises to stop."""

    def __init__(self, check_cancelled: Callable[[], None] | None = None) -> None:
        self.check_cancelled = check_cancelled

    def map(
        self,
        name: str,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        keys: Sequence[Any] | None = None,
    ) -> list[Result]:
        """See `Spread`."""
        return [self.made(function, item) for item in items]

    def made(self, function: Callable[[Item], Result], item: Item) -> Result:
        """One result, unless this is to stop."""
        if self.check_cancelled is not None:
            self.check_cancelled()
        return function(item)
