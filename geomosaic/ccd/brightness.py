"""What is bright: clouds mostly are, and whatever is bright and moves against the rest as a whole is cloud.

Brightness alone condemns nothing: snow and sand are bright too. It says which part of a scene to ask last
and whether that part lies where the curves drawn by the rest would have it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from geomosaic.ccd.model import Flags, Floats, Images
from geomosaic.constants import sourced, tuned

CELL_PX = tuned(
    8,
    "px",
    "side of the cells whose mean greys are looked at, a whole number of them in a block of 32 lines: "
    "in smaller ones noise and single roofs are bright, larger ones at a cloud's edge take ground with "
    "them",
)
_BINS = sourced(
    128,
    "bins",
    "of the histogram that is parted in two: fewer place the border by more than a hundredth of the "
    "range, more are mostly empty",
    "chosen; Otsu 1979 for the two groups",
)
_STANDS_OUT = tuned(
    0.2,
    "of the darker group's mean",
    "by which the brighter group's must be above it to be suspected: with less, fields beside woods are "
    "asked last, with more, thin clouds are asked first",
)
_IN_PART = tuned(
    0.25,
    "share of the way from the darker group's mean to the brighter's",
    "above which a place counts as bright: rows that clouds cover in part lie between; more takes them "
    "for ground, less takes ground for clouds",
)
_MOST_SHARE = tuned(
    0.97,
    "share of the scene",
    "the bright part must be less, else nothing is suspected: what is left would be too little to draw "
    "curves by; with less, scenes mostly under clouds would be matched by the clouds",
)


@dataclass(frozen=True)
class Suspect:
    """The part of a scene that may be cloud: brighter than a grey, or else darker."""

    grey: float
    brighter: bool = True

    def hides(self, grey: Floats) -> Flags:
        """Where greys (any shape) are of that part."""
        return np.asarray((grey > self.grey) == self.brighter)

    def pixels(self, cells: Floats, shape: tuple[int, int]) -> Flags:
        """Pixels of `shape` under cells (2, h, w), of either strip, of that part, or beside such."""
        hidden = np.asarray(self.hides(cells).any(axis=0), dtype=np.uint8)
        beside = cv2.dilate(hidden, np.ones((3, 3), np.uint8)).astype(np.bool_)
        at = (np.minimum(np.arange(n) // CELL_PX, m - 1) for n, m in zip(shape, beside.shape, strict=True))
        return np.asarray(beside[np.ix_(*at)])


def grey_cells(image: Images) -> Floats:
    """Mean greys of cells of CELL_PX by CELL_PX pixels."""
    h, w = (max(n // CELL_PX, 1) for n in image.shape)
    return np.asarray(cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA), dtype=np.float64)


def bright_part(brightness: Floats) -> Suspect | None:
    """What of brightness (any shape) is more than that of the darker of two groups, if these stand apart.

    The groups are Otsu's (1979); what lies between them counts as bright: rows that are in part so.
    """
    counts, edges = np.histogram(brightness, _BINS)
    middle = 0.5 * (edges[1:] + edges[:-1])
    below = np.cumsum(counts)[:-1]
    above = counts.sum() - below
    total = np.cumsum(counts * middle)
    low = total[:-1] / np.maximum(below, 1)
    high = (total[-1] - total[:-1]) / np.maximum(above, 1)
    split = int(np.argmax(below * above * (high - low) ** 2))
    if high[split] - low[split] < _STANDS_OUT * low[split]:
        return None
    found = Suspect(float(low[split] + _IN_PART * (high[split] - low[split])))
    return found if found.hides(brightness).mean() < _MOST_SHARE else None
