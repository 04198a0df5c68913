"""Registration of the cameras of a rig: the relative rotation and focal length of every other band."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from geomosaic.arrays import Bytes, Floats, Floats32
from geomosaic.camera.exterior import Pose, Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation, exp_turn
from geomosaic.constants import MEDIAN_LENGTH, tuned
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.matching.displacement import (
    LEAST_CORRELATION,
    SMOOTHING_SIGMA_PX,
    PatchMatching,
    measure_displacements,
    patch_corners,
)
from geomosaic.matching.least_squares_matching import MaskedImage
from geomosaic.matching.planes import LEAST_POINTS
from geomosaic.projection.footprint import ground_from_image, ground_sampling_distance_m
from geomosaic.projection.ground import GroundSurface
from geomosaic.projection.map_grid import MapGrid
from geomosaic.projection.resample import seen_on
from geomosaic.projection.warp import GroundWindow, ground_window
from geomosaic.survey.model import Band, Frame, Survey
from geomosaic.survey.pixels import read_pixels

Matches = tuple[int, Floats, Floats]
"""A frame, ground points (n, 3) and their image coordinates (n, 2) in the band."""

_MOST_FRAMES = tuned(4.0, "frames", "of pixels in a window: fewer refuse turned frames; more take memory")
_MOST_CAPTURES = tuned(12, "captures", "spread over the flight; each shows a hundred patches for 4 unknowns")
_PATCH_PX = tuned(96, "ground px", "side; smaller: too few common edges; larger: relief shifts them apart")
_PATCHES = tuned(120, "patches a capture", "about; of some bands few correlate; more take time alone")
_SEARCH_PX: tuple[int, int] = tuned((96, 8), "ground px", "of two rounds: 3 degrees in 960 px, then the rest")


@dataclass(frozen=True)
class BandPose:
    """A band's camera and its relative rotation. own_from_band (3, 3): from the band's camera axes to those
    of the survey's frames. places: number of matches; before_px, after_px: their median residual in the
    band's pixels, NaN where matches were too few and the reported values stay."""

    name: str
    camera: Camera
    own_from_band: Floats
    places: int
    before_px: float
    after_px: float


@dataclass(frozen=True)
class RigPoses:
    """All other bands of a survey; none without a rig."""

    bands: tuple[BandPose, ...] = ()


@dataclass(frozen=True)
class Captures:
    """A survey's captures with the poses, cameras and ground that were found; used: which poses hold."""

    survey: Survey
    poses: Poses
    cameras: Sequence[Camera]
    used: Sequence[bool]
    ground: GroundSurface


def register_bands(
    captures: Captures, threads: int = 2, progress: Callable[[int, int, str], None] | None = None
) -> RigPoses:
    """One rotation and focal length for each band, from all captures at once. Both images of a capture are
    projected to the ground. Edges (the gradient of log grey values, which red and infrared share) are
    correlated in patches; least squares with Cauchy's loss follow. A second round searches nearby. The offset
    of the lenses, some centimetres, acts as a rotation over level ground."""
    out = []
    survey, poses, used = captures.survey, captures.poses, captures.used
    for k, band in enumerate(survey.other_bands):
        there = [i for i, f in enumerate(band.frames) if f is not None and used[i]]
        some = np.unique(np.linspace(0, len(there) - 1, min(_MOST_CAPTURES, len(there))).astype(int))
        found = BandPose(band.name, band.camera, np.eye(3), 0, float("nan"), float("nan"))
        for search_px in _SEARCH_PX:
            with ThreadPoolExecutor(threads) as pool:
                search = partial(_matches, captures, band, found, search_px)
                each = list(pool.map(search, (there[j] for j in some)))
            if sum(len(ground_m) for _, ground_m, _ in each) < LEAST_POINTS:
                break
            found = _refined(found, band, [e for e in each if len(e[1])], poses)
        out.append(found)
        if progress is not None:
            progress(k + 1, len(survey.other_bands), "bands")
    return RigPoses(tuple(out))


def band_poses(poses: Poses, band: BandPose) -> Poses:
    """Poses of a band's camera from those of the captures' own camera."""
    return replace(poses, rotations=poses.rotations @ band.own_from_band)


def _matches(captures: Captures, band: Band, so_far: BandPose, search_px: int, i: int) -> Matches:
    """Matches of a band with frame i."""
    pose = band_poses(captures.poses, so_far)[i]
    gsd_m, band_gsd_m = (
        ground_sampling_distance_m(of, camera, captures.ground)
        for of, camera in ((captures.poses[i], captures.cameras[i]), (pose, so_far.camera))
    )
    coarser = max(1, int(band_gsd_m / gsd_m)) if np.isfinite(band_gsd_m) and gsd_m > 0.0 else 1
    window = _window(captures, i, coarser * gsd_m)
    if window is None:
        return i, np.zeros((0, 3)), np.zeros((0, 2))
    frame, of_band = captures.survey.frames[i], band.frames[i]
    if of_band is None:
        raise ValueError("a capture without this band")
    own = _edges(window, captures.poses[i], captures.cameras[i], *_brightness(frame, coarser, lit=True))
    other = _edges(window, pose, so_far.camera, *_brightness(of_band, 1, lit=frame.bands == 1))
    step_px = max(1, int(np.sqrt(own.pixels.size / _PATCHES)))
    found = measure_displacements(
        other,
        own,
        patch_corners(own.pixels.shape, _PATCH_PX, step_px),
        PatchMatching(_PATCH_PX, search_px, LEAST_CORRELATION),
    )
    points = window.points_m()
    there_m = _bilinear(points, found.centres_px + found.displacement_px)
    image_px = pose.image_from_ground(so_far.camera, there_m)
    good = np.isfinite(image_px).all(axis=1)
    return i, _bilinear(points, found.centres_px)[good], image_px[good]


def _window(captures: Captures, i: int, gsd_m: float) -> GroundWindow | None:
    """The map window of frame i; None where it looks too far aside to be projected."""
    survey, pose, camera = captures.survey, captures.poses[i], captures.cameras[i]
    border = ground_from_image(pose, camera, captures.ground, camera.border_px())
    border = border[np.isfinite(border).all(axis=1)]
    if not np.isfinite(gsd_m) or not len(border):
        return None
    geodetic = survey.work_frame.geodetic_from_enu(border)
    on_map = MapProjection(survey.map_crs).map_from_geodetic(geodetic[:, 0], geodetic[:, 1])
    west, south = on_map.min(axis=0)
    east, north = on_map.max(axis=0)
    size = int((east - west) / gsd_m) + 1, int((north - south) / gsd_m) + 1
    if size[0] * size[1] > _MOST_FRAMES * camera.width_px * camera.height_px:
        return None
    grid = MapGrid(survey.map_crs, west, north, gsd_m, *size)
    return ground_window(grid, survey.work_frame, captures.ground)


def _edges(
    window: GroundWindow,
    pose: Pose,
    camera: Camera,
    image: Floats32,
    mask: Bytes | None,
) -> MaskedImage:
    """Gradient magnitude of an image on the window, and where it is valid."""
    on_ground, valid = seen_on(window, pose, camera, image, mask)
    smooth = cv2.GaussianBlur(on_ground, (0, 0), SMOOTHING_SIGMA_PX)
    edges = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    valid = cv2.erode(valid.astype(np.uint8), np.ones((7, 7), np.uint8)).astype(bool)
    return MaskedImage(np.where(valid, edges * 100.0, np.float32(0.0)).astype(np.float32), valid)


def _brightness(frame: Frame, coarser: int, *, lit: bool) -> tuple[Floats32, Bytes | None]:
    """A frame's log grey values, linear where they are in a unit or show heat, and where they are valid.

    coarser: how many pixels a pixel of the window spans. lit: whether they show light.
    """
    pixels, mask = read_pixels(frame)
    values = pixels.astype(np.float32).mean(axis=2)
    values = np.log1p(values) if lit and pixels.dtype.kind != "f" else _spread(values, mask)
    if coarser > 1:
        values = np.asarray(cv2.GaussianBlur(values, (0, 0), coarser / np.sqrt(12.0)))  # as a mean over them
    return values, mask


def _spread(values: Floats32, mask: Bytes | None) -> Floats32:
    """Values from 0 at the first percentile to 1 at the last."""
    known = values[np.isfinite(values) if mask is None else np.isfinite(values) & (mask != 0)]
    low, high = np.percentile(known, (1.0, 99.0)) if known.size else (0.0, 0.0)
    if not high > low:
        return np.zeros_like(values)
    return np.asarray(np.nan_to_num(np.clip((values - low) / (high - low), 0.0, 1.0)), dtype=np.float32)


def _bilinear(points: Floats, pixel: Floats) -> Floats:
    """Points of a window's pixel centres (rows, cols, 3) interpolated at cols and rows (n, 2)."""
    x = np.clip(pixel - 0.5, 0.0, np.array(points.shape[1::-1]) - 1.001)
    c, r = x.astype(np.intp).T
    u, v = np.hsplit(x - x.astype(np.intp), 2)
    top = points[r, c] * (1.0 - u) + points[r, c + 1] * u
    low = points[r + 1, c] * (1.0 - u) + points[r + 1, c + 1] * u
    return np.asarray(top * (1.0 - v) + low * v)


def _refined(so_far: BandPose, band: Band, matches: Sequence[Matches], poses: Poses) -> BandPose:
    """The rotation and focal length with the least residuals of the matches."""
    from scipy.optimize import least_squares

    given = band.camera
    focal_sd = max(given.focal_length_sd_px, 1e-3 * given.focal_length_px)

    def stepped(step: Floats) -> tuple[Camera, Floats]:
        camera = replace(given, focal_length_px=given.focal_length_px * (1.0 + step[3]))
        return camera, np.asarray(so_far.own_from_band @ exp_turn(step[None, :3])[0])

    def off_px(step: Floats) -> Floats:
        camera, own_from_band = stepped(step)
        off = []
        for i, ground_m, image_px in matches:
            pose = replace(poses[i], rotation=Rotation(poses.rotations[i] @ own_from_band))
            off.append(pose.image_from_ground(camera, ground_m) - image_px)
        return np.nan_to_num(np.concatenate(off), nan=1e3)

    def residual(step: Floats) -> Floats:
        return np.append(off_px(step).ravel() / scale, step[3] * given.focal_length_px / focal_sd)

    def median_px(step: Floats) -> float:
        return float(np.median(np.linalg.norm(off_px(step), axis=1)))

    step = np.array([0.0, 0.0, 0.0, so_far.camera.focal_length_px / given.focal_length_px - 1.0])
    before = median_px(step)
    scale = max(before, 0.1)
    for _ in range(3):
        step = least_squares(residual, step, loss="cauchy", x_scale=1e-3).x
        after = median_px(step)
        scale = max(after / MEDIAN_LENGTH, 0.05)
    first = so_far.before_px if np.isfinite(so_far.before_px) else before
    return BandPose(band.name, *stepped(step), sum(len(m[1]) for m in matches), first, after)
