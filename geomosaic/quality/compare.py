"""A mosaic compared with a reference image: displacement vectors, the figures from them, and SSIM."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rasterio
from rasterio.windows import Window

from geomosaic.arrays import Floats, Floats32
from geomosaic.constants import tuned
from geomosaic.errors import InputError
from geomosaic.quality.compared_block import (
    GLANCE_PX,
    ComparedBlock,
    ComparisonOptions,
    compare_block,
    compared_tones,
    ssim_of,
)
from geomosaic.quality.figures import Figures, Similarity, figures, touching_patches
from geomosaic.quality.rasters import blocks, on_grid_of, open_map, pixel_m
from geomosaic.quality.ssim import SsimTerms, pooled

_FAR_SCALE = tuned(0.2, "share", "change of scale that no two images of one ground have: more admits chance")


@dataclass(frozen=True)
class Comparison:
    """What a mosaic and a reference say of each other; displacements are mosaic minus reference.

    vectors_m: (n, 4) easting and northing of the patch in the reference, displacement east and north.
    vectors_sd_px: (n,) standard deviation of each. overlap_share: valid pixels the reference covers.
    ssim_cells: (rows, cols) mean SSIM of cells of ssim_cell_m from the top left corner (west_m,
    north_m), NaN where nothing is valid. ssim_registered: after the best similarity, which takes out a shift,
    turn and scale that are stated as displacements; None where too little was measured for one.
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
    ssim_cells: Floats32
    ssim_cell_m: float
    west_m: float
    north_m: float
    ssim_registered: SsimTerms | None = None


def compare(
    mosaic: Path,
    reference: Path,
    options: ComparisonOptions = ComparisonOptions(),
    parts: Sequence[Window] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Comparison:
    """Compare two rasters on the mosaic's grid.

    The reference may lie on another grid or in another CRS: it is resampled (cubic) to the mosaic's
    pixels, by blocks, so that memory doesn't grow with the mosaic. Colours count as their luma.

    Args:
        parts: windows of the mosaic, from whole steps on, that alone are compared. All of it without.
        progress: called with the blocks done and their number; may raise to stop.
    Raises:
        FileError: a file that isn't a raster, or has no georeference. InputError: no overlap.
    """
    options.check()
    fix = "give a reference of the same place"
    apart = InputError("does not overlap the mosaic", file=reference, fix=fix)
    with ExitStack() as stack:
        a = stack.enter_context(open_map(mosaic))
        b = stack.enter_context(open_map(reference))
        _, metres = pixel_m(a, mosaic)
        pair = stack.enter_context(on_grid_of(a, b, reference))
        step_px = options.step_px
        side = max(step_px, GLANCE_PX // step_px * step_px)
        windows = list(blocks(a.height, a.width, side) if parts is None else parts)
        if not windows:
            raise InputError("no part of the reference lies in the mosaic", file=reference, fix=fix)
        glanced = [Window(0, 0, a.width, a.height)] if parts is None else windows
        tones = compared_tones(a, pair, glanced, match=options.match_tone)
        if tones is None:
            raise apart
        compared: list[ComparedBlock] = []
        for done, block in enumerate(windows):
            if progress:
                progress(done, len(windows))
            compared.append(compare_block(a, pair, block, options, tones))
        if progress:
            progress(len(windows), len(windows))
        if not any(p.shared_px for p in compared):
            raise apart
        found = _assembled(compared, a, (mosaic, reference), options)
        over = registered(a.transform, found.figures.similarity, metres)
        if over is None:
            return found
        moved = stack.enter_context(on_grid_of(a, b, reference, over))
        again = pooled([ssim_of(a, moved, block, tones) for block in windows])
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


def _assembled(
    parts: list[ComparedBlock],
    raster: rasterio.DatasetReader,
    paths: tuple[Path, Path],
    options: ComparisonOptions,
) -> Comparison:
    """The blocks of a mosaic as one; paths: its own and the reference's."""
    (gsd_m, metres), t = pixel_m(raster, paths[0]), raster.transform
    affine = np.array([[t.a, t.b, t.c], [t.d, t.e, t.f]]) * metres
    cells = np.full([-(-n // options.step_px) for n in raster.shape], np.nan, dtype=np.float32)
    for p in parts:
        cells[p.row : p.row + p.cells.shape[0], p.col : p.col + p.cells.shape[1]] = p.cells
    centres = np.concatenate([p.found.centres_px for p in parts])
    at_m = centres @ affine[:, :2].T + affine[:, 2]
    displacement_m = np.concatenate([p.found.displacement_px for p in parts]) @ affine[:, :2].T
    touching = touching_patches(centres, options.patch_px, options.step_px)
    asked = sum(p.found.asked for p in parts)
    return Comparison(
        mosaic=paths[0].name,
        reference=paths[1].name,
        crs=raster.crs.to_string(),
        gsd_m=gsd_m,
        patch_px=options.patch_px,
        step_px=options.step_px,
        search_px=options.search_px,
        overlap_share=sum(p.shared_px for p in parts) / sum(p.valid_px for p in parts),
        figures=figures(at_m, displacement_m, touching, gsd_m, asked),
        vectors_m=np.concatenate([at_m, displacement_m], axis=1),
        vectors_sd_px=np.concatenate([p.found.sd_px for p in parts]),
        ssim=pooled([p.terms for p in parts]),
        ssim_cells=cells,
        ssim_cell_m=options.step_px * gsd_m,
        west_m=float(affine[0, 2]),
        north_m=float(affine[1, 2]),
    )
