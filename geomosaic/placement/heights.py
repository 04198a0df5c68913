"""Heights of frames and of flat ground, from whatever POS reports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from pyproj import Geod

from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.constants import ASSUMED_SD_SHARE as ASSUMED_SD_SHARE
from geomosaic.constants import NORMAL_PER_MAD, sourced, tuned
from geomosaic.estimation.robust import LEAST_OBSERVATIONS
from geomosaic.placement.flights import flights_of
from geomosaic.placement.graph import HOVER, usual_step_m
from geomosaic.survey.model import ControlPoint, Frame, Survey

ASSUMED_HEIGHT_M = sourced(120.0, "m", "over ground, where none is reported", "EU 2019/947: the most allowed")
LEAST_HEIGHT_M = tuned(1.0, "m", "nobody surveys lower, and unset cameras write 0; more loses low flights")
_ON_THE_GROUND = tuned(0.05, "share", "of the usual height, impossible below: more doubts summits")
_FAR = tuned(
    2.5, "usual heights", "ratio in doubt next to an impossible one: less drops good, more keeps bad"
)


def or_nan(value: float | None) -> float:
    """The value, or NaN for what is unknown."""
    return np.nan if value is None else value


@dataclass(frozen=True)
class FrameHeights:
    """Ellipsoidal heights of frames in metres (n,), NaN where unknown, and their standard deviations (n,)."""

    m: Floats
    sd_m: Floats


def frame_heights_m(survey: Survey, ground_heights_m: Floats) -> Floats:
    """Ellipsoidal heights of the projection centres, (n,); NaN where nothing says.

    Heights above the ground count from the take-off point, whose height is taken as the median of the
    ground below the frames. They have priority over an absolute height of worse than 3 m. Flights that took
    off from another level, by more than their absolute heights are off, count from there.

    Args: ground_heights_m (n,) ellipsoidal heights of the ground below the frames.
    """
    frames = survey.frames
    absolute = np.array([or_nan(f.position.height_ellipsoidal_m) for f in frames])
    above = np.array([or_nan(f.position.height_above_ground_m) for f in frames])
    weak = np.array([f.position.sd_vertical_m > 3.0 for f in frames]) | np.isnan(absolute)
    relative = np.isfinite(above)
    if not relative.any():
        return absolute
    flights = flights_of(survey.clock_times_s, [f.name for f in frames])
    sd_m = np.array([f.position.sd_vertical_m for f in frames])
    level = np.median(ground_heights_m[relative]) + _take_offs_m(absolute - above, sd_m, flights)
    return np.where(weak & relative, level + above, absolute)


def _take_offs_m(level_m: Floats, sd_m: Floats, flights: Ints) -> Floats:
    """How far each frame's (n,) take-off point lies above the usual one, by absolute less relative heights
    (n,). It is 0 within the deviation of absolute heights (n,), which a flight's frames share."""
    out, known = np.zeros(len(level_m)), np.isfinite(level_m)
    if not known.any():
        return out
    usual_m = float(np.median(level_m[known]))
    for flight in np.unique(flights[known]):
        its = flights == flight
        above_m = float(np.median(level_m[its & known])) - usual_m
        out[its] = above_m if abs(above_m) > float(np.median(sd_m[its & known])) else 0.0
    return out


def with_missing_heights(heights: FrameHeights, ground_heights_m: Floats) -> FrameHeights:
    """Heights in order of capture, those that are NaN taken from their neighbours.

    A missing height goes evenly from the known one before to the one after. Its deviation is what known
    heights spread about their middle, and at least a tenth of how high it comes to lie above the ground.
    All stay NaN where none is known.
    """
    known = np.flatnonzero(np.isfinite(heights.m))
    missing = np.isnan(heights.m)
    if not known.size or not missing.any():
        return heights
    filled = np.interp(np.arange(len(heights.m)), known, heights.m[known])
    spread = NORMAL_PER_MAD * float(np.median(np.abs(heights.m[known] - np.median(heights.m[known]))))
    wide = np.maximum(spread, ASSUMED_SD_SHARE * np.abs(filled - ground_heights_m))
    return FrameHeights(filled, np.where(missing, wide, heights.sd_m))


def possible_heights(heights: FrameHeights, ground_heights_m: Floats) -> tuple[FrameHeights, Bools]:
    """Heights that can be true, and which (n,) were replaced: those would put the frame on the ground or
    below.

    Where one does, all that are far from the usual height above the ground are in doubt, unless others flew
    as high. They are set to the usual height, with half of it as deviation, and the images determine the
    rest. Where most frames lie below the ground nothing is changed: then it is the ground that is wrong.
    """
    above = heights.m - ground_heights_m
    usual = float(np.nanmedian(above)) if np.isfinite(above).any() else 0.0
    if not usual > 0.0 or not np.any(above <= _ON_THE_GROUND * usual):
        return heights, np.zeros(len(above), dtype=bool)
    implausible = (above < usual / _FAR) | (above > usual * _FAR)
    implausible &= (above <= _ON_THE_GROUND * usual) | (_as_high(above) < LEAST_OBSERVATIONS - 1)
    used_m = np.where(implausible, ground_heights_m + usual, heights.m)
    sd_m = np.where(implausible, np.maximum(heights.sd_m, usual / 2.0), heights.sd_m)
    return FrameHeights(used_m, sd_m), implausible


def _as_high(above_m: Floats) -> Ints:
    """How many other frames flew as high above the ground as each, within twice what a height is assumed to
    be off by, (n,)."""
    order = np.sort(above_m[above_m > 0.0])
    first, end = (
        np.searchsorted(order, above_m * of)
        for of in (1.0 - 2.0 * ASSUMED_SD_SHARE, 1.0 + 2.0 * ASSUMED_SD_SHARE)
    )
    return np.where(above_m > 0.0, end - first - 1, 0)


@dataclass(frozen=True)
class FlyingHeight:
    """How high a survey flew above the ground, in metres, as its images say; NaN where they weren't asked or
    don't say."""

    above_ground_m: float


def height_is_unknown(survey: Survey) -> bool:
    """Whether nothing says how high the frames flew: no DEM, and no heights above the ground."""
    return any(survey.located) and survey.elevation is None and ground_height_m(survey.frames) is None


def ground_height_m(frames: tuple[Frame, ...]) -> float | None:
    """The flat ground's ellipsoidal height: the median of absolute minus relative heights; None where these
    are missing, or say that the frames were taken on the ground."""
    both = [
        (p.height_ellipsoidal_m, p.height_above_ground_m)
        for p in (f.position for f in frames)
        if p.height_ellipsoidal_m is not None and p.height_above_ground_m is not None
    ]
    absolute, above = np.array(both).reshape(-1, 2).T
    return float(np.median(absolute - above)) if both and np.median(above) > LEAST_HEIGHT_M else None


def neighbours(frames: Sequence[Frame], most: int) -> list[tuple[int, int, float]]:
    """Up to `most` pairs of frames of one camera next to each other in time, spread over the flight: indices
    and horizontal distance in metres. Hovers and ferries are left out."""
    by_camera: dict[str, list[int]] = {}
    for i, frame in enumerate(frames):
        if frame.position.known:
            by_camera.setdefault(frame.camera, []).append(i)
    pairs = sorted(pair for its in by_camera.values() for pair in pairwise(its))
    if not pairs:
        return []
    at = np.array([[frames[i].position.lon_deg, frames[i].position.lat_deg] for pair in pairs for i in pair])
    base_m = np.asarray(Geod(ellps="WGS84").inv(*at[::2].T, *at[1::2].T)[2])
    usual_m = usual_step_m(base_m)
    apart = np.flatnonzero((base_m > HOVER * usual_m) & (base_m < 3.0 * usual_m))
    chosen = apart[np.unique(np.linspace(0, len(apart) - 1, min(most, len(apart))).astype(np.intp))]
    return [(*pairs[k], float(base_m[k])) for k in chosen]


def with_any_height(survey: Survey) -> tuple[Survey, float]:
    """A survey none of whose frames has a position, at some height over flat ground, and the ground's height.

    Where frames see two control points or more, the height is that at which these are as far apart as
    surveyed. The ground is then at the points' height. Otherwise the height is the usual one above the ground
    that frames report. Without any report it is 120 m, so that velocities in units a second are near those in
    m/s. Images and control correct it.
    """
    used = [c for c in survey.control if not c.check]
    reported = [f.position.height_above_ground_m for f in survey.frames]
    usual_m = float(np.median([h for h in reported if h is not None] or [ASSUMED_HEIGHT_M]))
    above = _height_by_control_m(survey, used) or (usual_m if usual_m > LEAST_HEIGHT_M else ASSUMED_HEIGHT_M)
    level = float(np.median([c.height_ellipsoidal_m for c in used])) if used else 0.0
    frames = tuple(
        replace(f, position=replace(f.position, height_above_ground_m=above)) for f in survey.frames
    )
    return replace(survey, frames=frames), level


def _height_by_control_m(survey: Survey, points: Sequence[ControlPoint]) -> float | None:
    """The median of what the two control points farthest apart in each frame say of its flying height."""
    seen: dict[str, list[tuple[float, float, ControlPoint]]] = {}
    for point in points:
        for name, col, row in point.images:
            seen.setdefault(name, []).append((col, row, point))
    heights = []
    for i, frame in enumerate(survey.frames):
        here = seen.get(frame.name, [])
        if len(here) < 2:
            continue
        px = np.array([[col, row] for col, row, _ in here])
        apart = np.linalg.norm(px[:, None] - px[None], axis=2)
        a, b = np.unravel_index(int(apart.argmax()), apart.shape)
        p, q = here[a][2], here[b][2]
        base_m = Geod(ellps="WGS84").inv(p.lon_deg, p.lat_deg, q.lon_deg, q.lat_deg)[2]
        if apart[a, b] > 0.0 and base_m > 0.0:
            heights.append(survey.camera_of(i).focal_length_px * base_m / apart[a, b])
    return float(np.median(heights)) if heights else None


def with_heights_above_ground(survey: Survey, above_m: float) -> tuple[Survey, float]:
    """The survey flown above_m over flat ground, and that ground's ellipsoidal height.

    Absolute heights that are known stay, and put the ground below their median; else the ground is at 0
    and every frame at above_m, to a tenth of it. Heights above the ground that were given are dropped.
    """
    absolute = np.array([or_nan(f.position.height_ellipsoidal_m) for f in survey.frames])
    level = float(np.nanmedian(absolute)) - above_m if np.isfinite(absolute).any() else 0.0
    sd_m = ASSUMED_SD_SHARE * above_m
    frames = tuple(
        replace(f, position=replace(f.position, height_above_ground_m=None))
        if f.position.height_ellipsoidal_m is not None
        else replace(f, position=replace(f.position, height_above_ground_m=above_m, sd_vertical_m=sd_m))
        for f in survey.frames
    )
    return replace(survey, frames=frames), level
