"""The stage: it adapts between geomosaic and `dark`."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from geomosaic.api import Context, Frame, StageParams, Survey, param, read_pixels, stage
from geomosaic_haze.dark import dark_level


@dataclass(frozen=True)
class Hazes:
    """Of each frame of the survey, in its order: the dark level, 0 (clear) to 1."""

    levels: tuple[float, ...]


def haze_of(frame: Frame, share: float) -> float:
    """The dark level of one frame: done by a worker, and kept on disk."""
    return dark_level(*read_pixels(frame, reduction=8), share)


class HazeParams(StageParams):
    """See each parameter's help."""

    share: float = param(0.01, help="darkest pixels that are used", unit="share", ge=0.0001, le=0.5)
    hazy: float = param(0.25, help="dark level from which a frame is warned of", ge=0.0, le=1.0)


def worst(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """How hazy the worst frame is: a line at the end of a run."""
    return [("haze", f"{summary['metrics']['haze']['worst']:.2f} in the worst frame")]


@stage(
    "haze.estimate", "Estimate haze", group="Haze", version=1, outputs="hazes", results=("haze.csv",),
    conclusions=worst,
)  # fmt: skip
def haze_estimate(survey: Survey, params: HazeParams, context: Context) -> Hazes:
    """Estimates how hazy each frame is, by its darkest pixels."""
    frames = survey.frames
    levels = context.map("haze", partial(haze_of, share=params.share), frames)
    for frame, level in zip(frames, levels, strict=True):
        if level > params.hazy:
            context.warn("frame-hazy", frame.name, f"hazy: its darkest pixels are at {level:.2f} of white")
    context.metric("haze.worst", max(levels))
    with context.writing("haze.csv") as path, path.open("w", encoding="utf-8", newline="") as file:
        rows = zip((frame.name for frame in frames), levels, strict=True)
        csv.writer(file).writerows([("frame", "dark_level"), *rows])
    return Hazes(tuple(levels))
