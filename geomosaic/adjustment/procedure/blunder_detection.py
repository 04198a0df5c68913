"""Detection of wrong GNSS and IMU data and undetermined parameters; resection of frames with wrong poses."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import cv2
import numpy as np

from geomosaic.adjustment.kernels.interior import FOCAL, INTERIOR, PRINCIPAL
from geomosaic.adjustment.model import Block, SharedUnknowns
from geomosaic.adjustment.solver.solution import Solution
from geomosaic.arrays import Bools, Floats
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation, log_turn
from geomosaic.constants import sourced, tuned
from geomosaic.estimation.robust import BLUNDER
from geomosaic.matching.explanations import WRONG, HeadingEvidence, explained
from geomosaic.matching.planes import LEAST_POINTS
from geomosaic.matching.tracks import Tracks
from geomosaic.placement.prior import (
    heading_assumed,
    heading_limits_rad,
    position_assumed,
    smooth_courses_deg,
)
from geomosaic.survey.model import Warn

WITHIN_PX = tuned(8.0, "px", "residual of a point that agrees; rolling shutters take some")
_TRIALS = sourced(1000, "samples of five", "with 1/3 of good points", "Fischler 1981: 1 - (1 - 3^-5)^1000")
_DOWNWARDS = np.diag([1.0, -1.0, -1.0])
"""From camera axes with z backwards to OpenCV's with z forwards."""
_LEFT_OUT = (
    "left out, and other frames show its ground; if ground is missing, correct its position with --pos"
)
_TURNED_BACK = "turned back: nothing to do"
_UPRIGHT_DEG = tuned(20.0, "degrees", "most tilt of a nadir view")
_OBLIQUE_DEG = tuned(45.0, "degrees", "tilt from which the view has a heading; at 90, yaw and roll are one")


def counted_shares(tracks: Tracks, bundle: Solution, frames: int) -> Floats:
    """Share of each frame's observations with more than half of the full weight, (n,); NaN without any."""
    counts = np.bincount(tracks.frame, bundle.weight[: len(tracks.frame)] > 0.5, minlength=frames)
    with np.errstate(invalid="ignore"):
        return np.asarray(counts / np.bincount(tracks.frame, minlength=frames))


def undetermined_frames(tracks: Tracks, bundle: Solution, frames: int) -> Bools:
    """Which frames (n,) of tie points have too few good ones for the six unknowns of a pose, and no control
    points. Their own positions say more than wrong matches do. Good are points of more than half the full
    weight. One that one other frame sees gives one equation, one that more see gives two."""
    good = bundle.weight[: len(tracks.frame)] > 0.5
    seen = np.bincount(tracks.point, good, minlength=tracks.points)[tracks.point]
    equations = np.bincount(tracks.frame, good * np.clip(seen - 1.0, 0.0, 2.0), minlength=frames)
    of_ties = np.setdiff1d(tracks.frame, bundle.problem.tracks.frame[len(tracks.frame) :])
    return np.isin(np.arange(frames), of_ties) & (equations < 6.0)


def resected(tracks: Tracks, bundle: Solution, cameras: Sequence[Camera], wrong: Bools) -> Poses | None:
    """The bundle's poses with frames resected from points of at least two other frames; None where none is
    better than before. Random samples, then a quadratic programme of all points that agree (SQPnP, Terzakis
    and Lourakis 2020), which finds the better of two poses over a plane. Args: cameras: of each frame; wrong
    (n,): frames to resect."""
    counts = (bundle.weight > 0.5) & ~wrong[tracks.frame]
    sure = np.bincount(tracks.point, counts, minlength=tracks.points) >= 2
    positions, rotations, found = bundle.poses.positions_m.copy(), bundle.poses.rotations.copy(), False
    for i in np.flatnonzero(wrong).tolist():
        mine = np.flatnonzero((tracks.frame == i) & sure[tracks.point])
        if len(mine) < LEAST_POINTS:
            continue
        ground_m, image_px = bundle.points_m[tracks.point[mine]], tracks.image_px[mine]
        pose = _pose(ground_m, image_px, cameras[i])
        if pose is None:
            continue
        off_px = cameras[i].image_from_camera((ground_m - pose[0]) @ pose[1]) - image_px
        now, before = (np.linalg.norm(off, axis=1) for off in (off_px, bundle.residual_px[mine]))
        now, before = (np.median(np.nan_to_num(length, nan=np.inf)) for length in (now, before))
        if now < before / 2.0:
            positions[i], rotations[i], found = *pose, True
    return replace(bundle.poses, positions_m=positions, rotations=rotations) if found else None


def _pose(ground_m: Floats, image_px: Floats, camera: Camera) -> tuple[Floats, Floats] | None:
    """Position (3,) in m and rotation (3, 3), if enough points agree with them."""
    ray = camera.ray_from_image(image_px) @ _DOWNWARDS
    middle, hit = ground_m.mean(axis=0), np.isfinite(ray).all(axis=1)
    if hit.sum() < LEAST_POINTS:
        return None
    try:
        done, turn, shift, agree = cv2.solvePnPRansac(
            ground_m[hit] - middle,
            ray[hit, :2],
            np.eye(3),
            None,
            iterationsCount=_TRIALS,
            reprojectionError=WITHIN_PX / camera.focal_length_px,
            flags=cv2.SOLVEPNP_SQPNP,
        )
    except cv2.error:  # ground points at one place
        return None
    if not done or agree is None or len(agree) < LEAST_POINTS:
        return None
    from_ground = np.array(cv2.Rodrigues(turn)[0], dtype=np.float64)
    return middle - from_ground.T @ np.array(shift, dtype=np.float64).ravel(), from_ground.T @ _DOWNWARDS


def contradicted_frames(block: Block, poses: Poses, shares: Floats) -> dict[int, Warn]:
    """Frames to leave out, by number. They are far from their positions, and either oblique among nadir views
    or with most tie points down-weighted. Over flat ground, views may converge to a second, oblique pose.
    Args: shares (n,): `counted_shares`, NaN for frames that are not judged."""
    far, limit = _off_m(block, poses)
    far = np.where(np.isnan(shares), 0.0, far)
    tilt = np.degrees(np.arccos(np.clip(poses.rotations[:, 2, 2], -1.0, 1.0)))
    usual = float(np.median(tilt))
    aside = (tilt > usual + _UPRIGHT_DEG) & (usual <= _UPRIGHT_DEG) & (far > limit)
    found = {}
    for i in np.flatnonzero((far > limit) & (shares < 0.5)).tolist():
        text = f"{100.0 * (1.0 - shares[i]):.0f} % of its tie points contradict those of other frames, "
        text += f"which put it {far[i]:.0f} m from its own position: {_LEFT_OUT}"
        found[i] = Warn("frame-contradicted", block.names[i], text)
    for i in np.flatnonzero(aside).tolist():
        text = (
            f"by the images it looks {tilt[i]:.0f} degrees aside of straight down, {far[i]:.0f} m from its "
            f"own position: {_LEFT_OUT}"
        )
        found[i] = Warn("frame-oblique", block.names[i], text)
    return found


def _off_m(block: Block, poses: Poses) -> tuple[Floats, Floats]:
    """Distances (n,) of frames from their given positions in plan, and their limits (n,), in m."""
    moved = poses.positions_m - block.poses.positions_m
    far = np.where(position_assumed(block.poses), 0.0, np.linalg.norm(moved[:, :2], axis=1))
    return far, BLUNDER * np.maximum(np.median(far), block.poses.positions_sd_m[:, 0])


def wrong_tags(block: Block, poses: Poses, strayed: Collection[int] = (), scatter: float = 1.0) -> list[Warn]:
    """Warnings of wrong positions and headings, except of frames that are left out. Where the estimated
    deviation is smaller than the stated one, often a cautious default, it counts, together with the frame's
    own. Args: scatter: estimated by stated deviation of positions in plan."""
    far, limit = _off_m(block, poses)
    known_m = np.hypot(scatter * block.poses.positions_sd_m[:, 0], poses.positions_sd_m[:, 0])
    limit = np.minimum(limit, BLUNDER * np.maximum(np.median(far), known_m))
    off_deg, most_deg = headings_off_deg(block.poses, poses)
    given_rad, found_rad = (_headings_rad(p) for p in (block.poses, poses))
    given, found = (np.degrees(yaw_rad) % 360.0 for yaw_rad in (given_rad, found_rad))
    course_rad = np.radians(smooth_courses_deg(poses.positions_m))
    evidence = HeadingEvidence(
        np.where(heading_assumed(block.poses), np.nan, given_rad),
        found_rad,
        course_rad,
        heading_limits_rad(block.poses) / 4.0,
        np.tile([True, False, True, False], (len(given), 1)),
    )
    causes, oblique = explained(evidence).reshape(len(given), 8).argmax(axis=1), _oblique(poses)
    out = []
    for i in np.flatnonzero(far > limit).tolist():
        text = (
            f"its position was off by {far[i]:.0f} m; placed by its neighbours: nothing to do for a single "
        )
        text += "frame; for many check names and order in --pos"
        out.append((i, "position-wrong", text))
    for i in np.flatnonzero((np.abs(off_deg) > most_deg) & ~heading_assumed(block.poses)).tolist():
        turned = causes[i] % 4 == 2 and not oblique[i]
        if turned:
            out.append(
                (i, "frame-turned", f"its pixels were turned by 180 degrees after the flight; {_TURNED_BACK}")
            )
        if not turned or causes[i] >= WRONG:
            text = f"its heading was given as {given[i]:.0f} degrees and is {found[i]:.0f}"
            out.append((i, "yaw-wrong", f"{text} by its neighbours, which set it: nothing to do"))
    return [Warn(code, block.names[i], text) for i, code, text in out if i not in strayed]


def headings_off_deg(given: Poses, found: Poses) -> tuple[Floats, Floats]:
    """Differences of headings (n,), found minus given, and their limits (n,), in degrees. Of oblique frames
    the directions of view are compared. NaN where one pose is oblique and the other is not: then nothing says
    what part of the rotation is a change of heading."""
    turned = log_turn(found.rotations @ np.swapaxes(given.rotations, 1, 2))[:, 2]
    aside = [_oblique(poses) for poses in (given, found)]
    viewed = np.angle(np.exp(1j * (_headings_rad(given) - _headings_rad(found))))
    turned = np.where(aside[0] & aside[1], viewed, turned)
    turned[aside[0] != aside[1]] = np.nan
    return np.degrees(turned), np.degrees(heading_limits_rad(given))


def _oblique(poses: Poses) -> Bools:
    """Frames (n,) that look so far aside that their yaw is not the direction they look in."""
    return np.asarray(poses.rotations[:, 2, 2] < np.cos(np.radians(_OBLIQUE_DEG)))


def _headings_rad(poses: Poses) -> Floats:
    """Yaw (n,) from north, clockwise; of oblique frames the direction of view."""
    east, north = -poses.rotations[:, :2, 2].T
    yaw_rad = Rotation(poses.rotations).yaw_pitch_roll()[0]
    return np.where(_oblique(poses), np.arctan2(east, north), yaw_rad)


def implausible_lenses(cameras: Sequence[Camera], strayed: Bools) -> list[Warn]:
    """Warnings of lenses that have estimated numbers that no lens has (by `implausible_interior`)."""
    rows = strayed[: len(cameras) * len(INTERIOR)].reshape(len(cameras), -1)
    kept = (
        "kept as given. Something else bends the block: check the positions in --pos, or give a calibrated "
        "lens with --camera"
    )
    texts = {
        "the images draw its principal point farther off than a lens can have it": rows[:, PRINCIPAL],
        "the images draw its focal length far from the reported one, without need": rows[:, [FOCAL]],
    }
    return [
        Warn("lens-strayed", "", f"{camera.name}: {text}; {kept}")
        for text, its in texts.items()
        for camera, row in zip(cameras, its, strict=True)
        if row.any()
    ]


def undetermined_unknowns(shared: SharedUnknowns, cameras: Sequence[Camera]) -> list[Warn]:
    """Warnings of requested, undetermined unknowns beyond the lens; of readouts unless reported."""
    reported = {c.name for c in cameras if c.readout_s}
    text = (
        "this block does not determine it; kept as given, and the map is as true as that is. To determine "
        "it, fly lines there, back and across"
    )
    return [
        Warn("not-determined", "", f"{name}: {text}")
        for of, name, fixed in zip(shared.of, shared.names, shared.fixed, strict=True)
        if fixed and name not in INTERIOR[:-1] and not (name == INTERIOR[-1] and of in reported)
    ]


def unsolved_frames(block: Block, unsolved: Bools) -> list[Warn]:
    """Warnings of frames with singular equations or too few good tie points."""
    text = (
        "its tie points don't determine its pose; placed as its neighbours suggest, so seams may show there: "
        "fly more overlap, or take it out of the folder"
    )
    return [Warn("pose-not-determined", block.names[i], text) for i in np.flatnonzero(unsolved)]
