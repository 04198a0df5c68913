"""Images for the report's map: how many frames show the ground, and a reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from rasterio import Affine
from rasterio.enums import Resampling
from rasterio.vrt import WarpedVRT

from geomosaic.arrays import Floats
from geomosaic.composition.grid import coarser
from geomosaic.composition.model import OutputGrid
from geomosaic.doors.raster import reading
from geomosaic.quality.rasters import open_map
from geomosaic.report.glance import Glance, data_uri, glance_of

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
    """A reference as the report shows it next to the mosaic, without opening it again. None where the run
    has no mosaic to compare it to."""

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
