"""The surface as a coloured point cloud: LAZ, LAS 1.4."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final
from uuid import UUID

import laspy
import numpy as np
from laspy.vlrs.known import WktCoordinateSystemVlr
from numpy.typing import NDArray

from geomosaic.arrays import Floats32
from geomosaic.composition.model import OutputGrid
from geomosaic.composition.raster import SOFTWARE
from geomosaic.doors.raster import OWN, Raster, reading
from geomosaic.export.shown_bands import ShownBands, shown_bands
from geomosaic.export.surface import SurfaceBlock, mosaic_window
from geomosaic.export.surface_heights import HeightSystem, reference_of

GROUND: Final = 2
OTHER: Final = 1
"""ASPRS, LAS specification 1.4 R15, table 17: ground; processed, but unclassified."""
_COLOURED: Final = 7
_SCALE_M: Final = 0.001


@contextmanager
def writing_cloud(
    path: Path, grid: OutputGrid, by: int, heights: HeightSystem, mosaic: Raster
) -> Iterator[Callable[[SurfaceBlock], None]]:
    """A point for each pixel whose height was matched; gives what writes those of a block.

    Coordinates are whole millimetres; equal surfaces give equal bytes, so no day of making stands in it.
    Raises: `OSError` if it can't be written.
    """
    header = laspy.LasHeader(point_format=_COLOURED, version="1.4")
    header.scales = np.full(3, _SCALE_M)
    header.offsets = np.array([np.floor(grid.west_m), np.floor(grid.south_m), 0.0])
    header.uuid, header.creation_date = UUID(int=0), None
    header.generating_software, header.system_identifier = SOFTWARE, "matched frames"
    header.vlrs.append(WktCoordinateSystemVlr(_wkt(heights)))
    header.global_encoding.wkt = True
    backend, shown = laspy.LazBackend.Lazrs, shown_bands(Path(mosaic.name))
    with path.open("wb") as file:
        writer = laspy.LasWriter(file, header, do_compress=True, laz_backend=backend, closefd=False)

        def write(block: SurfaceBlock) -> None:
            rows, cols = np.nonzero(block.valid & (block.views > 0))
            if not len(rows):
                return
            points = laspy.ScaleAwarePointRecord.zeros(len(rows), header=header)
            pixel = np.column_stack([cols + (block.col + 0.5), rows + (block.row + 0.5)]).astype(np.float64)
            points.x, points.y = grid.map_from_pixel(pixel).T
            points.z = block.height_m[rows, cols].astype(np.float64)
            points.classification = np.where(block.ground[rows, cols], GROUND, OTHER).astype(np.uint8)
            points.return_number = points.number_of_returns = np.ones(len(rows), dtype=np.uint8)
            points.red, points.green, points.blue = _colours(mosaic, shown, block, by)[:, rows, cols]
            writer.write_points(points)

        yield write
        writer.close()


def _wkt(heights: HeightSystem) -> str:
    """As LAS wants it: WKT 1, which has ellipsoidal heights as a vertical CRS of their own."""
    reference = reference_of(heights.whole_crs)
    return str(reference.ExportToWkt(["FORMAT=WKT1", "ALLOW_ELLIPSOIDAL_HEIGHT_AS_VERTICAL_CRS=YES"]))


def _colours(mosaic: Raster, shown: ShownBands, block: SurfaceBlock, by: int) -> NDArray[np.uint16]:
    """(3, rows, cols) red, green, blue: means of the mosaic's valid pixels in each of the block's."""
    size = block.height_m.shape[0], block.height_m.shape[1]
    bands = shown.bands if len(shown.bands) == 3 else shown.bands * 3
    window = mosaic_window(mosaic, block.row, block.col, size, by)
    with reading(Path(mosaic.name), OWN.problem, OWN.fix):
        pixels = mosaic.read(bands, window=window)
        valid = mosaic.dataset_mask(window=window) > 0
    number = _sums(valid.astype(np.float32), size, by)
    sums = np.stack([_sums(np.where(valid, band, 0).astype(np.float32), size, by) for band in pixels])
    means = sums / np.maximum(number, np.float32(1.0))
    if pixels.dtype.kind == "f":  # measured values, which may be shares or degrees
        means = shown.eight_bits(means).astype(np.float32)
    if pixels.dtype.kind == "f" or pixels.dtype == np.uint8:
        means *= np.float32(257.0)  # of eight bits to sixteen
    return np.asarray(np.clip(np.round(means), 0.0, 65535.0).astype(np.uint16))


def _sums(values: NDArray[Any], size: tuple[int, int], by: int) -> Floats32:
    padded = np.zeros((size[0] * by, size[1] * by), dtype=np.float32)
    padded[: values.shape[0], : values.shape[1]] = values
    return np.asarray(padded.reshape(size[0], by, size[1], by).sum(axis=(1, 3)))
