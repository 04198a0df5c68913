"""How two neighbouring strips go over into each other in their overlap."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

Floats32 = NDArray[np.float32]
Flags = NDArray[np.bool_]
Blend = Callable[[Floats32, Floats32, Flags, Floats32, float], Floats32]
"""(left, right, both, distance_px, half_px) -> pixels.

left, right, both: (rows, cols), the overlap as each strip has it, and where both are valid. distance_px:
(cols,) from the seam to the pixels' middles, positive to its right. half_px: how far from the seam, either
way, both strips may be used. Only pixels of `both` are asked for.
"""
REACH_ROWS: Final = 24
"""As many rows above and below a blend may look at."""
_SHARP_PX: Final = 3.0
_LOW_SD_PX: Final = 8.0


def none(left: Floats32, right: Floats32, both: Flags, distance_px: Floats32, half_px: float) -> Floats32:
    """The left strip up to the seam, the right one from there."""
    return np.where(distance_px < 0.0, left, right)


def smooth(left: Floats32, right: Floats32, both: Flags, distance_px: Floats32, half_px: float) -> Floats32:
    """Grey smoothing: weights go linearly from one strip to the other over the overlap."""
    return np.asarray(left + _ramp(distance_px, half_px) * (right - left))


def multi_band(
    left: Floats32, right: Floats32, both: Flags, distance_px: Floats32, half_px: float
) -> Floats32:
    """Low frequencies go over in the whole overlap, high ones within some pixels of the seam.

    Two bands of Burt and Adelson 1983, written for the strips' difference, so that no pixels beyond the
    overlap are needed.
    """
    weight = both.astype(np.float32)
    apart = (right - left) * weight
    sd = min(_LOW_SD_PX, half_px / 3.0) if half_px > 0.0 else 0.5
    size = (2 * min(int(3.0 * sd + 0.5), REACH_ROWS) + 1,) * 2
    low, seen = (cv2.GaussianBlur(v, size, sd, borderType=cv2.BORDER_CONSTANT) for v in (apart, weight))
    low = low / np.maximum(seen, np.float32(1e-6))
    wide, sharp = _ramp(distance_px, half_px), _ramp(distance_px, min(_SHARP_PX, half_px))
    return np.asarray(left + wide * low + sharp * (apart - low))


def _ramp(distance_px: Floats32, half_px: float) -> Floats32:
    if half_px <= 0.0:
        return np.asarray(distance_px >= 0.0, dtype=np.float32)
    ramp = np.clip(0.5 + distance_px / np.float32(2.0 * half_px), 0.0, 1.0)
    return np.asarray(ramp, dtype=np.float32)


BLENDS: Final[dict[str, Blend]] = {"none": none, "smooth": smooth, "multi_band": multi_band}
