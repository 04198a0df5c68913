"""Reported velocities, rotation rates, headings and heights corrected by the solved block."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geomosaic.adjustment.kernels.row_functions import with_rotation_terms
from geomosaic.adjustment.model import Block, Settings
from geomosaic.adjustment.solver.solution import Solution
from geomosaic.arrays import Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import about_z
from geomosaic.constants import NORMAL_PER_MAD, SLIGHT, tuned
from geomosaic.estimation.linear import inverse, least_squares, orthonormal
from geomosaic.estimation.robust import FAR, LEAST_OBSERVATIONS, THREE_SIGMA
from geomosaic.estimation.similarity import fit_similarity
from geomosaic.placement.graph import connected_parts
from geomosaic.placement.prior import heading_assumed, heading_limits_rad, position_assumed
from geomosaic.placement.velocity import flown_m_per_s, unsteady_m_per_s
from geomosaic.survey.model import Warn

_MOST_PARTS = tuned(4, "jumps and slopes", "two batteries, a wrong barometer: two of each; more: noise")
_OTHER_VELOCITY = tuned(0.1, "share of the velocity", "that justifies a new solve; less has no effect")
_MOST_SCALE = tuned(1.5, "times", "given by solved paths; beyond it the positions show no scale")
_OWN_SD_RAD_PER_S = tuned(0.012, "rad/s", "of a frame about the offset: 1 ms of delay in 10 rad/s²")


def with_solved_velocities(block: Block, poses: Poses) -> tuple[Block, bool]:
    """The block with velocities of solved poses, and whether one differs by a tenth from the given, as after
    wrong positions, gaps and ends of lines. Their scale is that of given positions, since rolling shutters
    tie the size of the block to velocities."""
    given, times_s = block.poses.velocities_m_per_s, block.times_s
    if given is None or times_s is None or not np.isfinite(times_s).any():
        return block, False
    known, scale = ~position_assumed(block.poses), 1.0
    if known.sum() >= 3:
        turn, _ = fit_similarity(poses.positions_m[known, :2], block.poses.positions_m[known, :2])
        scale = float(abs(turn)) if 1.0 / _MOST_SCALE < abs(turn) < _MOST_SCALE else 1.0
    unsteady = unsteady_m_per_s(scale * poses.positions_m, times_s)
    velocities = flown_m_per_s(scale * poses.positions_m, times_s)
    velocities = np.where(np.isfinite(times_s)[:, None], velocities, given)
    off, speed = (np.linalg.norm(v, axis=1) for v in (velocities - given, velocities))
    other = bool((off > _OTHER_VELOCITY * speed).any())
    poses = replace(block.poses, velocities_m_per_s=velocities)
    return replace(block, poses=poses, unsteady_m_per_s=unsteady), other


def with_common_rate(block: Block, settings: Settings, solved: Solution) -> tuple[Block, Settings]:
    """The block with the median of the frames' own rates (a gyroscope's zero), in camera axes, added to the
    reported rotations, and settings with a narrower prior of own rates. Rates as free as the offset weaken
    small blocks."""
    readouts_s = np.array([c.readout_s for c in block.cameras])
    known = solved.estimate.rotation_terms_rad.any(axis=(1, 2)) & (readouts_s > 0.0)
    if known.sum() < LEAST_OBSERVATIONS:
        return block, settings
    common = np.median(solved.estimate.rotation_terms_rad[known, 0] / readouts_s[known, None], axis=0)
    poses = with_rotation_terms(block.poses, (readouts_s[:, None] * common)[:, None], readouts_s)
    return replace(block, poses=poses), replace(settings, rate_sd_rad_per_s=_OWN_SD_RAD_PER_S)


def with_common_heading(block: Block, start: Poses) -> tuple[Block, Poses, list[Warn]]:
    """The block with the headings of each connected part corrected by their common error, initial poses that
    go with it, and a warning for each part whose headings were observed. What the adjustment takes for such
    an error is limited by the headings' deviation. The median turn from given to initial headings is common
    where it is beyond each frame's limit and the frames' own scatter. Where it is within three deviations of
    what the positions tell of a turn, as of frames that hover, the initial poses are turned instead."""
    observed, located = ~heading_assumed(block.poses), ~position_assumed(block.poses)
    limit = heading_limits_rad(block.poses)
    turned = np.einsum("nij,nkj->nik", start.rotations, block.poses.rotations)
    angle = np.arctan2(turned[:, 1, 0] - turned[:, 0, 1], turned[:, 0, 0] + turned[:, 1, 1])
    common, warnings = np.zeros(len(angle)), []
    parts = [np.array(part) for part in connected_parts(len(block.names), block.ties.frames)]
    for its in [part[which[part]] for part in parts for which in (observed, ~observed)]:
        mine = its[located[its]]
        if len(mine) < LEAST_OBSERVATIONS:
            continue
        mean = np.angle(np.exp(1j * angle[mine]).sum())
        apart = np.angle(np.exp(1j * (angle[mine] - mean)))
        off = float(np.angle(np.exp(1j * (mean + np.median(apart)))))
        scatter = NORMAL_PER_MAD * float(np.median(np.abs(apart - np.median(apart))))
        if abs(off) <= max(float(np.median(limit[mine])), 2.0 * scatter):
            continue
        if observed[its[0]] and abs(off) <= THREE_SIGMA * _turn_sd_rad(block.poses, mine):
            start = _turned(start, its, -off)
            continue
        common[its] = off
        if not observed[its[0]]:
            continue
        text = (
            f"the headings of {len(its)} frames are {abs(np.degrees(off)):.0f} degrees too "
            f"{'small' if off < 0.0 else 'large'} in common, as their positions show: corrected, "
            "nothing to do"
        )
        warnings.append(Warn("headings-off", "", text))
    rotations = about_z(common) @ block.poses.rotations
    return replace(block, poses=replace(block.poses, rotations=rotations)), start, warnings


def _turn_sd_rad(poses: Poses, frames: Ints) -> float:
    """Of a common turn by the reported positions of frames, whose errors count as alike for all of them."""
    at_m = poses.positions_m[frames, :2]
    spread_m = float(np.sqrt(np.square(at_m - at_m.mean(axis=0)).sum(axis=1).mean()))
    return float(np.median(poses.positions_sd_m[frames, :2])) / max(spread_m, SLIGHT)


def _turned(poses: Poses, frames: Ints, angle_rad: float) -> Poses:
    """The poses with some frames turned together about their middle."""
    turn = about_z(np.array([angle_rad]))[0]
    positions_m, rotations = poses.positions_m.copy(), poses.rotations.copy()
    middle_m = positions_m[frames].mean(axis=0)
    positions_m[frames] = middle_m + (positions_m[frames] - middle_m) @ turn.T
    rotations[frames] = turn @ rotations[frames]
    return replace(poses, positions_m=positions_m, rotations=rotations)


@dataclass(frozen=True)
class HeightDrift:
    """Drift of reported heights in order of flight. order (n,): frames by time. metres (n,): drift of each,
    with mean 0. parts: the largest first: rise in m, and the place in `order` behind which it jumps, or None
    for a slope from end to end."""

    order: Ints
    metres: Floats
    parts: tuple[tuple[float, int | None], ...]

    def freed(self, block: Block) -> Block:
        """The block with heights without the drift."""
        at = block.poses.positions_m.copy()
        at[self.order, 2] -= self.metres
        return replace(block, poses=replace(block.poses, positions_m=at))

    def warnings(self, block: Block) -> list[Warn]:
        """The largest part as a warning."""
        if not self.parts:
            return []
        rise_m, jump = self.parts[0]
        first, last = block.names[self.order[0]], block.names[self.order[-1]]
        does = f"drift by {rise_m:+.1f} m from {first} to {last}"
        if jump is not None:
            first, last = block.names[self.order[jump]], block.names[self.order[jump + 1]]
            does = f"jump by {rise_m:+.1f} m between {first} and {last}"
        stated_m = float(np.median(block.poses.positions_sd_m[self.order, 2]))
        more = f", and {len(self.parts) - 1} more such" if len(self.parts) > 1 else ""
        text = f"heights {does} against the images (stated deviation {stated_m:.1f} m){more}"
        return [
            Warn(
                "heights-drift",
                first,
                f"{text}; set by the images: give control points with --gcp where heights matter",
            )
        ]


def height_drift(block: Block, poses: Poses, frames: Ints) -> HeightDrift:
    """The drift of reported minus adjusted heights of the given frames, as slopes and jumps. Forward
    selection: a line, a jump, or both at once where neither suffices, as long as each rise exceeds three
    stated deviations of a height and five of its own."""
    known = set(frames[~position_assumed(block.poses)[frames]].tolist())
    order = np.array([i for i in block.sequence if i in known], dtype=np.intp)
    n = len(order)
    if n < LEAST_OBSERVATIONS:
        return HeightDrift(order, np.zeros(n), ())
    off_m = block.poses.positions_m[order, 2] - poses.positions_m[order, 2]
    off_m -= off_m.mean()
    least_m = THREE_SIGMA * float(np.median(block.poses.positions_sd_m[order, 2]))
    parts: tuple[int, ...] = ()
    rises = np.zeros(0)
    while grown := _with_one_more(off_m, parts, least_m):
        parts, rises = grown
    by_size = sorted(zip(rises.tolist(), parts, strict=True), key=lambda part: -abs(part[0]))
    return HeightDrift(order, rises @ _shapes(parts, n), tuple((r, k or None) for r, k in by_size))


def _with_one_more(
    off_m: Floats, parts: tuple[int, ...], least_m: float
) -> tuple[tuple[int, ...], Floats] | None:
    """The parts with the best one, or a line and the best jump, added, and all rises (k,) in m; else None."""
    for line in ((), (0,)):
        others = (*parts, *line)
        if len(set(others)) < len(others) or len(others) >= min(_MOST_PARTS, len(off_m) - 3):
            continue
        tried = (*others, _best(off_m, others))
        if len(set(tried)) < len(tried):
            continue
        shapes = _shapes(tried, len(off_m))
        rises = least_squares(shapes.T, off_m)
        left = float(((off_m - rises @ shapes) ** 2).sum())
        sds = np.sqrt(np.diag(inverse(shapes @ shapes.T)) * left / (len(off_m) - 1 - len(rises)))
        if (np.abs(rises) > np.maximum(least_m, FAR * sds))[len(parts) :].all():
            return tried, rises
    return None


def _shapes(parts: tuple[int, ...], n: int) -> Floats:
    """A line (0), and jumps behind the k-th frame, that rise by 1 with mean 0, (parts, n)."""
    along = np.arange(n)
    shapes = [along / (n - 1.0) if k == 0 else (along > k).astype(np.float64) for k in parts]
    return np.array([s - s.mean() for s in shapes]).reshape(len(parts), n)


def _best(off_m: Floats, others: tuple[int, ...]) -> int:
    """The line or jump that reduces the squares most, given the other parts. All jumps at once, by running
    sums: a jump's product with a vector of mean 0 is the sum behind the jump."""
    n = len(off_m)
    (line,), q = _shapes((0,), n), orthonormal(_shapes(others, n).T)
    behind = np.arange(1, n - 2)  # two frames at least on either side

    def products(vectors: Floats) -> Floats:
        sums = vectors.sum(axis=0) - np.cumsum(vectors, axis=0)
        return np.concatenate([line[None] @ vectors, sums[behind]])

    squares = np.concatenate([[line @ line], (behind + 1.0) * (n - 1.0 - behind) / n])
    free = squares - (products(q) ** 2).sum(axis=1)
    along = products((off_m - q @ (q.T @ off_m))[:, None])[:, 0]
    gain = along**2 / np.where(free > 1e-9 * squares, free, np.inf)
    return int(np.concatenate([[0], behind])[gain.argmax()])
