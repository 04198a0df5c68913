"""Tiles of frames as JPEG, cut from the original files when they are asked for."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from geomosaic.arrays import Bytes
from geomosaic.constants import tuned
from geomosaic.export.shown_bands import ShownBands
from geomosaic.radiometry.panel import BLACK_WHITE
from geomosaic.survey.model import Frame
from geomosaic.survey.pixels import read_pixels
from geomosaic.survey.small import REDUCTIONS

TILE_PX: Final = 512
_QUALITY: Final = 92  # of JPEG; less: blocks at edges of targets; more: slow
_MOST_BYTES = tuned(4e8, "bytes", "of decoded frames; less: neighbours are decoded again; more: RAM")


class FrameTiles:
    """Decoded frames, the latest kept. May be asked from several threads."""

    def __init__(self, frames: Sequence[Frame]) -> None:
        self._frames = frames
        self._decoded: OrderedDict[tuple[int, int], Bytes] = OrderedDict()
        self._bands: dict[int, ShownBands] = {}
        self._lock = threading.Lock()

    def tile(self, frame: int, reduction: int, across: int, down: int) -> bytes | None:
        """A JPEG of at most TILE_PX pixels a side; None where there is none.

        Args: frame: its number; reduction: full pixels per pixel, 1, 2, 4 or 8; across, down: of the tile.
        Raises: `FileError` for a frame that cannot be decoded.
        """
        if not 0 <= frame < len(self._frames) or reduction not in REDUCTIONS or min(across, down) < 0:
            return None
        top, left = down * TILE_PX, across * TILE_PX
        part = self.pixels(frame, reduction)[top : top + TILE_PX, left : left + TILE_PX]
        if not part.size:
            return None
        colours = "GRAY" if part.shape[2] == 1 else "RGB"
        pixels = np.ascontiguousarray(part)
        return bytes(simplejpeg.encode_jpeg(pixels, _QUALITY, colours, "444"))

    def pixels(self, frame: int, reduction: int) -> Bytes:
        """A frame (rows, cols, 1 or 3) in 8 bits. Raises: `FileError` where it cannot be decoded."""
        key = frame, reduction
        with self._lock:
            if key not in self._decoded:
                values, _ = read_pixels(self._frames[frame], reduction)
                self._decoded[key] = self._in_eight_bits(frame, values)
            self._decoded.move_to_end(key)
            while len(self._decoded) > 1 and sum(of.nbytes for of in self._decoded.values()) > _MOST_BYTES:
                self._decoded.popitem(last=False)
            return self._decoded[key]

    def _in_eight_bits(self, frame: int, values: NDArray[Any]) -> Bytes:
        """The first three bands, or the first; all reductions of a frame are stretched alike."""
        values = values[..., : 3 if values.shape[2] >= 3 else 1]
        if values.dtype == np.uint8:
            return np.ascontiguousarray(values)
        if frame not in self._bands:
            small, _ = read_pixels(self._frames[frame], max(REDUCTIONS))
            limits = [np.nanpercentile(small[..., k], BLACK_WHITE) for k in range(values.shape[2])]
            bounds = tuple((float(low), max(float(high), float(low) + 1e-9)) for low, high in limits)
            self._bands[frame] = ShownBands([*range(values.shape[2])], bounds)
        shown = self._bands[frame].eight_bits(np.moveaxis(values, 2, 0))
        return np.ascontiguousarray(np.moveaxis(shown, 0, 2))
