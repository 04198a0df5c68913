"""Frames as seen from the map: where each one's nadir point and outline lie, and how fine it is there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np

from geomosaic.arrays import Bools, Floats, Floats32
from geomosaic.camera.exterior import Pose, Poses
from geomosaic.camera.interior import Camera
from geomosaic.composition.hidden import Hidden
from geomosaic.composition.limits import Limits
from geomosaic.constants import tuned
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.projection.footprint import ground_from_image, ground_sampling_distance_m, sightings
from geomosaic.projection.ground import GroundSurface
from geomosaic.survey.model import Survey

_SAMPLES_PER_SIDE = tuned(17, "places", "on a frame's edge: fewer miss its bends by more than _SPARE")
_SPARE = tuned(0.02, "share", "added to bounds: edges bend outwards; less cuts them off")


@dataclass(frozen=True)
class FrameView:
    """One frame (an index into `Survey.frames`) on the map.

    nadir_m: easting and northing below the projection centre. bounds_m: west, south, east, north of what
    it sees of the ground, or of what it sees well. gsd_m: its ground sampling distance. hidden: what stands
    before it, if anything. quality: by `Limits`, at places evenly over the image with its edges, (k, k); None
    where it sees all well.
    """

    frame: int
    pose: Pose
    camera: Camera
    nadir_m: Floats
    bounds_m: Floats
    gsd_m: float
    hidden: Hidden | None = None
    quality: Floats32 | None = None

    def sees_well(self, cols: Floats32, rows: Floats32) -> Bools | None:
        """Which places of the frame (h, w) are seen well enough to give pixels; None where all are."""
        if self.quality is None:
            return None
        col, row = (
            np.nan_to_num(of * np.float32((len(self.quality) - 1) / size), nan=-9.0).astype(np.float32)
            for of, size in ((cols, self.camera.width_px), (rows, self.camera.height_px))
        )
        found = cv2.remap(
            self.quality, col, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0
        )
        return np.asarray(found >= 1.0)

    def widened(self) -> FrameView:
        """With bounds that hold all of its bent edges."""
        west, south, east, north = self.bounds_m
        spare = _SPARE * max(east - west, north - south)
        return replace(self, bounds_m=self.bounds_m + spare * np.array([-1.0, -1.0, 1.0, 1.0]))


@dataclass(frozen=True)
class PosedFrames:
    """A survey's frames with the poses and cameras (n,) of each, the ground that they show, and which of them
    may give pixels: used (n,)."""

    survey: Survey
    poses: Poses
    cameras: Sequence[Camera]
    used: Sequence[bool]
    ground: GroundSurface


def frame_views(frames: PosedFrames, crs: str, limits: Limits | None = None) -> tuple[FrameView, ...]:
    """The views of the frames in use, in the frames' order.

    A frame whose middle looks past the ground has none. Of a frame that sees the horizon the part below
    it counts; with limits, of every frame the part that it sees well, if any.
    """
    projection = MapProjection(crs)
    views = []
    ground = frames.ground
    for i, camera in enumerate(frames.cameras):
        if not frames.used[i]:
            continue
        pose = frames.poses[i]
        part = seen_part(pose, camera, ground, limits)
        gsd_m = ground_sampling_distance_m(pose, camera, ground)
        if part.quality is not None and not gsd_m <= part.pixel_m:
            gsd_m = part.pixel_m
        if not np.isfinite(gsd_m) or not len(part.points_m):
            continue
        seen = np.vstack([pose.position_m, part.points_m])
        geodetic = frames.survey.work_frame.geodetic_from_enu(seen)
        on_map = projection.map_from_geodetic(geodetic[:, 0], geodetic[:, 1])
        bounds = np.concatenate([on_map[1:].min(axis=0), on_map[1:].max(axis=0)])
        view = FrameView(i, pose, camera, on_map[0], bounds, gsd_m, quality=part.quality)
        views.append(view if part.quality is None else view.widened())
    return tuple(views)


@dataclass(frozen=True)
class SeenPart:
    """What a frame sees of the ground, or what of it within limits: points (n, 3) over it with its edge, in
    the work frame, m. quality: see `FrameView`. pixel_m: the longer side of its pixels in the median."""

    points_m: Floats
    quality: Floats32 | None = None
    pixel_m: float = np.nan


def seen_part(pose: Pose, camera: Camera, ground: GroundSurface, limits: Limits | None = None) -> SeenPart:
    """By a lattice of places of the frame."""
    samples = _image_samples(camera.width_px, camera.height_px)
    if limits is None:
        return SeenPart(_known(ground_from_image(pose, camera, ground, samples)))
    points, tangent, pixel_m = sightings(pose, camera, ground, samples)
    quality = limits.quality(tangent, pixel_m)
    well = quality >= 1.0
    if well.all():
        return SeenPart(_known(points))
    edge = ground_from_image(pose, camera, ground, _edge(samples, quality))
    seen = _known(np.vstack([points[well], edge]))
    return SeenPart(seen, quality, float(np.nanmedian(pixel_m[well])) if len(seen) else np.nan)


def _known(points_m: Floats) -> Floats:
    return points_m[np.isfinite(points_m).all(axis=-1)]


def _edge(samples: Floats, quality: Floats32) -> Floats:
    """Places (n, 2) of an image where its quality passes 1, between neighbours of its samples (k, k, 2)."""
    found = []
    for one, other in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        a, b = quality[one].astype(np.float64), quality[other].astype(np.float64)
        passes = (a >= 1.0) != (b >= 1.0)
        share = ((1.0 - a[passes]) / (b[passes] - a[passes]))[:, None]
        found.append(samples[one][passes] * (1.0 - share) + samples[other][passes] * share)
    return np.vstack(found)


@cache
def _image_samples(width_px: int, height_px: int) -> Floats:
    t = np.linspace(0.0, 1.0, _SAMPLES_PER_SIDE)
    samples = np.stack(np.meshgrid(t * width_px, t * height_px), axis=-1)
    samples.flags.writeable = False
    return samples
