"""Ground that several frames see and on which none has tie points."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import shapely
from numpy.typing import NDArray

from geomosaic.constants import CHOSEN, Because
from geomosaic.projection.footprint import footprint, ground_from_image
from geomosaic.recording.solved import Solved

_CELLS: Annotated[
    int,
    Because(
        "cells a side of a frame",
        "in which tie points are looked for: of fewer a pond lies in none, in more honest ground has none",
        CHOSEN,
    ),
] = 8
_SEEN_BY: Annotated[
    int, Because("other frames", "that have to see ground of which tie points are missed", CHOSEN)
] = 2
BARE: Annotated[
    float,
    Because(
        "share of the ground that two others see too",
        "without tie points to be worth a word: of fields, roads and villages up to 3 % are, of water 75 %",
        "ten simulated surveys of 20 frames against their true cover",
    ),
] = 0.05


def bare_shares(solved: Solved) -> dict[str, tuple[int, int]]:
    """Of each tied frame: how many of its cells without tie points two other tied frames see, too, and how
    many cells these see."""
    if solved.adjusted is None or solved.ties is None:
        return {}
    a, names = solved.adjusted, solved.names
    tied = [i for i, s in enumerate(a.status) if s == "tied"]
    outlines = {i: footprint(a.poses[i], a.cameras[i], a.ground, 4)[:, :2] for i in tied}
    rings = {i: o for i, o in outlines.items() if np.isfinite(o).all()}
    if not rings:
        return {}
    numbers = np.array(list(rings))
    polygons = shapely.polygons([rings[i] for i in numbers])
    tree = shapely.STRtree(polygons)
    counts = _cell_counts(solved)
    out: dict[str, tuple[int, int]] = {}
    middle = (np.arange(_CELLS) + 0.5) / _CELLS
    cols, rows = np.meshgrid(middle, middle)
    for i in rings:
        camera = a.cameras[i]
        px = np.stack([cols * camera.width_px, rows * camera.height_px], axis=-1).reshape(-1, 2)
        at = ground_from_image(a.poses[i], camera, a.ground, px)[:, :2]
        cell, _ = tree.query(shapely.points(np.nan_to_num(at)), predicate="intersects")
        seen = np.bincount(cell, minlength=len(at)) - 1 >= _SEEN_BY
        seen &= np.isfinite(at).all(axis=1)
        if seen.any():
            out[names[i]] = int((seen & (counts[i] == 0)).sum()), int(seen.sum())
    return out


def _cell_counts(solved: Solved) -> NDArray[np.int64]:
    """How many tie points lie in each cell of each frame, (n, cells)."""
    assert solved.ties is not None
    counts = np.zeros((len(solved.names), _CELLS**2), dtype=np.int64)
    for t in solved.ties.pairs:
        for i, px in ((t.left, t.left_px), (t.right, t.right_px)):
            frame = solved.survey.frames[i]
            share = px / [max(frame.width_px, 1), max(frame.height_px, 1)]
            col, row = np.clip(np.nan_to_num(share) * _CELLS, 0, _CELLS - 1).astype(np.int64).T
            counts[i] += np.bincount(row * _CELLS + col, minlength=_CELLS**2)
    return counts
