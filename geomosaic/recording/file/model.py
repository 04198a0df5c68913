"""What a recording holds, as read."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from geomosaic.arrays import Floats, Ints64
from geomosaic.doors.plain import plain_yaml
from geomosaic.errors import FileError


@dataclass
class StageRecord:
    """One stage of a run; `index` counts them in order of execution.

    `finished` is False where the run ended within it; seconds are None where unknown.
    `reads_run`: it reports the run itself, so that equal runs differ in its outputs.
    `written` and `lineage` are what its outputs' fingerprints hold besides their bytes.
    `notes` is what it added to run.json besides its artefacts. begun_ns, ended_ns: by the recording's clock.
    """

    index: int
    stage_id: str
    version: int
    params: dict[str, Any]
    inputs: dict[str, str]
    outputs: dict[str, str] = field(default_factory=dict)
    seconds: float | None = None
    cached: bool = False
    finished: bool = False
    notes: dict[str, Any] = field(default_factory=dict)
    reads_run: bool = False
    written: dict[str, str] = field(default_factory=dict)
    lineage: tuple[str, ...] = ()
    begun_ns: int = 0
    ended_ns: int = 0


@dataclass(frozen=True)
class LogLine:
    """One line of the log. number: of the recording's messages; level is debug, info, warning or error; stage
    and frame may be empty."""

    number: int
    time_ns: int
    level: str
    text: str
    stage: str
    frame: str


@dataclass(frozen=True)
class RoundOffsets:
    """One round of an adjustment, see `Recorder.offsets`.

    pairs: (left, right) names; misalignments_m: (pairs, 2); frames: names; moves_m: (frames, 2);
    each east and north in metres, NaN where unknown.
    """

    stage: str
    stage_index: int
    round_index: int
    pairs: tuple[tuple[str, str], ...]
    misalignments_m: Floats
    frames: tuple[str, ...]
    moves_m: Floats


@dataclass(frozen=True)
class StripCurve:
    """Offsets of one pair of strips at some lines (n,), see `Recorder.strip_offsets`.

    offset_px, sd_px: (n, 2) dcol and dline. label: (n,) 0 measured, 1 bridged, 2 unreliable.
    """

    stage_index: int
    pair: int
    left: str
    right: str
    line: Ints64
    offset_px: Floats
    sd_px: Floats
    label: Ints64


@dataclass(frozen=True)
class StripResidual:
    """What is left between a pair's strips, at the middles of n blocks; see `Recorder.strip_residuals`.

    line: (n,) of the left strip. residual_px: (n, 2) dcol and dline, NaN where unknown. sd_px: (n,).
    """

    stage_index: int
    pair: int
    left: str
    right: str
    line: Ints64
    residual_px: Floats
    sd_px: Floats


@dataclass(frozen=True)
class Jitter:
    """A spectrum (f,), see `Recorder.jitter`; `what` is found or left."""

    stage_index: int
    what: str
    frequency_hz: Floats
    across_px: Floats
    along_px: Floats


@dataclass(frozen=True)
class StageProgress:
    """The last reported progress of a stage: `done` of `total` of what `text` names; memory_bytes 0
    where unknown."""

    stage_id: str
    stage_index: int
    text: str
    done: int
    total: int
    seconds: float
    memory_bytes: int


@dataclass(frozen=True)
class FigureTable:
    """A table: of frames (`row`), or of pairs of `row` and `other`; columns (rows,) by name, NaN where
    unknown; `note` a text for each row, or empty."""

    name: str
    stage_index: int
    row: tuple[str, ...]
    other: tuple[str, ...]
    columns: dict[str, Floats]
    note: tuple[str, ...]

    def column(self, name: str) -> Floats:
        """One column; all unknown if it isn't there."""
        return self.columns.get(name, np.full(len(self.row), np.nan))

    @cached_property
    def number(self) -> dict[str, int]:
        """Each row's number by its name."""
        return {name: k for k, name in enumerate(self.row)}


@dataclass
class ArtefactEntry:
    """An artefact in the recording, not loaded.

    `found` has each part's place: the file offset of its chunk and its sequence number.
    """

    stage_id: str
    stage_index: int
    name: str
    type_name: str
    fingerprint: str
    parts: int
    total_bytes: int
    found: list[tuple[int, int]] = field(default_factory=list)

    @property
    def complete(self) -> bool:
        """Whether every part is there."""
        return len(self.found) == self.parts


@dataclass
class Topic:
    """A topic, the name of its messages' schema, and how many there are."""

    name: str
    schema: str
    messages: int = 0


@dataclass
class Recording:
    """What a recording holds; tie points, thumbnails and the artefacts' bytes stay in the file.

    `problem` is empty for a whole file, else it says where the file ends or what is damaged. with_images:
    whether the other images are kept: JPEGs by topic and name, and chips with their `ChipTies`, worst first.
    metrics, outlines, clouds (points (n, 3)): the latest of each name. transforms, corners: of each frame the
    projection centre (3,) and quaternion x, y, z, w from map, and rays (4, 3) to the image's corners.
    strips_lonlat: outlines of CCD strips on the map. last_ns: of the recording's clock.
    """

    path: Path
    with_images: bool = False
    problem: str = ""
    recipe_yaml: str = ""
    environment: dict[str, Any] = field(default_factory=dict)
    manifest: dict[str, Any] = field(default_factory=dict)
    stages: list[StageRecord] = field(default_factory=list)
    log: list[LogLine] = field(default_factory=list)
    rounds: list[RoundOffsets] = field(default_factory=list)
    strips: list[StripCurve] = field(default_factory=list)
    strip_residuals: list[StripResidual] = field(default_factory=list)
    jitter: list[Jitter] = field(default_factory=list)
    iterations: list[dict[str, Any]] = field(default_factory=list)
    tables: list[FigureTable] = field(default_factory=list)
    metrics: dict[str, Any] = field(default_factory=dict)
    outlines: dict[str, list[tuple[str, Floats]]] = field(default_factory=dict)
    strips_lonlat: list[tuple[str, Floats]] = field(default_factory=list)
    clouds: dict[str, Floats] = field(default_factory=dict)
    transforms: dict[str, tuple[Floats, Floats]] = field(default_factory=dict)
    corners: dict[str, Floats] = field(default_factory=dict)
    images: dict[str, dict[str, bytes]] = field(default_factory=dict)
    chips: list[tuple[bytes, Any]] = field(default_factory=list)
    progress: StageProgress | None = None
    artefacts: list[ArtefactEntry] = field(default_factory=list)
    topics: dict[str, Topic] = field(default_factory=dict)
    last_ns: int = 0

    def table(self, name: str) -> FigureTable:
        """The latest table of a name, or one without rows."""
        nothing = FigureTable(name, -1, (), (), {}, ())
        return next((t for t in reversed(self.tables) if t.name == name), nothing)

    @property
    def whole(self) -> bool:
        """Whether the file was closed and nothing in it is damaged."""
        return not self.problem

    @property
    def verdict(self) -> dict[str, Any]:
        """What its report says of the mosaic, the evidence as a list of mappings; empty without a report."""
        for stage in self.stages:
            report = stage.notes.get("report")
            verdict = report.get("verdict") if isinstance(report, dict) else None
            if isinstance(verdict, dict):
                evidence = verdict.get("evidence")
                listed = evidence if isinstance(evidence, list) else ()
                return {**verdict, "evidence": [e for e in listed if isinstance(e, dict)]}
        return {}

    @property
    def planned(self) -> int:
        """How many stages its recipe has; 0 where that can't be read."""
        try:
            plain = plain_yaml(self.recipe_yaml, None, "")
        except FileError:
            return 0
        stages = plain.get("stages") if isinstance(plain, dict) else None
        return len(stages) if isinstance(stages, list) else 0

    @property
    def warnings(self) -> list[LogLine]:
        """The log's warnings and errors."""
        return [line for line in self.log if line.level in ("warning", "error", "fatal")]
