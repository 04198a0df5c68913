"""The messages of a run and of its stages: passed on at once, or spooled until the stage's turn."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from geomosaic.pipeline.reporter import Reporter
from geomosaic.pipeline.stage_recorder import StageRecorder, replay_calls
from geomosaic.recording.file.writer import Recorder


@dataclass(frozen=True)
class RunLog:
    """Where the messages of a run go: its recording, and whoever shows it to people.

    cancelled: whether the user wants the run to stop.
    """

    recorder: Recorder
    reporter: Reporter
    cancelled: Callable[[], bool]

    def progress(self, done: int, total: int, text: str) -> None:
        """How far it is."""
        self.recorder.progress(done, total, text)
        self.reporter.progress(done, total, text)


class StageLog:
    """The messages of a running stage: passed on at once, or spooled until its turn.

    spool: where its calls of the recorder are kept. early: whether it begins before its turn.
    """

    def __init__(self, log: RunLog, spool: Path, stage_id: str, *, early: bool) -> None:
        self._log = log
        self._early, self._live, self._ended = early, not early, False
        self._notes: list[str] = []
        self._lock = threading.Lock()
        self.spool = spool
        self.calls = StageRecorder(log.recorder, spool, stage_id, spooled_only=early)

    def progress(self, done: int, total: int, text: str) -> None:
        """How far it is, if it is its turn."""
        if self._live:
            self._log.progress(done, total, text)

    def note(self, text: str) -> None:
        """A line for the user."""
        with self._lock:
            if self._live:
                self._log.reporter.note(text)
            else:
                self._notes.append(text)

    def cancelled(self) -> bool:
        """Whether the user wants the run to stop, or the run this stage."""
        return self._ended or self._log.cancelled()

    def turn(self) -> None:
        """Passes on the spooled notes; later ones are passed on at once."""
        with self._lock:
            for text in self._notes:
                self._log.reporter.note(text)
            self._live = True

    def end(self) -> None:
        """The stage is to stop."""
        self._ended = True

    def close(self) -> None:
        """Ends the log: what the stage recorded before its turn is copied into the recording."""
        self.calls.close()
        if self._early and self._live:
            self._early = False
            replay_calls(self.spool, self._log.recorder)
