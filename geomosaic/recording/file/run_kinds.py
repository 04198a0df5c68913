"""Kinds of messages of any run: stages, figures, tables, outlines, log, artefacts."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log
from numpy.typing import ArrayLike

from geomosaic.camera.interior import Camera
from geomosaic.recording.file.messages import At, Kind, Topics, own
from geomosaic.recording.file.model import (
    ArtefactEntry,
    FigureTable,
    LogLine,
    Recording,
    StageProgress,
    StageRecord,
)
from geomosaic.recording.file.plain import as_text, json_object, json_text, set_singles, topic_part

MAX_ARTEFACT_BYTES = 4 * 2**30

StageEvent = own(
    "StageEvent",
    # One at a stage's start and one at its end. `seconds` is absent at the start and in a recording with
    # fixed times. `params_json` and `inputs` stand at the start, `outputs` and `notes_json` at the end. An
    # output's fingerprint is of its bytes, of files that the stage wrote (`written`, name and hash) and of
    # all files that it goes back to (`lineage`, sorted), both at the end (`fingerprints.py`).
    # `reads_run`: the stage reports the run itself, durations included, so its outputs differ every time.
    "string stage_id",
    "uint32 stage_index version",
    "bool finished cached",
    "optional double seconds",
    "string params_json",
    "repeated Fingerprint inputs outputs",
    "string notes_json",
    "bool reads_run",
    "repeated Fingerprint written",
    "repeated string lineage",
    "optional uint64 peak_memory_bytes",
    Fingerprint=("string name fingerprint",),
)


def _take_stage(recording: Recording, event: Any, at: At) -> None:
    stages = recording.stages
    if not event.finished:
        if stages and event.stage_index <= stages[-1].index:
            raise ValueError(f"stage {event.stage_id[:80]} begins twice")
        inputs = {f.name: f.fingerprint for f in event.inputs}
        params = json_object(event.params_json)
        stages.append(StageRecord(event.stage_index, event.stage_id, event.version, params, inputs))
        stages[-1].reads_run, stages[-1].begun_ns = event.reads_run, at.time_ns
        return
    if not stages or (stages[-1].index, stages[-1].stage_id) != (event.stage_index, event.stage_id):
        raise ValueError(f"stage {event.stage_id[:80]} ends without having begun")
    stages[-1].outputs = {f.name: f.fingerprint for f in event.outputs}
    stages[-1].seconds = event.seconds if event.HasField("seconds") else None
    stages[-1].notes = json_object(event.notes_json) if event.notes_json else {}
    stages[-1].written = {f.name: f.fingerprint for f in event.written}
    stages[-1].lineage = tuple(event.lineage)
    stages[-1].cached, stages[-1].finished, stages[-1].ended_ns = event.cached, True, at.time_ns


Progress = own(
    "Progress",
    # How far a stage is: `done` of `total` of what `text` names, `seconds` after its start, and the memory
    # of all processes (0: unknown). At most one a second; none in a recording with fixed times.
    "string stage_id",
    "uint32 stage_index",
    "string text",
    "uint64 done total",
    "double seconds",
    "uint64 memory_bytes",
)


def _take_progress(recording: Recording, message: Any, at: At) -> None:
    values = (getattr(message, name) for name in StageProgress.__dataclass_fields__)
    recording.progress = StageProgress(*values)


Artefact = own(
    "Artefact",
    # One part of an encoded artefact; the parts' data joined in order has `total_bytes` bytes.
    "string stage_id",
    "uint32 stage_index",
    "string name type_name fingerprint",
    "uint32 part parts",
    "uint64 total_bytes",
    "bytes data",
)


def _take_artefact(recording: Recording, message: Any, at: At) -> None:
    """The parts of an artefact follow one another; nothing stands between them."""
    artefacts = recording.artefacts
    if message.part == 0:
        if message.total_bytes > MAX_ARTEFACT_BYTES:
            raise ValueError(f"an artefact of {message.total_bytes} bytes")
        names = ("stage_id", "stage_index", "name", "type_name", "fingerprint", "parts", "total_bytes")
        artefacts.append(ArtefactEntry(*(getattr(message, name) for name in names)))
    entry = artefacts[-1] if artefacts else None
    if entry is None or (message.name, message.part) != (entry.name, len(entry.found)):
        raise ValueError(f"part {message.part} of an artefact is out of its order")
    entry.found.append((at.offset, at.number))


def log(level: str, text: str, stage: str = "", frame: str = "") -> Topics:
    """One line, of level debug, info, warning or error, about a stage and a frame if they are named."""
    message = Log(message=as_text(f"{frame}: {text}" if frame else text), name=stage, file=as_text(frame))
    message.level = Log.Level.Value(level.upper())
    yield "/log", message


def _take_log(recording: Recording, log: Any, at: At) -> None:
    level, text = Log.Level.Name(log.level).lower(), log.message.removeprefix(f"{log.file}: ")
    recording.log.append(LogLine(at.number, at.time_ns, level, text, log.name, log.file))


Metric = own(
    "Metric",
    # One figure of a stage, or a whole entry of run.json, as it comes: `json` is its value, `number` too if
    # it is one. The same stand in the stage's `notes_json`.
    "string stage_id",
    "uint32 stage_index",
    "string name",
    "optional double number",
    "string json",
)


def metric(name: str, value: Any) -> Topics:
    """One figure, or a whole entry of run.json: of values that JSON knows. The name's dots nest."""
    message = Metric(name=name, json=json_text(value))
    if isinstance(value, int | float) and not isinstance(value, bool):
        message.number = value
    yield "/metrics", message


def _take_metric(recording: Recording, message: Any, at: At) -> None:
    recording.metrics[message.name] = json.loads(message.json)


Table = own(
    "Table",
    # Any table: rows are frames, or pairs of `row` and `other`. Values stand column by column, NaN where
    # unknown; the columns' names end in units. `note` has a text for each row, or is empty.
    "string stage_id",
    "uint32 stage_index",
    "repeated string row other column",
    "repeated double value",
    "repeated string note",
)


def table(
    name: str,
    rows: Sequence[str],
    columns: Mapping[str, ArrayLike],
    others: Sequence[str] = (),
    notes: Sequence[str] = (),
) -> Topics:
    """A table of frames, or of pairs of frames where `others` has the second ones: numbers by column, whose
    names end in units, NaN where unknown. notes: a text for each row, or none."""
    values = [np.broadcast_to(np.asarray(v, dtype=np.float64), (len(rows),)) for v in columns.values()]
    message = Table(
        row=[as_text(r) for r in rows],
        other=[as_text(o) for o in others],
        column=list(columns),
        value=np.concatenate([np.zeros(0), *values]),
        note=[as_text(n) for n in notes],
    )
    yield f"/tables/{topic_part(name)}", message


def camera(name: str, camera: Camera) -> Topics:
    """A camera's interior orientation as given: pixels with the corner origin, terms of its kind of lens,
    which the note names."""
    columns = {k: v for k, v in asdict(camera).items() if isinstance(v, int | float)}
    return table(f"camera.{name}", [name], columns, notes=[camera.kind])


def _take_table(recording: Recording, message: Any, at: At) -> None:
    rows, columns = len(message.row), tuple(message.column)
    if len(message.value) != rows * len(columns) or len(set(columns)) < len(columns):
        raise ValueError("a table of unequal columns")
    if len(message.other) not in (0, rows) or len(message.note) not in (0, rows):
        raise ValueError("a table of unequal rows")
    values = np.array(message.value, dtype=np.float64).reshape(len(columns), rows)
    recording.tables.append(
        FigureTable(
            at.name,
            message.stage_index,
            tuple(message.row),
            tuple(message.other),
            dict(zip(columns, values, strict=True)),
            tuple(message.note),
        )
    )


Outlines = own(
    "Outlines",
    # Rings or lines in the work frame, one behind the other: `vertices` says how many points each has.
    "string stage_id",
    "uint32 stage_index",
    "repeated string name",
    "repeated uint32 vertices",
    "repeated float east_m north_m",
)


def outlines(what: str, names: Sequence[str], lines_m: Sequence[ArrayLike]) -> Topics:
    """Rings or lines (k, 2 or more) in the work frame, east and north first; points not finite are left
    out."""
    lines = (np.asarray(line, dtype=np.float64) for line in lines_m)
    shown = [line[:, :2] if line.size else np.zeros((0, 2)) for line in lines]
    shown = [line[np.isfinite(line).all(axis=1)] for line in shown]
    east, north = np.concatenate([np.zeros((0, 2)), *shown]).T
    message = Outlines(name=[as_text(n) for n in names], vertices=[len(line) for line in shown])
    set_singles(message, east_m=east, north_m=north)
    yield f"/outlines/{topic_part(what)}", message


def _take_outlines(recording: Recording, message: Any, at: At) -> None:
    at_m = np.array([message.east_m, message.north_m], dtype=np.float64).T
    if sum(message.vertices) != len(at_m) or len(message.vertices) != len(message.name):
        raise ValueError("outlines of unequal lengths")
    ends = np.cumsum(message.vertices, dtype=np.int64)
    parts = np.split(at_m, ends)[: len(ends)]
    recording.outlines[at.name] = list(zip(message.name, parts, strict=True))


RUN_KINDS = (
    Kind(StageEvent, "/stages", "stages", take=_take_stage),
    Kind(Progress, "/progress", "verdict and warnings", take=_take_progress),
    Kind(Metric, "/metrics", "verdict and warnings", calls=(metric,), take=_take_metric),
    Kind(Table, "/tables/NAME", "plan, lists", calls=(table, camera), take=_take_table),
    Kind(Outlines, "/outlines/NAME", "plan", calls=(outlines,), take=_take_outlines),
    Kind(Artefact, "/artefacts", level="normal", take=_take_artefact),
    Kind(Log, "/log", "log", calls=(log,), take=_take_log),
)
