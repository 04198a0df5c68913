"""Inputs that several stages take together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from geomosaic.adjustment.model import Adjusted
from geomosaic.composition.model import Mosaic
from geomosaic.composition.ownership import Ownership
from geomosaic.composition.plugins import BLENDS_GROUP
from geomosaic.composition.strip_compose import StripMosaic
from geomosaic.composition.tones import Tones
from geomosaic.matching.band_registration import RigPoses
from geomosaic.matching.model import TiePoints
from geomosaic.pipeline.function_stage import InputGroup
from geomosaic.projection.ground import GroundSurface
from geomosaic.quality.strips import StripQuality
from geomosaic.survey.model import Survey
from geomosaic.survey.strips import StripGeometry


@dataclass(frozen=True)
class AdjustedSurvey(InputGroup):
    """A survey's frames after the adjustment, and the ground that they look at."""

    survey: Survey
    ground: GroundSurface
    adjusted: Adjusted


@dataclass(frozen=True)
class AdjustedBlock(AdjustedSurvey):
    """These with the tie points between the frames."""

    ties: TiePoints


@dataclass(frozen=True)
class FrameShares(InputGroup):
    """What each frame gives to the mosaic: its part, its tones, and its other bands where it is a rig's."""

    ownership: Ownership
    rig: RigPoses | None = None
    tones: Tones | None = None


@dataclass(frozen=True)
class BandTones(InputGroup):
    """How frames show the ground: their tones, and their other bands where they are a rig's."""

    rig: RigPoses | None = None
    tones: Tones | None = None


@dataclass(frozen=True)
class FrameMosaic(InputGroup):
    """A survey and the mosaic of its frames."""

    survey: Survey
    mosaic: Mosaic


@dataclass(frozen=True)
class ComposedStrips(InputGroup):
    """The scene that CCD strips were composed to."""

    strips: StripGeometry
    strip_mosaic: StripMosaic


@dataclass(frozen=True)
class JudgedScene(ComposedStrips):
    """That scene and how good it is."""

    strip_quality: StripQuality


def plugged_blend(params: Any) -> list[tuple[str, str]]:
    """The blend of a composing stage, which may be another distribution's."""
    return [(BLENDS_GROUP, params.blend)]
