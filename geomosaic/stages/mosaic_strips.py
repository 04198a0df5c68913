"""The scene of CCD strips, every pixel resampled once."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np

from geomosaic.ccd.layout import Ends, SceneLayout, image_space_layout
from geomosaic.ccd.model import StripOffsets
from geomosaic.ccd.object_space import read_object_space
from geomosaic.ccd.outlines import Outlines, outlines
from geomosaic.ccd.radiometry import Radiometry
from geomosaic.ccd.scene_rpc import SceneRpc, scene_rpc
from geomosaic.ccd.virtual_layout import virtual_layout
from geomosaic.composition.blends import BLENDS
from geomosaic.composition.estimate import FilledPixels, estimate_scene
from geomosaic.composition.grid import MAX_GIGAPIXELS
from geomosaic.composition.strip_compose import PlacedStrips, StripMosaic, StripOptions, compose_strips
from geomosaic.errors import InputError
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, RunFile, StageParams, param
from geomosaic.projection.resample import RESAMPLING
from geomosaic.stages.input_groups import plugged_blend
from geomosaic.survey.strips import StripGeometry

RASTER = "work/mosaic.strips/raster.tif"
RPC = "mosaic_RPC.TXT"
_SPACES = ("auto", "image", "object")


class StripMosaicParams(StageParams):
    """See each parameter's help."""

    blend: str = param("feather", help="how greys go over at a seam", choices=BLENDS)
    resampling: str = param(
        "lanczos", help="interpolation of the strips; cubic shifts by up to 0.05 px", choices=RESAMPLING
    )
    ends: Ends = param(
        "all", help="all: every line any strip has; common: those all have", choices=get_args(Ends)
    )
    space: str = param(
        "auto",
        help="image: joined by the offsets; object: the ideal line by model and DEM; auto: by the method",
        choices=_SPACES,
    )
    max_gigapixels: float = param(
        MAX_GIGAPIXELS,
        help="largest scene; a larger one is refused before offsets are sought",
        unit="gigapixels",
        ge=0.001,
        le=1e6,
        affects_output=False,
    )
    threads: int = param(2, help="threads that resample", ge=1, le=64, affects_output=False)


@stage(
    "mosaic.strips", "Compose the scene of strips", group="Mosaic", version=7, outputs=("strip_mosaic",
    "outlines", "raster_file"), results=(RPC,), plugged=plugged_blend,
)  # fmt: skip
def mosaic_strips(
    strips: StripGeometry,
    offsets: StripOffsets,
    radiometry: Radiometry,
    params: StripMosaicParams,
    context: Context,
) -> tuple[StripMosaic, Outlines, RunFile]:
    """Joins the strips to one scene, with an RPC where there is a model or an RPC."""
    space = read_object_space(strips)
    for warning in space.warnings if space is not None else ():
        context.warn(warning.code, warning.frame, warning.text)
    by_object = params.space == "object" or (params.space == "auto" and offsets.method == "virtual_line")
    if by_object and space is None:
        raise InputError(
            "a scene on the ground needs a rigorous model",
            fix="give 'model' in the geometry file, or --set mosaic.strips.space=image",
        )
    layout: SceneLayout
    if by_object and space is not None:
        layout = virtual_layout(strips, space, params.ends)
    else:
        layout = image_space_layout(strips, offsets, params.ends)
    estimate_scene((layout.width_px, layout.height_px), FilledPixels(1.0, 2), params.max_gigapixels)
    rpc = scene_rpc(strips, layout, space)
    with context.writing(RASTER) as path:
        mosaic = compose_strips(
            PlacedStrips(strips, layout, radiometry, None if rpc is None else rpc.rpc.metadata()),
            path,
            StripOptions(params.blend, params.resampling, params.threads),
            context,
        )
    if rpc is not None:
        with context.writing(RPC) as path:
            path.write_text(rpc.rpc.text(), encoding="ascii")
    rings = outlines(strips, layout, space, rpc) or Outlines(np.zeros((0, 2)), {})
    _report(context, strips, mosaic, rpc, rings)
    return replace(mosaic, raster=RASTER), rings, context.run_file(RASTER)


def _report(
    context: Context, geometry: StripGeometry, mosaic: StripMosaic, rpc: SceneRpc | None, rings: Outlines
) -> None:
    context.report(
        "mosaic",
        {
            "crs": None,
            "gsd_m": geometry.ground_pixel_m,
            "width": mosaic.width_px,
            "height": mosaic.height_px,
            "first_line": mosaic.first_line,
        },
    )
    for first, last in mosaic.gaps_px:
        text = f"columns {first} to {last - 1} of the scene stay empty, as no CCD covers them: "
        text += "nothing to do if a CCD is dead, else give its 'path' in the geometry file"
        context.warn("scene-gap", "", text)
    if rpc is not None and rpc.rms_px is not None:
        context.metric("rpc.rms_px", round(rpc.rms_px, 4))
        context.metric("rpc.worst_px", round(rpc.worst_px or 0.0, 4))
    names = {k: path.name for k, ccd in enumerate(geometry.ccds) if (path := ccd.path) is not None}
    features = [
        {
            "type": "Feature",
            "properties": {"strip": names[k]},
            "geometry": {"type": "Polygon", "coordinates": [ring.tolist()]},
        }
        for k, ring in rings.ccds.items()
    ]
    if features:
        context.recorder.geojson("/map/strips", features)
