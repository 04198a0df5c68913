"""Places of points by their own marks, in a block of frames that lies nowhere on the Earth.

A finished run without positions relates its frames to each other up to a similarity of space. So the marks of
a point place it within the block, and points that are placed give the similarity that places the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.constants import ROUNDS
from geomosaic.estimation.similarity import Similarity3D, fit_similarity
from geomosaic.geodesy.local import LocalFrame
from geomosaic.marking.pose_correction import MARK_SD_PX, STEP
from geomosaic.projection.footprint import ground_from_image
from geomosaic.projection.ground import GroundSurface
from geomosaic.survey.model import ControlPoint


@dataclass(frozen=True)
class PlacedPoint:
    """A point by its m marks: place_m (3,) in the work frame; off_px (m,): how far each mark lies from where
    the other marks predict it; deviations (m,): the same over what is expected. NaN of fewer than three."""

    place_m: Floats
    off_px: Floats
    deviations: Floats


def placed_point(
    poses: Sequence[Pose], cameras: Sequence[Camera], image_px: Floats, ground: GroundSurface
) -> PlacedPoint | None:
    """A point by its marks, one a frame: on the ground by one mark, by least squares of more. None where the
    first ray does not meet the ground.

    Args: poses, cameras: of the m marked frames; image_px (m, 2); ground: where a single ray ends.
    """
    start = ground_from_image(poses[0], cameras[0], ground, image_px[:1])[0]
    if not np.isfinite(start).all():
        return None
    place, slopes, off = start, np.zeros((len(poses), 2, 3)), np.zeros((len(poses), 2))
    for _ in range(ROUNDS):
        off, slopes = _linearised(poses, cameras, image_px, place)
        place = place + np.linalg.lstsq(slopes.reshape(-1, 3), off.ravel(), rcond=None)[0]
        if not np.isfinite(place).all():
            return PlacedPoint(start, *np.full((2, len(poses)), np.nan))
    if len(poses) < 3:
        return PlacedPoint(place, *np.full((2, len(poses)), np.nan))
    leverage = slopes @ np.linalg.pinv(np.einsum("mij,mik->jk", slopes, slopes)) @ np.swapaxes(slopes, 1, 2)
    left_out = (np.linalg.pinv(np.eye(2) - leverage) @ off[..., None])[..., 0]
    deviations = np.sqrt(np.maximum(np.sum(off * left_out, axis=1), 0.0)) / MARK_SD_PX
    return PlacedPoint(place, np.linalg.norm(left_out, axis=1), deviations)


def places_of_others(points: Sequence[ControlPoint], places_m: Floats, ground: GroundSurface) -> Floats:
    """Places (k, 3) of all points: those that are placed, and the others by the similarity between these and
    their surveyed coordinates. Of two placed points, or of some along a line, it is one of the plane.

    Args: places_m (k, 3): NaN where a point is not placed yet, and in the result where nothing places it.
    """
    placed = np.asarray(np.isfinite(places_m).all(axis=1))
    if placed.sum() < 2:
        return places_m
    heights = [p.height_ellipsoidal_m for p in points if not p.plan_only] or [0.0]
    level = float(np.mean(heights))
    frame = LocalFrame(points[0].lon_deg, points[0].lat_deg, level)
    given = [(p.lon_deg, p.lat_deg, level if p.plan_only else p.height_ellipsoidal_m) for p in points]
    surveyed = frame.enu_from_geodetic(*np.array(given).T)
    similarity = Similarity3D.through(surveyed[placed], places_m[placed])
    if similarity is not None:
        return np.where(placed[:, None], places_m, similarity.of(surveyed))
    turn, shift = fit_similarity(surveyed[placed, :2], places_m[placed, :2])
    plan = turn * (surveyed[:, :2] @ [1, 1j]) + shift
    others = np.column_stack([plan.real, plan.imag, ground.up_at(plan.real, plan.imag)])
    return np.where(placed[:, None], places_m, others)


def _linearised(
    poses: Sequence[Pose], cameras: Sequence[Camera], image_px: Floats, place_m: Floats
) -> tuple[Floats, Floats]:
    """Marks minus where a place is seen (m, 2), and derivatives of the latter by the place (m, 2, 3)."""
    off, slopes = [], []
    for pose, camera, marked in zip(poses, cameras, image_px, strict=True):
        step_m = STEP * float(np.linalg.norm(place_m - pose.position_m))
        around = np.concatenate([np.zeros((1, 3)), step_m * np.eye(3), -step_m * np.eye(3)])
        seen = pose.image_from_ground(camera, place_m + around)
        off.append(marked - seen[0])
        slopes.append((seen[1:4] - seen[4:]).T / (2.0 * step_m))
    return np.nan_to_num(np.array(off)), np.nan_to_num(np.array(slopes))
