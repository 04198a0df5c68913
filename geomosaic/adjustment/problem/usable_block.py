"""The block as the equations take it: images as the camera took them, and finite numbers alone.

A lens belongs to the sensor: frames of one camera share their interior orientation only if their pixels are
counted from the same corner of it. (Images turned by 90 degrees are a camera of their own.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from geomosaic.adjustment.model import Adjusted, Block, GroundControl
from geomosaic.arrays import Bools, Floats
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import Rotation
from geomosaic.constants import SLIGHT, tuned
from geomosaic.matching.model import TiePairs, TiePoints
from geomosaic.survey.accuracy import POSITION
from geomosaic.survey.model import Warn
from geomosaic.survey.names import some

_LEAST_SD_M = tuned(1e-4, "m", "of a position: no survey is better; zero weighs without bound")


def _half_turned(quarters: Sequence[int]) -> list[int]:
    return [i for i, its in enumerate(quarters) if its == 2]


def turned_poses(poses: Poses, quarters: Sequence[int]) -> Poses:
    """Poses of images of which some (2 quarters) are turned by 180 degrees."""
    frames = _half_turned(quarters)
    rotations = poses.rotations.copy()
    rotations[frames] = Rotation(rotations[frames]).turned(2).matrix
    turns = None if poses.turns is None else poses.turns.turned(frames, 2)
    return replace(poses, rotations=rotations, turns=turns)


def as_taken(block: Block) -> Block:
    """The block with half-turned images turned back: poses, cameras, tie points and control."""
    frames = set(_half_turned(block.turned))
    if not frames:
        return block
    cameras = tuple(c.turned(2) if i in frames else c for i, c in enumerate(block.cameras))
    size = np.array([[c.width_px, c.height_px] for c in cameras], dtype=np.float64)
    control = tuple(
        replace(
            p,
            observations=tuple(
                (i, float(size[i, 0]) - col, float(size[i, 1]) - row) if i in frames else (i, col, row)
                for i, col, row in p.observations
            ),
        )
        for p in block.control
    )
    pairs = tuple(
        replace(
            t,
            left_px=size[t.left] - t.left_px if t.left in frames else t.left_px,
            right_px=size[t.right] - t.right_px if t.right in frames else t.right_px,
        )
        for t in block.ties.pairs
    )
    return replace(
        block,
        cameras=cameras,
        poses=turned_poses(block.poses, block.turned),
        ties=replace(block.ties, pairs=pairs),
        turned=(),
        control=control,
    )


def as_filed(adjusted: Adjusted, block: Block) -> Adjusted:
    """The outcome of `as_taken(block)` for the images as they lie in the files."""
    frames, residuals = _half_turned(block.turned), adjusted.image_residuals
    cameras = tuple(c.turned(2) if i in frames else c for i, c in enumerate(adjusted.cameras))
    if residuals is not None:
        turned = np.isin(residuals.frame, frames)[:, None]
        size = np.array([[c.width_px, c.height_px] for c in cameras], dtype=np.float64)
        residuals = replace(
            residuals,
            image_px=np.where(turned, size[residuals.frame] - residuals.image_px, residuals.image_px),
            residual_px=np.where(turned, -residuals.residual_px, residuals.residual_px),
        )
    poses = turned_poses(adjusted.poses, block.turned)
    return replace(adjusted, cameras=cameras, poses=poses, image_residuals=residuals)


def usable(block: Block) -> tuple[Block, tuple[Warn, ...]]:
    """The block with finite poses, deviations, tie points and control points, and warnings of what was
    removed or averaged. A position or attitude that is not finite counts as unknown, as does a deviation that
    is NaN. Deviations of zero or less become the least that a survey can have."""
    poses, warnings = _usable_poses(block)
    ties, lost = _usable_ties(block.ties)
    if lost:
        text = f"{lost} tie points have coordinates that are no numbers and are left out: nothing to do"
        warnings.append(Warn("tie-points-not-finite", "", text))
    control, notes = _usable_control(block.control)
    return replace(block, poses=poses, ties=ties, control=control), (*warnings, *notes)


def _usable_control(given: Sequence[GroundControl]) -> tuple[tuple[GroundControl, ...], list[Warn]]:
    """Points that are finite and marked, at most once in an image."""
    most_m, finite = POSITION["none"].sd_vertical_m, [c for c in given if _finite(c)]
    marked = [c for c in finite if c.observations]
    control = tuple(
        replace(c, sd_m=_sound(c.sd_m, _LEAST_SD_M, most_m), observations=_once_an_image(c.observations))
        for c in marked
    )
    gone = [c.name for c in given if not _finite(c)]
    unmarked = [c.name for c in finite if not c.observations]
    repeated = [
        c.name
        for c, once in zip(marked, control, strict=True)
        if len(set(c.observations)) > len(once.observations)
    ]
    warnings = (
        ("control-not-finite", gone, "coordinates are no numbers: the points are left out; correct them"),
        ("control-points-unused", unmarked, "no image mark: the points are left out; mark them"),
        ("control-mark-repeated", repeated, "marks of one image differ: their mean counts; correct them"),
    )
    return control, [
        Warn(code, "", f"control or check points ({some(names)}): {text} in the --gcp file")
        for code, names, text in warnings
        if names
    ]


def _once_an_image(marks: Sequence[tuple[int, float, float]]) -> tuple[tuple[int, float, float], ...]:
    """Marks of a point, in the mean where one image has several."""
    by_image: dict[int, list[tuple[float, float]]] = {}
    for i, col, row in marks:
        by_image.setdefault(i, []).append((col, row))
    means = {i: np.mean(at, axis=0).tolist() for i, at in by_image.items()}
    return tuple((i, col, row) for i, (col, row) in means.items())


def _usable_poses(block: Block) -> tuple[Poses, list[Warn]]:
    poses = block.poses
    placed, looking = _finite_rows(poses.positions_m), _are_rotations(poses.rotations)
    warnings: list[Warn] = []
    for what, good in (("position", placed), ("attitude", looking)):
        bad = [block.names[i] for i in np.flatnonzero(~good)]
        if bad:
            text = f"the {what} of {len(bad)} frames is no number and counts as unknown ({some(bad)}): "
            text += "the images decide it; correct it in the --pos file or the frames' tags"
            warnings.append(Warn("pose-not-finite", "", text))
    middle = np.median(poses.positions_m[placed], axis=0) if placed.any() else np.array([0.0, 0.0, 100.0])
    unknown = POSITION["none"]
    farthest = np.array([unknown.sd_horizontal_m, unknown.sd_horizontal_m, unknown.sd_vertical_m])
    sd_m = _sound(poses.positions_sd_m, _LEAST_SD_M, farthest)
    sd_rad = _sound(poses.rotations_sd_rad, SLIGHT, np.pi)
    velocities = poses.velocities_m_per_s
    whole = replace(
        poses,
        positions_m=np.where(placed[:, None], poses.positions_m, middle),
        rotations=np.where(looking[:, None, None], poses.rotations, np.eye(3)),
        positions_sd_m=np.where(placed[:, None], sd_m, farthest),
        rotations_sd_rad=np.where(looking[:, None], sd_rad, np.pi),
        velocities_m_per_s=None if velocities is None else np.nan_to_num(velocities, posinf=0.0, neginf=0.0),
    )
    return whole, warnings


def _sound(sd: Floats, least: float, most: Floats | float) -> Floats:
    """Deviations between the least and the most; NaN counts as the most."""
    return np.asarray(np.clip(np.where(np.isnan(sd), most, sd), least, most))


def _usable_ties(ties: TiePoints) -> tuple[TiePoints, int]:
    """Tie points that are finite in both frames, and how many are not."""
    pairs = TiePairs.of(ties.pairs)
    good = _finite_rows(pairs.image_px)
    kept: Bools = good[pairs.keypoints[0]] & good[pairs.keypoints[1]]
    if kept.all():
        return ties, 0
    sound = pairs.part(kept, np.where(good[:, None], pairs.image_px, 0.0))
    return TiePoints(sound, ties.untied), int((~kept).sum())


def _finite_rows(values: Floats) -> Bools:
    """Which rows (n,) of (n, k) are finite."""
    return np.asarray(np.isfinite(values).all(axis=1))


def _are_rotations(matrices: Floats) -> Bools:
    """Which of (n, 3, 3) are right-handed and orthonormal."""
    finite = np.nan_to_num(matrices, nan=0.0, posinf=0.0, neginf=0.0)
    off = np.abs(finite @ np.swapaxes(finite, 1, 2) - np.eye(3)).max(axis=(1, 2))
    volume = np.einsum("ni,ni->n", np.cross(finite[:, 0], finite[:, 1]), finite[:, 2])
    return np.asarray((off < SLIGHT) & (volume > 0.0))


def _finite(control: GroundControl) -> bool:
    at = np.array([[col, row] for _, col, row in control.observations])
    return bool(np.isfinite(control.enu_m).all() and np.isfinite(at).all())
