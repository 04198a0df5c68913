"""The best way through correlation volumes: the motion all pairs share and what each keeps for itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from geomosaic.ccd.brightness import bright_part
from geomosaic.ccd.layers import Layer, either_layer, layer_candidates, second_layer
from geomosaic.ccd.model import Flags, Floats
from geomosaic.ccd.volumes import BLOCK_LINES

Ints = NDArray[np.intp]
_BIN_PX = 2
_WINDOW_BLOCKS = 8
# What a step of one bin costs: of the motion, of a pair's own part, of a pair taken alone.
_MOTION_STEP, _OWN_STEP, _ALONE_STEP = 100.0, 60.0, 24.0
_JUMP = 250.0
# A second layer must explain this share more than one layer does.
_LAYER_GAIN = 0.003
# And be seen beside the first, on such a share of the lines, in such a share of the pairs, and come and go.
_LAYER_SHARE, _LAYER_PAIRS, _LAYER_CHANGES = 0.05, 0.4, 1.5
# How far the ground may well lie from the nominal geometry.
_NOMINAL_PX = 6.0
# What bright blocks count: enough to find bright ground, not to lead the path off to clouds.
_BRIGHT_WEIGHT = 0.05


@dataclass(frozen=True)
class Coarse:
    """Offsets to about a bin.

    offsets_px: (pairs, blocks, 2) dcol, dline at the blocks' centres. layers: clouds found. cloudy:
    (pairs, blocks) where they hide the ground.
    """

    offsets_px: Floats
    layers: list[Layer]
    cloudy: Flags


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


def coarse_offsets(volumes: Floats, brightness: Floats, rounds: int = 3) -> Coarse:
    """Offsets of all pairs at once, to about a bin: the shared motion, and a slow part of each pair.

    By turns: the evidence of all pairs is summed, each moved by its own slow part, and the best path taken
    for the motion; then each pair's evidence is summed over windows of 256 lines along the motion, and
    the best slow path taken for its own part. A second layer, clouds, is tried wherever the volumes
    hint at one, and taken where it explains more than a path through one layer does.

    Args: volumes (pairs, blocks, h, c). brightness: (pairs, blocks) mean grey of the blocks.
    """
    bright = bright_part(brightness)
    volumes = volumes * np.where(bright, _BRIGHT_WEIGHT, 1.0)[..., None, None]
    best, evidence = _solve(volumes, rounds)
    layers: list[Layer] = []
    threshold = _LAYER_GAIN * evidence.sum()
    for candidate in [] if bright.any() else layer_candidates(volumes):
        tried, found = _solve(either_layer(volumes, [candidate]), rounds)
        opposite = Layer(-candidate.lines, -candidate.cols)
        moved, other = _solve(either_layer(volumes, [opposite]), rounds)
        for path, value, layer in ((tried, found, candidate), (moved, other, opposite)):
            if _by_patches(second_layer(volumes, layer, path)) and value.sum() > evidence.sum() + threshold:
                best, evidence, layers = path, value, [layer]
                threshold = 0.0
    if layers:
        best, layers = _ground_first(volumes, brightness, best, layers, rounds)
    cloudy = np.zeros(volumes.shape[:2], dtype=bool)
    for layer in layers:
        cloudy |= second_layer(volumes, layer, best)
    middle = np.array(volumes.shape[2:]) // 2
    return Coarse(_BIN_PX * (best - middle)[:, :, ::-1].astype(np.float64), layers, cloudy)


def _by_patches(hidden: Flags) -> bool:
    """Whether a second layer, at (pairs, blocks), comes and goes as clouds do: lost lines change it once."""
    share = hidden.mean(axis=1)
    both = (share > _LAYER_SHARE) & (share < 1.0 - _LAYER_SHARE)
    patches = uniform_filter1d(hidden.astype(np.float64), 9, axis=1, mode="nearest") > 0.5
    changes = np.count_nonzero(np.diff(patches, axis=1), axis=1)
    return bool(both.mean() > _LAYER_PAIRS and changes[both].mean() > _LAYER_CHANGES)


def _ground_first(
    volumes: Floats, brightness: Floats, path: Ints, layers: list[Layer], rounds: int
) -> tuple[Ints, list[Layer]]:
    """The same two layers, the ground the first: near the nominal geometry, and not the brighter one."""
    layer = layers[0]
    step = np.array([layer.lines, layer.cols])
    middle = np.array(volumes.shape[2:]) // 2
    second = second_layer(volumes, layer, path)
    first_off = np.median((path - middle).reshape(-1, 2), axis=0)
    nearer = (np.sum((first_off + step) ** 2) - np.sum(first_off**2)) * (_BIN_PX / _NOMINAL_PX) ** 2 / 2
    brighter = 0.0
    if second.any() and not second.all():
        spread = max(float(np.std(brightness)), 1e-9)
        brighter = 3.0 * float(np.median(brightness[second]) - np.median(brightness[~second])) / spread
    if nearer + brighter >= 0.0:
        return path, layers
    swapped = Layer(-layer.lines, -layer.cols)
    either = either_layer(volumes, [swapped])
    tried = [_solve(either, rounds, start) for start in (None, path + step)]
    return max(tried, key=lambda solved: solved[1].sum())[0], [swapped]


def _solve(volumes: Floats, rounds: int, start: Ints | None = None) -> tuple[Ints, Floats]:
    """Paths (pairs, blocks, 2) as indices, and each pair's evidence along them less the cost of its steps."""
    k, n, h, c = volumes.shape
    middle = np.array([h // 2, c // 2])
    prior = -0.5 * (((np.arange(h) - h // 2) / (0.5 * h)) ** 2)[:, None] - 0.5 * (
        ((np.arange(c) - c // 2) / (0.5 * c)) ** 2
    )
    if start is None:
        start = best_path(volumes + 0.1 * prior, _ALONE_STEP)
    first = start - middle
    own = np.repeat(np.rint(np.median(first, axis=1)).astype(np.intp)[:, None], n, axis=1)
    own -= np.rint(np.median(own, axis=0)).astype(np.intp)
    motion = np.zeros((n, 2), dtype=np.intp)
    for _ in range(rounds):
        summed = sum(shifted(volumes[p], own[p]) for p in range(k)) + prior
        motion = best_path(summed[None], _MOTION_STEP)[0] - middle
        own = _slow_parts(np.stack([shifted(volume, motion) for volume in volumes]) + 0.1 * prior) - middle
    path = np.clip(motion[None] + own + middle, 0, (h - 1, c - 1))
    evidence = volumes[np.arange(k)[:, None], np.arange(n), path[..., 0], path[..., 1]].sum(axis=1)
    steps = _MOTION_STEP / k * float((np.diff(motion, axis=0) ** 2).sum())
    own_steps = np.minimum(_OWN_STEP * (np.diff(own, axis=1) ** 2).sum(axis=2), _JUMP).sum(axis=1)
    return path, np.asarray(evidence - steps - own_steps)


def _slow_parts(volumes: Floats) -> Ints:
    """The best slow paths (pairs, blocks, 2), from evidence already straightened by the shared motion."""
    k, n, h, c = volumes.shape
    windows = -(-n // _WINDOW_BLOCKS)
    padded = np.zeros((k, windows * _WINDOW_BLOCKS, h, c))
    padded[:, :n] = volumes
    path = best_path(padded.reshape(k, windows, _WINDOW_BLOCKS, h, c).sum(axis=2), _OWN_STEP, _JUMP)
    return np.asarray(np.repeat(path, _WINDOW_BLOCKS, axis=1)[:, :n], dtype=np.intp)


def block_centres(blocks: int) -> Floats:
    """Lines u of the blocks' centres, as positions between rows: the first row's centre is 0."""
    return np.asarray(np.arange(blocks) * float(BLOCK_LINES) + (BLOCK_LINES - 1) / 2)
