"""People's scores: the five levels of CCIR Recommendation 500-1, as table 1 of Yue et al. 2021 uses them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from geomosaic.constants import Because


@dataclass(frozen=True)
class Level:
    """One level: the words for quality and for how far the defects hinder viewing."""

    score: int
    quality: str
    obstruction: str


@dataclass(frozen=True)
class Criterion:
    """Something a viewer scores on the mosaic: a key for the file, a question for the page."""

    key: str
    question: str


CCIR_500_1: Annotated[
    tuple[Level, ...],
    Because(
        "scores",
        "the five levels that people score a mosaic by, so that scores compare with the paper's",
        "CCIR Recommendation 500-1, by table 1 of Yue et al. 2021 (IRLA20200529)",
    ),
] = (
    Level(5, "Excellent", "no loss of quality to be seen"),
    Level(4, "Good", "a loss can be seen but does not hinder viewing"),
    Level(3, "Fair", "a clear loss that hinders viewing slightly"),
    Level(2, "Poor", "hinders viewing"),
    Level(1, "Bad", "hinders viewing very seriously"),
)

CRITERIA = (
    Criterion("geometry", "Lines that cross seams (roads, roofs, field edges) run on unbroken"),
    Criterion("seams", "Seams cannot be seen as lines"),
    Criterion("tone", "Brightness and colour run evenly from frame to frame"),
    Criterion("detail", "Detail is sharp, without ghosts or smear"),
    Criterion("overall", "The mosaic as a whole"),
)
