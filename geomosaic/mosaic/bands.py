"""The bands of a rig in one raster: each composed on one grid from its own files, then put side by side."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import rasterio
from rasterio.enums import ColorInterp

from geomosaic.doors.raster import OWN, open_raster


def stack_bands(rasters: Sequence[Path], names: Sequence[str], path: Path) -> None:
    """Rasters of one band and one grid as one raster with named bands; valid is what all of them show.

    Raises: `OSError` if it can't be written.
    """
    with ExitStack() as files:
        bands = [files.enter_context(open_raster(raster, OWN)) for raster in rasters]
        files.enter_context(rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True))
        profile = bands[0].profile | {"count": len(bands), "interleave": "pixel", "BIGTIFF": "IF_SAFER"}
        out = files.enter_context(rasterio.open(path, "w", **profile, SPARSE_OK=True))
        out.colorinterp = [ColorInterp.gray, *[ColorInterp.undefined] * (len(bands) - 1)]
        for k, name in enumerate(names, 1):
            out.set_band_description(k, name)
        for _, window in out.block_windows(1):
            valid = np.all([band.dataset_mask(window=window) for band in bands], axis=0)
            if valid.any():
                pixels = np.stack([band.read(1, window=window) for band in bands])
                out.write(np.where(valid, pixels, 0).astype(pixels.dtype), window=window)
                out.write_mask(valid.astype(np.uint8) * 255, window=window)
