"""What can't be: heights, attitudes and lenses that no frame has, or not among these others.

A slip of a decimal point or a damaged tag can put a frame far too high, or make its image far too wide.
Ground and mosaic would reach as far, and take as much memory. Such a value is taken as not given, and named.
Errors that a survey can have (barometers that drift, a datum that isn't stated, a position far off) are left
to the adjustment.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.camera.interior import Camera
from geomosaic.constants import CHOSEN, NORMAL_PER_MAD, SLIGHT, tuned
from geomosaic.errors import InputError
from geomosaic.geodesy.ellipsoid import mid_latitude_offset_m
from geomosaic.survey.model import Attitude, Position, Warn
from geomosaic.survey.names import some


@dataclass(frozen=True)
class Limit:
    """A value that nothing real is beyond: why, and by what source."""

    value: float
    unit: str
    reason: str
    source: str


LOWEST: Final = Limit(-1000.0, "m", "land at -430 m, geoid -106 m; room for barometers", "Dead Sea; EGM2008")
HIGHEST: Final = Limit(60_000.0, "m", "aircraft reach 26 km, balloons 54", "SR-71, 1976; JAXA BS13-08, 2013")
APART: Final = Limit(1500.0, "m", "above its neighbours: more than sheer faces", "Great Trango Tower: 1340 m")
SPREADS: Final = Limit(10.0, "robust deviations", "of those neighbours' own heights, on top", CHOSEN)
NARROWEST: Final = Limit(100.0, "focal / side", "3600 mm on 36 mm: more is a telescope", "Nikon P1000: 83")
WIDEST: Final = Limit(0.1, "focal / side", "a flat image of 157 degrees", "fisheye of 8 mm on 36 mm: 0.22")
ZOOM: Final = Limit(20.0, "ratio", "between frames of one make, model and size", "DJI H20's zoom: 4.7")
BENT: Final = Limit(0.5, "share", "of the radius, halfway to the corner: fisheyes reach 0.3", "Brown 1971")
OFF_CENTRE: Final = Limit(0.05, "share", "principal point off: stabilisers reach 0.03", "tags: Sequoia 0.007")
RESURVEYED: Final = Limit(1.0, "m", "between two lines of one control point, surveyed twice", "RTK: 0.05 m")
SLOWEST: Final = Limit(5.0, "s", "to read a frame's rows: rolling shutters take under 0.3 s", "makers' tags")
FASTEST: Final = Limit(1000.0, "m/s", "three times the speed of sound", "SR-71: 980")
FASTEST_TURN: Final = Limit(
    35.0, "rad/s", "2000 degrees a second: gyroscopes end there", "InvenSense MPU-6000"
)
NEIGHBOURS = tuned(8, "frames", "that judge a height: of fewer two wrong ones decide; more reach slopes")


def plausible_positions(
    names: Sequence[str], positions: Sequence[Position]
) -> tuple[tuple[Position, ...], list[Warn]]:
    """The positions, in order of capture, without the heights that can't be, and a warning for each kind.

    Raises: `InputError` where heights are given and none of them, above the ellipsoid or the ground, can be.
    """
    heights = np.array([p.height_ellipsoidal_m for p in positions], dtype=np.float64)
    above = np.array([p.height_above_ground_m for p in positions], dtype=np.float64)
    lonlat = np.array([[p.lon_deg, p.lat_deg] for p in positions])
    wrong = _absurd(lonlat, heights), _absurd(lonlat, above)
    given = np.isfinite(heights) | np.isfinite(above)
    if given.any() and not ((np.isfinite(heights) & ~wrong[0]) | (np.isfinite(above) & ~wrong[1])).any():
        worst = float(heights[0] if np.isfinite(heights[0]) else above[np.flatnonzero(given)[0]])
        raise InputError(
            f"no frame has a plausible height: {names[int(np.argmax(given))]} has {worst:g} m",
            fix="give heights in metres, or leave them out: they are then estimated from the images",
        )
    kept = tuple(
        replace(
            p,
            height_ellipsoidal_m=None if high else p.height_ellipsoidal_m,
            height_above_ground_m=None if far else p.height_above_ground_m,
        )
        for p, high, far in zip(positions, *wrong, strict=True)
    )
    warnings = [
        warn("height-absurd", names, where, [f"a {kind} of {v:g} m" for v in values])
        for where, values, kind in (
            (wrong[0], heights, "height"), (wrong[1], above, "height above the ground"),
        )
        if where.any()
    ]  # fmt: skip
    return kept, warnings


def plausible_attitudes(
    names: Sequence[str], attitudes: Sequence[Attitude], unknown: Attitude
) -> tuple[tuple[Attitude, ...], list[Warn]]:
    """The attitudes, `unknown` in place of those with an angle beyond half a turn, and warnings of these and
    of cameras that look above the horizon."""
    given = [[abs(t) for t in (a.pitch_deg, a.roll_deg) if t is not None] for a in attitudes]
    tilts = [max(t, default=0.0) for t in given]
    wrong = np.array([not t <= 180.0 for t in tilts], dtype=bool)
    kept = tuple(unknown if w else a for a, w in zip(attitudes, wrong, strict=True))
    texts = [f"a tilt of {t:g} degrees" for t in tilts]
    warnings = [warn("attitude-absurd", names, wrong, texts)] if wrong.any() else []
    down = [math.prod(math.cos(math.radians(t or 0.0)) for t in (a.pitch_deg, a.roll_deg)) for a in kept]
    up = [name for name, its in zip(names, down, strict=True) if its < -SLIGHT]
    if up:
        few = f" ({len(up)} of {len(names)} frames: {some(up)})" if 1 < len(up) < len(names) else ""
        text = "the camera looks above the horizon, and its ground may be missing; correct the sign of pitch "
        text += f"and roll with --pos if it looked down, else take it out of the folder{few}"
        warnings.append(Warn("frame-looks-up", up[0] if len(up) == 1 else "", text))
    return kept, warnings


def warn(
    code: str, names: Sequence[str], concerned: Bools, what: Sequence[str], fix: str = "correct it with --pos"
) -> Warn:
    """One line for all frames that a kind of absurd value concerns, with the first one's and what to do."""
    which = [name for name, c in zip(names, concerned, strict=True) if c]
    first = what[int(np.argmax(concerned))]
    if len(which) == 1:
        return Warn(code, which[0], f"{first} can't be: taken as not given; {fix}")
    few = f"{len(which)} of {len(names)} frames: {some(which)}"
    return Warn(code, "", f"{first} in {which[0]} can't be, and others: taken as not given ({few}); {fix}")


def focal_length_can_be(focal_length_px: float, width_px: int, height_px: int) -> bool:
    """Whether a lens of such a focal length for such an image exists."""
    return WIDEST.value <= focal_length_px / max(width_px, height_px) <= NARROWEST.value


def lens_problem(camera: Camera) -> str:
    """What of a camera's numbers no lens has, in words; empty where all can be."""
    width, height = camera.width_px, camera.height_px
    if not focal_length_can_be(camera.focal_length_px, width, height):
        return f"a focal length of {camera.focal_length_px:.3g} px for {width} x {height} px can't be"
    col, row = camera.principal_col_px, camera.principal_row_px
    if not (-width <= col <= 2 * width and -height <= row <= 2 * height):
        return f"a principal point at {col:.5g}, {row:.5g} for {width} x {height} px can't be"
    half = math.hypot(width, height) / 4.0 / camera.focal_length_px
    shares = camera.terms * camera.lens.shares(half)
    if not max(abs(shares[:3].sum()), *abs(shares[3:])) <= BENT.value:
        return "its distortion moves points halfway to the corner by more than half as far; it can't be"
    if not abs(camera.readout_s) <= SLOWEST.value:
        return f"a readout of {camera.readout_s:g} s can't be"
    return ""


def strange_lenses(relative: Floats) -> Bools:
    """Which focal lengths (n,) of frames of one make, model and size are none that most others can have."""
    if len(relative) < 3:
        return np.zeros(len(relative), dtype=bool)
    ratio = np.exp(np.abs(np.log(relative / np.median(relative))))
    return np.asarray((ratio > ZOOM.value) & (np.median(ratio) < 2.0))


def _absurd(lonlat: Floats, heights_m: Floats) -> Bools:
    """Which heights (n,), NaN where unknown, nothing that flies has, or no frame among these neighbours."""
    known = np.isfinite(heights_m)
    wrong = known & ((heights_m < LOWEST.value) | (heights_m > HIGHEST.value))
    rest = np.flatnonzero(known & ~wrong)
    if len(rest) < 3:
        return wrong
    at = mid_latitude_offset_m(*lonlat[rest[0]], *lonlat[rest].T)
    wrong[rest] = _strangers(at, heights_m[rest])
    return wrong


def _strangers(at_m: Floats, heights_m: Floats) -> Bools:
    """Which frames are far above their neighbours, both in plan and in order of capture.

    Too low a one does no harm to others, and may be a take-off; below the ground, placement finds it.
    """
    n = len(heights_m)
    most = min(NEIGHBOURS, n - 1)
    _, near = cKDTree(at_m).query(at_m, k=most + 1)
    first = np.clip(np.arange(n) - most // 2, 0, n - 1 - most)
    ordered = first[:, None] + np.arange(most + 1)
    return np.asarray(_above(heights_m, near) & _above(heights_m, ordered))


def _above(heights_m: Floats, groups: Ints) -> Bools:
    """groups (n, k + 1): of each frame its neighbours, and (somewhere) itself."""
    n = len(heights_m)
    own = groups == np.arange(n)[:, None]
    own[~own.any(axis=1), -1] = True  # many frames at one place: another one stands for itself
    others = np.where(own, np.nan, heights_m[groups])
    middle = np.nanmedian(others, axis=1)
    spread = NORMAL_PER_MAD * np.nanmedian(np.abs(others - middle[:, None]), axis=1)
    return np.asarray(heights_m - middle > APART.value + SPREADS.value * spread)
