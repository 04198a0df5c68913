"""How large the mosaic will be, and what it will take, before the first pixel is matched."""

from __future__ import annotations

import numpy as np
import shapely

from geomosaic.composition.estimate import FilledPixels, before_composing, estimate
from geomosaic.composition.frames import decoded_bytes
from geomosaic.composition.grid import output_grid, stretching
from geomosaic.composition.mosaic_scene import CandidateFrames, extent_within, mosaic_pixels
from geomosaic.composition.views import seen_part
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context
from geomosaic.placement.model import Placement
from geomosaic.projection.ground import GroundSurface
from geomosaic.stages.mosaic_seams import mosaic_seams
from geomosaic.stages.reporting import in_recipe, params_of, report_estimate
from geomosaic.stages.surface_dense import surface_dense
from geomosaic.survey.model import Survey


@stage("mosaic.estimate", "Estimate the mosaic", group="Mosaic", version=5, cached=False, looks_ahead=True)
def mosaic_estimate(
    survey: Survey, prior_ground: GroundSurface, prior_placement: Placement, context: Context
) -> None:
    """Refuses a mosaic that is too large, or that the disk has no room for, and names who stretches it.

    The pixel and the limit are mosaic.seams', the memory mosaic.compose's. It runs every time: the disk's
    room is of today.
    """
    seams = params_of(context, mosaic_seams)
    names = [f.name for f in survey.frames]
    cameras = [survey.camera_of(i) for i in range(len(names))]
    if not any(survey.located):
        context.inform("no frame has a position: how large the mosaic will be only the images can show")
        return
    own_m = prior_placement.ground_pixel_m
    pixels = mosaic_pixels(seams.gsd_m, seams.align_to, survey.map_crs, own_m)
    gsd_m = pixels.gsd_m
    seeing = CandidateFrames(survey, prior_placement.poses, cameras, survey.located, prior_ground)
    limits = seeing.limits(seams.edges, max(gsd_m, own_m))
    extent = extent_within(seams.aoi, survey.map_crs, seeing.views())
    views = extent.views
    if limits is not None:
        well = seeing.views(limits)
        views = (well if extent.area is None else extent.area.seen_by(well)) or views
    grid = output_grid(pixels, views, names, seams.max_gigapixels)
    outlines = [seen_part(v.pose, v.camera, prior_ground, limits).points_m[:, :2] for v in views]
    seen = shapely.union_all([shapely.convex_hull(shapely.MultiPoint(o)) for o in outlines])
    seen_m2 = float(seen.area)
    if extent.area is not None:
        seen_m2 = min(seen_m2, float(extent.area.geometry.area))
    first = survey.frames[views[0].frame]
    pixel_bytes = first.bands * np.dtype(first.dtype).itemsize
    memory = float(context.workers * max(map(decoded_bytes, survey.frames)))
    sizes_px = [(f.width_px, f.height_px) for f in survey.frames]
    before = before_composing(sizes_px, len(prior_placement.pairs), context.workers, memory)
    dense = in_recipe(context, surface_dense)
    filled = FilledPixels(
        min(1.0, seen_m2 / (grid.width_px * grid.height_px * gsd_m**2)),
        pixel_bytes,
        params_of(context, surface_dense).cell_px * own_m if dense else None,
    )
    expected = estimate(
        grid,
        filled,
        before,
        context.workers,
    )
    if (far := stretching(views, gsd_m)) is not None:
        view, share = far
        context.warn(
            "mosaic-stretched",
            names[view.frame],
            f"lies so far out that without it the mosaic would have {100.0 * share:.2g} % of its size; "
            "correct its position and height with --pos, or take it out of the folder",
        )
    report_estimate(context, expected)
