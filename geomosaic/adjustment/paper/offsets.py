"""Methods that shift whole frames over the map: the paper's error sharing and its rivals.

Each returns the moves (n, 2) of all frames in metres, and the rounds of the adjustment.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geomosaic.adjustment.model import Round
from geomosaic.adjustment.paper.misalignment import OffsetNet
from geomosaic.arrays import Floats
from geomosaic.placement.graph import connected_parts

Moves = tuple[Floats, tuple[Round, ...]]


def rounds_of(net: OffsetNet, moves: Floats) -> tuple[Round, Round]:
    """The rounds of a method with a single step: misalignments before it, and after it."""
    still = np.zeros((net.n, 2))
    return Round(net.misalignments_m(still), moves), Round(net.misalignments_m(moves), still)


def error_sharing(net: OffsetNet, epsilon_m: float, max_rounds: int) -> Moves:
    """Error sharing without a base frame, all frames at once from the same state.

    On an open line each frame moves by half the difference of its misalignments on both sides, so that the
    mean move is 0 (Yue et al. 2021, section 2.2 and equation 6). On a net halves would oscillate; there a
    pair's share is 1 / (1 + the larger number of neighbours), which converges (Metropolis weights, Xiao and
    Boyd 2004). It stops when no misalignment exceeds epsilon_m in east or north, or after max_rounds.
    """
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
    """Traditional fine adjustment: the middle frame of each part stays, its error is passed on.

    From the base outward, best tied first, each frame moves once, to zero mean misalignment against the
    frames already aligned.
    """
    moves = np.zeros((net.n, 2))
    weight = [len(d) for d in net.left_m]
    order = {frame: k for k, frame in enumerate(sequence)}
    for part in connected_parts(net.n, net.edges):
        aligned = {sorted(part, key=lambda i: order[i])[len(part) // 2]}
        while len(aligned) < len(part):
            ends = [p for p, pair in enumerate(net.edges) if len(aligned.intersection(pair)) == 1]
            best = max(ends, key=lambda p: (weight[p], -p))
            frame = next(i for i in net.edges[best] if i not in aligned)
            mine = [net.pair_of[frame, i] for i in aligned if (frame, i) in net.pair_of]
            pulls = [net.misalignment_m(p, moves, seen_from=frame) for p in sorted(mine)]
            moves[frame] += np.average(pulls, axis=0, weights=[weight[p] for p in sorted(mine)])
            aligned.add(frame)
    return moves, rounds_of(net, moves)


def layered(net: OffsetNet, sequence: Sequence[int]) -> Moves:
    """The sequence aligned in halves, the drift of the whole spread evenly.

    After Wu et al. 2016 (the paper's reference 13): the sequence is halved down to single frames; upwards,
    two halves each take half of the misalignment between them. At the top the drift from the first to the
    last frame, against the coarse placement, is removed in equal parts.
    """
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
