"""How the cameras of a rig stand to one another: bands show the same edges, if not the same greys."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.camera.exterior import Pose, Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation, exp_turn
from geomosaic.constants import MEDIAN_LENGTH, tuned
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.matching.displacement import measure_displacements, patch_corners
from geomosaic.projection.footprint import ground_from_image, ground_sampling_distance_m
from geomosaic.projection.ground import GroundSurface
from geomosaic.projection.resample import seen_on
from geomosaic.projection.warp import GroundWindow, ground_window
from geomosaic.survey.model import Band, Frame, Survey
from geomosaic.survey.pixels import read_pixels

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]

MOST_CAPTURES = tuned(
    12,
    "captures",
    "looked at, spread over the flight: each gives a hundred places and more, and three angles and a "
    "focal length are all that is asked; more take time and show nothing new",
)
_PATCH_PX = tuned(
    96,
    "ground px",
    "side of a patch in which edges are compared: a smaller one holds too few edges that both bands "
    "show, a larger one relief that shifts them apart",
)
_LEAST_STEP_PX = tuned(
    16,
    "ground px",
    "from patch to patch at least: closer ones share nearly all of their pixels and show the same",
)
_PLACES = tuned(
    120,
    "patches a capture",
    "compared, about: many, since of some bands few correlate; more take time alone",
)
_SEARCH_PX: tuple[int, int] = tuned(
    (96, 8),
    "ground px",
    "how far off a band is looked for in the first round and in the second: cameras of a rig stand up "
    "to some 3 degrees apart, a tenth of a frame's width (of 960 px); then what is left, since a wider "
    "search finds wrong edges",
)
_LEAST_CORRELATION = tuned(
    0.3,
    "correlation coefficient",
    "of edges in two bands, half of what one band's greys show: below it patches meet by chance, above "
    "it few of red and infrared are left",
)
_MOST_SD_PX = tuned(
    0.3,
    "px",
    "stated deviation of a place by least-squares matching: patches that are less sure have next to no "
    "edges, or edges one way only",
)
_LEAST_PLACES = tuned(
    12,
    "places in all captures",
    "three for each of the four unknowns, so that wrong ones can be found; of fewer, what the tags say "
    "stands",
)
_EDGE_SIGMA_PX = tuned(
    1.0,
    "ground px",
    "smoothing before gradients are taken: with less, noise of single pixels counts as edges; with "
    "more, fine edges run together",
)


@dataclass(frozen=True)
class BandPose:
    """A band's camera and how it is turned.

    own_from_band: (3, 3), from directions in the band's camera axes to those of the camera that took the
    survey's frames. places: where it was measured; before_px, after_px: median distance of the bands there,
    in the band's pixels; NaN where too few places were found, and what the tags say stands.
    """

    name: str
    camera: Camera
    own_from_band: Floats
    places: int
    before_px: float
    after_px: float


@dataclass(frozen=True)
class RigPoses:
    """All other bands of a survey; none for a survey that isn't a rig's."""

    bands: tuple[BandPose, ...] = ()


@dataclass(frozen=True)
class _Places:
    """Ground points (n, 3) and where the band shows them, cols and rows (n, 2), by frame (n,)."""

    frame: NDArray[np.intp]
    ground_m: Floats
    image_px: Floats

    @classmethod
    def joined(cls, each: Sequence[_Places]) -> _Places:
        """Those of several captures."""
        return cls(*(np.concatenate([getattr(e, f.name) for e in each]) for f in fields(cls)))


def register_bands(
    survey: Survey,
    poses: Poses,
    cameras: Sequence[Camera],
    used: Sequence[bool],
    ground: GroundSurface,
    *,
    threads: int = 2,
    progress: Callable[[int, int, str], None] | None = None,
) -> RigPoses:
    """One turn for each band against the frames' own camera, and its focal length, from all captures at once.

    Both images of a capture are laid on the ground by what is known; edges (the length of the gradient of
    the greys' logarithm: plants, dark in red and bright in infrared, show the same) are correlated patch by
    patch; the turn and the focal length that explain most places follow by least squares with Cauchy's loss.
    Twice, since the first round may be far off. The lenses stand centimetres apart, which level ground can't
    distinguish from a turn.
    """
    out = []
    for k, band in enumerate(survey.other_bands):
        there = [i for i, f in enumerate(band.frames) if f is not None and used[i]]
        some = np.unique(np.linspace(0, len(there) - 1, min(MOST_CAPTURES, len(there))).astype(int))
        found = BandPose(band.name, band.camera, np.eye(3), 0, float("nan"), float("nan"))
        for search_px in _SEARCH_PX:
            look = partial(_seen, survey, poses, cameras, ground, band, found, search_px)
            with ThreadPoolExecutor(threads) as pool:
                each = list(pool.map(look, (there[j] for j in some)))
            if sum(len(e.frame) for e in each) < _LEAST_PLACES:
                break
            found = _turned(found, band, _Places.joined(each), poses)
        out.append(found)
        if progress is not None:
            progress(k + 1, len(survey.other_bands), "bands")
    return RigPoses(tuple(out))


def band_poses(poses: Poses, band: BandPose) -> Poses:
    """Where a band's camera stood and looked while the captures' own camera had `poses`."""
    return replace(poses, rotations=poses.rotations @ band.own_from_band)


def _seen(
    survey: Survey,
    poses: Poses,
    cameras: Sequence[Camera],
    ground: GroundSurface,
    band: Band,
    so_far: BandPose,
    search_px: int,
    i: int,
) -> _Places:
    """Where the band shows the ground of one capture."""
    window = _window_of(survey, poses[i], cameras[i], ground)
    theirs = band_poses(poses, so_far)[i]
    own, own_valid = _edges(window, poses[i], cameras[i], survey.frames[i])
    their, their_valid = _edges(window, theirs, so_far.camera, band.frames[i])
    found = measure_displacements(
        their,
        own,
        their_valid,
        own_valid,
        patch_corners(own.shape, _PATCH_PX, max(_LEAST_STEP_PX, int(np.sqrt(own.size / _PLACES)))),
        patch_px=_PATCH_PX,
        search_px=search_px,
        min_correlation=_LEAST_CORRELATION,
        max_sd_px=_MOST_SD_PX,
    )
    points = window.points_m()
    there = found.centres_px + found.displacement_px
    shown = theirs.image_from_ground(so_far.camera, _at(points, there))
    good = np.isfinite(shown).all(axis=1)
    at = _at(points, found.centres_px)[good]
    return _Places(np.full(good.sum(), i, dtype=np.intp), at, shown[good])


def _window_of(survey: Survey, pose: Pose, camera: Camera, ground: GroundSurface) -> GroundWindow:
    """The map window that a frame sees, at its own ground sampling distance."""
    seen = ground_from_image(pose, camera, ground, camera.border_px())
    geodetic = survey.work_frame.geodetic_from_enu(seen[np.isfinite(seen).all(axis=1)])
    on_map = MapProjection(survey.map_crs).map_from_geodetic(geodetic[:, 0], geodetic[:, 1])
    gsd_m = ground_sampling_distance_m(pose, camera, ground)
    west, south = on_map.min(axis=0)
    east, north = on_map.max(axis=0)
    width, height = int((east - west) / gsd_m) + 1, int((north - south) / gsd_m) + 1
    return ground_window(survey.map_crs, survey.work_frame, ground, west, north, gsd_m, width, height)


def _edges(
    window: GroundWindow, pose: Pose, camera: Camera, frame: Frame | None
) -> tuple[Floats32, NDArray[np.bool_]]:
    """Length of the gradient of the logarithm of a frame's greys on the window, and where it is valid."""
    if frame is None:
        raise ValueError("a capture without this band")
    pixels, mask = read_pixels(frame)
    on_ground, valid = seen_on(window, pose, camera, np.log1p(pixels[..., 0].astype(np.float32)), mask)
    smooth = cv2.GaussianBlur(on_ground, (0, 0), _EDGE_SIGMA_PX)
    edges = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    valid = cv2.erode(valid.astype(np.uint8), np.ones((7, 7), np.uint8)).astype(bool)
    return np.where(valid, edges * 100.0, np.float32(0.0)).astype(np.float32), valid


def _at(points: Floats, pixel: Floats) -> Floats:
    """Points of a window's pixel centres (rows, cols, 3) between them, at cols and rows (n, 2)."""
    x = np.clip(pixel - 0.5, 0.0, np.array(points.shape[1::-1]) - 1.001)
    whole = x.astype(np.intp)
    part = x - whole
    c, r = whole.T
    u, v = part[:, :1], part[:, 1:]
    top = points[r, c] * (1.0 - u) + points[r, c + 1] * u
    low = points[r + 1, c] * (1.0 - u) + points[r + 1, c + 1] * u
    return np.asarray(top * (1.0 - v) + low * v)


def _turned(so_far: BandPose, band: Band, places: _Places, poses: Poses) -> BandPose:
    """The turn and focal length that bring the band's places to where the frames' camera puts them."""
    from scipy.optimize import least_squares

    frames = np.unique(places.frame)
    focal_sd = max(band.camera.focal_length_sd_px, 1e-3 * band.camera.focal_length_px)

    def with_step(step: Floats) -> tuple[Camera, Floats]:
        camera = replace(band.camera, focal_length_px=band.camera.focal_length_px * (1.0 + step[3]))
        return camera, np.asarray(so_far.own_from_band @ exp_turn(step[None, :3])[0])

    def missed(step: Floats) -> Floats:
        camera, own_from_band = with_step(step)
        off = np.empty_like(places.image_px)
        for i in frames:
            mine = places.frame == i
            pose = replace(poses[int(i)], rotation=Rotation(poses.rotations[i] @ own_from_band))
            off[mine] = pose.image_from_ground(camera, places.ground_m[mine]) - places.image_px[mine]
        return np.nan_to_num(off, nan=1e3)

    def residual(step: Floats) -> Floats:
        prior = step[3] * band.camera.focal_length_px / focal_sd
        return np.append(missed(step).ravel() / scale, prior)

    start = np.array([0.0, 0.0, 0.0, so_far.camera.focal_length_px / band.camera.focal_length_px - 1.0])
    before = float(np.median(np.linalg.norm(missed(start), axis=1)))
    scale = max(before, 0.1)
    for _ in range(3):
        start = least_squares(residual, start, loss="cauchy", x_scale=[1e-3, 1e-3, 1e-3, 1e-3]).x
        after = float(np.median(np.linalg.norm(missed(start), axis=1)))
        scale = max(after / MEDIAN_LENGTH, 0.05)
    camera, own_from_band = with_step(start)
    first = so_far.before_px if np.isfinite(so_far.before_px) else before
    return BandPose(band.name, camera, own_from_band, len(places.frame), first, after)
