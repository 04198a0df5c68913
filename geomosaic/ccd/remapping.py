"""Images taken from elsewhere by cv2.remap, and where its tables really take them from."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from geomosaic.arrays import Floats, Floats32

STEPS_PER_PX: Final = cv2.INTER_TAB_SIZE
"""Of cv2.remap's tables, as `lands` expects."""


def lands(at: Floats) -> Floats:
    """Where the image that cv2.remap takes from `at` really comes from: the kernel's centre of mass."""
    steps = np.arange(STEPS_PER_PX, dtype=np.float32) / np.float32(STEPS_PER_PX)
    ramp = np.arange(16, dtype=np.float32)[None, :]
    centre = cv2.remap(
        ramp,
        steps[None, :] + 8,
        np.zeros((1, len(steps)), np.float32),
        cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REPLICATE,
    )
    off = centre[0].astype(np.float64) - 8.0 - steps
    return np.asarray(at + off[np.rint(at * STEPS_PER_PX).astype(np.int64) % STEPS_PER_PX])


def remap(image: Floats32, cols: Floats32, lines: Floats32, how: int) -> Floats32:
    """cv2.remap, in pieces of less than the 32,767 lines it can address."""
    out = np.empty(cols.shape, dtype=np.float32)
    piece = 8192
    for top in range(0, len(cols), piece):
        part = slice(top, min(top + piece, len(cols)))
        low = int(np.clip(np.floor(lines[part].min()) - 4, 0, len(image) - 1))
        high = int(np.clip(np.ceil(lines[part].max()) + 5, low + 1, len(image)))
        out[part] = cv2.remap(
            image[low:high],
            cols[part],
            lines[part] - np.float32(low),
            how,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=0,
        )
    return out
