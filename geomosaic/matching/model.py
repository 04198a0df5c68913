"""Tie points: what matching gives and adjustment takes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class TiePair:
    """Tie points of two frames. Indices are into `Survey.frames`; left < right.

    left_px, right_px: (k, 2) col and row in the full frames, GDAL's corner origin.
    left_feature, right_feature: (k,) keypoint numbers in each frame, so that pairs join to tracks.
    """

    left: int
    right: int
    left_px: Floats
    right_px: Floats
    left_feature: NDArray[np.int32]
    right_feature: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.left_px)


@dataclass(frozen=True)
class TiePoints:
    """All pairs that hold together; pairs tried without success are named in `untied`."""

    pairs: tuple[TiePair, ...]
    untied: tuple[tuple[int, int], ...] = ()
