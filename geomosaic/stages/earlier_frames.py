"""Frames of the run that this one goes on from."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.adjustment.procedure.changed_part import moved_m
from geomosaic.arrays import Ints64
from geomosaic.composition.composed_tiles import MOST_MOVED_PX
from geomosaic.pipeline.stage import Context
from geomosaic.survey.model import Survey


def earlier_numbers(survey: Survey, adjusted: Adjusted, pixel_m: float, context: Context) -> Ints64:
    """Of each frame (n,) the number that it had in the run before, -1 where it is new, another, or shows the
    ground `MOST_MOVED_PX` of the mosaic's pixels elsewhere. No tile with such a frame is kept, so that its
    tones and seams are found anew."""
    none = np.full(len(survey.frames), -1)
    if context.earlier is None:
        return none
    before = context.earlier.artefact("survey", Survey)
    was = context.earlier.artefact("adjusted", Adjusted)
    if before is None or was is None or before.work_frame != survey.work_frame:
        return none
    unchanged = context.earlier.unchanged({f.name: Path(f.path) for f in survey.frames})
    number = {frame.name: k for k, frame in enumerate(before.frames) if frame.name in unchanged}
    numbers = np.array([number.get(frame.name, -1) for frame in survey.frames], dtype=np.int64)
    known = np.flatnonzero(numbers >= 0)
    stays = known[moved_m(adjusted, (was.poses, numbers), known) <= MOST_MOVED_PX * pixel_m]
    return np.where(np.isin(np.arange(len(numbers)), stays), numbers, none)
