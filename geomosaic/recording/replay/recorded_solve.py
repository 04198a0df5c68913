"""What a recording holds of a survey's frames and their adjustment, decoded."""

from __future__ import annotations

from typing import TypeVar

from geomosaic.adjustment.model import Adjusted
from geomosaic.errors import FileError
from geomosaic.matching.model import TiePoints
from geomosaic.pipeline.artefact_reader import decode
from geomosaic.pipeline.artefacts import type_name
from geomosaic.pipeline.former_names import present_name
from geomosaic.placement.model import Placement
from geomosaic.recording.file.model import Recording
from geomosaic.recording.file.reader import artefact_data
from geomosaic.recording.inspect.solved import Solved
from geomosaic.recording.inspect.table_figures import warned
from geomosaic.survey.model import Survey

Kind = TypeVar("Kind")


def solved_of(recording: Recording) -> Solved | None:
    """The survey of frames as far as the run got with it; None where none is recorded (strips, levels without
    artefacts). Raises `FileError` where what is recorded can't be one run's."""
    survey = _last(recording, "survey", Survey)
    if survey is None:
        return None
    solved = Solved(
        survey,
        _last(recording, "prior_placement", Placement),
        _last(recording, "placement", Placement),
        _last(recording, "ties", TiePoints),
        _last(recording, "adjusted", Adjusted),
        warned(recording),
    )
    if problem := solved.problem():
        raise FileError(problem, file=recording.path, fix="run the recipe again")
    return solved


def _last(recording: Recording, name: str, kind: type[Kind]) -> Kind | None:
    """The latest whole artefact of a name and a type that recordings of this version have under it."""
    for entry in reversed(recording.artefacts):
        if entry.name == name and present_name(entry.type_name) == type_name(kind) and entry.complete:
            try:
                value: Kind = decode(artefact_data(recording, entry), kind)
            except FileError as error:
                raise FileError(f"{name}: {error.problem}", file=recording.path, fix=error.fix) from error
            return value
    return None
