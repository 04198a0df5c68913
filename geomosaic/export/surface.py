"""The surface, its deviation and the ground model as rasters on the map."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from osgeo import gdal
from rasterio.windows import Window

from geomosaic.arrays import Bools, Bytes, Floats, Floats32, Ints
from geomosaic.composition.model import OutputGrid
from geomosaic.doors.gdal_failures import close, gdal_failures
from geomosaic.doors.raster import OWN, Raster, open_with_osgeo, reading
from geomosaic.export.surface_heights import HeightSystem, describe_bands, reference_of
from geomosaic.geodesy.local import LocalFrame
from geomosaic.projection.ground import GroundSurface
from geomosaic.projection.warp import ground_window
from geomosaic.surface.cells import Cells
from geomosaic.surface.dtm import TerrainModel
from geomosaic.surface.model import DenseSurface

NODATA: Final = -9999.0
_BLOCK_PX: Final = 512
_OPTIONS: Final = ["TILED=YES", f"BLOCKXSIZE={_BLOCK_PX}", f"BLOCKYSIZE={_BLOCK_PX}", "BIGTIFF=IF_SAFER"]
_MOSAIC_PX: Final = 4096
"""Side of a block in the mosaic's pixels, at most: 64 MB of colours."""
_GRAIN: Final = np.float32(1024.0)
"""Heights and deviations are whole parts of a metre: what lies below the noise takes half of a file."""


def surface_grid(mosaic: OutputGrid, cell_m: float) -> tuple[OutputGrid, int]:
    """The grid of a surface over a mosaic's, from the same corner, and how many of the mosaic's pixels one of
    its pixels is along a side. The number is the one that comes nearest to a cell of cell_m."""
    by = max(1, round(cell_m / mosaic.gsd_m))
    size = -(-mosaic.width_px // by), -(-mosaic.height_px // by)
    return OutputGrid(mosaic.crs, mosaic.west_m, mosaic.north_m, mosaic.gsd_m * by, *size), by


@dataclass(frozen=True)
class SurfaceBlock:
    """Part of the grid, (rows, cols) each: the pixels' heights, those of the ground below, what deviates and
    how many frames agree, and where the ground was seen; valid: where there is a surface."""

    row: int
    col: int
    height_m: Floats32
    terrain_m: Floats32
    sd_m: Floats32
    views: Bytes
    ground: Bools
    valid: Bools


@dataclass(frozen=True)
class SurfaceOnMap:
    """A surface and the ground below it as the map's pixels see them; by: the mosaic's in one of grid's."""

    grid: OutputGrid
    by: int
    work_frame: LocalFrame
    surface: DenseSurface
    terrain: TerrainModel
    heights: HeightSystem

    def blocks(self, mosaic: Raster) -> Iterator[SurfaceBlock]:
        """All of it, row by row; what neither a frame nor the mosaic shows isn't valid."""
        top, ground = self.surface.ground(), self.terrain.ground()
        side = min(_BLOCK_PX, max(1, _MOSAIC_PX // self.by))
        for row in range(0, self.grid.height_px, side):
            for col in range(0, self.grid.width_px, side):
                size = min(side, self.grid.height_px - row), min(side, self.grid.width_px - col)
                shown = _shown(mosaic, row, col, size, self.by)
                yield self._block(Window(col, row, size[1], size[0]), top, ground, shown)

    def _block(self, window: Window, top: GroundSurface, ground: GroundSurface, shown: Bools) -> SurfaceBlock:
        height_m, at = self._heights(top, window)
        terrain_m, below = self._heights(ground, window)
        within = _inside(self.surface.cells, *at)
        place, place_below = _cell_of(self.surface.cells, *at), _cell_of(self.terrain.cells, *below)
        views = self.surface.views[place]
        return SurfaceBlock(
            window.row_off, window.col_off, height_m, terrain_m, _grained(self.surface.sd_m[place]), views,
            self.terrain.seen[place_below], within & (shown | (views > 0)),
        )  # fmt: skip

    def _heights(self, ground: GroundSurface, part: Window) -> tuple[Floats32, tuple[Floats, Floats]]:
        """Heights of pixels as they are written, and where in the work frame they lie."""
        grid = self.grid
        window = ground_window(
            grid.part(part.row_off, part.col_off, (part.height, part.width)), self.work_frame, ground
        )
        assert window.relief_m is not None
        level_m = self.work_frame.geodetic_from_enu(window.polynomial[0])[2]
        undulation_m = self.heights.undulation_at(grid, part.row_off, part.col_off, part.height, part.width)
        height_m = level_m + window.relief_m.astype(np.float64) - undulation_m
        points = window.points_m()
        return _grained(height_m), (points[..., 0], points[..., 1])


def _grained(values_m: Floats | Floats32) -> Floats32:
    return np.round(values_m * _GRAIN).astype(np.float32) / _GRAIN


def _inside(cells: Cells, east: Floats, north: Floats) -> Bools:
    col, row = (east - cells.west_m) / cells.cell_m, (north - cells.south_m) / cells.cell_m
    return np.asarray((col >= 0.0) & (col <= cells.cols) & (row >= 0.0) & (row <= cells.rows))


def _cell_of(cells: Cells, east: Floats, north: Floats) -> tuple[Ints, Ints]:
    """Row and col of the cell that a place lies in, or is nearest to."""
    col = np.floor((east - cells.west_m) / cells.cell_m).astype(np.intp)
    row = np.floor((north - cells.south_m) / cells.cell_m).astype(np.intp)
    return row.clip(0, cells.rows - 1), col.clip(0, cells.cols - 1)


def mosaic_window(mosaic: Raster, row: int, col: int, size: tuple[int, int], by: int) -> Window:
    """The mosaic's pixels below part of the surface's grid, as far as the mosaic goes."""
    height = min(size[0] * by, mosaic.height - row * by)
    width = min(size[1] * by, mosaic.width - col * by)
    return Window(col * by, row * by, width, height)


def _shown(mosaic: Raster, row: int, col: int, size: tuple[int, int], by: int) -> Bools:
    """Where any of the mosaic's pixels in one of the grid's is valid."""
    found = np.zeros((size[0] * by, size[1] * by), dtype=bool)
    with reading(Path(mosaic.name), OWN.problem, OWN.fix):
        valid = mosaic.dataset_mask(window=mosaic_window(mosaic, row, col, size, by)) > 0
    found[: valid.shape[0], : valid.shape[1]] = valid
    return np.asarray(found.reshape(size[0], by, size[1], by).any(axis=(1, 3)))


@dataclass(frozen=True)
class Bands:
    """A raster's bands. described: what stands in each, and its unit."""

    described: tuple[tuple[str, str], ...]
    values: Callable[[SurfaceBlock], Sequence[NDArray[Any]]]


RASTERS: Final[Mapping[str, Bands]] = {
    "surface": Bands((("height of the surface", "m"),), lambda b: (b.height_m,)),
    "surface_confidence": Bands(
        (
            ("deviation of the height", "m"),
            ("frames that agree, 0 where what lies around holds the height", ""),
        ),
        lambda b: (b.sd_m, b.views),
    ),
    "terrain": Bands((("height of the ground", "m"),), lambda b: (b.terrain_m,)),
}


@contextmanager
def writing_rasters(
    paths: Mapping[str, Path], grid: OutputGrid, heights: HeightSystem
) -> Iterator[Callable[[SurfaceBlock], None]]:
    """Plain rasters of `RASTERS`, whole when the block ends; gives what writes one block to all of them.

    Raises: `OSError` where one of them can't be written.
    """
    with gdal_failures(next(iter(paths.values()))):
        made = {name: _created(path, grid, heights, RASTERS[name]) for name, path in paths.items()}

        def write(block: SurfaceBlock) -> None:
            for name, dataset in made.items():
                for number, values in enumerate(RASTERS[name].values(block), start=1):
                    known = np.where(block.valid & np.isfinite(values), values, NODATA)
                    dataset.GetRasterBand(number).WriteArray(known.astype(np.float32), block.col, block.row)

        yield write
        for dataset in made.values():
            close(dataset)


def _created(path: Path, grid: OutputGrid, heights: HeightSystem, bands: Bands) -> Any:
    size = grid.width_px, grid.height_px, len(bands.described)
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), *size, gdal.GDT_Float32, _OPTIONS)
    dataset.SetSpatialRef(reference_of(heights.crs))
    dataset.SetGeoTransform(grid.geotransform)
    dataset.SetMetadataItem("HEIGHTS", heights.text)
    describe_bands(dataset, bands.described, NODATA)
    return dataset


def write_difference(path: Path, surface: Path, difference_m: Floats32) -> None:
    """A plain raster of differences (rows, cols) from a reference on a surface's pixels, NaN where unknown.

    Raises: `OSError` if it can't be written.
    """
    with gdal_failures(path):
        source = open_with_osgeo(surface, OWN)
        rows, cols = difference_m.shape
        made = gdal.GetDriverByName("GTiff").Create(str(path), cols, rows, 1, gdal.GDT_Float32, _OPTIONS)
        made.SetSpatialRef(source.GetSpatialRef())
        made.SetGeoTransform(source.GetGeoTransform())
        describe_bands(made, [("surface minus reference", "m")], NODATA)
        made.GetRasterBand(1).WriteArray(
            np.where(np.isfinite(difference_m), difference_m, np.float32(NODATA))
        )
        close(made)
        del source
