"""A frame off the disk, ready to be resampled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Floats32
from geomosaic.survey.model import Frame
from geomosaic.survey.pixels import read_pixels

_DISTANCE_BYTES = np.dtype(np.float32).itemsize
_FULLY_VALID = (".jpg", ".jpeg")


@dataclass(frozen=True)
class Decoded:
    """A frame's pixels (rows, cols, bands), and per pixel the distance in px to the nearest one whose
    resampling would touch an invalid pixel, or None where all are valid."""

    pixels: NDArray[Any]
    mask_distance_px: Floats32 | None


def may_be_masked(frame: Frame) -> bool:
    """False where the format has no invalid pixels; else only decoding shows."""
    jpeg = frame.path.lower().endswith(_FULLY_VALID)
    damaged = frame.whole_rows is not None
    return not jpeg or damaged or frame.valid_mask is not None or frame.nodata is not None


def decode(frame: Frame, kernel_radius_px: int) -> Decoded:
    """One frame off the disk, ready to be resampled."""
    pixels, mask = read_pixels(frame)
    if mask is None or mask.all():
        return Decoded(pixels, None)
    reach = np.ones((2 * kernel_radius_px + 1, 2 * kernel_radius_px + 1), dtype=np.uint8)
    safe = cv2.erode((mask != 0).astype(np.uint8), reach)
    distance = cv2.distanceTransform(safe, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return Decoded(pixels, np.asarray(distance, dtype=np.float32))


def decoded_bytes(frame: Frame) -> int:
    """What a decoded frame takes, its mask's distances included if it may have some."""
    per_pixel = frame.bands * np.dtype(frame.dtype).itemsize
    per_pixel += _DISTANCE_BYTES if may_be_masked(frame) else 0
    return frame.width_px * frame.height_px * per_pixel
