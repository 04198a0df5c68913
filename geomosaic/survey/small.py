"""What a JPEG shows at a fraction of its size, of one decode at half of it, for all who look at it small."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.constants import sourced
from geomosaic.survey.model import Frame

Pixels = NDArray[np.uint8]
REDUCTIONS = sourced((1, 2, 4, 8), "px a side", "of smaller decodes; others blur", "libjpeg: 8 x 8 blocks")
HALF: Final = REDUCTIONS[1]
"""Of the shared decode: of 9 MP it takes 36 ms, at an eighth 28 ms."""
QUARTER: Final = REDUCTIONS[2]
"""Of the detail that sharpness is compared with."""
EIGHTH: Final = REDUCTIONS[-1]
"""Of tones, seams and report: 0.4 MB a frame of 9 MP."""


@dataclass(frozen=True)
class Small:
    """Pixels (rows, cols, bands) of a JPEG: its brightness at half its size, and its colours at an eighth."""

    grey: Pixels
    colours: Pixels

    def at(self, reduction: int, *, luma: bool) -> Pixels | None:
        """What is asked for, if it is one of them."""
        if luma and reduction == HALF:
            return self.grey
        return self.colours if not luma and reduction == EIGHTH else None


class Spare(Protocol):
    """Where they may lie."""

    def found(self) -> Small | None: ...

    def leave(self, result: Small) -> None: ...


@dataclass(frozen=True)
class FrameToDecode:
    """A frame to be decoded, and where what it shows small may lie."""

    frame: Frame
    spare: Spare | None = None


def small_of(half: Pixels) -> Small:
    """Of a JPEG's pixels (rows, cols, bands) at half its size."""
    return Small(brightness(half), means(half, EIGHTH // HALF))


def brightness(pixels: Pixels) -> Pixels:
    """One band (rows, cols, 1) of red, green, blue, or of one: by ITU-R BT.601, as JPEG itself has it."""
    if pixels.shape[2] == 1:
        return pixels
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), dtype=np.uint8)[..., None]


def means(pixels: NDArray[Any], side: int) -> NDArray[Any]:
    """Means of side x side pixels (rows, cols, bands); what is missing at the right and below is repeated."""
    if side == 1:
        return pixels
    whole = padded(pixels, side)
    size = (whole.shape[1] // side, whole.shape[0] // side)
    return np.atleast_3d(cv2.resize(whole, size, interpolation=cv2.INTER_AREA)).reshape(size[1], size[0], -1)


def padded(array: NDArray[Any], side: int) -> NDArray[Any]:
    """Rows and cols to whole squares of side x side pixels, by repeating the last ones."""
    rows, cols = (-n % side for n in array.shape[:2])
    if not rows and not cols:
        return array
    return np.pad(array, [(0, rows), (0, cols), *[(0, 0)] * (array.ndim - 2)], mode="edge")
