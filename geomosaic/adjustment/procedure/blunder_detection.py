"""What an adjusted block says against the positions and attitudes it was given."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import Block, SharedUnknowns
from geomosaic.adjustment.procedure.resection import UNHEARD
from geomosaic.adjustment.terms.collinearity import INTERIOR
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation, log_turn
from geomosaic.constants import MEDIAN_LENGTH, tuned
from geomosaic.estimation.similarity import fit_similarity
from geomosaic.matching.turned import headings_fit
from geomosaic.placement.graph import flight_lines
from geomosaic.placement.prior import (
    courses_deg,
    heading_assumed,
    heading_limits_rad,
    position_assumed,
)
from geomosaic.survey.model import Warn

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]
_POSITION_LIES = tuned(
    6.0,
    "deviations",
    "beyond which a position is called wrong: of a million honest ones none is",
)
_UPRIGHT_DEG = tuned(20.0, "degrees", "tilt up to which a survey or a frame of it looks down")
HALF_TURN_DEG = tuned(30.0, "degrees", "about half a turn: less than halfway to the next quarter")
_SAME_PLACE_M = tuned(1e-3, "m", "positions given alike say nothing of the scale")
_SCALE_IN_DOUBT = tuned(
    4.0,
    "deviations",
    "by which scales of tie points and positions may differ: of ten thousand blocks one by chance",
)
_WITHIN_FLIGHT_M = tuned(
    1.0,
    "m",
    "to what a code receiver's positions of one flight agree, whatever is stated of them",
)
_SHIFT_IN_DOUBT = tuned(
    5.0,
    "deviations",
    "by which control and positions may be apart: datums differ by more",
)


def strayed_frames(block: Block, poses: Poses, heard: Floats) -> dict[int, Warn]:
    """Frames that are left out, by number: far from their own positions, and either looking aside among
    others that look down, or with most of their tie points put aside.

    Flat ground seen aslant has two poses that look alike: where a frame was given as looking down and
    looks to the horizon, the wrong one may be found.

    Args: heard (n,): `heard_shares`.
    """
    far, limit = _off_m(block, poses)
    tilt = np.degrees(np.arccos(np.clip(poses.rotations[:, 2, 2], -1.0, 1.0)))
    usual = float(np.median(tilt))
    aside = (tilt > usual + _UPRIGHT_DEG) & (usual <= _UPRIGHT_DEG) & (far > limit)
    found = {
        int(i): Warn(
            "frame-contradicted",
            block.names[i],
            f"{100.0 * (1.0 - heard[i]):.0f} % of its tie points contradict those of other frames, which put "
            f"it {far[i]:.0f} m from its own position; left out",
        )
        for i in np.flatnonzero(unheard_far_off(block, poses, heard))
    }
    return found | {
        int(i): Warn(
            "frame-oblique",
            block.names[i],
            f"by the images it looks {tilt[i]:.0f} degrees aside of straight down, {far[i]:.0f} m from its "
            "own position; left out",
        )
        for i in np.flatnonzero(aside)
    }


def unheard_far_off(block: Block, poses: Poses, heard: Floats) -> Bools:
    """Frames far from their own positions with most of their tie points put aside, (n,)."""
    far, limit = _off_m(block, poses)
    return np.asarray((far > limit) & (heard < UNHEARD))


def _off_m(block: Block, poses: Poses) -> tuple[Floats, Floats]:
    """How far frames came to lie from where their positions say, in plan, and what is too far for one."""
    moved = poses.positions_m - block.poses.positions_m
    far = np.where(position_assumed(block.poses), 0.0, np.linalg.norm(moved[:, :2], axis=1))
    return far, _POSITION_LIES * np.maximum(np.median(far), block.poses.positions_sd_m[:, 0])


def lying_tags(block: Block, poses: Poses, strayed: Collection[int] = (), scatter: float = 1.0) -> list[Warn]:
    """Frames whose POS the block contradicts far beyond its deviation, with before and after; not those that
    are left out.

    Stated deviations are often a default on the careful side: where the solve found that positions scatter
    less, a position is judged by that, together with what is not known of its frame.

    Args: scatter: of positions in plan, times the stated deviation, as the solve found it.
    """
    far, limit = _off_m(block, poses)
    known_m = np.hypot(scatter * block.poses.positions_sd_m[:, 0], poses.positions_sd_m[:, 0])
    limit = np.minimum(limit, _POSITION_LIES * np.maximum(np.median(far), known_m))
    off_deg, most_deg = headings_off_deg(block.poses, poses)
    given_rad, found_rad = (Rotation(p.rotations).yaw_pitch_roll()[0] for p in (block.poses, poses))
    given, found = (np.degrees(yaw_rad) % 360.0 for yaw_rad in (given_rad, found_rad))
    out = [
        Warn(
            "position-wrong",
            block.names[i],
            f"its position was off by {far[i]:.0f} m; placed by its neighbours",
        )
        for i in np.flatnonzero(far > limit)
        if i not in strayed
    ]
    half = np.flatnonzero(np.abs(np.abs(off_deg) - 180.0) < HALF_TURN_DEG)
    course_rad = np.radians(courses_deg(poses.positions_m, flight_lines(poses.positions_m)))
    fits, _ = headings_fit(half.tolist(), given_rad, found_rad, course_rad)
    for i in np.flatnonzero((np.abs(off_deg) > most_deg) & ~heading_assumed(block.poses)):
        if i in strayed:
            continue
        words = (
            f"its heading was given as {given[i]:.0f} degrees and is {found[i]:.0f}; set by its neighbours"
        )
        head_down = fits.get(int(i), False)
        if head_down:
            words = "its pixels were turned by 180 degrees after the flight; laid so by its neighbours"
        out.append(Warn("frame-turned" if head_down else "yaw-wrong", block.names[i], words))
    return out


def headings_off_deg(given: Poses, found: Poses) -> tuple[Floats, Floats]:
    """By how much each frame turned about the vertical, (n,), and by how much its heading may be off."""
    turned = log_turn(found.rotations @ np.swapaxes(given.rotations, 1, 2))[:, 2]
    return np.degrees(turned), np.degrees(heading_limits_rad(given))


def doubtful_positions(block: Block, poses: Poses, seen: NDArray[np.intp]) -> list[Warn]:
    """What only the positions as a whole can say against the block: its scale, and its place.

    The best similarity from the adjusted to the given positions of the frames `seen` in the block. Its
    scale's standard deviation is that of a position over the root of the squared extent; a position's is
    what the similarity leaves, but not below the stated one, or what one flight's agree to. A shift of all
    frames beyond five stated deviations is what control in another datum does.
    """
    seen = seen[~position_assumed(block.poses)[seen]]
    if not len(seen):
        return []
    stated = block.poses.positions_sd_m[seen]
    shift_m = np.median(block.poses.positions_m[seen] - poses.positions_m[seen], axis=0)
    out = []
    if np.any(np.abs(shift_m) > _SHIFT_IN_DOUBT * np.median(stated, axis=0)):
        east, north, up = shift_m
        text = (
            f"the positions lie {east:+.1f} m east, {north:+.1f} m north and {up:+.1f} m up of where the "
            "adjustment puts the frames; check their datum and height system, and those of control points"
        )
        out.append(Warn("positions-shifted", "", text))
    given, found = block.poses.positions_m[seen, :2], poses.positions_m[seen, :2]
    stated_m = float(np.median(stated[:, :2]))
    extent_m = float(np.sqrt(((found - found.mean(axis=0)) ** 2).sum()))
    distinct = len(seen) >= 3 and bool(np.ptp(given, axis=0).max() > _SAME_PLACE_M)
    if extent_m == 0.0 or not distinct:
        return out
    turn, shift = fit_similarity(found, given)
    left = given @ [1, 1j] - turn * (found @ [1, 1j]) - shift
    scatter_m = float(np.median(np.abs(left))) / MEDIAN_LENGTH
    position_sd_m = max(min(stated_m, _WITHIN_FLIGHT_M), scatter_m)
    off, sd = 1.0 / abs(turn) - 1.0, position_sd_m / extent_m
    if abs(off) > _SCALE_IN_DOUBT * sd:
        text = (
            f"the block is {abs(off) * 100.0:.2f} % {'larger' if off > 0.0 else 'smaller'} than its "
            f"frames' positions say (standard deviation {sd * 100.0:.2f} %); the mosaic's scale is in "
            "doubt: check the focal length, the flying height and the positions"
        )
        out.append(Warn("scale-doubtful", "", text))
    return out


def strayed_lenses(cameras: Sequence[Camera], strayed: Bools) -> list[Warn]:
    """Principal points (by `strayed_principal_points`) that the images drew where no lens has them."""
    rows = strayed[: len(cameras) * len(INTERIOR)].reshape(len(cameras), -1)
    text = (
        "the images draw its principal point farther off than a lens can have it; kept as given. Something "
        "else bends the block: another kind of lens, rows read one after the other, wrong positions"
    )
    return [
        Warn("lens-strayed", "", f"{c.name}: {text}")
        for c, row in zip(cameras, rows, strict=True)
        if row.any()
    ]


def undetermined_wishes(shared: SharedUnknowns, cameras: Sequence[Camera]) -> list[Warn]:
    """What was asked for beyond the lens and can't be determined from this block; a readout that is
    reported nobody asked for."""
    reported = {c.name for c in cameras if c.readout_s}
    names = [
        name
        for of, name, held in zip(shared.of, shared.names, shared.held, strict=True)
        if held and name not in INTERIOR[:-1] and not (name == INTERIOR[-1] and of in reported)
    ]
    text = "this block does not determine it; kept as given. It takes lines flown there, back and across"
    return [Warn("not-determined", "", f"{name}: {text}") for name in names]


def unsolved_frames(block: Block, left_out: NDArray[np.bool_]) -> list[Warn]:
    """Frames at which the system of equations broke down."""
    text = "its tie points don't determine its pose; placed beside its neighbours as well as can be"
    return [Warn("pose-not-determined", block.names[i], text) for i in np.flatnonzero(left_out)]
