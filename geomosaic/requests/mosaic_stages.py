"""The stages of a mosaic of frames, in order."""

from __future__ import annotations

from typing import Final

STAGES: Final = (
    "survey.read",
    "matching.flying_height",
    "projection.ground",
    "placement.pos",
    "mosaic.estimate",
    "matching.sift",
    "matching.reference",
    "adjustment.solve",
    "adjustment.rig",
    "surface.dense",
    "surface.terrain",
    "mosaic.ground",
    "mosaic.tones",
    "mosaic.seams",
    "mosaic.compose",
    "export.cog",
    "export.surface",
    "quality.compare",
    "quality.surface",
    "quality.verdict",
    "quality.accuracy",
    "export.layers",
    "export.project",
    "mosaic.given",
    "export.report",
)
ROOFS: Final = ("surface.dense", "surface.terrain", "mosaic.roofs")
"""Put roofs in place in a mosaic on the tie points' ground: after its seams, before it is composed."""
_ON_SURFACE: Final = (
    "surface.dense",
    "surface.terrain",
    "mosaic.ground",
    "export.surface",
    "quality.surface",
)
WITH_ROOFS: Final = tuple(
    id
    for stage in STAGES
    if stage not in _ON_SURFACE
    for id in ((*ROOFS, stage) if stage == "mosaic.compose" else (stage,))
)
"""The same with these."""
OPTIONAL: Final = (
    "matching.flying_height",
    "matching.reference",
    "surface.dense",
    "surface.terrain",
    "mosaic.ground",
    "export.surface",
    "quality.compare",
    "quality.surface",
)
"""Run only where they are asked for; the flying height is measured unless the ground's height is given."""
