"""A mosaic reduced to what a page can hold, as an image that lines and points are drawn over."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.vrt import WarpedVRT

from geomosaic.arrays import Bools, Bytes, Floats
from geomosaic.doors.raster import OWN, Raster, open_raster, reading
from geomosaic.quality.rasters import colour_bands, mask_of

_LONGER_SIDE_PX = 2800
_QUALITY = 75
"""Of the mosaic: half as many bytes again as at 2000 px and 82."""


@dataclass(frozen=True)
class Glance:
    """A reduced mosaic: a data URI, its size, and what of the full mosaic is covered.

    px_from_map: (2, 3) takes easting, northing, 1 to col and row of the reduced image.
    """

    uri: str
    width_px: int
    height_px: int
    px_from_map: Floats
    covered_m2: float

    def at(self, map_m: Floats) -> Floats:
        """Col and row (n, 2) of map coordinates (n, 2)."""
        return np.asarray(map_m @ self.px_from_map[:, :2].T + self.px_from_map[:, 2])


def glance(path: Path, longest_px: int = _LONGER_SIDE_PX) -> Glance:
    """A reduced read of mosaic.tif as a WebP image whose invalid pixels are transparent.

    Values of other than 8 bits are stretched between their 1st and 99th percentile.
    """
    with open_raster(path, OWN) as dataset, reading(path, OWN.problem, OWN.fix):
        return glance_of(dataset, longest_px, _QUALITY)


def glance_of(dataset: Raster | WarpedVRT, longest_px: int, quality: int = 82) -> Glance:
    """The same of an open raster."""
    scale = max(1.0, max(dataset.shape) / longest_px)
    shape = max(1, round(dataset.height / scale)), max(1, round(dataset.width / scale))
    colours = colour_bands(dataset)
    bands = dataset.read(colours, out_shape=(len(colours), *shape), resampling=Resampling.average)
    valid = mask_of(dataset, shape=shape) > 127
    t = dataset.transform
    full = np.array([[t.a, t.b, t.c], [t.d, t.e, t.f], [0.0, 0.0, 1.0]])
    size = dataset.width, dataset.height
    eight_bits = bands if bands.dtype == np.uint8 else stretched(bands, valid)
    drawn = np.moveaxis(np.broadcast_to(eight_bits, (3, *shape)), 0, -1)
    reduce = np.diag([shape[1] / size[0], shape[0] / size[1], 1.0])
    pixel_m2 = abs(np.linalg.det(full[:2, :2])) * size[0] * size[1] / (shape[0] * shape[1])
    return Glance(
        webp(drawn, valid, quality),
        shape[1],
        shape[0],
        (reduce @ np.linalg.inv(full))[:2],
        float(valid.sum() * pixel_m2),
    )


def stretched(values: NDArray[np.generic], valid: Bools) -> Bytes:
    """Values (..., rows, cols) in 8 bits: 0 at the 1st percentile of the valid ones (rows, cols), 255 at the
    99th."""
    grey = values.astype(np.float32)
    low, high = 0.0, 1.0
    if valid.any():
        low, high = np.nanpercentile(grey[..., valid], [1.0, 99.0], overwrite_input=True)
    grey -= np.float32(low)
    grey *= np.float32(255.0 / max(high - low, 1e-9))
    np.clip(grey, 0.0, 255.0, out=grey)
    return np.nan_to_num(grey, copy=False).astype(np.uint8)


def webp(colours: Bytes, valid: Bools, quality: int) -> str:
    """A data URI of red, green, blue (rows, cols, 3), transparent where nothing is valid (rows, cols)."""
    drawn = np.dstack([colours[..., ::-1], np.where(valid, 255, 0).astype(np.uint8)])
    return data_uri("webp", drawn, [cv2.IMWRITE_WEBP_QUALITY, quality])


def data_uri(kind: str, image: Bytes, settings: Sequence[int] = ()) -> str:
    """An encoded image (blue, green, red, opacity) that a page can hold."""
    data = cv2.imencode(f".{kind}", image, list(settings))[1]
    return f"data:image/{kind};base64," + base64.b64encode(data.tobytes()).decode("ascii")
