"""Which frames see a place: those that nothing stands before."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise, product

import cv2
import numpy as np

from geomosaic.arrays import Floats32
from geomosaic.constants import tuned
from geomosaic.surface.plane_sweep import WHOLE, Block, PlaneSweep

Asked = Sequence[tuple[Block, Sequence[int]]]
REACH_CELLS = tuned(16, "cells", "along a ray: shorter sees through high houses; longer takes time")
_NEAREST_CELLS = tuned(1.5, "cells", "start of the occlusion search: nearer, a leaning surface hides itself")

_MOST_HIDDEN = tuned(0.3, "share", "of a block seen by < 2 frames: yards have less, uncertain crowns more")


def asked_frames(
    sweep: PlaneSweep, shapes: list[tuple[int, int]], side: int, rim: int, most: int
) -> list[tuple[Block, tuple[int, ...]]]:
    """Squares of cells, and for each the frames that see most of it, of those the steepest first; those along
    the tile's edge have its rim as well."""
    rows, cols = sweep.base_m.shape
    blocks = list(product(_parts(rows, side, rim), _parts(cols, side, rim)))
    seeing: list[list[tuple[bool, float, int]]] = [[] for _ in blocks]
    for k, (height_px, width_px) in enumerate(shapes):
        col, row = sweep.base_places(k)
        inside = (col >= 0.0) & (col < width_px - 1.0) & (row >= 0.0) & (row < height_px - 1.0)
        slant = 1.0 / sweep.towards(k)[2]
        for at, of in zip(blocks, seeing, strict=True):
            if inside[at].any():
                of.append((not inside[at].all(), float(slant[at].mean()), k))
    return [(at, tuple(k for *_, k in sorted(of)[:most])) for at, of in zip(blocks, seeing, strict=True)]


def _parts(count: int, side: int, rim: int) -> Iterator[slice]:
    ends = [0, *range(rim + side, count - rim, side), count]
    return (slice(*pair) for pair in pairwise(ends))


def hidden_below(
    sweep: PlaneSweep, frame: int, height_m: Floats32, cell_m: float, at: Block = WHOLE
) -> Floats32:
    """The height over the base above which a frame sees a cell of a block, if the land is height_m (rows,
    cols of the tile) high. It is the highest shadow that anything on the way to the camera throws there, less
    a cell's side for errors of heights."""
    east, north, rise = sweep.towards(frame, at)
    rows, cols = (np.arange(n, dtype=np.float32)[s] for n, s in zip(height_m.shape, at, strict=True))
    col, row = np.meshgrid(cols, rows)
    low = np.full(rise.shape, -np.inf, dtype=np.float32)
    for away in np.arange(_NEAREST_CELLS, REACH_CELLS, 1.0, dtype=np.float32):
        there = cv2.remap(
            height_m,
            col + away * east,
            row + away * north,
            cv2.INTER_NEAREST,
            borderMode=cv2.BORDER_REPLICATE,
        )
        np.maximum(low, there - away * rise, out=low)
    return np.asarray(low - np.float32(cell_m))


def hidden_from(sweep: PlaneSweep, asked: Asked, height_m: Floats32, cell_m: float) -> dict[int, Floats32]:
    """`hidden_below` of each frame that is asked anywhere, -inf where it isn't. Nothing is hidden in blocks
    where less than two frames would see many cells of the land itself. Such land is too rough to be a surface
    that hides."""
    found: dict[int, Floats32] = {}
    for frame in sorted({k for _, chosen in asked for k in chosen}):
        at = _about([block for block, chosen in asked if frame in chosen])
        found[frame] = np.full(height_m.shape, -np.inf, dtype=np.float32)
        found[frame][at] = hidden_below(sweep, frame, height_m, cell_m, at)
    for at, chosen in asked:
        seeing = sum((height_m[at] >= found[k][at]).astype(np.uint8) for k in chosen)
        if float(np.mean(seeing < 2)) > _MOST_HIDDEN:
            for k in chosen:
                found[k][at] = -np.inf
    return found


def _about(blocks: Sequence[Block]) -> Block:
    """The least block that holds them."""
    rows, cols = (slice(min(b[k].start for b in blocks), max(b[k].stop for b in blocks)) for k in (0, 1))
    return rows, cols
