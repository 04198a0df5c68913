"""Writes the recording of a run: an MCAP file of protobuf messages.

The file grows under its final name, unlike every other result. A run that is killed leaves a file that is
whole up to its last second, and `reader.read_recording` reads it.
"""

from __future__ import annotations

import functools
import io
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

from geomosaic import __version__
from geomosaic.errors import InputError
from geomosaic.recording.file.heartbeat import Beat, Heartbeat
from geomosaic.recording.file.kinds import CALLS, KINDS, kind_of
from geomosaic.recording.file.levels import reaches
from geomosaic.recording.file.mcapfile import DAMAGED
from geomosaic.recording.file.messagefile import MessageFile
from geomosaic.recording.file.plain import json_text, topic_part
from geomosaic.recording.file.privacy import Privacy
from geomosaic.recording.file.run_kinds import Artefact, Progress, StageEvent

PROFILE = "geomosaic"
FORMAT = "1"
RECIPE, ENVIRONMENT, MANIFEST = "recipe.yaml", "environment.json", "manifest.json"
ARTEFACT_PART_BYTES = 1024 * 1024

_OF_RUNNER = ("geomosaic.StageEvent", "geomosaic.Artefact")
STAGE_CALLS = (*CALLS, "left_out")
"""What a stage may record; the other calls are the runner's."""


@dataclass(frozen=True)
class StageEnd:
    """How a stage ended. outputs: their fingerprints by name. seconds: None where it is not recorded.

    cached: whether the outcome was there before. notes: what it adds to run.json, so that a replay can add it
    again. written, lineage: what the fingerprints hold besides the artefacts' bytes (`artefact_fingerprint`).
    peak_memory_bytes: the peak of all processes so far.
    """

    outputs: Mapping[str, str] = field(default_factory=dict)
    seconds: float | None = None
    cached: bool = False
    notes: Mapping[str, Any] | None = None
    written: Mapping[str, str] = field(default_factory=dict)
    lineage: Iterable[str] = ()
    peak_memory_bytes: int = 0


class Recorder:
    """The recording of one run.

    Every call writes at most a few messages and keeps nothing, so memory doesn't grow with the run.
    Arguments are plain values and arrays: a call can be stored and made again. All messages share one
    clock and one counter (the MCAP sequence number), so that they share every timeline; of frames the time
    is that of the exposure (`MessageFile`). With `fixed_time` the clock is a counter and durations are left
    out, so that equal runs give equal bytes.

    The calls of the table of message kinds (`kinds.CALLS`) are methods: `recorder.table(...)`.

    path: None for no file. level: one of LEVELS. memory_bytes: says what all processes hold now. privacy:
    goes over all that is recorded.
    Raises OutputError where the file can't be written; further calls then raise it again.
    """

    def __init__(
        self,
        path: Path | None,
        fixed_time: bool = False,
        *,
        level: str = "normal",
        memory_bytes: Callable[[], int] = lambda: 0,
        privacy: Privacy | None = None,
    ) -> None:
        self.path = path
        self.level = level
        self.fixed_time = fixed_time
        self._memory_bytes = memory_bytes
        self.privacy = privacy
        self._count = -1
        self._stage, self._index, self._iteration = "", 0, 0
        self._file = MessageFile(path, PROFILE, fixed_time)
        self._heartbeat = Heartbeat(self._beat)

    def wants(self, name: str) -> bool:
        """Whether messages of a call, or of a schema, are recorded at this level: what costs time needn't be
        made if not."""
        kind = kind_of(name)
        return reaches(self.level, kind.level if kind is not None else "summary")

    def __getattr__(self, call: str) -> Callable[..., None]:
        if call not in CALLS:
            raise AttributeError(f"'{call}' is no call of a recorder")
        return functools.partial(self._record, call)

    def _record(self, call: str, /, *positional: Any, **named: Any) -> None:
        for topic, message in CALLS[call](*positional, **named):
            own = {"stage_id": self._stage, "stage_index": self._index, "iteration": self._iteration}
            for name in own.keys() & message.DESCRIPTOR.fields_by_name.keys():
                setattr(message, name, own[name])
                self._iteration += name == "iteration"
            self._write(topic, message)

    def begin_run(
        self,
        recipe_yaml: str,
        environment: Mapping[str, Any],
        manifest: Mapping[str, Any] | None = None,
    ) -> None:
        """What the run does and where, written first and put on the disk at once.

        `environment` holds versions and the machine, of values that JSON knows. manifest: see `inputs`; None
        if it comes later.
        """
        described = {"format": FORMAT, "geomosaic": __version__, "fixed_time": str(self.fixed_time).lower()}
        self._file.describe(PROFILE, described)
        if self.privacy is not None:
            recipe_yaml = self.privacy.yaml(recipe_yaml)
            environment = self.privacy.value(environment)
        self._file.attach(RECIPE, "application/yaml", recipe_yaml.encode())
        self._file.attach(ENVIRONMENT, "application/json", json_text(environment).encode())
        self.flush()
        if manifest is not None:
            self.inputs(manifest)
        elif not self.fixed_time:
            self._heartbeat.begin("")

    def inputs(self, manifest: Mapping[str, Any]) -> None:
        """The inputs with their hashes, of values that JSON knows: once, before the first stage."""
        self._heartbeat.rest()
        if self.privacy is not None:
            manifest = self.privacy.value(manifest)
        self._file.attach(MANIFEST, "application/json", json_text(manifest).encode())
        self.flush()

    def stage_started(
        self,
        stage_id: str,
        version: int,
        params: Mapping[str, Any],
        input_fingerprints: Mapping[str, str],
        reads_run: bool = False,
    ) -> None:
        """A stage begins, which is in the file at once; what is recorded until its end belongs to it.

        `reads_run`: it reports the run itself, such as durations, so equal runs differ in its outputs.
        """
        self._count += 1
        self._stage, self._index, self._iteration = stage_id, self._count, 0
        event = StageEvent(stage_id=stage_id, stage_index=self._count, version=version, reads_run=reads_run)
        event.params_json = json_text(params)
        for name, fingerprint in input_fingerprints.items():
            event.inputs.add(name=name, fingerprint=fingerprint)
        self._write("/stages", event)
        self._file.flush(sync=False)
        if not self.fixed_time:
            self._heartbeat.begin(stage_id)

    def progress(self, done: int, total: int, text: str = "") -> None:
        """How far the stage is; the heartbeat tells it within a second."""
        self._heartbeat.progress(done, total, text)

    def left_out(self, schema: str) -> None:
        """Logs that a stage made no messages of a call or a schema, since they weren't recorded then, if they
        are wanted now. This happens when its result comes from the cache."""
        kind = kind_of(schema)
        if kind is not None and self.wants(schema):
            what = kind.schema.rpartition(".")[2]
            text = (
                f"no {what}: they weren't recorded when this was worked out; a run into a new folder has them"
            )
            self.log("info", text, stage=self._stage)

    def _beat(self, beat: Beat) -> None:
        message = Progress(
            stage_id=beat.stage_id,
            stage_index=self._index,
            text=beat.text,
            done=max(beat.done, 0),
            total=max(beat.total, 0),
            seconds=time.monotonic() - beat.begun_s,
            memory_bytes=self._memory_bytes(),
        )
        self._write("/progress", message)
        self._file.flush(sync=False)

    def stage_finished(self, stage_id: str, end: StageEnd) -> None:
        """A stage is done and its artefacts are recorded: all of it is put on the disk."""
        self._heartbeat.rest()
        event = StageEvent(stage_id=stage_id, stage_index=self._index, finished=True, cached=end.cached)
        if end.seconds is not None and not self.fixed_time:
            event.seconds = end.seconds
        if end.peak_memory_bytes and not self.fixed_time:
            event.peak_memory_bytes = end.peak_memory_bytes
        for name, fingerprint in end.outputs.items():
            event.outputs.add(name=name, fingerprint=fingerprint)
        for name, fingerprint in end.written.items():
            event.written.add(name=name, fingerprint=fingerprint)
        event.lineage.extend(sorted(end.lineage))
        if end.notes is not None:
            event.notes_json = json_text(end.notes)
        self._write("/stages", event)
        self.flush()

    def artefact(self, stage_id: str, name: str, type_name: str, fingerprint: str, data: BinaryIO) -> None:
        """An output of a stage as bytes, from which a replay can go on, in parts of 1 MiB."""
        if not self.wants("geomosaic.Artefact") or (self.privacy is not None and self.privacy.places):
            return
        size = data.seek(0, io.SEEK_END)
        data.seek(0)
        parts = max(1, -(-size // ARTEFACT_PART_BYTES))
        for part in range(parts):
            message = Artefact(
                stage_id=stage_id,
                stage_index=self._index,
                name=name,
                type_name=type_name,
                fingerprint=fingerprint,
                part=part,
                parts=parts,
                total_bytes=size,
                data=data.read(ARTEFACT_PART_BYTES),
            )
            self._write("/artefacts", message)

    def _write(self, topic: str, message: Any) -> None:
        if not self.wants(message.DESCRIPTOR.full_name):
            return
        if self.privacy is not None:
            self.privacy.message(message)
        self._file.write(topic, message)

    def copy(self, topic: str, schema: str, data: bytes, captured: bool = False) -> None:
        """A message of another recording as it is, but for its time, unless that is of an exposure
        (`captured`). See `reader.stage_messages`.

        Raises InputError if it is none that a stage records, or damaged.
        """
        if schema == Progress.DESCRIPTOR.full_name:
            return  # how far another run was
        kind = KINDS.get(schema)
        if kind is None or schema in _OF_RUNNER:
            raise InputError(f"no stage records a '{topic_part(schema)}'", fix="replay from an earlier stage")
        try:
            message = kind.of(data)
        except DAMAGED as error:
            raise InputError(f"a {schema} is damaged", fix="replay from an earlier stage") from error
        if "timestamp" in message.DESCRIPTOR.fields_by_name and not captured:
            message.ClearField("timestamp")
        self._write(topic, message)

    def flush(self) -> None:
        """End the chunk and put everything on the disk."""
        self._file.flush()

    def close(self) -> None:
        """Write the summary and the footer, which make the file whole. Closing twice is harmless."""
        self._heartbeat.end()
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._heartbeat.end()
        if error is None or not self._file.failed:
            self.close()
