"""Places of a reference map that the frames show, as control points in plan."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rasterio import Affine
from rasterio.enums import ColorInterp, Resampling
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window

from geomosaic.arrays import Floats
from geomosaic.camera.interior import Camera
from geomosaic.constants import tuned
from geomosaic.errors import InputError
from geomosaic.geodesy.mapcrs import MapProjection, is_local
from geomosaic.matching.expected_overlap import LEAST_RADIUS_PX, lattice
from geomosaic.matching.features import Features, stretched
from geomosaic.matching.match import Matching
from geomosaic.matching.planes import LEAST_POINTS, Guess, guessed, plane_through
from geomosaic.matching.reference_map import (
    ExpectedOnMap,
    FoundOnMap,
    MapTile,
    ReferenceGrid,
    expected_on_map,
    found_on_map,
    joined_features,
    spread_places,
    tile_bounds,
    tile_features,
    with_margin,
)
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, param
from geomosaic.pipeline.stored_result import StoredResult
from geomosaic.placement.model import Placement
from geomosaic.placement.reach import misplacement_m
from geomosaic.projection.footprint import ground_from_image
from geomosaic.projection.ground import GroundSurface
from geomosaic.quality.rasters import open_map, read_luma
from geomosaic.stages.keypoints import FrameReduction, KeypointParams, frame_features, pictured
from geomosaic.survey.accuracy import POSITION
from geomosaic.survey.model import ControlPoint, MapPlaces, Survey

_FIX = "give a map of the same place, or leave out --coregister"
_LEAST_LOOK_PX = tuned(200, "px", "longest side of frames looked at: smaller ones have too few keypoints")
_PLACE_PX = tuned(0.3, "px", "deviation of a keypoint, which the adjustment raises: less says nothing more")
_CELLS = tuned(
    4.0, "cells a frame side", "with a place each: fewer leave parts of the map free; more is slow"
)


class ReferenceParams(KeypointParams):
    """See each parameter's help."""

    reference: Path = param(help="orthophoto that the mosaic is to coincide with")
    least: int = param(16, help="fewest places that tie a frame to the map", ge=4, le=1000)


@dataclass(frozen=True)
class _OnMap:
    """A frame's keypoints, and what is expected of it on the map."""

    features: StoredResult[Features]
    expected: ExpectedOnMap
    pixel_px: float


def _match(how: Matching, item: _OnMap) -> FoundOnMap:
    return found_on_map(how, item.features.load(), item.expected, item.pixel_px)


def _check(params: ReferenceParams) -> None:
    """The reference is a raster with a place on the map."""
    open_map(params.reference).close()


def _conclusions(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """How many places of the map the frames show."""
    found = summary["metrics"].get("reference", {})
    if not found:
        return []
    return [("on the map", f"{found['places']} places of it in {found['frames']} frames")]


@stage(
    "matching.reference", "Match frames with a reference map", group="Matching", version=3,
    outputs="map_places", wants_frames=True, check=_check, conclusions=_conclusions,
)  # fmt: skip
def matching_reference(
    survey: Survey,
    prior_ground: GroundSurface,
    placement: Placement,
    params: ReferenceParams,
    context: Context,
) -> MapPlaces:
    """Finds places of the map in the frames; the adjustment takes them as control points in plan."""
    _check_no_other_control(survey, params.reference)
    cameras = [survey.camera_of(i) for i in range(len(survey.frames))]
    sight = FrameReduction(params.keypoints_px, params.keypoints_px)
    look_px = float(np.median([sight.pixel_px(f) for f in survey.frames]))
    grid = _grid(survey, placement, cameras, prior_ground, (params.reference, look_px))
    of_map = _map_features(grid, params, context)
    longest_px = max(max(f.width_px, f.height_px) for f in survey.frames)
    keypoints_px = min(params.keypoints_px, max(_LEAST_LOOK_PX, round(longest_px / grid.pixel_px)))
    sight = FrameReduction(keypoints_px, keypoints_px)  # as coarse as the map
    with pictured(context, sight, survey.frames) as pictures:
        take = partial(frame_features, keypoints_px, params.keypoints)
        features = context.stored("keypoints", take, pictures)
        items = [
            _OnMap(features[i], expected_on_map(of_map, guess), max(look_px, grid.pixel_px))
            for i, guess in enumerate(_guesses(survey, placement, cameras, prior_ground, grid))
        ]
        how = Matching(params.ratio, "auto", params.tolerance_px, params.least)
        found = context.map("frames on the map", partial(_match, how), items)
    at_m = grid.map_m(of_map.image_px)
    side_m = placement.ground_pixel_m * float(np.median([np.sqrt(c.width_px * c.height_px) for c in cameras]))
    chosen = spread_places(found, at_m, side_m / _CELLS)
    tied = sum(len(f.image_px) > 0 for f in found)
    if len(chosen) < LEAST_POINTS:
        raise InputError(
            f"{tied} of {len(found)} frames show {len(chosen)} of its places in common, and {LEAST_POINTS} "
            "are needed to put the mosaic onto it",
            file=params.reference,
            fix="give a map of the same ground, of a like season and resolution, or leave out --coregister",
        )
    text = (
        f"placed onto {params.reference.name} by {len(chosen)} places in {tied} frames: absolute accuracy "
        "in plan that is stated is against it, and its own error comes on top"
    )
    context.inform(text)
    context.metric("reference.places", len(chosen))
    context.metric("reference.frames", tied)
    off_m = np.array([f.off_px for f in found if np.isfinite(f.off_px)]) * placement.ground_pixel_m
    context.metric("reference.off_m", float(np.median(off_m)) if off_m.size else None)
    places = {k: at_m[k] for k in chosen}
    return MapPlaces(tuple(_control(survey, prior_ground, found, places, grid.pixel_m)))


def _check_no_other_control(survey: Survey, reference: Path) -> None:
    if is_local(survey.map_crs):
        problem = "no frame has a position, so nothing says where on it they are"
        raise InputError(problem, file=reference, fix="give positions with --pos")
    if any(not p.check for p in survey.control):
        raise InputError(
            "it and the control points both place the map",
            file=reference,
            fix="leave out --coregister, or make them check points (kind check in the --gcp file)",
        )


def _grid(
    survey: Survey,
    placement: Placement,
    cameras: Sequence[Camera],
    ground: GroundSurface,
    given: tuple[Path, float],
) -> ReferenceGrid:
    """given: the reference, and the pixels of frames that one of the images has which keypoints are of."""
    path, look_px = given
    reach_m = float(np.median(misplacement_m(placement.poses, cameras, ground)))
    outlines = [_on_map(survey, placement, c, ground, i) for i, c in enumerate(cameras)]
    seen = np.concatenate([o[np.isfinite(o).all(axis=1)] for o in outlines])
    west, south = seen.min(axis=0) - reach_m
    east, north = seen.max(axis=0) + reach_m
    with open_map(path) as reference, WarpedVRT(reference, crs=survey.map_crs) as there:
        own_m = float(np.sqrt(abs(there.transform.determinant)))
        bounds = there.bounds
    pixel_m = max(own_m, look_px * placement.ground_pixel_m)
    west, east = max(west, bounds.left), min(east, bounds.right)
    south, north = max(south, bounds.bottom), min(north, bounds.top)
    if west >= east or south >= north:
        raise InputError("does not show the ground under the frames", file=path, fix=_FIX)
    size = (max(1, round((east - west) / pixel_m)), max(1, round((north - south) / pixel_m)))
    return ReferenceGrid(path, survey.map_crs, west, north, size, pixel_m, pixel_m / placement.ground_pixel_m)


def _on_map(survey: Survey, placement: Placement, camera: Camera, ground: GroundSurface, i: int) -> Floats:
    """Easting and northing (n, 2) of a lattice of a frame."""
    enu = ground_from_image(placement.poses[i], camera, ground, lattice(camera))
    lonlat = survey.work_frame.geodetic_from_enu(enu)
    return MapProjection(survey.map_crs).map_from_geodetic(lonlat[:, 0], lonlat[:, 1])


def _guesses(
    survey: Survey,
    placement: Placement,
    cameras: Sequence[Camera],
    ground: GroundSurface,
    grid: ReferenceGrid,
) -> list[Guess]:
    """Where the map is expected to show each frame."""
    reach_m = misplacement_m(placement.poses, cameras, ground)
    out = []
    for i, camera in enumerate(cameras):
        there = grid.image_px(_on_map(survey, placement, camera, ground, i))
        radius_px = max(LEAST_RADIUS_PX, float(reach_m[i]) / placement.ground_pixel_m)
        known = np.isfinite(radius_px) and survey.located[i]
        plane = plane_through(lattice(camera), there) if known else None
        out.append(guessed((camera.width_px, camera.height_px), plane, radius_px))
    return out


def _map_features(grid: ReferenceGrid, params: ReferenceParams, context: Context) -> Features:
    """Keypoints of the map under the survey."""
    tiles = []
    width, height = grid.size_px
    step = grid.pixel_m
    with open_map(grid.path) as reference:
        coarser = step > 1.5 * abs(reference.transform.a)
        with WarpedVRT(
            reference,
            crs=grid.crs,
            transform=Affine(step, 0.0, grid.west, 0.0, -step, grid.north),
            width=width,
            height=height,
            resampling=Resampling.average if coarser else Resampling.cubic,
            add_alpha=ColorInterp.alpha not in reference.colorinterp,
        ) as warped:
            for core in tile_bounds(grid.size_px, params.keypoints_px):
                (left, top), (right, bottom) = with_margin(core, grid.size_px)
                pixels, valid = read_luma(warped, Window(left, top, right - left, bottom - top))
                if not valid.any():
                    continue
                seen = np.where(valid, 255, 0).astype(np.uint8)
                grey, _ = stretched(pixels[..., None], seen)
                tiles.append(MapTile(grey, seen, (left, top), core, grid.pixel_px))
    if not tiles:
        problem = "has no valid pixel under the frames"
        raise InputError(problem, file=grid.path, fix=_FIX)
    return joined_features(
        context.map("keypoints of the map", partial(tile_features, params.keypoints), tiles)
    )


def _control(
    survey: Survey,
    ground: GroundSurface,
    found: Sequence[FoundOnMap],
    at_m: Mapping[int, Floats],
    pixel_m: float,
) -> list[ControlPoint]:
    """Places of the map as control points in plan, with their marks in the frames."""
    marks: dict[int, dict[str, tuple[str, float, float]]] = defaultdict(dict)
    for frame, f in zip(survey.frames, found, strict=True):
        for (col, row), number in zip(f.image_px.tolist(), f.number.tolist(), strict=True):
            if number in at_m:
                marks[number].setdefault(frame.name, (frame.name, col, row))
    projection = MapProjection(survey.map_crs)
    points = []
    for count, (number, place) in enumerate(at_m.items(), start=1):
        lon_deg, lat_deg = (float(v) for v in projection.geodetic_from_map(*place))
        enu = survey.work_frame.enu_from_geodetic(lon_deg, lat_deg, survey.work_frame.height_ellipsoidal_m)
        up_m = float(ground.up_at(*enu[:2]))
        on_ground = survey.work_frame.geodetic_from_enu(np.array([*enu[:2], up_m]))
        points.append(
            ControlPoint(
                name=f"reference {count}",
                lon_deg=lon_deg,
                lat_deg=lat_deg,
                height_ellipsoidal_m=float(on_ground[2]),
                sd_horizontal_m=_PLACE_PX * pixel_m,
                sd_vertical_m=POSITION["none"].sd_vertical_m,
                check=False,
                images=tuple(marks[number].values()),
                plan_only=True,
                sd_assumed=False,
            )
        )
    return points
