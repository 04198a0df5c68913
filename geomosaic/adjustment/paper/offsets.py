"""Methods that slide whole frames over the map: the paper's error sharing and its rivals.

Each takes the net of tie points and what else it needs from the block and returns the moves of all
frames (n, 2) in metres with the rounds that led there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import Round
from geomosaic.adjustment.paper.misalignment import OffsetNet
from geomosaic.placement.graph import connected_parts

Floats = NDArray[np.float64]
Moves = tuple[Floats, tuple[Round, ...]]


def none(net: OffsetNet) -> Moves:
    """Coarse placement alone: one round in which nothing moves, so that misalignments are on record."""
    still = np.zeros((net.n, 2))
    return still, (Round(net.misalignments_m(still), still),)


def error_sharing(net: OffsetNet, epsilon_m: float, max_rounds: int) -> Moves:
    """Error sharing without a base frame, all frames at once from the same state.

    Yue et al. 2021, section 2.2 and equation 6: on an open line each frame moves by half the
    difference of its misalignments on its two sides, an end's missing side counting zero. So each
    pair's misalignment is split into two equal and opposite halves, and the mean of all moves is zero.
    On a net (across flight lines, or over more than one neighbour) halves would let a chequerboard of
    moves swing for ever; there a pair's share is 1 / (1 + the larger number of neighbours), which
    keeps the two opposite and the rounds contracting (Metropolis weights, Xiao and Boyd 2004).

    Stops when no misalignment exceeds epsilon_m in east or north, or after max_rounds.
    """
    degree = np.bincount(net.pairs.ravel(), minlength=net.n)
    share = _shares(net, degree)
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


def _shares(net: OffsetNet, degree: NDArray[np.intp]) -> Floats:
    share = 1.0 / (1.0 + np.maximum(degree[net.pairs[:, 0]], degree[net.pairs[:, 1]]))
    for part in connected_parts(net.n, net.edges):
        inside = np.isin(net.pairs[:, 0], part)
        if degree[part].max(initial=0) <= 2 and inside.sum() == len(part) - 1:
            share[inside] = 0.5
    return np.asarray(share)


def base_frame(net: OffsetNet, sequence: Sequence[int]) -> Moves:
    """Traditional fine adjustment: the middle frame stays, its error is passed on.

    From the base outward, best tied first, each frame moves once so that it agrees in the mean with
    the frames already settled. Each part of the survey has a base of its own.
    """
    moves = np.zeros((net.n, 2))
    first = net.misalignments_m(moves)
    weight = np.array([len(d) for d in net.left_m])
    order = {frame: k for k, frame in enumerate(sequence)}
    for part in connected_parts(net.n, net.edges):
        by_order = sorted(part, key=lambda i: order[i])
        settled = {by_order[len(by_order) // 2]}
        while len(settled) < len(part):
            open_pairs = [
                p for p, (a, b) in enumerate(net.pairs) if (int(a) in settled) != (int(b) in settled)
            ]
            best = max(open_pairs, key=lambda p: (weight[p], -p))
            frame = next(int(i) for i in net.pairs[best] if int(i) not in settled)
            moves[frame] = _agree(net, moves, frame, settled)
            settled.add(frame)
    return moves, (Round(first, moves.copy()), Round(net.misalignments_m(moves), np.zeros_like(moves)))


def _agree(net: OffsetNet, moves: Floats, frame: int, settled: set[int]) -> Floats:
    """The move of a frame that zeroes its mean misalignment against settled frames."""
    mine = [p for p, (a, b) in enumerate(net.edges) if frame in (a, b) and a + b - frame in settled]
    pulls = [net.misalignment_m(p, moves, seen_from=frame) for p in mine]
    return np.asarray(moves[frame] + np.average(pulls, axis=0, weights=[len(net.left_m[p]) for p in mine]))


def layered(net: OffsetNet, sequence: Sequence[int]) -> Moves:
    """The sequence matched in halves, the total error spread evenly.

    After Wu et al. 2016 (the paper's reference 13): the sequence is halved down to single frames;
    going back up, two halves meet at their joint and each takes half of its misalignment; at the top
    the whole line's drift from first to last frame, against the coarse placement, is taken out in equal
    parts at every joint. So the line holds its place as a whole, and every joint keeps a little.
    """
    start = np.zeros((net.n, 2))
    joints = {pair: p for p, pair in enumerate(net.edges)}
    moves = start.copy()

    def settle(frames: Sequence[int]) -> None:
        if len(frames) < 2:
            return
        half = len(frames) // 2
        settle(frames[:half])
        settle(frames[half:])
        left, right = frames[:half], frames[half:]
        across = [(a, b) for a in reversed(left) for b in right if (min(a, b), max(a, b)) in joints]
        if across:
            a, b = across[0]
            m = net.misalignment_m(joints[(min(a, b), max(a, b))], moves, seen_from=a)
            moves[list(left)] += m / 2.0
            moves[list(right)] -= m / 2.0

    for part in connected_parts(net.n, net.edges):
        members = set(part)
        line = [i for i in sequence if i in members]
        settle(line)
        if len(line) > 1:
            drift = moves[line[-1]] - moves[line[0]]
            moves[line] -= np.linspace(-0.5, 0.5, len(line))[:, None] * drift
    return moves, (
        Round(net.misalignments_m(start), moves.copy()),
        Round(net.misalignments_m(moves), np.zeros_like(moves)),
    )
