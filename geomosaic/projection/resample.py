"""Resampling: a frame's pixels at places between them."""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bools, Floats32
from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.constants import sourced
from geomosaic.projection.warp import GroundWindow, frame_from_map
from geomosaic.survey.header import MOST_SIDE_PX

RESAMPLING: Final = {
    "bilinear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "lanczos": cv2.INTER_LANCZOS4,
}
"""OpenCV's interpolations by name; its cubic is Keys' with a = -0.75."""
KERNEL_RADIUS_PX = sourced(
    {"bilinear": 1, "cubic": 2, "lanczos": 4},
    "px",
    "less bleeds masked pixels in; more widens masks",
    "OpenCV: kernels of 2, 4, 8 px",
)
_MOST_CHANNELS = sourced(4, "bands", "in one call; it fails beyond", "cv2.remap of OpenCV 5.0, cubic")


def resample(pixels: NDArray[Any], cols: Floats32, rows: Floats32, resampling: str) -> NDArray[Any]:
    """Pixels (h, w, bands) at cols and rows with corner origin; the outer half pixel repeats the edge.

    Only the part of the frame in use is handed to cv2, and no more rows of places at once than it takes.
    """
    if len(cols) > MOST_SIDE_PX:
        parts = (slice(k, k + MOST_SIDE_PX) for k in range(0, len(cols), MOST_SIDE_PX))
        return np.concatenate([resample(pixels, cols[part], rows[part], resampling) for part in parts])
    height, width, bands = pixels.shape
    x, y = (_before_middle(*of) for of in ((cols, width), (rows, height)))
    reach = KERNEL_RADIUS_PX[resampling] + 1
    left, right = (
        int(np.clip(v, 0, width - 1)) for v in (np.floor(x.min()) - reach, np.ceil(x.max()) + reach)
    )
    top, bottom = (
        int(np.clip(v, 0, height - 1)) for v in (np.floor(y.min()) - reach, np.ceil(y.max()) + reach)
    )
    x -= np.float32(left)
    y -= np.float32(top)
    part = pixels[top : bottom + 1, left : right + 1]
    found = [
        cv2.remap(
            np.ascontiguousarray(part[..., k : k + _MOST_CHANNELS]),
            x,
            y,
            RESAMPLING[resampling],
            borderMode=cv2.BORDER_REPLICATE,
        ).reshape(*cols.shape, -1)
        for k in range(0, bands, _MOST_CHANNELS)
    ]
    return found[0] if len(found) == 1 else np.concatenate(found, axis=-1)


def _before_middle(places: Floats32, size: int) -> Floats32:
    """Counted from the first pixel's middle; the image's own middle where there is no place."""
    moved = places - np.float32(0.5)
    if np.isnan(moved.min()):
        moved[np.isnan(moved)] = (size - 1) / 2.0
    return moved


def seen_on(
    window: GroundWindow, pose: Pose, camera: Camera, grey: Floats32, mask: NDArray[Any] | None
) -> tuple[Floats32, Bools]:
    """One band (rows, cols) of a frame on a map window, 0 where it isn't valid; and where it is."""
    cols, rows = frame_from_map(window, pose, camera)
    height, width = grey.shape
    valid = (cols > 0.0) & (cols < width) & (rows > 0.0) & (rows < height)
    if mask is not None:
        at = np.where(valid, rows, 0.0).astype(np.intp), np.where(valid, cols, 0.0).astype(np.intp)
        valid &= mask[at] != 0
    image = resample(grey[..., None], cols, rows, "cubic")[..., 0]
    return np.where(valid, image, np.float32(0.0)).astype(np.float32), valid
