"""Which stages there are: geomosaic's own, and those that distributions announce by entry points.

Nothing of them is imported.
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib.metadata import EntryPoint, entry_points
from typing import Final

GROUP: Final = "geomosaic.stages"
OWN: Final = {
    "survey.read": "survey_read:survey_read",
    "projection.ground": "projection_ground:projection_ground",
    "placement.pos": "placement_pos:placement_pos",
    "matching.flying_height": "matching_flying_height:matching_flying_height",
    "matching.sift": "matching_sift:matching_sift",
    "matching.reference": "matching_reference:matching_reference",
    "adjustment.solve": "adjustment_solve:adjustment_solve",
    "survey.strips": "survey_strips:survey_strips",
    "ccd.offsets": "ccd_offsets:ccd_offsets",
    "ccd.radiometry": "ccd_radiometry:ccd_radiometry",
    "mosaic.strips": "mosaic_strips:mosaic_strips",
    "quality.strips": "quality_strips:quality_strips",
    "mosaic.estimate": "mosaic_estimate:mosaic_estimate",
    "mosaic.estimate_strips": "mosaic_estimate_strips:mosaic_estimate_strips",
    "adjustment.rig": "adjustment_rig:adjustment_rig",
    "quality.verdict": "quality_verdict:quality_verdict",
    "quality.accuracy": "quality_accuracy:quality_accuracy",
    "surface.dense": "surface_dense:surface_dense",
    "surface.terrain": "surface_terrain:surface_terrain",
    "mosaic.given": "mosaic_given:mosaic_given",
    "mosaic.preview": "mosaic_preview:mosaic_preview",
    "mosaic.ground": "mosaic_ground:mosaic_ground",
    "mosaic.tones": "mosaic_tones:mosaic_tones",
    "mosaic.seams": "mosaic_seams:mosaic_seams",
    "mosaic.roofs": "mosaic_roofs:mosaic_roofs",
    "mosaic.compose": "mosaic_compose:mosaic_compose",
    "export.cog": "export_cog:export_cog",
    "export.surface": "export_surface:export_surface",
    "export.layers": "exports_for_gis:export_layers",
    "export.report": "export_report:export_report",
    "export.offsets": "exports_of_strips:export_offsets",
    "export.strip_layers": "exports_of_strips:export_strip_layers",
    "export.strip_report": "exports_of_strips:export_strip_report",
    "export.stac": "exports_for_web:export_stac",
    "export.tiles": "exports_for_web:export_tiles",
    "export.vrt": "exports_for_web:export_vrt",
    "export.project": "exports_for_gis:export_project",
    "export.colmap": "exports_of_block:export_colmap",
    "export.metashape": "exports_of_block:export_metashape",
    "export.odm": "exports_of_block:export_odm",
    "export.opensfm": "exports_of_block:export_opensfm",
    "export.pix4d": "exports_of_block:export_pix4d",
    "export.index": "exports_for_gis:export_index",
    "export.footprints": "exports_for_gis:export_footprints",
    "export.kmz": "exports_for_web:export_kmz",
    "export.mbtiles": "exports_for_web:export_mbtiles",
    "export.pmtiles": "exports_for_web:export_pmtiles",
    "export.map": "exports_of_strips:export_map",
    "export.orthos": "export_orthos:export_orthos",
    "quality.compare": "quality_compare:quality_compare",
    "quality.surface": "quality_surface:quality_surface",
}
"""By id the module in geomosaic.stages and the stage in it."""


def announced() -> list[EntryPoint]:
    """Every stage, by id. An installation of geomosaic may announce its own by names of earlier versions."""
    own = [EntryPoint(id, f"geomosaic.stages.{where}", GROUP) for id, where in OWN.items()]
    others = entry_points(group=GROUP)
    return own + [e for e in others if not (e.name in OWN and e.value.startswith("geomosaic.stages."))]


def modules_of(ids: Iterable[str]) -> list[str]:
    """The modules of stages, where any are announced under these ids."""
    wanted = set(ids)
    return sorted({entry.module for entry in announced() if entry.name in wanted})
