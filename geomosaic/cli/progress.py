"""A run's progress on stderr: a bar with the time left on a terminal, plain lines otherwise."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from geomosaic.pipeline.reporter import Reporter, Silent, Source
from geomosaic.recording.file.reader import printable

_SECONDS_BETWEEN_LINES = 10.0


def _how(seconds: float, source: Source) -> str:
    texts = {
        "work": f"{seconds:.1f} s",
        "cache": "unchanged, from the cache",
        "recording": "from the recording",
    }
    return texts[source]


def _duration(seconds: float) -> str:
    """Rounded up: to a second below a minute and a half, to a minute below that many hours."""
    if seconds < 90.0:
        return f"{math.ceil(seconds)} s"
    return f"{math.ceil(seconds / 60)} min" if seconds < 5400.0 else f"{math.ceil(seconds / 360) / 10:.1f} h"


class _Lines:
    """A reporter that writes lines of text."""

    _name = ""

    def _say(self, text: str, style: str = "") -> None:
        raise NotImplementedError

    def stage_started(self, index: int, total: int, name: str) -> None:
        self._name = f"[{index + 1}/{total}] {name}"

    def warning(self, text: str) -> None:
        self._say(f"warning: {text}", style="yellow")

    def note(self, text: str) -> None:
        self._say(f"{self._name}: {text}")

    def stage_finished(self, seconds: float, source: Source) -> None:
        self._say(f"{self._name}: {_how(seconds, source)}")


class ProgressLines(_Lines):
    """One line when a stage begins, ends or warns, and one every ten seconds in between.

    When the reader of a pipe goes away, or the disk is full, the run goes on unheard.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream
        self._next_s = time.monotonic() + _SECONDS_BETWEEN_LINES
        self._work: tuple[str, int] = "", 0
        self._begun = 0, 0.0

    def _say(self, text: str, style: str = "") -> None:
        if self._stream is not None:
            try:
                print(printable(text), file=self._stream, flush=True)
            except OSError:
                self._stream = None
        self._next_s = time.monotonic() + _SECONDS_BETWEEN_LINES

    def progress(self, done: int, total: int, text: str) -> None:
        """So much of the present stage is done; the time left is that of these items."""
        now_s = time.monotonic()
        if self._work != (text, total) or done < self._begun[0]:
            self._work, self._begun = (text, total), (done, now_s)
        if now_s >= self._next_s:
            first, begun_s = self._begun
            left_s = (now_s - begun_s) * (total - done) / (done - first) if done > first else 0.0
            left = f", {_duration(left_s)} left" if left_s else ""
            self._say(f"{self._name}: {text} {done} of {total}{left}".replace(":  ", ": "))


class Bar(_Lines):
    """A bar for the present stage, and a line for each finished one."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._task: TaskID | None = None

    def _say(self, text: str, style: str = "") -> None:
        self._progress.console.print(escape(printable(text)), style=style, highlight=False)

    def stage_started(self, index: int, total: int, name: str) -> None:
        super().stage_started(index, total, name)
        self._begin()

    def _begin(self) -> TaskID:
        if self._task is not None:
            self._progress.remove_task(self._task)
        name = escape(self._name or "reading inputs")
        self._task = self._progress.add_task(name, total=None, count="", text="")
        return self._task

    def progress(self, done: int, total: int, text: str) -> None:
        task = self._begin() if self._task is None else self._task
        count = f"{done}/{total}, time left"
        self._progress.update(task, completed=done, total=total, count=count, text=escape(printable(text)))

    def stage_finished(self, seconds: float, source: Source) -> None:
        if self._task is not None:
            self._progress.remove_task(self._task)
            self._task = None
        super().stage_finished(seconds, source)


@contextmanager
def progress(*, quiet: bool = False) -> Iterator[Reporter]:
    """The reporter that suits stderr; a silent one if quiet."""
    if quiet:
        yield Silent()
        return
    console = Console(stderr=True)
    if sys.stderr is None or not console.is_terminal:
        yield ProgressLines(sys.stderr)
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        TimeElapsedColumn(),
        TextColumn("{task.fields[count]}"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[text]}"),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        yield Bar(bar)
