"""Whoever shows a run's progress to people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, Protocol

Source = Literal["work", "cache", "recording"]
"""Where a stage's outcome is from: it was worked out, or taken from RUN/work or from a recording."""


class Reporter(Protocol):
    """What the runner reports. `progress` may come before the first stage: inputs are being read."""

    def stage_started(self, index: int, total: int, name: str) -> None:
        """Stage `index` (from 0) of `total` begins."""

    def progress(self, done: int, total: int, text: str) -> None:
        """So much of the present stage is done."""

    def warning(self, text: str) -> None:
        """A stage's warning."""

    def note(self, text: str) -> None:
        """What a stage reports that is no warning."""

    def stage_finished(self, seconds: float, source: Source) -> None:
        """The present stage is done."""


_ONE_BY_ONE = 3


def warning_lines(warnings: Sequence[Mapping[str, str]]) -> list[str]:
    """A stage's warnings (code, frame, text) for people: one line each, but one line with a count for a code
    that concerns more than three frames."""
    frames: dict[str, list[str]] = {}
    for w in warnings:
        if w["frame"]:
            frames.setdefault(w["code"], []).append(w["frame"])
    lines, counted = [], set()
    for w in warnings:
        code, frame, text = w["code"], w["frame"], w["text"]
        many = frames.get(code, [])
        if not frame or len(many) <= _ONE_BY_ONE:
            lines.append(f"{frame}: {text}" if frame else text)
        elif code not in counted:
            counted.add(code)
            names = f"{', '.join(many[:_ONE_BY_ONE])} and {len(many) - _ONE_BY_ONE} more"
            lines.append(f"{len(many)} frames alike ({names}), such as {frame}: {text}")
    return lines


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
