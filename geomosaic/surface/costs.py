"""How differently frames show the points of verticals: the cost of every height."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.constants import CHOSEN, Because
from geomosaic.surface.census import NOT_SEEN, Bits
from geomosaic.surface.verticals import Verticals

Bytes = NDArray[np.uint8]
Steps = NDArray[np.int16]
_MOST_BITS: Annotated[
    int,
    Because(
        "bits",
        "that differ, at most: of 24 by chance 12 do, so that more say no more; with less, what is seen "
        "badly is taken for what isn't there",
        CHOSEN,
    ),
] = 14
_AGREEING: Annotated[
    int,
    Because(
        "frames",
        "that count besides the first, the ones that agree best with it: of four that see a place from "
        "all sides one may be behind a wall; with two, chance agrees",
        CHOSEN,
    ),
] = 3
_UNSEEN_BITS: Annotated[
    int,
    Because(
        "bits",
        "of a frame that doesn't see a point: as much as by chance. With more, heights are preferred that "
        "more frames see, whatever they show there; with less, those that few see",
        "half of the census's bits",
    ),
] = 12
PER_BIT: Final = 4
"""Costs count in quarters of a bit: means of up to four frames are whole."""


def census_costs(verticals: Verticals, seen: Sequence[Bits], steps: Steps, step_m: float) -> Bytes:
    """The mean number of bits, in quarters, in which the frames that agree best differ from the first one.

    Args: seen: censuses of the frames, the first one being what the others are compared with. steps
    (heights, rows, cols): heights over the base in steps of step_m. Returns: as steps.
    """
    costs = np.empty(steps.shape, dtype=np.uint8)
    views = [bits.view(np.float32) for bits in seen]
    agreeing = min(_AGREEING, len(seen) - 1)
    for k, height in enumerate(steps):
        bent = verticals.bent(height.astype(np.float32) * np.float32(step_m))
        first, *others = (_at(view, *verticals.places(i, bent)) for i, view in enumerate(views))
        differing = np.stack([_differing(first, other) for other in others])
        if len(others) > agreeing:
            differing.partition(agreeing - 1, axis=0)
        costs[k] = differing[:agreeing].sum(axis=0, dtype=np.uint16) * PER_BIT // agreeing
    return costs


def _at(view: NDArray[np.float32], cols: NDArray[np.float32], rows: NDArray[np.float32]) -> Bits:
    """The nearest pixels' census; floats are moved as they are."""
    found = cv2.remap(view, cols, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=-0.0)
    return np.asarray(found).view(np.uint32)


def _differing(one: Bits, other: Bits) -> Bytes:
    found = np.minimum(np.bitwise_count(one ^ other), np.uint8(_MOST_BITS))
    found[((one | other) & NOT_SEEN) != 0] = _UNSEEN_BITS
    return np.asarray(found)
