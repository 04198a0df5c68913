"""The best way through correlation volumes: the motion all pairs share and what each keeps for itself."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import maximum_filter

from geomosaic.arrays import Floats, Ints
from geomosaic.ccd.best_path import best_path, shifted
from geomosaic.ccd.brightness import Suspect, bright_part
from geomosaic.ccd.expected import Expected
from geomosaic.ccd.volumes import BLOCK_LINES
from geomosaic.constants import NORMAL_PER_MAD, sourced, tuned

_BIN_PX = sourced(2, "px", "a whole shift of halved images; another scales all offsets", "volumes.volume")
WINDOW_BLOCKS = tuned(8, "blocks", "summed for an own part: fewer follow clouds; more miss relief")
_JUMP = tuned(250.0, "log-likelihood", "a jump's cost: below 240 windows jump alone; more misses lost lines")
_WARMTH_PX = tuned(0.05, "px", "own change without relief: less forbids steps; more lets clouds lead")
_CERTAIN = tuned(8.0, "deviations", "peak of a certain layer, its gain: more lets frequent clouds win")
_FAR_COST = tuned(6.0, "log-likelihood", "cap of a far layer's cost: less admits clouds; more loses ground")
_HOLD = tuned(0.4, "log-likelihood", "a bin's square off the level: less follows clouds; more misses relief")
_DARK_CLOUDS = tuned(
    3.0, "log-likelihood", "of clouds darker than ground: less lets wind decide; more fails over snow"
)


@dataclass(frozen=True)
class Coarse:
    """Offsets to about a bin.

    offsets_px: (pairs, blocks, 2) dcol, dline at the blocks' centres. suspect: what was asked last, as it may
    be cloud by its brightness.
    """

    offsets_px: Floats
    suspect: Suspect | None


def coarse_offsets(volumes: Floats, brightness: Floats, likely: Expected) -> Coarse:
    """Offsets of all pairs at once, to about a bin: the shared motion, and a slow part of each pair.

    Two steps alternate. The evidence of all pairs is summed, each moved by its own slow part, and the best
    path is taken for the motion. Then each pair's evidence is summed over windows of 256 lines along the
    motion, and the best slow path is taken for its own part. Where a part of the scene stands out by its
    brightness, the darker or the brighter part alone counts, whichever is rather the ground's. Few clouds
    are the darker part.

    Args: volumes (pairs, blocks, h, c). brightness: (pairs, blocks) mean grey of the blocks.
    """
    bright = bright_part(brightness)
    if bright is None:
        return Coarse(_px(volumes, _solve(volumes, likely)), None)
    parts = bright, replace(bright, brighter=False)
    hidden = [part.hides(brightness)[..., None, None] for part in parts]
    offsets = [_px(volumes, _solve(np.where(of, 0.0, volumes), likely)) for of in hidden]
    dark, light = (np.median(of.reshape(-1, 2), axis=0) for of in offsets)
    far = np.abs(light - dark).max() > _BIN_PX
    which = int(far and _DARK_CLOUDS + _cost(light, dark, likely) < _cost(dark, light, likely))
    return Coarse(offsets[which], parts[which])


def _px(volumes: Floats, path: Ints) -> Floats:
    """dcol, dline of a path's indices."""
    middle = np.array(volumes.shape[2:]) // 2
    return np.asarray(_BIN_PX * (path - middle)[:, :, ::-1], dtype=np.float64)


def _cost(ground_px: Floats, clouds_px: Floats, likely: Expected) -> float:
    """What speaks against ground and clouds lying there (dcol, dline).

    Ground lies near the nominal geometry. Clouds lie off the ground: across by the wind, along by wind and
    height, and height moves them one way.
    """
    moved = (clouds_px - ground_px - likely.clouds_px) / likely.clouds_sd_px
    return 0.5 * float(((ground_px / likely.ground_sd_px) ** 2 + moved**2).sum())


def _solve(volumes: Floats, likely: Expected) -> Ints:
    """Paths (pairs, blocks, 2) as indices."""
    k, n, h, c = volumes.shape
    middle = np.array([h // 2, c // 2])
    motion_step, own_step = _step_costs(likely)
    prior = -0.5 * (((np.arange(h) - h // 2) / (0.5 * h)) ** 2)[:, None] - 0.5 * (
        ((np.arange(c) - c // 2) / (0.5 * c)) ** 2
    )
    start = best_path(volumes + 0.1 * prior, motion_step)
    first = start - middle
    own = np.repeat(np.rint(np.median(first, axis=1)).astype(np.intp)[:, None], n, axis=1)
    own -= np.rint(np.median(own, axis=0)).astype(np.intp)
    motion = np.zeros((n, 2), dtype=np.intp)
    for _ in range(3):
        summed = sum(shifted(volumes[p], own[p]) for p in range(k)) + prior
        motion = best_path(summed[None], motion_step)[0] - middle
        own = (
            _slow_parts(np.stack([shifted(volume, motion) for volume in volumes]), motion, likely, own_step)
            - middle
        )
    return np.asarray(np.clip(motion[None] + own + middle, 0, (h - 1, c - 1)), dtype=np.intp)


def _step_costs(likely: Expected) -> tuple[float, float]:
    """What a step of one bin costs, of the motion from block to block and of an own part between windows.

    Half the square of how often the usual change it is, with what mounting and warmth add to own parts.
    """
    motion = likely.moves_px_per_line * BLOCK_LINES
    own = math.hypot(likely.bends_px_per_line * WINDOW_BLOCKS * BLOCK_LINES, _WARMTH_PX)
    return 0.5 * (_BIN_PX / motion) ** 2, 0.5 * (_BIN_PX / own) ** 2


def _slow_parts(volumes: Floats, motion: Ints, likely: Expected, step: float) -> Ints:
    """The best slow paths (pairs, blocks, 2), from evidence already straightened by the shared motion."""
    k, n, h, c = volumes.shape
    levels = _levels(volumes, motion, likely)
    i, j = np.arange(h)[:, None] - levels[:, 0, None, None], np.arange(c) - levels[:, 1, None, None]
    windows = -(-n // WINDOW_BLOCKS)
    padded = np.zeros((k, windows * WINDOW_BLOCKS, h, c))
    padded[:, :n] = volumes
    summed = padded.reshape(k, windows, WINDOW_BLOCKS, h, c).sum(axis=2)
    path = best_path(summed - WINDOW_BLOCKS * _HOLD * (i**2 + j**2)[:, None], step, _JUMP)
    return np.asarray(np.repeat(path, WINDOW_BLOCKS, axis=1)[:, :n], dtype=np.intp)


def _levels(volumes: Floats, motion: Ints, likely: Expected) -> Ints:
    """Where each pair's ground lies (pairs, 2): of the layers that are there, by where ground may lie.

    How often a layer is seen says nothing: clouds may hide most of the ground. Ground lies near the nominal
    geometry, and about as far from the motion in one pair as in the others.
    """
    k, _, h, c = volumes.shape
    total = volumes.sum(axis=1)
    above = total - np.median(total, axis=(1, 2), keepdims=True)
    chance = NORMAL_PER_MAD * np.median(np.abs(above), axis=(1, 2), keepdims=True)
    above /= np.maximum(chance, np.finfo(np.float64).eps)
    peak = total >= maximum_filter(total, size=(1, 3, 3))
    there = np.where(peak, np.clip(above, 0.0, _CERTAIN), 0.0)
    at = np.stack(np.meshgrid(np.arange(h), np.arange(c), indexing="ij"), axis=-1)
    nominal = _BIN_PX * (at - (h // 2, c // 2) + motion.mean(axis=0)) / likely.ground_sd_px[::-1]
    score = there - np.minimum(0.5 * (nominal**2).sum(axis=-1), _FAR_COST)
    found = _highest(score)
    if k < 3:
        return found
    middle = np.median(found, axis=0)
    spread = np.maximum(NORMAL_PER_MAD * np.median(np.abs(found - middle), axis=0), 1.0)
    return _highest(score - 0.5 * (((at - middle) / spread) ** 2).sum(axis=-1))


def _highest(score: Floats) -> Ints:
    flat = score.reshape(len(score), -1).argmax(axis=1)
    return np.stack(np.unravel_index(flat, score.shape[1:]), axis=1)


def block_centres(blocks: int) -> Floats:
    """Lines u of the blocks' centres, as positions between rows: the first row's centre is 0."""
    return np.asarray(np.arange(blocks) * float(BLOCK_LINES) + (BLOCK_LINES - 1) / 2)
