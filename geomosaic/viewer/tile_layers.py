"""Layers of a map that are drawn as tiles: the mosaic, the surface shaded, the accuracy, indices."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bools, Bytes
from geomosaic.doors.raster import OWN, open_raster, reading
from geomosaic.export.index import index_ends
from geomosaic.export.project_rasters import index_colours
from geomosaic.export.shown_bands import ShownBands, shown_bands
from geomosaic.quality.compared_block import GLANCE_PX
from geomosaic.report.accuracy_image import COLOURS, ENDS, coloured_deviations
from geomosaic.report.surface import in_colours, shaded
from geomosaic.viewer.grid_raster import GridRaster, ViewGrid

_QUALITY: Final = 90  # of WebP; less: blocks at edges; more: larger tiles over no network
_HEIGHT_ENDS: Final = (0.01, 0.99)
"""Quantiles of the heights that are drawn in the first and the last colour."""


class TileLayer(Protocol):
    """What is drawn of a run."""

    @property
    def title(self) -> str:
        """Its name for people."""

    @property
    def legend(self) -> tuple[str, str, list[str]] | None:
        """The colours' ends in words, and the colours from low to high."""

    def tile(self, reduction: int, across: int, down: int) -> bytes | None:
        """A WebP of at most 512 px a side, a pixel of reduction x reduction of the map; None beyond it."""


@dataclass(frozen=True)
class Colours:
    """Values that are drawn in the first and the last colour."""

    low: float
    high: float

    @classmethod
    def of(cls, path: Path, band: int, ends: tuple[float, float]) -> Colours | None:
        """By quantiles of a raster's band; None where nothing is known."""
        with open_raster(path, OWN) as raster, reading(path, OWN.problem, OWN.fix):
            reduction = max(1, max(raster.shape) // GLANCE_PX)
            shape = -(-raster.height // reduction), -(-raster.width // reduction)
            values = raster.read(band, out_shape=shape, masked=True).astype(np.float64).filled(np.nan)
        known = values[np.isfinite(values)]
        return cls(*np.quantile(known, ends).tolist()) if known.size else None

    def legend(self, colours: list[str]) -> tuple[str, str, list[str]]:
        """Their ends in metres, and the colours."""
        digits = int(np.clip(np.ceil(1.5 - np.log10(max(self.high - self.low, 1e-9))), 0, 3))
        return f"{self.low:.{digits}f} m", f"{self.high:.{digits}f} m", colours


class MosaicLayer:
    """The mosaic's own pixels, those of more than 8 bits stretched."""

    title, legend = "Mosaic", None

    def __init__(self, path: Path, grid: ViewGrid) -> None:
        self._grid, self._raster, self._shown = grid, GridRaster(path, grid), shown_bands(path)

    def tile(self, reduction: int, across: int, down: int) -> bytes | None:
        """See `TileLayer`."""
        window = self._grid.window(reduction, across, down)
        if window is None:
            return None
        values, known = self._raster.read(self._shown.bands, window, reduction)
        return _webp(_blue_green_red(self._shown, values), known)


class SurfaceLayer:
    """Heights of the surface in colours, lit from the north-west."""

    title = "Surface"

    def __init__(self, path: Path, grid: ViewGrid, colours: Colours) -> None:
        self._grid, self._raster, self._colours = grid, GridRaster(path, grid), colours
        self.legend = colours.legend(_hex(cv2.applyColorMap(_STEPS, cv2.COLORMAP_CIVIDIS)[:, 0]))

    def tile(self, reduction: int, across: int, down: int) -> bytes | None:
        """See `TileLayer`. Slopes at its edges count the pixels beyond them."""
        window, wide = (self._grid.window(reduction, across, down, margin) for margin in (0, 1))
        if window is None or wide is None:
            return None
        values, known = self._raster.read([1], wide, reduction)
        heights = np.where(known, values[0], np.nan).astype(np.float32)
        drawn = shaded(heights, self._grid.pixel_m * reduction, self._colours.low, self._colours.high)
        top, left = (
            round((a - b) / reduction)
            for a, b in zip((window.row_off, window.col_off), (wide.row_off, wide.col_off), strict=True)
        )
        shape = -(-int(window.height) // reduction), -(-int(window.width) // reduction)
        drawn = drawn[top : top + shape[0], left : left + shape[1]]
        return _webp(drawn[..., :3], drawn[..., 3] > 0)


class AccuracyLayer:
    """Deviations in plan, green to red."""

    title = "Accuracy"

    def __init__(self, path: Path, grid: ViewGrid, colours: Colours) -> None:
        self._grid, self._raster, self._colours = grid, GridRaster(path, grid), colours
        self.legend = colours.legend(_hex(np.array(COLOURS)))

    def tile(self, reduction: int, across: int, down: int) -> bytes | None:
        """See `TileLayer`."""
        window = self._grid.window(reduction, across, down)
        if window is None:
            return None
        values, known = self._raster.read([1], window, reduction)
        drawn = coloured_deviations(values[0], self._colours.low, self._colours.high)
        return _webp(drawn[..., :3], known & (drawn[..., 3] > 0))


class IndexLayer:
    """An index of the mosaic's bands, as its style has it."""

    def __init__(self, path: Path, grid: ViewGrid) -> None:
        self._grid, self._raster = grid, GridRaster(path, grid)
        self._ends, self._colours = index_ends(path), index_colours(path)
        self.title = path.stem.removeprefix("index_")
        low, high = (f"{end:.3g}" for end in self._ends)
        self.legend = low, high, list(self._colours)

    def tile(self, reduction: int, across: int, down: int) -> bytes | None:
        """See `TileLayer`."""
        window = self._grid.window(reduction, across, down)
        if window is None:
            return None
        values, known = self._raster.read([1], window, reduction)
        return _webp(in_colours(values[0], self._ends, self._colours)[..., :3], known)


_STEPS: Final = np.linspace(0, 255, 6).astype(np.uint8)[:, None]


def surface_colours(path: Path) -> Colours | None:
    """The ends of a surface's colours."""
    return Colours.of(path, 1, _HEIGHT_ENDS)


def accuracy_colours(path: Path) -> Colours | None:
    """The ends of the colours of deviations."""
    return Colours.of(path, 1, ENDS)


def _hex(colours: NDArray[Any]) -> list[str]:
    """Colours (n, 3) of blue, green, red as a page has them."""
    return [f"#{int(red):02x}{int(green):02x}{int(blue):02x}" for blue, green, red in colours]


def _blue_green_red(shown: ShownBands, values: NDArray[Any]) -> Bytes:
    colours = np.moveaxis(shown.eight_bits(values), 0, 2)
    return colours[..., ::-1] if colours.shape[2] == 3 else np.repeat(colours, 3, axis=2)


def _webp(colours: Bytes, known: Bools) -> bytes:
    opacity = np.where(known, 255, 0).astype(np.uint8)
    _, data = cv2.imencode(".webp", np.dstack([colours, opacity]), [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
    return bytes(data.tobytes())
