"""Roofs lie where they belong, one by one; all else stays on the tie points' ground."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from geomosaic.composition.mosaic_scene import CandidateFrames
from geomosaic.composition.ownership import Ownership
from geomosaic.composition.roof_ownership import with_roofs
from geomosaic.composition.roofs import raised_roofs
from geomosaic.composition.scene import Scene
from geomosaic.pipeline.function_stage import InputGroup, stage
from geomosaic.pipeline.stage import Context
from geomosaic.projection.ground import GroundSurface
from geomosaic.stages.input_groups import AdjustedSurvey
from geomosaic.surface.dtm import TerrainModel
from geomosaic.surface.model import DenseSurface


@dataclass(frozen=True)
class MatchedSurface(InputGroup):
    """The surface that was matched, and the ground below it."""

    surface: DenseSurface
    terrain: TerrainModel


def _conclusions(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """How many roofs were raised."""
    found = summary["metrics"].get("roofs")
    if found is None:
        return []
    return [
        ("roofs", f"{found['raised']} of {found['candidates']} roofs in place; all else as on tie points")
    ]


@stage(
    "mosaic.roofs", "Put roofs in place", group="Mosaic", version=2, outputs=("ground", "ownership"),
    wants_frames=True, conclusions=_conclusions,
)  # fmt: skip
def mosaic_roofs(
    of: AdjustedSurvey, ownership: Ownership, matched: MatchedSurface, context: Context
) -> tuple[GroundSurface, Ownership]:
    """Raises the roofs that at least three frames agree on at their heights, and not on the ground."""
    survey, ground = of.survey, of.adjusted.ground
    frames = CandidateFrames.adjusted(survey, of.adjusted, ground)
    frames = replace(frames, used=ownership.used.tolist())
    views = frames.views()
    surface = matched.surface.ground()
    found = raised_roofs((surface, matched.terrain.ground(), ground), survey.frames, views, context)
    context.metric("roofs.candidates", found.candidates)
    context.metric("roofs.raised", len(found.raised))
    area_m2 = sum(float(np.count_nonzero(one.mask)) * one.on_ground.spacing_m**2 for one in found.raised)
    context.metric("roofs.area_m2", area_m2)
    if not found.raised:
        return ground, ownership
    scene = Scene(survey.work_frame, ground, ownership.grid, views)
    raised = replace(ground, raised=tuple(one.on_ground for one in found.raised))
    return raised, with_roofs(ownership, scene, surface, found.raised, context)
