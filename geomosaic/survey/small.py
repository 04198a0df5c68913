"""What a JPEG shows at a fraction of its size, of one decode at half of it, for all who look at it small."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Final, Protocol, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bytes
from geomosaic.constants import sourced
from geomosaic.survey.model import Frame

Small = TypeVar("Small")
REDUCTIONS = sourced((1, 2, 4, 8), "px a side", "of smaller decodes; others blur", "libjpeg: 8 x 8 blocks")
HALF: Final = REDUCTIONS[1]
"""Of the shared decode: of 9 MP it takes 36 ms, at an eighth 28 ms."""
QUARTER: Final = REDUCTIONS[2]
"""Of the detail that sharpness is compared with."""
EIGHTH: Final = REDUCTIONS[-1]
"""Of tones, seams and report: 0.4 MB a frame of 9 MP."""


@dataclass(frozen=True)
class HalfGrey:
    """A JPEG's brightness (rows, cols, 1) at half its size. version: of how it is made."""

    pixels: Bytes
    version: ClassVar[int] = 1

    @classmethod
    def of(cls, half: Bytes) -> HalfGrey:
        """Of its pixels (rows, cols, bands) at half its size."""
        return cls(brightness(half))


@dataclass(frozen=True)
class EighthColours:
    """A JPEG's pixels (rows, cols, bands) at an eighth of its size. version: as that of `HalfGrey`."""

    pixels: Bytes
    version: ClassVar[int] = 1

    @classmethod
    def of(cls, half: Bytes) -> EighthColours:
        """Of its pixels (rows, cols, bands) at half its size."""
        return cls(means(half, EIGHTH // HALF))


class Cache(Protocol[Small]):
    """Where one of them may lie."""

    def found(self) -> Small | None: ...

    def leave(self, result: Small) -> None: ...


@dataclass(frozen=True)
class Spare:
    """Where what a frame shows small may lie."""

    grey: Cache[HalfGrey]
    colours: Cache[EighthColours]

    def at(self, reduction: int, bands: int) -> Bytes | None:
        """What is asked for, if it lies there: bands is 1 for the brightness alone."""
        if reduction == HALF and bands == 1:
            grey = self.grey.found()
            return None if grey is None else grey.pixels
        colours = self.colours.found() if reduction == EIGHTH else None
        return None if colours is None or colours.pixels.shape[2] != bands else colours.pixels

    def leave(self, half: Bytes) -> None:
        """Leaves what a JPEG's pixels at half its size show."""
        self.grey.leave(HalfGrey.of(half))
        self.colours.leave(EighthColours.of(half))


@dataclass(frozen=True)
class FrameToDecode:
    """A frame to be decoded, and where what it shows small may lie."""

    frame: Frame
    spare: Spare | None = None


def brightness(pixels: Bytes) -> Bytes:
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
