"""Frames as seen from the map: where each one's nadir point and outline lie, and how fine it is there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from geomosaic.camera.exterior import Pose, Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import CHOSEN, Because
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.mosaic.hidden import Hidden
from geomosaic.projection.footprint import ground_from_image, ground_sampling_distance_m
from geomosaic.projection.ground import GroundSurface

Floats = NDArray[np.float64]
_SAMPLES_PER_SIDE: Annotated[
    int,
    Because(
        "places",
        "along each side of a frame, whose bounds on the map are theirs: between them a bent edge"
        " reaches farther by less than the share to spare",
        CHOSEN,
    ),
] = 17
_SPARE: Annotated[
    float,
    Because(
        "share of a frame's bounds",
        "bounds are those of places along a frame's edges, and a bent edge reaches a little "
        "farther: with less, what it shows may be cut there",
        CHOSEN,
    ),
] = 0.02


@dataclass(frozen=True)
class FrameView:
    """One frame (an index into `Survey.frames`) on the map.

    nadir_m: easting and northing below the projection centre. bounds_m: west, south, east, north of what
    it sees of the ground. gsd_m: its ground sampling distance. hidden: what stands before it, if anything.
    """

    frame: int
    pose: Pose
    camera: Camera
    nadir_m: Floats
    bounds_m: Floats
    gsd_m: float
    hidden: Hidden | None = None

    def widened(self) -> FrameView:
        """With bounds that hold all of its bent edges."""
        west, south, east, north = self.bounds_m
        spare = _SPARE * max(east - west, north - south)
        return replace(self, bounds_m=self.bounds_m + spare * np.array([-1.0, -1.0, 1.0, 1.0]))


def frame_views(
    work_frame: LocalFrame,
    crs: str,
    poses: Poses,
    cameras: Sequence[Camera],
    used: Sequence[bool],
    ground: GroundSurface,
) -> tuple[FrameView, ...]:
    """The views of the frames in use, in the frames' order.

    A frame whose middle looks past the ground has none. Of a frame that sees the horizon the part below
    it counts.
    """
    projection = MapProjection(crs)
    views = []
    for i, camera in enumerate(cameras):
        if not used[i]:
            continue
        pose = poses[i]
        gsd_m = ground_sampling_distance_m(pose, camera, ground)
        if not np.isfinite(gsd_m):
            continue
        samples = _image_samples(camera.width_px, camera.height_px)
        seen = ground_from_image(pose, camera, ground, samples).reshape(-1, 3)
        seen = np.vstack([pose.position_m, seen[np.isfinite(seen).all(axis=1)]])
        geodetic = work_frame.geodetic_from_enu(seen)
        on_map = projection.map_from_geodetic(geodetic[:, 0], geodetic[:, 1])
        bounds = np.concatenate([on_map[1:].min(axis=0), on_map[1:].max(axis=0)])
        views.append(FrameView(i, pose, camera, on_map[0], bounds, gsd_m))
    return tuple(views)


@cache
def _image_samples(width_px: int, height_px: int) -> Floats:
    t = np.linspace(0.0, 1.0, _SAMPLES_PER_SIDE)
    samples = np.stack(np.meshgrid(t * width_px, t * height_px), axis=-1)
    samples.flags.writeable = False
    return samples
