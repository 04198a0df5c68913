"""Who does what can be done side by side: a stage's workers, or this process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, Protocol, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


class ProgressObserver(Protocol):
    """Shows how far work has come and stops it, as `pipeline.Context` does."""

    def progress(self, done: int, total: int, text: str = "") -> None:
        """done of total are ready; text: of what."""

    def check_cancelled(self) -> None:
        """Raises to stop."""


class Spread(ProgressObserver, Protocol):
    """As `pipeline.Context` does it."""

    def map(
        self,
        name: str,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        keys: Sequence[Any] | None = None,
    ) -> list[Result]:
        """Results in the items' order, of a module's own function. keys: tell the items of a name apart
        that is asked for once; else they are distinguished by what they contain."""


class Unobserved:
    """Shows nothing and never stops."""

    def progress(self, done: int, total: int, text: str = "") -> None:
        """See `ProgressObserver`."""

    def check_cancelled(self) -> None:
        """See `ProgressObserver`."""


UNOBSERVED: Final = Unobserved()


class AtOnce(Unobserved):
    """In this process, one after the other."""

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
        self.check_cancelled()
        return function(item)
