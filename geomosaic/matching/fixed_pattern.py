"""The fixed pattern of thermal sensors: what all frames show alike, whatever they look at."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from geomosaic.arrays import Bytes, Floats32
from geomosaic.constants import NORMAL_PER_MAD, sourced, tuned
from geomosaic.estimation.robust import THREE_SIGMA
from geomosaic.matching.contrast import window_px

MOST_PX = sourced(
    1280 * 1024,
    "px",
    "of a frame: larger ones are of no uncooled thermal sensor",
    "DJI Zenmuse H30T, data sheet",
)
RUN = tuned(100, "frames", "with one pattern: shutters renew it every few minutes; fewer leave ground in it")
SAMPLE = tuned(24, "frames", "of a run: fewer leave ground in the pattern; more take time")
_ALIKE = sourced(
    1.0 / 3.0,
    "correlation",
    "of two halves' medians, at least: then half of the variance of the whole's is the pattern's",
    "Spearman 1910, Brown 1910: reliability 2 r / (1 + r)",
)


def fixed_pattern(images: Sequence[Bytes]) -> Floats32 | None:
    """The pattern (rows, cols) in grey levels that images of this size have in common; None without one.

    It is the median of their fine detail. Two halves of the images must show it alike.
    """
    if len(images) < SAMPLE:
        return None
    details = np.stack([_detail(image) for image in images])
    halves = [np.median(details[k::2], axis=0).ravel() for k in (0, 1)]
    spread = [float(half.std()) for half in halves]
    if not min(spread) > 0.0 or float(np.corrcoef(halves[0], halves[1])[0, 1]) < _ALIKE:
        return None
    return np.asarray(np.median(details, axis=0), dtype=np.float32)


def without_pattern(image: Bytes, pattern: Floats32) -> Bytes:
    """An image less as much of the pattern as it shows: cameras that stretch contrast stretch both."""
    own = _detail(image)
    most = THREE_SIGMA * NORMAL_PER_MAD * float(np.median(np.abs(own)))
    shown = float((own.clip(-most, most) * pattern).sum() / (pattern * pattern).sum())
    return np.asarray(np.clip(np.rint(image - max(shown, 0.0) * pattern), 0, 255).astype(np.uint8))


def _detail(image: Bytes) -> Floats32:
    whole = image.astype(np.float32)
    side = window_px(image.shape)
    return np.asarray(whole - cv2.blur(whole, (side, side), borderType=cv2.BORDER_REFLECT))
