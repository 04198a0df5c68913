"""One block of a comparison: displacements of its patches, SSIM of its pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window

from geomosaic.arrays import Floats, Floats32, Ints64
from geomosaic.constants import tuned
from geomosaic.errors import FileError, InputError
from geomosaic.matching.displacement import Displacements, PatchMatching, measure_displacements
from geomosaic.matching.least_squares_matching import MaskedImage
from geomosaic.quality.rasters import grown, read_luma, within
from geomosaic.quality.ssim import WINDOW_PX, SsimTerms, gain_and_offset, mean_terms, ssim_maps

GLANCE_PX = tuned(1024, "px", "read at once: smaller reads margins twice; larger takes memory")


@dataclass(frozen=True)
class ComparisonOptions:
    """How two rasters are compared.

    patch_px, step_px, search_px: side of a patch, distance between patches, longest displacement looked for,
    in the mosaic's pixels. match_tone: before SSIM, bring the mosaic's mean and contrast to the reference's
    (one gain and one offset for all of it); displacements don't depend on either. min_correlation: of a patch
    that is found again.
    """

    patch_px: int = 64
    step_px: int = 64
    search_px: int = 128
    match_tone: bool = False
    min_correlation: float = 0.5

    def check(self) -> None:
        """Raises `InputError` for sides that are out of bounds."""
        if 16 <= self.patch_px <= 512 and 1 <= self.step_px <= 4096 and 1 <= self.search_px <= 4096:
            return
        fix = "give patches of 16 to 512 px, steps and searches up to 4096 px"
        raise InputError("a patch, step or search is out of bounds", fix=fix)


@dataclass(frozen=True)
class ComparedTones:
    """Span of the values, and the mosaic's gain and offset against the reference."""

    span: float
    gain: float
    offset: float


@dataclass(frozen=True)
class ComparedBlock:
    """What one block says; displacements are in pixels of the whole mosaic, cells lie at row, col."""

    valid_px: int
    shared_px: int
    found: Displacements
    terms: SsimTerms
    cells: Floats32
    row: int
    col: int


def compare_block(
    mosaic: rasterio.DatasetReader,
    pair: WarpedVRT,
    block: Window,
    options: ComparisonOptions,
    tones: ComparedTones,
) -> ComparedBlock:
    """Patches that begin in the block and SSIM of its pixels, read with a margin around it."""
    outer = grown(block, max(options.search_px + options.patch_px, WINDOW_PX), mosaic.height, mosaic.width)
    image, image_valid, reference, reference_valid = _both(mosaic, pair, outer)
    both, inner = image_valid & reference_valid, within(block, outer)
    corners = _corners(block, outer, options.patch_px, options.step_px)
    found = measure_displacements(
        MaskedImage(image, image_valid),
        MaskedImage(reference, reference_valid),
        corners if both.any() else corners[:0],
        PatchMatching(options.patch_px, options.search_px, options.min_correlation),
    )
    maps = ssim_maps(image * tones.gain + tones.offset, reference, both, tones.span).cut(inner)
    return ComparedBlock(
        int(image_valid[inner].sum()),
        int(both[inner].sum()),
        replace(found, centres_px=found.centres_px + np.array([outer.col_off, outer.row_off])),
        mean_terms(maps, tones.gain, tones.offset),
        _cell_means(maps.ssim, options.step_px),
        block.row_off // options.step_px,
        block.col_off // options.step_px,
    )


def _both(mosaic: rasterio.DatasetReader, pair: WarpedVRT, window: Window) -> tuple[Any, Any, Any, Any]:
    """Luma and valid pixels of both; the reference isn't read where the mosaic shows nothing."""
    image, valid = read_luma(mosaic, window)
    if valid.any():
        return image, valid, *read_luma(pair, window)
    return image, valid, np.zeros_like(image), np.zeros_like(valid)


def ssim_of(
    mosaic: rasterio.DatasetReader, pair: WarpedVRT, block: Window, tones: ComparedTones
) -> SsimTerms:
    """SSIM of a block's pixels."""
    outer = grown(block, WINDOW_PX, mosaic.height, mosaic.width)
    image, image_valid, reference, reference_valid = _both(mosaic, pair, outer)
    both = image_valid & reference_valid
    maps = ssim_maps(image * tones.gain + tones.offset, reference, both, tones.span)
    return mean_terms(maps.cut(within(block, outer)), tones.gain, tones.offset)


def compared_tones(
    mosaic: rasterio.DatasetReader, pair: WarpedVRT, windows: Sequence[Window], *, match: bool
) -> ComparedTones | None:
    """Of reduced reads of both; None where they share no valid pixel.

    Raises: `FileError` where the mosaic has none.
    """
    scale = max(1.0, *(np.sqrt(len(windows)) * max(w.width, w.height) / GLANCE_PX for w in windows))
    read: list[list[Any]] = []
    for window in windows:
        shape = max(1, round(window.height / scale)), max(1, round(window.width / scale))
        images = read_luma(mosaic, window, shape), read_luma(pair, window, shape)
        read.append([part.ravel() for image in images for part in image])
    a, a_valid, b, b_valid = map(np.concatenate, zip(*read, strict=True))
    if not a_valid.any():
        raise FileError("has no valid pixel", file=Path(mosaic.name), fix="give a mosaic with pixels in it")
    both = a_valid & b_valid
    if not both.any():
        return None
    eight_bits = mosaic.dtypes[0] == "uint8" and pair.dtypes[0] == "uint8"
    span = 255.0 if eight_bits else max(float(np.ptp(b[both])), 1e-6)
    gain, offset = 1.0, 0.0
    if match:
        gain, offset = gain_and_offset(a[both].astype(np.float64), b[both].astype(np.float64))
    return ComparedTones(span, gain, offset)


def _corners(inner: Window, outer: Window, patch_px: int, step_px: int) -> Ints64:
    """First row and col, in the outer window, of the grid's patches that begin in the inner one."""
    last_row = outer.row_off + outer.height - patch_px
    last_col = outer.col_off + outer.width - patch_px
    rows = np.arange(inner.row_off, min(inner.row_off + inner.height, last_row + 1), step_px)
    cols = np.arange(inner.col_off, min(inner.col_off + inner.width, last_col + 1), step_px)
    grid = np.stack(np.meshgrid(rows, cols, indexing="ij"), axis=-1).reshape(-1, 2)
    return np.asarray(grid - [outer.row_off, outer.col_off], dtype=np.int64)


def _cell_means(values: Floats, side: int) -> Floats32:
    """Means of square cells that are not NaN; the last row and col of cells may be smaller."""
    rows, cols = (-(-n // side) for n in values.shape)
    padded = np.full((rows * side, cols * side), np.nan)
    padded[: values.shape[0], : values.shape[1]] = values
    tiles = padded.reshape(rows, side, cols, side)
    count = np.isfinite(tiles).sum(axis=(1, 3))
    total = np.nansum(tiles, axis=(1, 3))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)
