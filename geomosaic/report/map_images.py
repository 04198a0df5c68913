"""Images for the report's map: how many frames show the ground, and a reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from rasterio import Affine
from rasterio.enums import Resampling
from rasterio.vrt import WarpedVRT

from geomosaic.arrays import Bytes, Floats
from geomosaic.composition.grid import coarser
from geomosaic.composition.model import OutputGrid
from geomosaic.doors.raster import OWN, open_raster, reading
from geomosaic.quality.rasters import open_map
from geomosaic.report.glance import Glance, data_uri, glance_of
from geomosaic.report.layers import MapImage
from geomosaic.report.numbers import short

_WIDEST_PX: Final = 500
ENDS: Final = (0.02, 0.98)
"""Quantiles of the deviations that are drawn in the first and the last colour."""
COLOURS: Final = ((65, 150, 26), (106, 217, 166), (191, 255, 255), (97, 174, 253), (28, 25, 215))
"""Small to large, blue, green, red: those of the QGIS project."""

_OVERLAP_PX: Final = 500
_COUNTS: Final = ("#d7301f", "#fc8d59", "#fee08b", "#a6d96a", "#1a9850")
"""Of ground that one, two, three, four, five and more frames show."""
_REFERENCE_PX: Final = 1400


def overlap_image(image: Glance, footprints_m: Sequence[Floats]) -> str:
    """A data URI of the mosaic's box, coloured by the number of footprints, transparent where none is."""
    shrink = min(1.0, _OVERLAP_PX / max(image.width_px, image.height_px))
    shape = max(1, round(image.height_px * shrink)), max(1, round(image.width_px * shrink))
    count = np.zeros(shape, np.uint16)
    one = np.zeros(shape, np.uint8)
    for outline in footprints_m:
        if len(outline) > 2 and np.isfinite(outline).all():
            one[:] = 0
            at = np.clip(image.at(outline) * shrink, -30_000, 30_000)
            cv2.fillPoly(one, [np.round(at).astype(np.int32)], 1)
            count += one
    table = np.array([[int(c[k : k + 2], 16) for k in (5, 3, 1)] + [255] for c in _COUNTS], np.uint8)
    table = np.vstack([np.zeros((1, 4), np.uint8), table])
    return data_uri("png", table[np.minimum(count, len(_COUNTS))])


@dataclass(frozen=True)
class ReferenceSeen:
    """A reference as the report lays it beside the mosaic, so that nobody has to open it again; None where
    there is no run's mosaic to lay it beside."""

    image: Glance | None


def reference_image(grid: OutputGrid, path: Path) -> Glance:
    """The reference in the mosaic's box, reduced. Raises `FileError` if it can't be read."""
    coarse = coarser(grid, _REFERENCE_PX)
    with (
        open_map(path) as raster,
        reading(path),
        WarpedVRT(
            raster, crs=coarse.crs, transform=Affine.from_gdal(*coarse.geotransform),
            width=coarse.width_px, height=coarse.height_px, resampling=Resampling.average, add_alpha=True,
        ) as warped,
    ):  # fmt: skip
        return glance_of(warped, _REFERENCE_PX)


def coloured_deviations(sd_m: NDArray[np.floating], low: float, high: float) -> Bytes:
    """Deviations (rows, cols) as blue, green, red and opacity, 0 where unknown."""
    known = np.isfinite(sd_m)
    share = np.clip((np.where(known, sd_m, low) - low) / max(high - low, 1e-9), 0.0, 1.0)
    stops = np.linspace(0.0, 1.0, len(COLOURS))
    channels = [np.interp(share, stops, channel) for channel in zip(*COLOURS, strict=True)]
    return np.dstack([*channels, np.where(known, 255, 0)]).astype(np.uint8)


def accuracy_image(path: Path, origin: Floats) -> MapImage | None:
    """The layer of a run's accuracy.tif, from the map's origin; None where nothing is known."""
    with open_raster(path, OWN) as raster, reading(path, OWN.problem, OWN.fix):
        scale = max(1.0, max(raster.shape) / _WIDEST_PX)
        shape = max(1, round(raster.height / scale)), max(1, round(raster.width / scale))
        sd_m = raster.read(1, out_shape=shape, resampling=Resampling.nearest)
        west, south, east, north = raster.bounds
    known = np.isfinite(sd_m)
    if not known.any():
        return None
    low, high = np.quantile(sd_m[known], ENDS).tolist()
    drawn = coloured_deviations(sd_m, low, high)
    east_0, north_0 = origin.tolist()
    box = (west - east_0, south - north_0, east - east_0, north - north_0)
    note = f"1 σ along an axis, green {short(low, 'm')} to red {short(high, 'm')}"
    uri = data_uri("png", drawn, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    return MapImage("accuracy", "Accuracy in plan", uri, box, note=note, opacity=0.6)
