"""What stages of this run, and the run that it goes on from, leave of frames for each other."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geomosaic.arrays import Ints64
from geomosaic.pipeline.stage import Context
from geomosaic.survey.model import Survey
from geomosaic.survey.small import EighthColours, HalfGrey, Spare


def earlier_numbers(survey: Survey, context: Context) -> Ints64:
    """Of each frame (n,) the number that it had in the run before, -1 where it is new or another."""
    before = None if context.earlier is None else context.earlier.artefact("survey", Survey)
    if before is None or context.earlier is None:
        return np.full(len(survey.frames), -1)
    unchanged = context.earlier.unchanged(Path(frame.path) for frame in survey.frames)
    number = {frame.name: k for k, frame in enumerate(before.frames) if frame.name in unchanged}
    return np.array([number.get(frame.name, -1) for frame in survey.frames], dtype=np.int64)


def spare_of(context: Context, path: str, *, lasting: bool = False) -> Spare:
    """Where a frame's file may lie small. lasting: its colours stay for later runs (0.4 MB of 9 MP)."""
    colours = context.optional_cache(EighthColours, path)
    if lasting and colours.path is not None:
        context.lasting_items.append(colours.path)
    return Spare(context.optional_cache(HalfGrey, path), colours)
