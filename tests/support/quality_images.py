"""Natural-looking images for the quality tests, shifted by known amounts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def texture(rows: int, cols: int, seed: int, slope: float = 1.2) -> Floats:
    """A periodic image with the power spectrum of natural scenes, mean 128, deviation 40."""
    noise = np.random.default_rng(seed).standard_normal((rows, cols))
    f = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(cols)[None])
    f[0, 0] = 1.0
    image = np.fft.irfft2(np.fft.rfft2(noise) * f**-slope, (rows, cols))
    image -= image.mean()
    return 128.0 + 40.0 * image / image.std()


def moved(image: Floats, down_px: float, right_px: float) -> Floats:
    """The periodic image moved by any amount, exactly, by its Fourier transform."""
    rows, cols = image.shape
    turn = np.fft.fftfreq(rows)[:, None] * down_px + np.fft.rfftfreq(cols)[None] * right_px
    spectrum = np.fft.rfft2(image) * np.exp(-2j * np.pi * turn)
    return np.fft.irfft2(spectrum, (rows, cols))


def north_up(west_m: float, north_m: float, gsd_m: float) -> Affine:
    """Map from col and row."""
    return Affine(gsd_m, 0.0, west_m, 0.0, -gsd_m, north_m)


def write_tif(
    path: Path,
    bands: NDArray[np.generic],
    west_m: float,
    north_m: float,
    gsd_m: float,
    crs: str | None = "EPSG:32632",
    valid: NDArray[np.bool_] | None = None,
) -> Path:
    """A GeoTIFF of (bands, rows, cols) with an internal mask."""
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(
            path,
            "w",
            driver="GTiff",
            width=bands.shape[2],
            height=bands.shape[1],
            count=bands.shape[0],
            dtype=bands.dtype,
            crs=crs,
            transform=north_up(west_m, north_m, gsd_m),
            tiled=True,
            blockxsize=256,
            blockysize=256,
        ) as dataset,
    ):
        dataset.write(bands)
        if valid is not None:
            dataset.write_mask(valid)
    return path


def eight_bits(image: Floats) -> NDArray[np.uint8]:
    """Rounded and clipped, as one band (1, rows, cols)."""
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)[None]
