"""Small JPEG images for the recording."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bytes, Floats
from geomosaic.errors import FileError
from geomosaic.survey.jpeg import parse_structure

_MOST_PX: Final = 4096
"""Of a side of a recorded image: chips at full resolution are below it; a file of some bytes may claim 30,000
and take gigabytes."""


def thumbnail(image: NDArray[np.generic], max_side_px: int = 512, quality: int = 85) -> bytes:
    """A JPEG of an image, its longer side at most `max_side_px`; never enlarged.

    `image` is (rows, cols) or (rows, cols, bands) with bands in the order red, green, blue (the first
    three count; of two, the first). Eight bits are shown as they are; everything else is stretched
    from its 1st to its 99th percentile, values that aren't finite are black.
    Raises ValueError if there are no pixels.
    """
    import cv2

    shown = image[:, :, None] if image.ndim == 2 else image
    if shown.ndim != 3 or 0 in shown.shape:
        raise ValueError(f"an image has rows, columns and bands, not the shape {image.shape}")
    shown = shown[:, :, :3] if shown.shape[2] >= 3 else shown[:, :, :1]
    rows, cols = shown.shape[:2]
    scale = min(1.0, max_side_px / max(rows, cols))
    if scale < 1.0:
        size = max(1, round(cols * scale)), max(1, round(rows * scale))
        wide = shown if shown.dtype in (np.uint8, np.uint16, np.float32) else shown.astype(np.float32)
        shown = cv2.resize(np.ascontiguousarray(wide), size, interpolation=cv2.INTER_AREA)
        shown = shown.reshape(size[1], size[0], -1)
    if shown.dtype != np.uint8:
        shown = _stretched(shown.astype(np.float64))
    done, jpeg = cv2.imencode(
        ".jpg", np.ascontiguousarray(shown[:, :, ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    if not done:
        raise ValueError(f"no JPEG of an image of the shape {image.shape}")
    return bytes(jpeg.tobytes())


def _stretched(values: Floats) -> Bytes:
    finite = np.isfinite(values)
    low, high = np.percentile(values[finite], [1.0, 99.0]) if finite.any() else (0.0, 1.0)
    scaled = (np.where(finite, values, low) - low) / max(high - low, 1e-12)
    return np.asarray(np.round(255.0 * np.clip(scaled, 0.0, 1.0)), dtype=np.uint8)


def decoded(jpeg: bytes) -> Bytes | None:
    """Pixels (rows, cols, 3), blue first as OpenCV draws, of a recorded image; nothing of what is no JPEG, or
    says that it is larger than any that is recorded."""
    import cv2

    try:
        header = parse_structure(jpeg, Path("thumbnail"), whole=False)
        if max(header.width_px, header.height_px) > _MOST_PX:
            return None
        image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    except (FileError, cv2.error):
        return None
    return None if image is None else np.asarray(image, np.uint8)
