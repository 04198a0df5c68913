"""Where a bundle begins: the frames' shape from the images, laid onto the positions part by part."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix

from geomosaic.adjustment.kernels.nested_dissection import Dissected
from geomosaic.adjustment.model import Block
from geomosaic.adjustment.paper.misalignment import OffsetNet
from geomosaic.adjustment.procedure.georeference_parts import Beliefs, Fixes, laid
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import about_z
from geomosaic.constants import tuned
from geomosaic.matching.relative import averaged, joints_of
from geomosaic.placement.graph import connected_parts
from geomosaic.placement.prior import heading_assumed, position_assumed
from geomosaic.placement.reach import flying_heights_m, heights_above_ground_m
from geomosaic.projection.footprint import ground_from_images

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Ints = NDArray[np.intp]
_MOST_TIES = tuned(
    60,
    "tie points a pair",
    "taken for the start: a similarity of two frames takes two, the others outvote wrong ones; more "
    "take time alone",
)
_ROUNDS = tuned(
    4,
    "rounds",
    "of shape by the ties, then laying on the positions: the first hears no position, the later ones "
    "those that fit; with fewer a long line stays bent",
)
_OF_A_PAIR = tuned(
    6.0,
    "independent tie points",
    "what a pair's tie points say together at most: they miss alike, by the frames' tilts; if each "
    "counted, positions would have no say",
)
_LOCAL_SCALE_SD = tuned(
    0.1,
    "share of the scale",
    "how far a frame's scale may go from what the pairs' average says: along a line of frames that all "
    "look 5 degrees ahead each pair's is off by some per cent, one way; with more, frames shrink to "
    "please ties",
)
_LOCAL_TURN_SD = tuned(
    0.1,
    "rad",
    "how far a frame's turn may go from what the pairs' average says; with more, a long line bends to "
    "please its ties",
)
_CAUCHY = tuned(
    3.0,
    "deviations of a tie point",
    "where its weight is a half: with less, ties that tilts put aside lose their say; with more, wrong "
    "matches keep it",
)
_ANYWHERE = tuned(
    100.0,
    "flying heights; for its scale the share",
    "that a frame without a position may be off: nothing beside the ties, but it holds a part that "
    "nothing else holds; with less it would draw the block to where the frame was assumed to be",
)


@dataclass(frozen=True)
class _Ties:
    """Tie points of a part, each pair thinned: frames a and b (m,), their places (m,) east + i north from the
    frames' nadir points, and what each may be off by (m,)."""

    a: Ints
    b: Ints
    z_a: Complexes
    z_b: Complexes
    sd_m: Floats


def start_poses(block: Block, net: OffsetNet) -> Poses:
    """Frames turned, scaled and shifted over the ground so that the images agree, each connected part laid
    onto its positions as one.

    A camera's heading may be wrong by any angle and its height by any factor: both come from the pairs. What
    a part has in common, scale, turn and place, comes from its positions by one robust similarity, and from
    headings and heights as far as their deviations go; ties that shrink have no way of pleasing themselves.
    """
    poses = block.poses
    height = flying_heights_m(poses, block.ground)
    nadir: Complexes = poses.positions_m[:, :2] @ np.array([1, 1j])
    turn, place = np.ones(len(nadir), np.complex128), nadir.copy()
    edges = net.edges
    whole = zip(net.left_m, net.right_m, edges, strict=True)
    joints = joints_of(edges, ((p @ [1, 1j] - nadir[a], q @ [1, 1j] - nadir[b]) for p, q, (a, b) in whole))
    left = [_thinned(p) @ [1, 1j] - nadir[a] for p, (a, _) in zip(net.left_m, edges, strict=True)]
    right = [_thinned(p) @ [1, 1j] - nadir[b] for p, (_, b) in zip(net.right_m, edges, strict=True)]
    shape = averaged(net.n, joints)
    tilt = np.minimum(poses.rotations_sd_rad[:, :2].max(axis=1), 0.5)
    position_sd_m = np.hypot(poses.positions_sd_m[:, :2].max(axis=1), height * tilt)
    assumed = position_assumed(poses)
    beliefs = Beliefs(
        nadir,
        np.where(assumed, _ANYWHERE * height, position_sd_m),
        np.minimum(poses.rotations_sd_rad[:, 2], np.pi),
        _scale_sd(block, height),
    )
    known = np.flatnonzero(~assumed)
    positions = Fixes(known, np.zeros(len(known), np.complex128), nadir[known], position_sd_m[known])
    control = _control_fixes(block, height * tilt)
    for frames in connected_parts(net.n, edges):
        if len(frames) == 1:
            continue
        inside = set(frames)
        mine = [k for k, (a, _) in enumerate(edges) if a in inside]
        ties = _ties([edges[k] for k in mine], [left[k] for k in mine], [right[k] for k in mine],
                     np.maximum(joints.miss_m[mine], net.step_m), frames)  # fmt: skip
        fixes = (positions if not assumed[frames].all() else control).of(np.array(frames))
        turn[frames], place[frames] = _part(ties, shape[frames], beliefs.of(np.array(frames)), fixes)
    scale = np.abs(turn)
    up = poses.positions_m[:, 2] + (scale - 1.0) * height
    return replace(
        poses,
        positions_m=np.column_stack([place.real, place.imag, up]),
        rotations=about_z(np.angle(turn)) @ poses.rotations,
    )


def placed_by_images(block: Block, start: Poses) -> Block:
    """The block with its frames without position where the start has put them, as high, and headed as there
    if they have no heading either; nothing is known of them still. Where no frame has a position, its ground
    pixel is that of these heights."""
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


def _control_fixes(block: Block, off_m: Floats) -> Fixes:
    """Where control points lie in the frames that see them; off_m (n,): what these are off by their tilts."""
    seen = [(i, (col, row), c) for c in block.control if not c.check for i, col, row in c.observations]
    frame = np.array([i for i, _, _ in seen], dtype=np.intp)
    if not len(frame):
        nowhere = np.zeros(0, np.complex128)
        return Fixes(frame, nowhere, nowhere, np.zeros(0))
    px = np.array([px for _, px, _ in seen])
    ground_m = ground_from_images(frame, px, block.poses, block.cameras, block.ground)
    offset: Complexes = (ground_m - block.poses.positions_m[frame])[:, :2] @ np.array([1, 1j])
    at: Complexes = np.array([c.enu_m[:2] for _, _, c in seen]) @ np.array([1, 1j])
    sd_m = np.hypot([c.sd_m[0] for _, _, c in seen], off_m[frame])
    hit, order = np.isfinite(offset), np.argsort(frame, kind="stable")
    order = order[hit[order]]
    return Fixes(frame[order], offset[order], at[order], sd_m[order])


def _scale_sd(block: Block, height_m: Floats) -> Floats:
    """How well frames' scales are determined by their heights and focal lengths, as shares of them, (n,)."""
    focal = np.array([(c.focal_length_sd_px or 0.0) / c.focal_length_px for c in block.cameras])
    height = np.minimum(block.poses.positions_sd_m[:, 2] / np.maximum(height_m, 1.0), 0.5)
    known = np.hypot(height, np.maximum(focal, 0.01))
    return np.where(position_assumed(block.poses), _ANYWHERE, known)


def _part(ties: _Ties, shape: Complexes, beliefs: Beliefs, fixes: Fixes) -> tuple[Complexes, Complexes]:
    """Turn and scale, and nadir point, of each frame of a part."""
    shape, place = shape / np.exp(np.log(np.abs(shape)).mean()), np.zeros(len(shape), np.complex128)
    own = fixes.offset == 0.0
    trust = np.ones(len(shape))
    trust[fixes.frame[own]] = 0.0
    first, whole = shape, 1.0 + 0j
    for _ in range(_ROUNDS):
        wanted = (beliefs.nadir - beliefs.nadir.mean()) / whole
        shape, place = _agreed(ties, shape, first, wanted, beliefs.position_sd_m / abs(whole), trust)
        whole, shift, heard = laid(shape, place, beliefs, fixes)
        trust[fixes.frame[own]] = heard[own]
        place = place + (shift - beliefs.nadir.mean()) / whole
    return whole * shape, whole * place + beliefs.nadir.mean()


def _agreed(
    ties: _Ties, shape: Complexes, first: Complexes, wanted: Complexes, sd_m: Floats, trust: Floats
) -> tuple[Complexes, Complexes]:
    """Frames of a part turned and scaled a little, and put down, so that their tie points meet; linear.

    Unknowns of a frame: the logarithm of its scale, its turn, and its place. The mean logarithm stays as it
    is: the part as a whole can't shrink. Places are drawn to those wanted as far as they are trusted, which
    keeps a long line from bending.
    """
    n, m = len(shape), len(ties.a)
    row = np.arange(m)
    g_a, g_b = shape[ties.a] * ties.z_a, -shape[ties.b] * ties.z_b
    one = np.ones(m)
    # Rows: east parts of all ties, then north parts. A frame's step (s + i t) moves g to g (1 + s + i t).
    entries = [
        (row, 4 * ties.a, g_a.real), (row, 4 * ties.a + 1, -g_a.imag), (row, 4 * ties.a + 2, one),
        (row, 4 * ties.b, g_b.real), (row, 4 * ties.b + 1, -g_b.imag), (row, 4 * ties.b + 2, -one),
        (row + m, 4 * ties.a, g_a.imag), (row + m, 4 * ties.a + 1, g_a.real), (row + m, 4 * ties.a + 3, one),
        (row + m, 4 * ties.b, g_b.imag), (row + m, 4 * ties.b + 1, g_b.real), (row + m, 4 * ties.b + 3, -one),
    ]  # fmt: skip
    rows, columns, values = (np.concatenate(part) for part in zip(*entries, strict=True))
    design = coo_matrix((values, (rows, columns)), shape=(2 * m, 4 * n)).tocsc()
    apart = -(g_a + g_b)
    side = np.concatenate([apart.real, apart.imag])
    off = np.log(shape / first)
    prior = np.column_stack([-off.real, -off.imag, wanted.real, wanted.imag]).ravel()
    sd = np.column_stack([np.full(n, _LOCAL_SCALE_SD), np.full(n, _LOCAL_TURN_SD), sd_m, sd_m]).ravel()
    prior_weight = (
        np.column_stack([np.ones((n, 2)), np.tile(np.maximum(trust, 1e-6)[:, None], 2)]).ravel() / sd**2
    )
    tie_weight, x = 1.0 / ties.sd_m**2, np.zeros(4 * n)
    for _ in range(3):
        weight = np.tile(tie_weight, 2)
        normal = design.T @ design.multiply(weight[:, None]).tocsc() + coo_matrix(
            (prior_weight, (np.arange(4 * n),) * 2)
        )
        total = np.zeros(4 * n)
        total[::4] = 1.0
        sides = np.column_stack([design.T @ (weight * side) + prior_weight * prior, total])
        free, along = Dissected(normal.tobsr(blocksize=(4, 4))).solve(sides).T
        x = free - along * (total @ free) / (total @ along)
        miss = design @ x - side
        length = np.hypot(miss[:m], miss[m:])
        limit = _CAUCHY * np.maximum(ties.sd_m / np.sqrt(_OF_A_PAIR), 1.5 * float(np.median(length)))
        tie_weight = 1.0 / ties.sd_m**2 / (1.0 + (length / limit) ** 2)
    scale, turn, east, north = x.reshape(n, 4).T
    return shape * np.exp(np.clip(scale, -0.5, 0.5) + 1j * turn), east + 1j * north


def _thinned(places_m: Floats) -> Floats:
    """At most _MOST_TIES of a pair's, evenly by number."""
    return places_m[np.linspace(0, len(places_m) - 1, min(len(places_m), _MOST_TIES)).astype(np.intp)]


def _ties(
    pairs: list[tuple[int, int]],
    left: list[Complexes],
    right: list[Complexes],
    miss_m: Floats,
    frames: list[int],
) -> _Ties:
    """Those of some pairs; frames counted in their part."""
    number = {frame: k for k, frame in enumerate(frames)}
    a, b, z_a, z_b, sd = [], [], [], [], []
    for (first, second), z, w, miss in zip(pairs, left, right, miss_m, strict=True):
        a.append(np.full(len(z), number[first], dtype=np.intp))
        b.append(np.full(len(z), number[second], dtype=np.intp))
        z_a.append(z)
        z_b.append(w)
        sd.append(np.full(len(z), miss * np.sqrt(max(len(z) / _OF_A_PAIR, 1.0))))
    return _Ties(*(np.concatenate(part) for part in (a, b, z_a, z_b, sd)))
