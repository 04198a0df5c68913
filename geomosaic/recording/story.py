"""What a view shows of a run, taken from its messages one after the other, while it is on or afterwards."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log

from geomosaic.arrays import Floats
from geomosaic.recording.kinds import KINDS
from geomosaic.recording.messages import Kind

SHOWN: Final[Mapping[str, Kind]] = {name: kind for name, kind in KINDS.items() if kind.shown}
"""What a story is made of, by schema."""
_OF_RUN: Final = ("StageEvent", "Progress", "Log", "Metric", "Iteration")
"""Kinds whose time is that of the run."""
THUMBNAILS: Final = "/frames"


@dataclass(frozen=True)
class ToldTable:
    """A table as arrays: see `messages`, `Table`."""

    row: tuple[str, ...]
    other: tuple[str, ...]
    columns: Mapping[str, Floats]
    note: tuple[str, ...]

    def column(self, name: str) -> Floats:
        """One column; all unknown if it isn't there."""
        return self.columns.get(name, np.full(len(self.row), np.nan))

    @cached_property
    def number(self) -> dict[str, int]:
        """Each row's number by its name."""
        return {name: k for k, name in enumerate(self.row)}


NO_TABLE: Final = ToldTable((), (), {}, ())


@dataclass
class StageTime:
    """A stage and when it began and ended, in ns; an end of 0 is none."""

    stage_id: str
    begun_ns: int
    ended_ns: int = 0
    cached: bool = False


@dataclass
class LoggedLine:
    """One line of the log, with its number among the messages."""

    number: int
    time_ns: int
    level: str
    stage: str
    frame: str
    text: str


@dataclass
class Story:
    """The latest of everything. images: JPEGs by topic and name, but those of frames, which may be many.
    chips: JPEG and `ChipTies`, worst first. figures: metrics by name. strips_lonlat: outlines of CCD strips
    on the map."""

    tables: dict[str, ToldTable] = field(default_factory=dict)
    outlines: dict[str, list[tuple[str, Floats]]] = field(default_factory=dict)
    steps: list[Any] = field(default_factory=list)
    spectra: dict[str, Any] = field(default_factory=dict)
    stages: list[StageTime] = field(default_factory=list)
    log: list[LoggedLine] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)
    images: dict[str, dict[str, bytes]] = field(default_factory=dict)
    chips: list[tuple[bytes, Any]] = field(default_factory=list)
    strips_lonlat: list[tuple[str, Floats]] = field(default_factory=list)
    beat: Any = None
    last_ns: int = 0

    def take(self, topic: str, message: Any, number: int, time_ns: int) -> None:
        """Raises ValueError for a message that can't be; whatever else it holds is left."""
        self.last_ns = time_ns if message.DESCRIPTOR.name in _OF_RUN else self.last_ns
        match message.DESCRIPTOR.name:
            case "StageEvent":
                self._take_stage(message, time_ns)
            case "Table":
                self.tables[topic.removeprefix("/tables/")] = _table(message)
            case "Outlines":
                self.outlines[topic.removeprefix("/outlines/")] = _outlines(message)
            case "Iteration":
                self.steps.append(message)
            case "JitterSpectrum":
                self.spectra[topic.rpartition("/")[2]] = message
            case "Metric":
                self.figures[message.name] = json.loads(message.json)
            case "CompressedImage" if topic != THUMBNAILS:
                self.images.setdefault(topic, {})[message.frame_id] = message.data
            case "ChipTies":
                _check_even(message)
                jpeg = self.images.get("/chips", {}).pop(f"{message.left} - {message.right}", None)
                if jpeg is not None:
                    self.chips.append((jpeg, message))
            case "GeoJSON" if topic == "/map/strips":
                self.strips_lonlat = _rings(json.loads(message.geojson))
            case "Progress":
                self.beat = message
            case "Log":
                level = Log.Level.Name(message.level)
                text = message.message.removeprefix(f"{message.file}: ")
                line = LoggedLine(number, time_ns, level, message.name, message.file, text)
                self.log.append(line)

    def _take_stage(self, event: Any, time_ns: int) -> None:
        if not event.finished:
            self.stages.append(StageTime(event.stage_id, time_ns))
        elif self.stages:
            self.stages[-1].ended_ns, self.stages[-1].cached = time_ns, event.cached

    def table(self, name: str) -> ToldTable:
        """A table, or one without rows."""
        return self.tables.get(name, NO_TABLE)


def _table(message: Any) -> ToldTable:
    rows = len(message.row)
    values = np.array(message.value, dtype=np.float64).reshape(len(message.column), rows)
    if len(message.other) not in (0, rows) or len(message.note) not in (0, rows):
        raise ValueError("a table of unequal lengths")
    columns = dict(zip(message.column, values, strict=True))
    return ToldTable(tuple(message.row), tuple(message.other), columns, tuple(message.note))


def _check_even(ties: Any) -> None:
    sides = (ties.left_x_px, ties.left_y_px, ties.right_x_px, ties.right_y_px, ties.weight)
    if len({len(side) for side in sides}) != 1:
        raise ValueError("tie points of unequal lengths")


def _outlines(message: Any) -> list[tuple[str, Floats]]:
    at = np.array([message.east_m, message.north_m], dtype=np.float64).T
    if sum(message.vertices) != len(at) or len(message.vertices) != len(message.name):
        raise ValueError("outlines of unequal lengths")
    if not message.name:
        return []
    ends = np.cumsum(message.vertices, dtype=np.int64)[:-1]
    return list(zip(message.name, np.split(at, ends), strict=True))


def _rings(collection: Any) -> list[tuple[str, Floats]]:
    """Name and outer ring (k, 2) of each polygon. Raises one of several errors for anything else."""
    out = []
    for feature in collection["features"]:
        ring = np.array(feature["geometry"]["coordinates"][0], dtype=np.float64).reshape(-1, 2)
        out.append((str(feature["properties"].get("strip", "")), ring))
    return out
