"""accuracy.tif in the report's map: deviations in plan, green to red."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from rasterio.enums import Resampling

from geomosaic.arrays import Bytes, Floats
from geomosaic.doors.raster import OWN, open_raster, reading
from geomosaic.report.glance import data_uri
from geomosaic.report.layers import MapImage
from geomosaic.report.numbers import short

_WIDEST_PX: Final = 500
ENDS: Final = (0.02, 0.98)
"""Quantiles of the deviations that are drawn in the first and the last colour."""
COLOURS: Final = ((65, 150, 26), (106, 217, 166), (191, 255, 255), (97, 174, 253), (28, 25, 215))
"""Small to large, blue, green, red: those of the QGIS project."""


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
