"""Methods that shift whole frames over the map: the paper's error sharing and its rivals, with moves (n, 2)
in metres."""

from __future__ import annotations

from collections.abc import Sequence
from heapq import heappop, heappush

import numpy as np
from scipy.sparse import coo_matrix, diags

from geomosaic.adjustment.model import Round
from geomosaic.adjustment.paper.misalignment import OffsetNet
from geomosaic.arrays import Complexes, Floats
from geomosaic.constants import sourced
from geomosaic.estimation.linear import SparseFactors
from geomosaic.estimation.similarity import fit_similarity
from geomosaic.placement.graph import connected_parts

Moves = tuple[Floats, tuple[Round, ...]]
_HUBER = sourced(1.5, "deviations", "of full weight; more: wrong pairs pull", "Huber 1981, about 1.345")


def rounds_of(net: OffsetNet, moves: Floats) -> tuple[Round, Round]:
    """The rounds of a method with a single step: misalignments before it, and after it."""
    still = np.zeros((net.n, 2))
    return Round(net.misalignments_m(still), moves), Round(net.misalignments_m(moves), still)


def error_sharing(net: OffsetNet, epsilon_m: float, max_rounds: int) -> Moves:
    """Error sharing without a base frame, all frames at once from the same state. On an open line each frame
    moves by half the difference of its misalignments on both sides (Yue et al. 2021, section 2.2 and equation
    6). On a net, where halves would oscillate, a pair's share is 1 / (1 + the larger number of neighbours)
    (Metropolis weights, Xiao and Boyd 2004). It stops when no misalignment exceeds epsilon_m in east or
    north, or after max_rounds."""
    share = _shares(net)
    moves, rounds = np.zeros((net.n, 2)), []
    for _ in range(max_rounds):
        misaligned = net.misalignments_m(moves)
        step = np.zeros_like(moves)
        np.add.at(step, net.pairs[:, 0], misaligned * share[:, None])
        np.add.at(step, net.pairs[:, 1], -misaligned * share[:, None])
        if not misaligned.size or np.abs(misaligned).max() < epsilon_m:
            step[:] = 0.0
        rounds.append(Round(misaligned, step))
        if not step.any():
            break
        moves = moves + step
    return moves, tuple(rounds)


def _shares(net: OffsetNet) -> Floats:
    """Of each pair's misalignment the share (m,) by which each of its frames moves."""
    degree = np.bincount(net.pairs.ravel(), minlength=net.n)
    share = 1.0 / (1.0 + degree[net.pairs].max(axis=1))
    for part in connected_parts(net.n, net.edges):
        inside = np.isin(net.pairs[:, 0], part)
        if degree[part].max(initial=0) <= 2 and inside.sum() == len(part) - 1:
            share[inside] = 0.5
    return np.asarray(share)


def base_frame(net: OffsetNet, sequence: Sequence[int]) -> Moves:
    """Traditional fine adjustment: the middle frame of each part stays. From there outward, best tied first,
    each frame moves once, to zero mean misalignment against the frames already aligned."""
    moves = np.zeros((net.n, 2))
    weight = [its.shape[1] for its in net.ends]
    order = {frame: k for k, frame in enumerate(sequence)}
    pairs: list[list[int]] = [[] for _ in range(net.n)]
    for p, pair in enumerate(net.edges):
        for frame in pair:
            pairs[frame].append(p)
    aligned: set[int] = set()
    for part in connected_parts(net.n, net.edges):
        frame = sorted(part, key=lambda i: order[i])[len(part) // 2]
        ends: list[tuple[int, int]] = []
        while True:
            aligned.add(frame)
            for p in pairs[frame]:
                heappush(ends, (-weight[p], p))
            while ends and aligned.issuperset(net.edges[ends[0][1]]):
                heappop(ends)
            if not ends:
                break
            frame = next(i for i in net.edges[ends[0][1]] if i not in aligned)
            mine = [p for p in pairs[frame] if not aligned.isdisjoint(net.edges[p])]
            pulls = [net.misalignment_m(p, moves, seen_from=frame) for p in mine]
            moves[frame] += np.average(pulls, axis=0, weights=[weight[p] for p in mine])
    return moves, rounds_of(net, moves)


def layered(net: OffsetNet, sequence: Sequence[int]) -> Moves:
    """The sequence aligned in halves, the drift of the whole spread evenly, after Wu et al. 2016 (the paper's
    reference 13). Upwards from single frames, two halves each take half of the misalignment between them. At
    the top the drift from the first to the last frame is removed in equal parts."""
    moves = np.zeros((net.n, 2))

    def align(frames: Sequence[int]) -> None:
        if len(frames) < 2:
            return
        left, right = frames[: len(frames) // 2], frames[len(frames) // 2 :]
        align(left)
        align(right)
        between = ((a, b) for a in reversed(left) for b in right if (a, b) in net.pair_of)
        if nearest := next(between, None):
            m = net.misalignment_m(net.pair_of[nearest], moves, seen_from=nearest[0])
            moves[list(left)] += m / 2.0
            moves[list(right)] -= m / 2.0

    for part in connected_parts(net.n, net.edges):
        members = set(part)
        line = [i for i in sequence if i in members]
        align(line)
        if len(line) > 1:
            drift = moves[line[-1]] - moves[line[0]]
            moves[line] -= np.linspace(-0.5, 0.5, len(line))[:, None] * drift
    return moves, rounds_of(net, moves)


def chain(net: OffsetNet, sequence: Sequence[int]) -> tuple[Complexes, Complexes]:
    """Turn (n,) and shift (n,): a frame's ground point z = east + i north goes to turn * z + shift. Each
    frame gets the similarity to the latest earlier frame with common tie points (Xu et al. 2019, the paper's
    reference 3, with similarities for homographies), so errors accumulate; without one it keeps its
    position."""
    turn = np.ones(net.n, dtype=np.complex128)
    shift = np.zeros(net.n, dtype=np.complex128)
    for k, frame in enumerate(sequence):
        last = next((i for i in reversed(sequence[:k]) if (i, frame) in net.pair_of), None)
        if last is None:
            continue
        pair = net.pair_of[last, frame]
        there, here = net.both_m(pair)[:: 1 if frame > last else -1]
        if len(here) < 2:
            continue
        aligned = (there @ [1, 1j]) * turn[last] + shift[last]
        turn[frame], shift[frame] = fit_similarity(here, np.column_stack([aligned.real, aligned.imag]))
    return turn, shift


def least_squares(
    net: OffsetNet, prior_sd_m: Floats, pair_sd_m: Floats, rounds: int = 8
) -> tuple[Floats, Floats]:
    """Moves (n, 2) and their standard deviations (n,) per axis, in metres. The moves minimise sum (move /
    prior_sd)² + sum rho(misalignment / pair_sd), with Huber's rho. A pair observes the difference of two
    moves as the median over its tie points. Args: prior_sd_m (n,): of the ground of a frame by GNSS and IMU;
    pair_sd_m (m,): of a pair's mean difference about a pure offset."""
    m, still = len(net.pairs), np.zeros((net.n, 2))
    observed = -np.array([np.median(net.differences_m(p, still), axis=0) for p in range(m)]).reshape(-1, 2)
    entries = np.concatenate([-np.ones(m), np.ones(m)])
    rows = np.tile(np.arange(m), 2)
    design = coo_matrix((entries, (rows, net.pairs.T.ravel())), shape=(m, net.n)).tocsc()
    weight, moves = 1.0 / pair_sd_m**2, still
    for _ in range(rounds):
        solver = SparseFactors((design.T @ diags(weight) @ design + diags(1.0 / prior_sd_m**2)).tocsc())
        moves = solver.solve(np.asarray(design.T @ (weight[:, None] * observed)))
        miss = np.linalg.norm(design @ moves - observed, axis=1) / pair_sd_m
        weight = np.minimum(1.0, _HUBER / np.maximum(miss, 1e-9)) / pair_sd_m**2
    variance = [solver.solve(np.eye(1, net.n, i)[0])[i] for i in range(net.n)]
    return np.asarray(moves), np.sqrt(variance)
