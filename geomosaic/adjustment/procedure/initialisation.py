"""Initial poses: relative orientation in the plane from the images, georeferenced part by part."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import bsr_matrix

from geomosaic.adjustment.model import Block
from geomosaic.adjustment.paper.misalignment import OffsetNet
from geomosaic.adjustment.procedure.georeference_parts import Fixes, PlanPriors, georeferenced
from geomosaic.arrays import Complexes, Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import about_z
from geomosaic.constants import ROUNDS, SLIGHT, tuned
from geomosaic.estimation.nested_dissection import Dissected, Dissection, matrix_of_pairs
from geomosaic.estimation.robust import THREE_SIGMA
from geomosaic.matching.relative import MOST_TIES, averaged, joints_of
from geomosaic.placement.graph import connected_parts
from geomosaic.placement.prior import heading_assumed, position_assumed
from geomosaic.placement.reach import flying_heights_m, heights_above_ground_m
from geomosaic.projection.footprint import ground_from_images

_OF_A_PAIR = tuned(6.0, "independent tie points", "of a pair, whose errors are alike; more outvote positions")
_LOCAL_SD = tuned(0.1, "rad, share of the scale", "of a frame about the pairs' mean; more: lines bend")
_ANYWHERE = tuned(100.0, "flying heights; of the scale the share", "deviation without a position; less pulls")


@dataclass(frozen=True)
class _Ties:
    """Tie points of a part: frames a and b (m,), east + i north (m,) from either nadir point, deviations
    (m,)."""

    a: Ints
    b: Ints
    z_a: Complexes
    z_b: Complexes
    sd_m: Floats

    @property
    def frames(self) -> int:
        """How many frames the part has."""
        return int(max(self.a.max(), self.b.max())) + 1

    @cached_property
    def pairs(self) -> tuple[Ints, Ints, Ints]:
        """Both frames of the pairs (k,), and each tie point's pair (m,)."""
        names, pair = np.unique(self.a * self.frames + self.b, return_inverse=True)
        return *np.divmod(names, self.frames), pair

    @cached_property
    def matrix(self) -> tuple[Ints, Ints, Ints, Dissection]:
        """See `matrix_of_pairs`; and in which order it is factorised."""
        columns, starts, order = matrix_of_pairs(self.frames, *self.pairs[:2])
        return columns, starts, order, Dissection.of(columns, starts)


def start_poses(block: Block, net: OffsetNet) -> Poses:
    """Poses turned, scaled and shifted over the ground until the images agree; attitudes stay level. Headings
    and heights come from the pairs, as single ones may be wrong by any amount. Each connected part is
    georeferenced by one robust similarity to positions, headings and heights, or to control points where no
    frame has a position."""
    poses, edges = block.poses, net.edges
    height = flying_heights_m(poses, block.ground)
    nadir: Complexes = poses.positions_m[:, :2] @ np.array([1, 1j])
    turn, place = np.ones(len(nadir), np.complex128), nadir.copy()
    all_m = ((net.both_m(k), pair) for k, pair in enumerate(edges))
    joints = joints_of(edges, ((p @ [1, 1j] - nadir[a], q @ [1, 1j] - nadir[b]) for (p, q), (a, b) in all_m))
    shape = averaged(net.n, joints)
    assumed, priors = position_assumed(poses), _priors(block, nadir, height)
    known = np.flatnonzero(~assumed)
    positions = Fixes(known, np.zeros(len(known), complex), nadir[known], priors.position_sd_m[known])
    control = _control_fixes(block, height)
    for part in connected_parts(net.n, edges):
        if len(part) == 1:
            continue
        frames = np.array(part)
        ties = _ties(net, nadir, np.maximum(joints.miss_m, net.step_m), part)
        fixes = (positions if not assumed[frames].all() else control).of(frames)
        turn[frames], place[frames] = _part(ties, shape[frames], priors.of(frames), fixes)
    up = poses.positions_m[:, 2] + (np.abs(turn) - 1.0) * height
    return replace(
        poses,
        positions_m=np.column_stack([place.real, place.imag, up]),
        rotations=about_z(np.angle(turn)) @ poses.rotations,
    )


def placed_by_images(block: Block, start: Poses) -> Block:
    """The block with frames without position moved to their initial place, and headed as there without a
    heading; their deviations stay. Without any position the ground pixel follows the new heights."""
    assumed = position_assumed(block.poses)
    if not assumed.any():
        return block
    positions_m = np.where(assumed[:, None], start.positions_m, block.poses.positions_m)
    turned = (assumed & heading_assumed(block.poses))[:, None, None]
    rotations = np.where(turned, start.rotations, block.poses.rotations)
    moved = replace(block, poses=replace(block.poses, positions_m=positions_m, rotations=rotations))
    if not assumed.all():
        return moved
    before, now = (heights_above_ground_m(b.poses, b.ground) for b in (block, moved))
    above = (before > 0.0) & (now > 0.0)
    times = float(np.median(now[above] / before[above])) if above.any() else 1.0
    return replace(moved, ground_pixel_m=block.ground_pixel_m * times)


def _priors(block: Block, nadir: Complexes, height_m: Floats) -> PlanPriors:
    """Priors in plan by positions, headings, heights and focal lengths."""
    poses, assumed = block.poses, position_assumed(block.poses)
    position_sd_m = np.hypot(poses.positions_sd_m[:, :2].max(axis=1), _by_tilt_m(poses, height_m))
    focal = np.array([(c.focal_length_sd_px or 0.0) / c.focal_length_px for c in block.cameras])
    height = np.minimum(poses.positions_sd_m[:, 2] / np.maximum(height_m, 1.0), 0.5)
    anywhere_m = _ANYWHERE * height_m
    return PlanPriors(
        nadir,
        np.where(assumed, anywhere_m, position_sd_m),
        np.minimum(poses.rotations_sd_rad[:, 2], np.pi),
        np.where(assumed, _ANYWHERE, np.hypot(height, np.maximum(focal, 0.01))),
        anywhere_m,
    )


def _by_tilt_m(poses: Poses, height_m: Floats) -> Floats:
    return np.asarray(height_m * np.minimum(poses.rotations_sd_rad[:, :2].max(axis=1), 0.5))


def _control_fixes(block: Block, height_m: Floats) -> Fixes:
    """Control points in their frames, with the deviations of the points and of the frames' tilts."""
    marks = [(i, (col, row), c) for c in block.control if not c.check for i, col, row in c.observations]
    marks.sort(key=lambda s: s[0])
    frame = np.array([i for i, _, _ in marks], dtype=np.intp)
    px = np.array([px for _, px, _ in marks], dtype=np.float64).reshape(-1, 2)
    ground_m = ground_from_images(frame, px, block.poses, block.cameras, block.ground)
    offset: Complexes = (ground_m - block.poses.positions_m[frame])[:, :2] @ np.array([1, 1j])
    at: Complexes = np.array([complex(*c.enu_m[:2]) for _, _, c in marks], complex)
    sd_m = np.hypot([c.sd_m[0] for _, _, c in marks], _by_tilt_m(block.poses, height_m)[frame])
    hit = np.isfinite(offset)
    return Fixes(frame[hit], offset[hit], at[hit], sd_m[hit])


def _part(ties: _Ties, shape: Complexes, priors: PlanPriors, fixes: Fixes) -> tuple[Complexes, Complexes]:
    """Turn and scale, and nadir point, of each frame of a part."""
    shape, place = shape / np.exp(np.log(np.abs(shape)).mean()), np.zeros(len(shape), np.complex128)
    own, middle = fixes.offset == 0.0, priors.nadir.mean()
    weight = np.ones(len(shape))
    weight[fixes.frame[own]] = 0.0
    first, whole = shape, 1.0 + 0j
    for _ in range(ROUNDS):
        off, wanted = np.log(shape / first), (priors.nadir - middle) / whole
        prior_weight = np.full((len(shape), 2), 1.0 / _LOCAL_SD**2)
        sd_m = np.minimum(priors.position_sd_m / np.sqrt(np.maximum(weight, SLIGHT)), priors.anywhere_m)
        prior_weight[:, 1] = (abs(whole) / sd_m) ** 2
        before = whole * shape
        shape, place = _agreed(ties, shape, np.column_stack([-off, wanted]), prior_weight)
        whole, shift, of_fixes = georeferenced(shape, place, priors, fixes)
        weight[fixes.frame[own]] = of_fixes[own]
        place = place + (shift - middle) / whole
        if np.abs(np.log(whole * shape / before)).max() < SLIGHT:
            break
    return whole * shape, whole * place + middle


def _agreed(
    ties: _Ties, shape: Complexes, prior: Complexes, prior_weight: Floats
) -> tuple[Complexes, Complexes]:
    """Turn and scale, and place, of a part's frames with the least distances of tie points; linear, robust.
    Unknowns of a frame, as complex numbers: the step of the logarithm of its scale and turn, and its place.
    The mean logarithm is fixed, so that the part does not shrink; priors (n, 2) of places keep long lines
    straight."""
    g_a, g_b = shape[ties.a] * ties.z_a, shape[ties.b] * ties.z_b
    tie_weight, total = 1.0 / ties.sd_m**2, np.tile([1.0, 0.0, 0.0, 0.0], len(shape))
    for _ in range(3):
        matrix, side = _normals(ties, g_a, g_b, tie_weight, prior_weight)
        side += prior_weight * prior
        sides = np.column_stack([side.view(np.float64).ravel(), total])
        free, along = Dissected(matrix, ties.matrix[-1]).solve(sides).T
        x = free - along * (total @ free) / (total @ along)
        step, place = x.view(np.complex128).reshape(-1, 2).T
        grown = 1.0 + step
        length = np.abs(g_a * grown[ties.a] + place[ties.a] - g_b * grown[ties.b] - place[ties.b])
        limit = THREE_SIGMA * np.maximum(ties.sd_m / np.sqrt(_OF_A_PAIR), 1.5 * float(np.median(length)))
        tie_weight = 1.0 / ties.sd_m**2 / (1.0 + (length / limit) ** 2)
    return shape * np.exp(np.clip(step.real, -0.5, 0.5) + 1j * step.imag), place


def _normals(
    ties: _Ties, g_a: Complexes, g_b: Complexes, weight: Floats, prior_weight: Floats
) -> tuple[bsr_matrix, Complexes]:
    """Normal equations of `_agreed` in real numbers, 4 a frame, and their right-hand side (n, 2) without that
    of the priors. g_a, g_b, weight (m,): of tie points from either nadir point."""
    left, right, pair = ties.pairs

    def summed(values: Complexes) -> Complexes:
        real, imaginary = (np.bincount(pair, weight * part) for part in (values.real, values.imag))
        return real + 1j * imaginary

    one, a, b = (summed(g) for g in (np.ones_like(g_a), g_a, g_b))
    aa, ab, bb = (summed(np.conj(g) * h) for g, h in ((g_a, g_a), (g_a, g_b), (g_b, g_b)))
    own, side = np.zeros((ties.frames, 2, 2), complex), np.zeros((ties.frames, 2), complex)
    own[:, [0, 1], [0, 1]] = prior_weight
    np.add.at(own, left, np.array([[aa, np.conj(a)], [a, one]]).transpose(2, 0, 1))
    np.add.at(own, right, np.array([[bb, np.conj(b)], [b, one]]).transpose(2, 0, 1))
    np.add.at(side, left, np.array([ab - aa, b - a]).T)
    np.add.at(side, right, np.array([np.conj(ab) - bb, a - b]).T)
    meet = -np.array([[ab, np.conj(a)], [b, one]]).transpose(2, 0, 1)
    columns, starts, order, _ = ties.matrix
    blocks = np.concatenate([own, meet, np.conj(np.swapaxes(meet, 1, 2))])[order]
    real = np.kron(blocks.real, np.eye(2)) + np.kron(blocks.imag, np.array([[0.0, -1.0], [1.0, 0.0]]))
    return bsr_matrix((real, columns, starts), shape=(4 * ties.frames,) * 2), side


def _ties(net: OffsetNet, nadir: Complexes, miss_m: Floats, part: list[int]) -> _Ties:
    """Tie points of a part, at most MOST_TIES a pair, frames renumbered; miss_m (m,): a pair's residual."""
    number = {frame: k for k, frame in enumerate(part)}
    pairs = []
    for (a, b), keypoints, miss in zip(net.edges, net.ends, miss_m, strict=True):
        if a in number:
            count = keypoints.shape[1]
            some = np.linspace(0, count - 1, min(count, MOST_TIES)).astype(np.intp)
            left, right = net.plan_m[keypoints[:, some]]
            sd_m = np.full(len(some), miss * np.sqrt(max(len(some) / _OF_A_PAIR, 1.0)))
            ends = np.full(len(some), number[a]), np.full(len(some), number[b])
            pairs.append((*ends, left @ [1, 1j] - nadir[a], right @ [1, 1j] - nadir[b], sd_m))
    return _Ties(*(np.concatenate(column) for column in zip(*pairs, strict=True)))
