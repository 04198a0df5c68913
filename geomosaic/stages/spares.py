"""Where stages of a run leave what a frame shows small for each other."""

from __future__ import annotations

from geomosaic.pipeline.stage import Context
from geomosaic.survey.small import EighthColours, HalfGrey, Spare


def spare_of(context: Context, path: str, *, lasting: bool = False) -> Spare:
    """Where a frame's file may lie small. lasting: its colours stay for later runs (0.4 MB of 9 MP)."""
    colours = context.optional_cache(EighthColours, path, EighthColours.version)
    if lasting and colours.path is not None:
        context.lasting_items.append(colours.path)
    return Spare(context.optional_cache(HalfGrey, path, HalfGrey.version), colours)
