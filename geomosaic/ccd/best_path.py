"""The path of most evidence through a volume of shifts."""

from __future__ import annotations

import numpy as np

from geomosaic.arrays import Floats, Ints


def best_path(volumes: Floats, cost: float, jump: float = np.inf) -> Ints:
    """The paths of most evidence less what their steps cost: dynamic programming (Viterbi 1967).

    A step is one bin at most along lines and along columns, from one block to the next; or any number along
    lines, where lines were lost.

    Args: volumes (pairs, blocks, h, c) evidence for every shift. cost: of a step of one bin. jump: of one of
    any number along lines.
    Returns: (pairs, blocks, 2) indices into h and c.
    """
    k, n, h, c = volumes.shape
    steps = sorted(((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)), key=lambda s: (abs(s[0]) + abs(s[1]), s))
    came = np.zeros((n, k, h, c), dtype=np.int8)
    best = np.zeros((n, k, c), dtype=np.intp)
    score = volumes[:, 0].copy()
    padded = np.full((k, h + 2, c + 2), -np.inf)
    for t in range(1, n):
        padded[:, 1:-1, 1:-1] = score
        candidates = np.stack(
            [padded[:, 1 + i : 1 + i + h, 1 + j : 1 + j + c] - cost * (i * i + j * j) for i, j in steps]
        )
        came[t] = candidates.argmax(axis=0)
        best[t] = score.argmax(axis=1)
        highest = score.max(axis=1, keepdims=True) - jump
        score = candidates.max(axis=0)
        came[t][score < highest] = len(steps)
        score = np.maximum(score, highest) + volumes[:, t]
    path = np.zeros((k, n, 2), dtype=np.intp)
    pairs, moves = np.arange(k), np.array([*steps, (0, 0)])
    path[:, -1] = np.stack(np.unravel_index(score.reshape(k, -1).argmax(axis=1), (h, c)), axis=1)
    for t in range(n - 1, 0, -1):
        how = came[t, pairs, path[:, t, 0], path[:, t, 1]]
        path[:, t - 1] = path[:, t] + moves[how]
        jumped = how == len(steps)
        path[jumped, t - 1, 0] = best[t, pairs, path[:, t, 1]][jumped]
    return path


def shifted(volume: Floats, by: Ints) -> Floats:
    """The volume with every block moved: out[t, i, j] = volume[t, i + by[t, 0], j + by[t, 1]], 0 beyond."""
    n, h, c = volume.shape
    i = np.arange(h)[None, :, None] + by[:, 0, None, None]
    j = np.arange(c)[None, None, :] + by[:, 1, None, None]
    inside = (i >= 0) & (i < h) & (j >= 0) & (j < c)
    t = np.arange(n)[:, None, None]
    return np.where(inside, volume[t, np.clip(i, 0, h - 1), np.clip(j, 0, c - 1)], 0.0)
