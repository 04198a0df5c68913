"""A sign of life of a run, written once a second into its work folder."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from geomosaic.errors import OutputError

EVERY_S = 1.0


@dataclass
class Beat:
    """How far the present stage is, since `begun_s` of the monotonic clock."""

    stage_id: str = ""
    begun_s: float = 0.0
    text: str = ""
    done: int = 0
    total: int = 0


class Heartbeat:
    """Records every second how far the stage is, from a thread of its own. So a stage that computes for
    minutes without reporting progress still shows that it is on.

    write: is given the beat; what can't be written is said by the run's own next message.
    """

    def __init__(self, write: Callable[[Beat], None]) -> None:
        self._write = write
        self._now: Beat | None = None
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def begin(self, stage_id: str) -> None:
        self._now = Beat(stage_id, time.monotonic())
        if self._thread is None:
            self._thread = threading.Thread(target=self._go_on, name="heartbeat", daemon=True)
            self._thread.start()

    def progress(self, done: int, total: int, text: str) -> None:
        """The stage got so far; costs nothing."""
        if self._now is not None:
            now = self._now
            now.text, now.done, now.total = text, done, total

    def rest(self) -> None:
        self._now = None

    def end(self) -> None:
        """The last beat."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()

    def _go_on(self) -> None:
        while not self._ended.wait(EVERY_S):
            if (beat := self._now) is not None:
                with contextlib.suppress(OutputError):
                    self._write(beat)
