"""Frames of the run that this one goes on from."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geomosaic.arrays import Ints64
from geomosaic.pipeline.stage import Context
from geomosaic.survey.model import Survey


def earlier_numbers(survey: Survey, context: Context) -> Ints64:
    """Of each frame (n,) the number that it had in the run before, -1 where it is new or another."""
    before = None if context.earlier is None else context.earlier.artefact("survey", Survey)
    if before is None or context.earlier is None:
        return np.full(len(survey.frames), -1)
    unchanged = context.earlier.unchanged({f.name: Path(f.path) for f in survey.frames})
    number = {frame.name: k for k, frame in enumerate(before.frames) if frame.name in unchanged}
    return np.array([number.get(frame.name, -1) for frame in survey.frames], dtype=np.int64)
