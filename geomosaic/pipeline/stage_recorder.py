"""What a stage records, kept so that a stage taken from the cache records it again."""

from __future__ import annotations

import functools
import inspect
import threading
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any

from geomosaic.errors import FileError
from geomosaic.pipeline.artefact_reader import decode
from geomosaic.pipeline.artefacts import dataclasses_in, encode
from geomosaic.recording.file.kinds import CALLS
from geomosaic.recording.file.writer import STAGE_CALLS, Recorder

_LENGTH_BYTES = 8


class StageRecorder:
    """The recording as a stage sees it: every call goes to `target` at once and is added to `spool`.

    It has the methods that `STAGE_CALLS` names; without a target nothing is recorded. The
    spool is a file of length-prefixed calls, so memory doesn't grow with it. spooled_only: calls don't go to
    the target, which only says what it wants.
    """

    def __init__(
        self,
        target: Recorder | None = None,
        spool: Path | None = None,
        stage: str = "",
        *,
        spooled_only: bool = False,
    ) -> None:
        self._target = target
        self._spooled_only = spooled_only
        self._stage = stage
        self._lock = threading.Lock()
        self._spool = None
        if spool is not None:
            spool.unlink(missing_ok=True)
            self._spool = spool.open("xb")

    def log(self, level: str, text: str, stage: str = "", frame: str = "") -> None:
        """One line; `level` is `debug`, `info`, `warning` or `error`."""
        self._call("log", level=level, text=text, stage=stage or self._stage, frame=frame)

    def wants(self, call: str) -> bool:
        """Whether messages of a call are recorded: what costs time needn't be made if not."""
        wanted = self._target is not None and self._target.wants(call)
        if not wanted:
            self._call("left_out", schema=call)
        return wanted

    def __getattr__(self, method: str) -> Callable[..., None]:
        if method not in STAGE_CALLS:
            raise AttributeError(f"'{method}' is no call of a recorder")
        return functools.partial(self._call, method)

    def _call(self, method: str, *positional: Any, **named: Any) -> None:
        arguments = _signature(method).bind(*positional, **named).arguments
        with self._lock:
            if self._spool is not None:
                data = encode((method, arguments))
                self._spool.write(len(data).to_bytes(_LENGTH_BYTES, "little") + data)
            if self._target is not None and not self._spooled_only:
                getattr(self._target, method)(**arguments)

    def close(self) -> None:
        """Ends the spool."""
        if self._spool is not None:
            self._spool.close()


@functools.cache
def _signature(method: str) -> inspect.Signature:
    return inspect.signature(CALLS.get(method, _left_out))


def _left_out(schema: str) -> None: ...


@functools.cache
def _recorded_classes() -> tuple[type, ...]:
    """The classes that a stage's calls may hold."""
    found: dict[str, type] = {}
    for call in CALLS.values():
        for hint in typing.get_type_hints(call).values():
            dataclasses_in(hint, found)
    return tuple(found.values())


def replay_calls(spool: Path, target: Recorder) -> None:
    """Sends every call of a spool to a recorder, in order. `FileError` if the spool isn't whole."""
    with spool.open("rb") as file:
        left = spool.stat().st_size
        while left:
            size = int.from_bytes(file.read(_LENGTH_BYTES), "little")
            left -= _LENGTH_BYTES + size
            if left < 0:
                raise FileError("the recorded calls are cut short", file=spool)
            call: tuple[str, dict[str, Any]] = decode(file.read(size), tuple, also=_recorded_classes())
            method, arguments = call
            if method not in STAGE_CALLS:
                raise FileError(f"'{method}' is no call of a recorder", file=spool)
            getattr(target, method)(**arguments)
