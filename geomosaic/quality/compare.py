"""A mosaic laid over a reference image: displacement vectors, the figures from them, and SSIM."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window

from geomosaic.constants import tuned
from geomosaic.errors import FileError, InputError
from geomosaic.matching.displacement import Displacements, PatchMatching, measure_displacements
from geomosaic.matching.least_squares_matching import MaskedImage
from geomosaic.quality.figures import Figures, Similarity, figures, touching_patches
from geomosaic.quality.rasters import blocks, grown, on_grid_of, open_map, pixel_m, read_luma
from geomosaic.quality.ssim import WINDOW_PX, SsimTerms, gain_and_offset, mean_terms, pooled, ssim_maps

Floats = NDArray[np.float64]

_BLOCK_PX = tuned(1536, "px", "compared at once: smaller reads margins twice; larger takes memory")
_FAR_SCALE = tuned(0.2, "share", "change of scale that no two images of one ground have: more admits chance")
_GLANCE_PX = tuned(1024, "px", "reduced images for one gain and offset: larger takes time to read")


@dataclass(frozen=True)
class Comparison:
    """What a mosaic and a reference say of each other; displacements are mosaic minus reference.

    vectors_m: (n, 4) easting and northing of the patch in the reference, displacement east and north.
    vectors_sd_px: (n,) standard deviation of each. overlap_share: valid pixels the reference covers.
    ssim_cells: (rows, cols) mean SSIM of cells of ssim_cell_m from the top left corner (west_m,
    north_m), NaN where nothing is valid. ssim_registered: after the best similarity, which takes out a shift,
    turn and scale that are told as displacements; None where too little was measured for one.
    """

    mosaic: str
    reference: str
    crs: str
    gsd_m: float
    patch_px: int
    step_px: int
    search_px: int
    overlap_share: float
    figures: Figures
    vectors_m: Floats
    vectors_sd_px: Floats
    ssim: SsimTerms
    ssim_cells: NDArray[np.float32]
    ssim_cell_m: float
    west_m: float
    north_m: float
    ssim_registered: SsimTerms | None = None


def compare(
    mosaic: Path,
    reference: Path,
    *,
    patch_px: int = 64,
    step_px: int = 64,
    search_px: int = 128,
    match_tone: bool = False,
    min_correlation: float = 0.5,
    parts: Sequence[Window] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Comparison:
    """Compare two rasters on the mosaic's grid.

    The reference may lie on another grid or in another CRS: it is resampled (cubic) to the mosaic's
    pixels, by blocks, so that memory doesn't grow with the mosaic. Colours count as their luma.

    Args:
        patch_px, step_px, search_px: side of a patch, distance between patches, longest displacement
            looked for, in the mosaic's pixels.
        match_tone: before SSIM, bring the mosaic's mean and contrast to the reference's (one gain and
            one offset for all of it); the displacements don't depend on either.
        parts: windows of the mosaic, from whole steps on, that alone are compared. All of it without.
        progress: called with the blocks done and their number; may raise to stop.
    Raises:
        FileError: a file that isn't a raster, or has no georeference. InputError: no overlap.
    """
    if not (16 <= patch_px <= 512 and 1 <= step_px <= 4096 and 1 <= search_px <= 4096):
        raise InputError(
            ("a patch, step or search is out of bounds"),
            fix="give patches of 16 to 512 px, steps and searches up to 4096 px",
        )
    with ExitStack() as stack:
        a = stack.enter_context(open_map(mosaic))
        b = stack.enter_context(open_map(reference))
        gsd_m, metres = pixel_m(a, mosaic)
        pair = stack.enter_context(on_grid_of(a, b, reference))
        sizes = _Sizes(patch_px, step_px, search_px, min_correlation)
        side = max(step_px, _BLOCK_PX // step_px * step_px)
        windows = list(blocks(a.height, a.width, side) if parts is None else parts)
        if not windows:
            raise InputError(
                ("no part of the reference lies in the mosaic"),
                file=reference,
                fix="give a reference of the same place",
            )
        glanced = [Window(0, 0, a.width, a.height)] if parts is None else windows
        tones = _tones(a, pair, glanced, match_tone, mosaic, reference)
        compared: list[_Part] = []
        for done, block in enumerate(windows):
            if progress:
                progress(done, len(windows))
            compared.append(_compare_block(a, pair, block, sizes, tones))
        if progress:
            progress(len(windows), len(windows))
        if not any(p.shared_px for p in compared):
            raise InputError(
                "does not overlap the mosaic", file=reference, fix="give a reference of the same place"
            )
        t = a.transform
        affine = np.array([[t.a, t.b, t.c], [t.d, t.e, t.f]]) * metres
        names = mosaic.name, reference.name
        found = _assembled(compared, names, a.crs.to_string(), a.shape, affine, gsd_m, sizes)
        over = registered(a.transform, found.figures.similarity, metres)
        if over is None:
            return found
        moved = stack.enter_context(on_grid_of(a, b, reference, over))
        again = pooled([_ssim_of(a, moved, block, tones) for block in windows])
        return replace(found, ssim_registered=again if again.pixels else None)


def registered(mosaic_px: rasterio.Affine, similarity: Similarity, metres: float) -> rasterio.Affine | None:
    """The mosaic's grid as it lies in the reference: from col and row to the map, in its units of so many
    metres. None where there is no similarity, or it isn't one of two images of the same ground.
    """
    s = similarity
    if not (np.isfinite(s.scale) and abs(s.scale - 1.0) < _FAR_SCALE):
        return None
    centre = np.array([s.centre_east_m, s.centre_north_m]) / metres
    shift = np.array([s.shift_east_m, s.shift_north_m]) / metres
    cosine, sine = np.cos(s.rotation_rad) / s.scale, np.sin(s.rotation_rad) / s.scale
    at = np.array([mosaic_px.c, mosaic_px.f]) - centre - shift
    back = np.array([[cosine, sine], [-sine, cosine]])
    (a, b), (d, e) = (back @ [[mosaic_px.a, mosaic_px.b], [mosaic_px.d, mosaic_px.e]]).tolist()
    west, north = (back @ at + centre).tolist()
    return rasterio.Affine(a, b, west, d, e, north)


@dataclass(frozen=True)
class _Sizes:
    patch_px: int
    step_px: int
    search_px: int
    min_correlation: float


@dataclass(frozen=True)
class _Tones:
    span: float
    gain: float
    offset: float


@dataclass(frozen=True)
class _Part:
    """What one block says; displacements are in pixels of the whole mosaic, cells lie at row, col."""

    valid_px: int
    shared_px: int
    found: Displacements
    terms: SsimTerms
    cells: NDArray[np.float32]
    row: int
    col: int


def _compare_block(
    mosaic: rasterio.DatasetReader, pair: WarpedVRT, block: Window, sizes: _Sizes, tones: _Tones
) -> _Part:
    """Patches that begin in the block and SSIM of its pixels, read with a margin around it."""
    outer = grown(block, max(sizes.search_px + sizes.patch_px, WINDOW_PX), mosaic.height, mosaic.width)
    image, image_valid, reference, reference_valid = _both(mosaic, pair, outer)
    both = image_valid & reference_valid
    row, col = block.row_off - outer.row_off, block.col_off - outer.col_off
    inner = np.s_[row : row + block.height, col : col + block.width]
    corners = _corners(block, outer, sizes.patch_px, sizes.step_px)
    found = measure_displacements(
        MaskedImage(image, image_valid),
        MaskedImage(reference, reference_valid),
        corners if both.any() else corners[:0],
        PatchMatching(sizes.patch_px, sizes.search_px, sizes.min_correlation),
    )
    maps = ssim_maps(image * tones.gain + tones.offset, reference, both, tones.span).cut(inner)
    return _Part(
        int(image_valid[inner].sum()),
        int(both[inner].sum()),
        replace(found, centres_px=found.centres_px + np.array([outer.col_off, outer.row_off])),
        mean_terms(maps, tones.gain, tones.offset),
        _cell_means(maps.ssim, sizes.step_px),
        block.row_off // sizes.step_px,
        block.col_off // sizes.step_px,
    )


def _both(mosaic: rasterio.DatasetReader, pair: WarpedVRT, window: Window) -> tuple[Any, Any, Any, Any]:
    """Luma and valid pixels of both; the reference isn't read where the mosaic shows nothing."""
    image, valid = read_luma(mosaic, window)
    if valid.any():
        return image, valid, *read_luma(pair, window)
    return image, valid, np.zeros_like(image), np.zeros_like(valid)


def _ssim_of(mosaic: rasterio.DatasetReader, pair: WarpedVRT, block: Window, tones: _Tones) -> SsimTerms:
    """SSIM of a block's pixels."""
    outer = grown(block, WINDOW_PX, mosaic.height, mosaic.width)
    image, image_valid, reference, reference_valid = _both(mosaic, pair, outer)
    row, col = block.row_off - outer.row_off, block.col_off - outer.col_off
    inner = np.s_[row : row + block.height, col : col + block.width]
    both = image_valid & reference_valid
    maps = ssim_maps(image * tones.gain + tones.offset, reference, both, tones.span).cut(inner)
    return mean_terms(maps, tones.gain, tones.offset)


def _assembled(
    parts: list[_Part],
    names: tuple[str, str],
    crs: str,
    shape: tuple[int, int],
    affine: Floats,
    gsd_m: float,
    sizes: _Sizes,
) -> Comparison:
    """The blocks as one; affine (2, 3) takes col, row, 1 to metres on the map."""
    cells = np.full([-(-n // sizes.step_px) for n in shape], np.nan, dtype=np.float32)
    for p in parts:
        cells[p.row : p.row + p.cells.shape[0], p.col : p.col + p.cells.shape[1]] = p.cells
    centres = np.concatenate([p.found.centres_px for p in parts])
    at_m = centres @ affine[:, :2].T + affine[:, 2]
    displacement_m = np.concatenate([p.found.displacement_px for p in parts]) @ affine[:, :2].T
    touching = touching_patches(centres, sizes.patch_px, sizes.step_px)
    asked = sum(p.found.asked for p in parts)
    return Comparison(
        mosaic=names[0],
        reference=names[1],
        crs=crs,
        gsd_m=gsd_m,
        patch_px=sizes.patch_px,
        step_px=sizes.step_px,
        search_px=sizes.search_px,
        overlap_share=sum(p.shared_px for p in parts) / sum(p.valid_px for p in parts),
        figures=figures(at_m, displacement_m, touching, gsd_m, asked),
        vectors_m=np.concatenate([at_m, displacement_m], axis=1),
        vectors_sd_px=np.concatenate([p.found.sd_px for p in parts]),
        ssim=pooled([p.terms for p in parts]),
        ssim_cells=cells,
        ssim_cell_m=sizes.step_px * gsd_m,
        west_m=float(affine[0, 2]),
        north_m=float(affine[1, 2]),
    )


def _tones(
    mosaic: rasterio.DatasetReader,
    pair: WarpedVRT,
    windows: Sequence[Window],
    match_tone: bool,
    path: Path,
    reference: Path,
) -> _Tones:
    """Span of the values, and the mosaic's gain and offset against the reference, from reduced reads."""
    scale = max(1.0, *(np.sqrt(len(windows)) * max(w.width, w.height) / _GLANCE_PX for w in windows))
    read: list[list[Any]] = []
    for window in windows:
        shape = max(1, round(window.height / scale)), max(1, round(window.width / scale))
        images = read_luma(mosaic, window, shape), read_luma(pair, window, shape)
        read.append([part.ravel() for image in images for part in image])
    a, a_valid, b, b_valid = map(np.concatenate, zip(*read, strict=True))
    if not a_valid.any():
        raise FileError("has no valid pixel", file=path, fix="give a mosaic with pixels in it")
    both = a_valid & b_valid
    if not both.any():
        raise InputError(
            "does not overlap the mosaic", file=reference, fix="give a reference of the same place"
        )
    eight_bits = mosaic.dtypes[0] == "uint8" and pair.dtypes[0] == "uint8"
    span = 255.0 if eight_bits else max(float(np.ptp(b[both])), 1e-6)
    gain, offset = 1.0, 0.0
    if match_tone:
        gain, offset = gain_and_offset(a[both].astype(np.float64), b[both].astype(np.float64))
    return _Tones(span, gain, offset)


def _corners(inner: Window, outer: Window, patch_px: int, step_px: int) -> NDArray[np.int64]:
    """First row and col, in the outer window, of the grid's patches that begin in the inner one."""
    last_row = outer.row_off + outer.height - patch_px
    last_col = outer.col_off + outer.width - patch_px
    rows = np.arange(inner.row_off, min(inner.row_off + inner.height, last_row + 1), step_px)
    cols = np.arange(inner.col_off, min(inner.col_off + inner.width, last_col + 1), step_px)
    grid = np.stack(np.meshgrid(rows, cols, indexing="ij"), axis=-1).reshape(-1, 2)
    return np.asarray(grid - [outer.row_off, outer.col_off], dtype=np.int64)


def _cell_means(values: Floats, side: int) -> NDArray[np.float32]:
    """Means of square cells that are not NaN; the last row and col of cells may be smaller."""
    rows, cols = (-(-n // side) for n in values.shape)
    padded = np.full((rows * side, cols * side), np.nan)
    padded[: values.shape[0], : values.shape[1]] = values
    tiles = padded.reshape(rows, side, cols, side)
    count = np.isfinite(tiles).sum(axis=(1, 3))
    total = np.nansum(tiles, axis=(1, 3))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)
