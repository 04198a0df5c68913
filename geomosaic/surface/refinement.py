"""Heights between the steps: where what frames show around a cell is most alike.

Normalised cross-correlation of what each frame shows on the surface itself and half a step above and below
it; a parabola through the three.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import cv2
import numpy as np

from geomosaic.arrays import Bools, Bytes, Floats32
from geomosaic.constants import tuned
from geomosaic.surface.squares import Squares, SweptPictures, by_first
from geomosaic.surface.visibility import Asked

_ROUNDS = tuned(2, "rounds", "each halves the step: one leaves a tenth of a step; a third gains a hundredth")
SIDE_CELLS = tuned(3, "(half) cells", "window of comparison: smaller follows noise; larger cuts corners")
_RIM_CELLS: Final = SIDE_CELLS // 2
_AGREEING = tuned(3, "frames", "best ones after the first: more, and one behind a wall spoils the match")
NOISE_GREY = tuned(2.0, "grey levels", "image noise: blank areas vary by less and correlate by chance")
SURE = tuned(0.6, "correlation", "to trust a height: 10 % off by > 1 m above it, 31 % below (simulated)")

UNSEEN: Final = -1.0
"""How alike frames are where no two see a cell."""


def refined(
    swept: SweptPictures,
    height_m: Floats32,
    step_m: float,
    asked: Asked,
    hidden_below_m: Mapping[int, Floats32],
) -> tuple[Floats32, Floats32]:
    """Heights over the base, and how alike the frames are there, (rows, cols) each: see `likeness`.

    Args: height_m (rows, cols): good to half a step.
    """
    out = height_m.copy()
    alike = np.full_like(height_m, UNSEEN)
    for squares in Squares(swept.sweep, swept.pictures, asked, _RIM_CELLS).some(3):
        height = squares.cut(height_m)
        for k in range(_ROUNDS):
            by = np.float32(0.5 * step_m / 2.0**k)
            three = height[:, None] + np.array([-by, 0.0, by], dtype=np.float32)[:, None, None]
            found = _correlations(squares, three, hidden_below_m)
            low, here, high = np.moveaxis(_mean_of(found, _most_alike(found[:, :, 1])[:, :, None]), 1, 0)
            bend = low - 2.0 * here + high
            peak = bend < 0.0
            off = np.where(peak, (low - high) / (2.0 * np.where(peak, bend, 1.0)), np.sign(high - low))
            height = np.asarray(height + np.nan_to_num(off).clip(-1.0, 1.0) * by, dtype=np.float32)
        squares.put(height, out)
        squares.put(here, alike)
    return out, alike


def likeness(swept: SweptPictures, height_m: Floats32, asked: Asked) -> tuple[Floats32, Bytes, Bytes]:
    """The mean correlation with the first frame that sees a cell of those that are most like it, -1 to 1; -1
    where no two see it. How many frames agree there, the first one with them; and how many see it."""
    alike = np.full_like(height_m, UNSEEN)
    views, seeing = (np.zeros(height_m.shape, dtype=np.uint8) for _ in range(2))
    for squares in Squares(swept.sweep, swept.pictures, asked, _RIM_CELLS).some(1):
        found = _correlations(squares, squares.cut(height_m)[:, None], {})[:, :, 0]
        squares.put(_mean_of(found, _most_alike(found)), alike)
        squares.put(_views(found), views)
        squares.put(1 + (found > -np.inf).sum(axis=0, dtype=np.uint8), seeing)
    return alike, views, seeing


def _views(correlations: Floats32) -> Bytes:
    agreeing = (correlations >= SURE).sum(axis=0, dtype=np.uint8)
    return np.asarray(agreeing + (agreeing > 0), dtype=np.uint8)


def _most_alike(correlations: Floats32) -> Bools:
    """Which frames count in each cell, as the correlations (frames, ...)."""
    better = np.zeros(correlations.shape, dtype=np.uint8)
    for k, one in enumerate(correlations):
        for other in range(k + 1, len(correlations)):
            ahead = one >= correlations[other]
            better[other] += ahead
            better[k] += ~ahead
    return np.asarray(better < _AGREEING)


def _mean_of(correlations: Floats32, which: Bools) -> Floats32:
    """Of those (frames, ...) that count and see the cell."""
    seen = which & (correlations > -np.inf)
    count = seen.sum(axis=0, dtype=np.uint8)
    total = np.where(seen, correlations, np.float32(0.0)).sum(axis=0)
    return np.asarray(np.where(count, total / np.maximum(count, 1), np.float32(UNSEEN)), np.float32)


def _correlations(squares: Squares, height_m: Floats32, hidden_below_m: Mapping[int, Floats32]) -> Floats32:
    """Correlations of each frame with the first one that sees a point, at heights (n, heights, rows, cols),
    as (frames, n, heights, rows, cols). They are -inf where one of both doesn't see it, and for the first one
    itself."""
    first, others = by_first(squares.shown(height_m, hidden_below_m))
    picture = first.astype(np.float32)
    mean, spread = _mean_and_spread(picture)
    found = []
    for grey, sees in others:
        own_picture = grey.astype(np.float32)
        own_mean, own_spread = _mean_and_spread(own_picture)
        alike = (_mean(picture * own_picture) - mean * own_mean) / np.sqrt(spread * own_spread)
        if sees is not None:
            alike[~sees] = -np.inf
        found.append(alike)
    return np.stack(found)


def _mean_and_spread(picture: Floats32) -> tuple[Floats32, Floats32]:
    mean = _mean(picture)
    return mean, np.maximum(_mean(picture * picture) - mean * mean, np.float32(NOISE_GREY**2))


def _mean(values: Floats32) -> Floats32:
    """In windows; squares lie one below the other, and are mixed at their rims, which nobody looks at."""
    side = (SIDE_CELLS, SIDE_CELLS)
    found = cv2.boxFilter(values.reshape(-1, values.shape[-1]), -1, side)
    return np.asarray(found, dtype=np.float32).reshape(values.shape)
