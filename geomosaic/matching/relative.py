"""How the images of pairs lie to each other in the plane, and what that makes of all frames: turns and
scales."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, diags
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from geomosaic.arrays import Complexes, Floats, Ints
from geomosaic.constants import NORMAL_PER_MAD, ROUNDS, SLIGHT, tuned
from geomosaic.estimation.linear import SparseFactors

MOST_TIES = tuned(60, "tie points a pair", "a similarity takes two, the others outvote wrong ones")
_LEAST_SPREAD = tuned(np.radians(0.5), "rad, log scale", "of pairs: less rejects tilted ones; more keeps bad")
ALIKE = tuned(0.2, "rad, log scale", "of agreeing pairs: less splits by tilt; more counts wrong ones")


@dataclass(frozen=True)
class Joints:
    """Pairs as similarities of the plane: left = turn * right, both counted from the frames' nadir points.

    left, right (m,): frames. turn (m,): complex, its size the scale. ties (m,): how many tie points.
    miss_m (m,): by how much the pair's own similarity misses its tie points, median.
    """

    left: Ints
    right: Ints
    turn: Complexes
    ties: Ints
    miss_m: Floats


def joints_of(pairs: Sequence[tuple[int, int]], both_m: Iterable[tuple[Complexes, Complexes]]) -> Joints:
    """The similarity of each pair from its tie points, east + i north from the two frames' nadir points.

    Neither frame is the truer one: the scale is the ratio of both clouds' extents, so that noise shrinks
    none. A pair counts with all its tie points, but some of them, evenly taken, make its similarity.
    """
    ties, some = np.zeros(len(pairs), np.intp), np.full((2, len(pairs), MOST_TIES), np.nan, np.complex128)
    for k, both in enumerate(both_m):
        ties[k] = len(both[0])
        which = np.linspace(0, ties[k] - 1, min(ties[k], MOST_TIES)).astype(np.intp)
        some[:, k, : len(which)] = [side[which] for side in both]
    turn, miss = _similarities(*some)
    ends = np.array(pairs, dtype=np.intp).reshape(-1, 2)
    return Joints(ends[:, 0], ends[:, 1], turn, ties, miss)


def _similarities(z: Complexes, w: Complexes) -> tuple[Complexes, Floats]:
    """z = turn w + shift, robust, of each pair (m, k), NaN beyond its ties: turns, median misses (m,)."""
    there = ~np.isnan(z.real)
    count = there.sum(axis=1)
    z, w = np.where(there, z, 0.0), np.where(there, w, 0.0)
    weight, turn, miss = there.astype(np.float64), np.ones(len(z), np.complex128), np.zeros(len(z))
    for _ in range(ROUNDS):
        total = np.maximum(weight.sum(axis=1), 1e-300)
        to_z, to_w = (v - ((weight * v).sum(axis=1) / total)[:, None] for v in (z, w))
        size_z, size_w = ((weight * np.abs(v) ** 2).sum(axis=1) for v in (to_z, to_w))
        along = (weight * to_z * np.conj(to_w)).sum(axis=1)
        spread = (size_z > 0.0) & (size_w > 0.0)
        scale = np.sqrt(size_z / np.where(spread, size_w, 1.0))
        turn = np.where(spread, scale * along / np.maximum(np.abs(along), 1e-300), turn)
        length = np.abs(to_z - turn[:, None] * to_w)
        miss = np.where(spread, _medians(np.where(there, length, np.inf), count), miss)
        weight = there / (1.0 + (length / np.maximum(2.0 * miss, 1e-9)[:, None]) ** 2)
    return turn, miss


def _medians(values: Floats, count: Ints) -> Floats:
    """Of the first `count` (m,) of each row once sorted; 0 of none."""
    values, row = np.sort(values, axis=1), np.arange(len(values))
    middle = (values[row, np.maximum(count - 1, 0) // 2] + values[row, count // 2]) / 2.0
    return np.where(count > 0, middle, 0.0)


def averaged(n: int, joints: Joints) -> Complexes:
    """Turn and scale of every frame, (n,), as all pairs together have it: left = turn_right / turn_left *
    right.

    Values are first chained along the tree of the pairs with most tie points, then set to what most
    neighbours agree on. Re-weighted least squares on the turns and on the logarithms of the scales follow
    (Govindu 2004; Chatterjee and Govindu 2013). So wrong pairs are outvoted. Each connected part turns and
    scales by what is the median of its frames: nothing shows the true value.
    """
    if not len(joints.left):
        return np.ones(n, np.complex128)
    step = np.log(joints.turn)
    value = _voted(n, joints, step, _along_tree(n, joints, step))
    for _ in range(ROUNDS):
        off = step - (value[joints.right] - value[joints.left])
        off = off.real + 1j * np.angle(np.exp(1j * off.imag))
        turn_weight, scale_weight = (_weights(part, joints.ties) for part in (off.imag, off.real))
        correction = _least_squares(n, joints, off.imag, turn_weight) * 1j
        correction = correction + _least_squares(n, joints, off.real, scale_weight)
        value = value + correction
        if np.abs(correction).max() < SLIGHT:
            break
    return np.asarray(np.exp(value))


def _weights(off: Floats, ties: Ints) -> Floats:
    spread = max(NORMAL_PER_MAD * float(np.median(np.abs(off))), _LEAST_SPREAD)
    return np.asarray(np.sqrt(ties) / (1.0 + (off / (2.0 * spread)) ** 2) ** 2)


def _along_tree(n: int, joints: Joints, step: Complexes) -> Complexes:
    """Logarithms of turns and scales along the pairs with most tie points; 0 at the first frame of each
    part."""
    tree = minimum_spanning_tree(coo_matrix((1.0 / joints.ties, (joints.left, joints.right)), shape=(n, n)))
    number = {(int(a), int(b)): k for k, (a, b) in enumerate(zip(joints.left, joints.right, strict=True))}
    value, seen = np.zeros(n, np.complex128), np.zeros(n, dtype=bool)
    for root in range(n):
        if seen[root]:
            continue
        order, before = breadth_first_order(tree, root, directed=False)
        for i in order[1:]:
            j = int(before[i])
            k = number.get((j, int(i)))
            value[i] = value[j] + (step[k] if k is not None else -step[number[int(i), j]])
        seen[order] = True
    return value


def _voted(n: int, joints: Joints, step: Complexes, value: Complexes) -> Complexes:
    """Each frame in turn takes what most of its pairs agree on, given its neighbours' present values, until
    none changes. This corrects a wrong pair in the tree, with all that depends on it."""
    mine: list[list[tuple[int, complex]]] = [[] for _ in range(n)]
    for a, b, s in zip(joints.left.tolist(), joints.right.tolist(), step, strict=True):
        mine[a].append((b, -s))
        mine[b].append((a, s))
    value = value.copy()
    for _ in range(ROUNDS):
        changed = False
        for i in (i for i in range(n) if len(mine[i]) > 2):
            said = np.array([value[j] + s for j, s in mine[i]])
            apart = said[:, None] - np.append(said, value[i])
            apart = np.hypot(apart.real, np.angle(np.exp(1j * apart.imag)))
            with_it = (apart < ALIKE).sum(axis=0)
            best = int(with_it.argmax())
            if with_it[best] > with_it[-1]:
                value[i], changed = said[best], True
        if not changed:
            break
    return value


def _least_squares(n: int, joints: Joints, off: Floats, weight: Floats) -> Floats:
    """Corrections (n,) whose differences, right minus left, come nearest to off; each part's mean stays."""
    rows = np.arange(len(off))
    difference = coo_matrix(
        (np.concatenate([np.ones(len(off)), -np.ones(len(off))]),
         (np.concatenate([rows, rows]), np.concatenate([joints.right, joints.left]))), shape=(len(off), n)
    ).tocsc()  # fmt: skip
    normal = difference.T @ diags(weight) @ difference + diags(np.full(n, SLIGHT * float(weight.max())))
    return SparseFactors(normal).solve(difference.T @ (weight * off))
