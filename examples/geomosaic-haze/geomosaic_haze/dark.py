"""Haze by the darkest pixels of an image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def dark_level(pixels: NDArray[np.generic], valid: NDArray[np.uint8] | None, share: float) -> float:
    """Mean of the darkest share of the valid pixels, as a share of the type's white; NaN where none is valid.

    Without haze some pixel of a patch is dark in some band (He, Sun, Tang 2011: dark channel prior).

    Args: pixels (rows, cols, bands); valid (rows, cols), 0 where a pixel counts for nothing, None: all count.
    """
    white = np.iinfo(pixels.dtype).max if np.issubdtype(pixels.dtype, np.integer) else 1.0
    dark = np.asarray(pixels, dtype=np.float64).min(axis=2)
    dark = np.sort(dark.ravel() if valid is None else dark[valid > 0])
    return float(dark[: max(1, round(share * dark.size))].mean() / white) if dark.size else float("nan")
