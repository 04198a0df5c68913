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
    """In this process, one after the other."""

    def map(
        self,
        name: str,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        keys: Sequence[Any] | None = None,
    ) -> list[Result]:
        """See `Spread`."""
        return [function(item) for item in items]
