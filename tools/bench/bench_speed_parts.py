"""Squares of ground that mosaics are judged on where the whole of them would take too long.

The reference's grid is cut into squares; chosen are those that most of the mosaics show to their rims, and
among these some drawn by a seed. Every mosaic is judged on the same ground.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray
from rasterio.warp import transform
from rasterio.windows import Window

Floats = NDArray[np.float64]
CELLS = 16
"""A side of a square in cells, by which it is known who shows what."""


@dataclass(frozen=True)
class Parts:
    """Squares of ground: their middles (n, 2), easting and northing in a CRS, and their side."""

    crs: str
    middles_m: Floats
    side_m: float

    def windows(self, mosaic: Path, step_px: int) -> list[Window]:
        """Where they lie in a mosaic, upright in its pixels, from whole steps on; what of them it holds."""
        with rasterio.open(mosaic) as tiff:
            at = np.array(transform(self.crs, tiff.crs, *self.middles_m.T)[:2])
            cols, rows = ~tiff.transform @ at
            side = self.side_m / math.sqrt(abs(tiff.transform.determinant))
            size = step_px * max(round(side / step_px), 1)
            found = []
            for col, row in zip(cols, rows, strict=True):
                left, top = (step_px * round((middle - size / 2.0) / step_px) for middle in (col, row))
                right, bottom = min(left + size, tiff.width), min(top + size, tiff.height)
                left, top = max(left, 0), max(top, 0)
                if left < right and top < bottom:
                    found.append(Window(left, top, right - left, bottom - top))
        return found


def parts_of(
    reference: Path, mosaics: Sequence[Path], number: int, side_px: int, spare_m: float, seed: int
) -> Parts | None:
    """Squares of so many of the reference's pixels. None where there are no more than asked for: the whole.

    Args: spare_m: how far a mosaic may lie off and still show a square.
    """
    with rasterio.open(reference) as tiff:
        crs, affine = tiff.crs.to_wkt(), tiff.transform
        down, across = (n // side_px for n in tiff.shape)
    if down * across <= number:
        return None
    rows, cols = np.indices((CELLS * down, CELLS * across)) + 0.5
    cells = affine @ Affine.scale(side_px / CELLS) @ np.stack([cols.ravel(), rows.ravel()])
    spare = np.ones(2 * [2 * math.ceil(spare_m * CELLS / (side_px * affine.a)) + 1], np.uint8)
    showing = np.zeros((down, across), dtype=np.int64)
    for mosaic in (reference, *mosaics):
        shown = cv2.erode(shown_at(mosaic, crs, cells).reshape(rows.shape).view(np.uint8), spare)
        showing += shown.reshape(down, CELLS, across, CELLS).all(axis=(1, 3))
    drawn = np.random.default_rng(seed).permutation(showing.size)
    best = drawn[np.argsort(-showing.ravel()[drawn], kind="stable")][:number]
    row, col = np.divmod(np.sort(best), across)
    middles = affine @ (side_px * (np.stack([col, row]) + 0.5))
    return Parts(crs, np.column_stack(middles), side_px * affine.a)


def valid_pixels(mosaic: rasterio.DatasetReader) -> NDArray[np.bool_]:
    """Of a reduced read, 2048 to 4095 px on its longer side."""
    scale = max(max(mosaic.shape) // 2048, 1)
    mask = mosaic.dataset_mask(out_shape=(mosaic.height // scale, mosaic.width // scale))
    return np.asarray(mask > 127)


def shown_at(mosaic: Path, crs: str, places_m: Sequence[Floats]) -> NDArray[np.bool_]:
    """Whether a mosaic shows something at places, easting and northing (n,) each in a CRS."""
    with rasterio.open(mosaic) as tiff:
        valid = valid_pixels(tiff)
        at = np.array(transform(crs, tiff.crs, *places_m)[:2])
        reduced = Affine.scale(valid.shape[1] / tiff.width, valid.shape[0] / tiff.height)
        col, row = (np.floor(a).astype(int) for a in reduced @ ~tiff.transform @ at)
    inside = (row >= 0) & (row < valid.shape[0]) & (col >= 0) & (col < valid.shape[1])
    return np.asarray(inside & valid[np.where(inside, row, 0), np.where(inside, col, 0)])
