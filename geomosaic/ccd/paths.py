"""The best way through correlation volumes: the motion all pairs share and what each keeps for itself."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import maximum_filter, uniform_filter1d

from geomosaic.ccd.best_path import Ints, best_path, shifted
from geomosaic.ccd.brightness import Suspect, bright_part
from geomosaic.ccd.expected import Expected
from geomosaic.ccd.layers import Layer, either_layer, layer_candidates, second_layer
from geomosaic.ccd.model import Flags, Floats
from geomosaic.ccd.volumes import BLOCK_LINES
from geomosaic.constants import NORMAL_PER_MAD, sourced, tuned

_BIN_PX = sourced(
    2,
    "px",
    "of a whole shift in the volumes, which are of images halved: any other number gives offsets of "
    "the wrong size",
    "structure: volumes.volume halves the images",
)
_WINDOW_BLOCKS = tuned(
    8,
    "blocks",
    "256 lines, over which a pair's evidence is summed for its own part: of fewer, blocks under clouds "
    "lead it off, over more, relief moves it by more than it can follow",
)
_ALONE = sourced(
    0.24,
    "share of what a step costs the motion of all",
    "what a step of one bin costs a pair taken alone, for the first path: its evidence is a fraction of "
    "all pairs'; with more, the path doesn't follow jitter, with less, it follows noise",
    "chosen: 24 and 100 before commit caa242d made both follow the camera",
)
_JUMP = tuned(
    250.0,
    "logarithm of a likelihood ratio",
    "what a jump along lines costs an own part, for any number of lost lines: more than the 240 of a "
    "window whose 8 blocks all say their most, so that no window jumps for itself; with much more, lost "
    "lines near an end are missed",
)
_WARMTH_PX = tuned(
    0.05,
    "px",
    "by which own parts change from window to window beside relief, by warmth: with less, steps where "
    "the ground is level cost too much to be taken, with more, clouds lead own parts off",
)
_CHANCE_SD = sourced(
    0.6,
    "logarithm of a likelihood ratio",
    "least deviation of a block's evidence where nothing matches, by which peaks of all blocks' sum are "
    "judged: with less, peaks of chance are layers, with more, ground that few blocks show is none",
    "chosen; volumes of tools/bench_strips.py, seed 3, have 0.7 to 0.9 of clear ground, 0.5 to 0.7 "
    "with clouds on a fifth, 0.3 to 0.5 on half, 0 of what is hardly asked: so it counts under clouds",
)
_PEAK_FROM = tuned(
    4.0,
    "deviations of chance",
    "from which on a peak begins to be a layer, of 120 blocks what one or two good ones say: with less, "
    "some of the volumes' hundreds of shifts are layers by chance, with more, ground that clouds hide "
    "but for a gap is none",
)
_PEAK_FULL = tuned(
    8.0,
    "deviations of chance",
    "from which on a peak is a layer for certain, and more of them don't make it the ground: with more, "
    "clouds that hide most of the ground would win by how often they are seen",
)
_THERE = tuned(
    8.0,
    "logarithm of a likelihood ratio",
    "in favour of a shift at which a layer is for certain: more than what speaks against the farthest "
    "one, else a pair that sees one layer far off would be put where it sees nothing",
)
_FAR_COST = tuned(
    6.0,
    "logarithm of a likelihood ratio",
    "against a layer far from nominal, at most: where nothing else is seen it may still be the ground; "
    "with less, clouds weigh nearly as much as a layer near nominal, with as much as speaks for a "
    "layer, far ground is lost",
)
_LEVELS_SD_BINS = tuned(
    1.0,
    "bins",
    "least deviation of the pairs' own levels about the middle of all: with less, CCDs mounted a bin "
    "aside are drawn to it, with more, a pair follows its clouds",
)
_HOLD = tuned(
    0.4,
    "logarithm of a likelihood ratio, a block and a bin's square",
    "that holds an own part to its pair's level: with less, clouds draw it away where the ground is "
    "hidden, with more, high relief can't",
)
_DARK_CLOUDS_COST = tuned(
    3.0,
    "logarithm of a likelihood ratio",
    "against clouds that are darker than the ground, odds of 20 to 1: with less, clouds near nominal "
    "pass for the ground, with more, snow and sand pass for clouds",
)
_LAYER_GAIN = tuned(
    0.003,
    "share of the evidence of one layer",
    "that a second layer must explain beyond: with less, noise is a layer, since the better of two "
    "shifts is taken in each block, with more, clouds on few lines are passed over",
)
_LAYER_SHARE = tuned(
    0.05,
    "share of a pair's blocks",
    "on which each of two layers must be seen: with less, single wrong blocks make a pair one with two "
    "layers, with more, few clouds and small gaps make none",
)
_LAYER_PAIRS = tuned(
    0.4,
    "share of the pairs",
    "that must see both layers, since clouds lie over several: with less, lost lines of one pair are a "
    "layer, with more, clouds over one side of the scene are none",
)
_LAYER_CHANGES = tuned(
    1.5,
    "changes from layer to layer, in the mean of those pairs",
    "that must be exceeded: lost lines change it once, for good, a cloud comes and goes; with less, "
    "lost lines are clouds, with more, one large cloud is none",
)
_BRIGHT_WEIGHT = tuned(
    0.05,
    "of the weight of other blocks",
    "that bright blocks have: enough to find bright ground where nothing else is seen, not to lead the "
    "path off to clouds",
)


@dataclass(frozen=True)
class Coarse:
    """Offsets to about a bin.

    offsets_px: (pairs, blocks, 2) dcol, dline at the blocks' centres. layers: clouds found. cloudy:
    (pairs, blocks) where they hide the ground. suspect: what was asked last, for it may be cloud by its
    brightness.
    """

    offsets_px: Floats
    layers: list[Layer]
    cloudy: Flags
    suspect: Suspect | None


def coarse_offsets(volumes: Floats, brightness: Floats, likely: Expected, rounds: int = 3) -> Coarse:
    """Offsets of all pairs at once, to about a bin: the shared motion, and a slow part of each pair.

    By turns: the evidence of all pairs is summed, each moved by its own slow part, and the best path taken
    for the motion; then each pair's evidence is summed over windows of 256 lines along the motion, and
    the best slow path taken for its own part. A second layer, clouds, is tried wherever the volumes
    hint at one, and taken where it explains more than a path through one layer does.

    Args: volumes (pairs, blocks, h, c). brightness: (pairs, blocks) mean grey of the blocks.
    """
    bright = bright_part(brightness)
    if bright is not None:
        best, suspect = _darker_or_brighter(volumes, bright, brightness, likely, rounds)
        return Coarse(_px(volumes, best), [], np.zeros(brightness.shape, dtype=np.bool_), suspect)
    best, evidence = _solve(volumes, likely, rounds)
    layers: list[Layer] = []
    threshold = evidence.sum() * (1.0 + _LAYER_GAIN)
    lowest = np.inf
    for candidate in layer_candidates(volumes, round(likely.steady_lines / BLOCK_LINES)):
        for layer in (candidate, Layer(-candidate.lines, -candidate.cols)):
            path, value = _solve(either_layer(volumes, [layer]), likely, rounds)
            ground = np.median(_px(volumes, path).reshape(-1, 2), axis=0)
            away = _BIN_PX * np.array([layer.cols, layer.lines], dtype=np.float64)
            cost = _cost(ground, ground + away, likely)
            if value.sum() > threshold and cost < lowest and _by_patches(second_layer(volumes, layer, path)):
                best, layers, lowest = path, [layer], cost
    cloudy = np.zeros(volumes.shape[:2], dtype=bool)
    for layer in layers:
        cloudy |= second_layer(volumes, layer, best)
    return Coarse(_px(volumes, best), layers, cloudy, None)


def _px(volumes: Floats, path: Ints) -> Floats:
    """dcol, dline of a path's indices."""
    middle = np.array(volumes.shape[2:]) // 2
    return np.asarray(_BIN_PX * (path - middle)[:, :, ::-1], dtype=np.float64)


def _darker_or_brighter(
    volumes: Floats, bright: Suspect, brightness: Floats, likely: Expected, rounds: int
) -> tuple[Ints, Suspect]:
    """The path by the darker or by the brighter part, whichever is rather the ground's; and the other part.

    Clouds are the brighter part but where the ground is snow or sand.
    """
    parts = bright, replace(bright, brighter=False)
    weights = [np.where(part.hides(brightness), _BRIGHT_WEIGHT, 1.0) for part in parts]
    paths = [_solve(volumes * weight[..., None, None], likely, rounds)[0] for weight in weights]
    middles = [np.median(_px(volumes, path).reshape(-1, 2), axis=0) for path in paths]
    costs = (
        _cost(middles[0], middles[1], likely),
        _cost(middles[1], middles[0], likely) + _DARK_CLOUDS_COST,
    )
    far = np.abs(middles[1] - middles[0]).max() > _BIN_PX
    which = 1 if far and costs[1] < costs[0] else 0
    return paths[which], parts[which]


def _cost(ground_px: Floats, clouds_px: Floats, likely: Expected) -> float:
    """What speaks against ground and clouds lying there (dcol, dline).

    Ground lies near the nominal geometry. Clouds lie off the ground: across by the wind, along by wind and
    height, and height moves them one way.
    """
    moved = (clouds_px - ground_px - likely.clouds_px) / likely.clouds_sd_px
    return 0.5 * float(((ground_px / likely.ground_sd_px) ** 2 + moved**2).sum())


def _by_patches(hidden: Flags) -> bool:
    """Whether a second layer, at (pairs, blocks), comes and goes as clouds do: lost lines change it once."""
    share = hidden.mean(axis=1)
    both = (share > _LAYER_SHARE) & (share < 1.0 - _LAYER_SHARE)
    patches = uniform_filter1d(hidden.astype(np.float64), 9, axis=1, mode="nearest") > 0.5
    changes = np.count_nonzero(np.diff(patches, axis=1), axis=1)
    return bool(both.mean() > _LAYER_PAIRS and changes[both].mean() > _LAYER_CHANGES)


def _solve(volumes: Floats, likely: Expected, rounds: int) -> tuple[Ints, Floats]:
    """Paths (pairs, blocks, 2) as indices; each pair's evidence along them less the cost of its steps."""
    k, n, h, c = volumes.shape
    middle = np.array([h // 2, c // 2])
    motion_step, own_step = _step_costs(likely)
    prior = -0.5 * (((np.arange(h) - h // 2) / (0.5 * h)) ** 2)[:, None] - 0.5 * (
        ((np.arange(c) - c // 2) / (0.5 * c)) ** 2
    )
    start = best_path(volumes + 0.1 * prior, _ALONE * motion_step)
    first = start - middle
    own = np.repeat(np.rint(np.median(first, axis=1)).astype(np.intp)[:, None], n, axis=1)
    own -= np.rint(np.median(own, axis=0)).astype(np.intp)
    motion = np.zeros((n, 2), dtype=np.intp)
    for _ in range(rounds):
        summed = sum(shifted(volumes[p], own[p]) for p in range(k)) + prior
        motion = best_path(summed[None], motion_step)[0] - middle
        own = (
            _slow_parts(np.stack([shifted(volume, motion) for volume in volumes]), motion, likely, own_step)
            - middle
        )
    path = np.clip(motion[None] + own + middle, 0, (h - 1, c - 1))
    evidence = volumes[np.arange(k)[:, None], np.arange(n), path[..., 0], path[..., 1]].sum(axis=1)
    steps = motion_step / k * float((np.diff(motion, axis=0) ** 2).sum())
    own_steps = np.minimum(own_step * (np.diff(own, axis=1) ** 2).sum(axis=2), _JUMP).sum(axis=1)
    return path, np.asarray(evidence - steps - own_steps)


def _step_costs(likely: Expected) -> tuple[float, float]:
    """What a step of one bin costs, of the motion from block to block and of an own part between windows.

    Half the square of how often the usual change it is, with what mounting and warmth add to own parts.
    """
    motion = likely.moves_px_per_line * BLOCK_LINES
    own = math.hypot(likely.bends_px_per_line * _WINDOW_BLOCKS * BLOCK_LINES, _WARMTH_PX)
    return 0.5 * (_BIN_PX / motion) ** 2, 0.5 * (_BIN_PX / own) ** 2


def _slow_parts(volumes: Floats, motion: Ints, likely: Expected, step: float) -> Ints:
    """The best slow paths (pairs, blocks, 2), from evidence already straightened by the shared motion."""
    k, n, h, c = volumes.shape
    levels = _levels(volumes, motion, likely)
    i, j = np.arange(h)[:, None] - levels[:, 0, None, None], np.arange(c) - levels[:, 1, None, None]
    windows = -(-n // _WINDOW_BLOCKS)
    padded = np.zeros((k, windows * _WINDOW_BLOCKS, h, c))
    padded[:, :n] = volumes
    summed = padded.reshape(k, windows, _WINDOW_BLOCKS, h, c).sum(axis=2)
    path = best_path(summed - _WINDOW_BLOCKS * _HOLD * (i**2 + j**2)[:, None], step, _JUMP)
    return np.asarray(np.repeat(path, _WINDOW_BLOCKS, axis=1)[:, :n], dtype=np.intp)


def _levels(volumes: Floats, motion: Ints, likely: Expected) -> Ints:
    """Where each pair's ground lies (pairs, 2): of the layers that are there, by where ground may lie.

    How often a layer is seen says nothing: clouds may hide most of the ground. Ground lies near the nominal
    geometry, and about as far from the motion in one pair as in the others.
    """
    k, n, h, c = volumes.shape
    total = volumes.sum(axis=1)
    above = total - np.median(total, axis=(1, 2), keepdims=True)
    chance = NORMAL_PER_MAD * np.median(np.abs(above), axis=(1, 2), keepdims=True)
    above /= np.maximum(chance, _CHANCE_SD * np.sqrt(n))
    peak = total >= maximum_filter(total, size=(1, 3, 3))
    there = np.where(peak, np.clip((above - _PEAK_FROM) / (_PEAK_FULL - _PEAK_FROM), 0.0, 1.0), 0.0)
    at = np.stack(np.meshgrid(np.arange(h), np.arange(c), indexing="ij"), axis=-1)
    nominal = _BIN_PX * (at - (h // 2, c // 2) + motion.mean(axis=0)) / likely.ground_sd_px[::-1]
    score = _THERE * there - np.minimum(0.5 * (nominal**2).sum(axis=-1), _FAR_COST)
    found = _highest(score)
    if k < 3:
        return found
    middle = np.median(found, axis=0)
    spread = np.maximum(NORMAL_PER_MAD * np.median(np.abs(found - middle), axis=0), _LEVELS_SD_BINS)
    return _highest(score - 0.5 * (((at - middle) / spread) ** 2).sum(axis=-1))


def _highest(score: Floats) -> Ints:
    flat = score.reshape(len(score), -1).argmax(axis=1)
    return np.stack(np.unravel_index(flat, score.shape[1:]), axis=1)


def block_centres(blocks: int) -> Floats:
    """Lines u of the blocks' centres, as positions between rows: the first row's centre is 0."""
    return np.asarray(np.arange(blocks) * float(BLOCK_LINES) + (BLOCK_LINES - 1) / 2)
