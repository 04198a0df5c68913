"""What is bright: clouds mostly are, and whatever is bright and moves against the rest as a whole is cloud.

Brightness alone decides nothing: snow and sand are bright too. It says which part of a scene counts last,
and whether its offsets agree with the curves of the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from geomosaic.arrays import Bools, Floats, Floats32
from geomosaic.constants import tuned

CELL_PX = tuned(8, "px", "cell of a mean grey, divides 32: smaller is noisy; larger mixes cloud and ground")
_STANDS_OUT = tuned(0.2, "share", "above the darker group: less suspects fields; more misses thin clouds")
_IN_PART = tuned(0.25, "share", "of the way to the brighter mean: more takes partly clouded rows for ground")
_MOST_SHARE = tuned(0.97, "share", "bright part of a scene: above, the rest is too small to draw curves by")


@dataclass(frozen=True)
class Suspect:
    """The part of a scene that may be cloud: brighter than a grey, or else darker."""

    grey: float
    brighter: bool = True

    def hides(self, grey: Floats) -> Bools:
        """Where greys (any shape) are of that part; unknown ones are of none."""
        return np.asarray(((grey > self.grey) == self.brighter) & np.isfinite(grey))

    def pixels(self, cells: Floats, shape: tuple[int, int]) -> Bools:
        """Pixels of `shape` under cells (2, h, w), of either strip, of that part, or next to it."""
        hidden = np.asarray(self.hides(cells).any(axis=0), dtype=np.uint8)
        grown = cv2.dilate(hidden, np.ones((3, 3), np.uint8)).astype(np.bool_)
        at = (np.minimum(np.arange(n) // CELL_PX, m - 1) for n, m in zip(shape, grown.shape, strict=True))
        return np.asarray(grown[np.ix_(*at)])


def grey_cells(image: Floats32, valid: Bools) -> Floats:
    """Mean greys of the valid pixels in cells of CELL_PX by CELL_PX, NaN where less than half are."""
    size = tuple(max(n // CELL_PX, 1) for n in image.shape[::-1])
    share = cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    sums = cv2.resize(image * valid, size, interpolation=cv2.INTER_AREA)
    return np.where(share >= 0.5, sums / np.maximum(share, 0.5), np.nan).astype(np.float64)


def of_one_response(greys: Sequence[Floats]) -> list[Floats]:
    """Greys (2, h, w) of the left and right strips of pairs in order, as if all CCDs responded alike. Two
    strips see the same ground: their median ratio leads from one CCD to the next."""
    out, response = [], 1.0
    for left, right in greys:
        n = min(len(left), len(right))
        known = np.isfinite(left[:n]) & np.isfinite(right[:n]) & (left[:n] > 0.0) & (right[:n] > 0.0)
        ratio = float(np.median(right[:n][known] / left[:n][known])) if known.any() else 1.0
        out.append(np.stack([left / response, right / (response * ratio)]))
        response *= ratio
    return out


def bright_part(brightness: Floats) -> Suspect | None:
    """What of brightness (any shape) is more than that of the darker of two groups, if these stand apart.

    The groups are Otsu's (1979); what lies between them counts as bright: rows that are in part so.
    """
    brightness = brightness[np.isfinite(brightness)]
    if not brightness.size:
        return None
    eight = np.asarray(cv2.normalize(brightness, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)).ravel()  # type: ignore[call-overload]
    split, _ = cv2.threshold(eight, 0, 255, cv2.THRESH_OTSU)
    if (eight > split).all() or (eight <= split).all():
        return None
    low, high = float(brightness[eight <= split].mean()), float(brightness[eight > split].mean())
    if high - low < _STANDS_OUT * low:
        return None
    found = Suspect(low + _IN_PART * (high - low))
    return found if found.hides(brightness).mean() < _MOST_SHARE else None
