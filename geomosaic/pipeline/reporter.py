"""Whoever shows a run's progress to people."""

from __future__ import annotations

from typing import Literal, Protocol

Source = Literal["work", "cache", "recording"]
"""Where a stage's outcome is from: it was worked out, or taken from RUN/work or from a recording."""


class Reporter(Protocol):
    """What the runner tells. `progress` may come before the first stage: inputs are being read."""

    def stage_started(self, index: int, total: int, name: str) -> None:
        """Stage `index` (from 0) of `total` begins."""

    def progress(self, done: int, total: int, text: str) -> None:
        """So much of the present stage is done."""

    def warning(self, text: str) -> None:
        """A stage's warning."""

    def note(self, text: str) -> None:
        """What a stage tells that is no warning."""

    def stage_finished(self, seconds: float, source: Source) -> None:
        """The present stage is done."""


class Silent:
    """A reporter that shows nothing."""

    def stage_started(self, index: int, total: int, name: str) -> None:
        """Nothing."""

    def progress(self, done: int, total: int, text: str) -> None:
        """Nothing."""

    def warning(self, text: str) -> None:
        """Nothing."""

    def note(self, text: str) -> None:
        """Nothing."""

    def stage_finished(self, seconds: float, source: Source) -> None:
        """Nothing."""
