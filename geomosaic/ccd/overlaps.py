"""The overlaps of neighbouring strips, read piece by piece."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from threading import Lock
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.errors import RasterioError
from rasterio.windows import Window

from geomosaic.arrays import Floats
from geomosaic.ccd.model import Overlap
from geomosaic.ccd.object_space import ObjectSpace
from geomosaic.constants import tuned
from geomosaic.doors.raster import READ_CACHE_BYTES
from geomosaic.errors import FileError
from geomosaic.survey.strip_pixels import open_strip
from geomosaic.survey.strips import StripGeometry

Edge = Literal["left", "right"]
Columns = Callable[[int, Edge, int, int], NDArray[Any]]
"""The first (`left`) or last (`right`) read_px columns of a CCD's strip, of its lines start to stop."""
_FIX = "copy it again, then run once more"
PIECE_LINES = tuned(4096, "lines", "of a strip at once: more take memory; fewer read margins twice")


class Strips:
    """The strips as the methods see them: by their overlaps, whatever holds them.

    pairs: those whose two strips are there. object_space: model and heights, where there are such. relief_px:
    by pair, for every line of the left strip, the part of dline that the DEM's heights make; may be empty.
    """

    def __init__(self, geometry: StripGeometry, columns: Columns) -> None:
        self.geometry = geometry
        self.object_space: ObjectSpace | None = None
        self.relief_px: dict[int, Floats] = {}
        self.pairs = tuple(k for k in geometry.pairs if geometry.lines[k] and geometry.lines[k + 1])
        self._columns = columns

    def lines(self, pair: int) -> int:
        """Lines of a pair's left strip."""
        return self.geometry.lines[pair]

    def overlap(self, pair: int, start: int = 0, stop: int | None = None) -> Overlap:
        """A pair's overlap at the left strip's lines start to stop, which may lie beyond the strip's ends."""
        g = self.geometry
        stop = self.lines(pair) if stop is None else stop
        side = g.side(pair)
        lag = round(side * g.row_separation_lines)
        shape = stop - start, g.read_px
        valid = np.ones(shape, dtype=bool)
        sides = []
        edges: tuple[tuple[int, Edge, int], ...] = ((pair, "right", 0), (pair + 1, "left", lag))
        for ccd, edge, shift in edges:
            first, last = np.clip([start + shift, stop + shift], 0, g.lines[ccd])
            found = self._columns(ccd, edge, int(first), int(last))
            image = np.zeros(shape, dtype=found.dtype)
            seen = np.zeros(shape, dtype=bool)
            at = slice(first - start - shift, last - start - shift)
            image[at] = found
            seen[at] = True if g.nodata is None else found != g.nodata
            valid &= seen
            sides.append(image)
        return Overlap(pair, sides[0], sides[1], side, valid, start)


class StripFiles(Strips):
    """Strips as GDAL reads them, for any number of threads; the last piece of each is kept, so that both its
    edges are read at once.

    Raises: `FileError` when a strip can't be read whole.
    """

    def __init__(self, geometry: StripGeometry) -> None:
        super().__init__(geometry, self._read)
        self._open = ExitStack()
        self._files: dict[int, Any] = {}
        self._locks = [Lock() for _ in geometry.ccds]
        self._kept: dict[int, tuple[tuple[int, int], dict[Edge, NDArray[Any]]]] = {}

    def __enter__(self) -> Self:
        with ExitStack() as files:
            files.enter_context(rasterio.Env(GDAL_CACHEMAX=READ_CACHE_BYTES))
            for k, ccd in enumerate(self.geometry.ccds):
                if ccd.path is not None:
                    self._files[k] = files.enter_context(open_strip(ccd.path, self.geometry.scale))
            self._open = files.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()

    def _read(self, ccd: int, edge: Edge, start: int, stop: int) -> NDArray[Any]:
        with self._locks[ccd]:
            if ccd not in self._kept or self._kept[ccd][0] != (start, stop):
                self._kept[ccd] = (start, stop), self._edges(ccd, start, stop)
            return self._kept[ccd][1][edge]

    def _edges(self, ccd: int, start: int, stop: int) -> dict[Edge, NDArray[Any]]:
        path, read = self.geometry.ccds[ccd].path, self.geometry.read_px
        assert path is not None
        last = self.geometry.width_px - read
        windows: dict[Edge, Window] = {
            "left": Window(0, start, read, stop - start),
            "right": Window(last, start, read, stop - start),
        }
        try:
            return {edge: self._files[ccd].read(1, window=window) for edge, window in windows.items()}
        except (RasterioError, ValueError, OSError) as error:
            raise FileError(f"can't be read: {error}", file=path, fix=_FIX) from error
