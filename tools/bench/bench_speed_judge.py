"""How good any program's mosaic is: against a true ortho, and by what it adds to the frames it was made of.

Steps: a seam is where a mosaic is brighter or of another colour on one side than on the other though no frame
shows it so. Mosaic and frames are averaged over cells of 64 px of the ground pixel, frames by the poses,
cameras and ground of one solved run, the same for all. From one cell to its neighbour the mosaic and a frame
differ by so many grey levels (root mean square of the colours). Before that the frame is changed by one
offset, one gain, or one factor of its odds v / (255 - v). Programs even tones in one of these ways, and none
is a seam. The step is the least of the three and over all frames that see both cells: where a mosaic goes on
as some frame does there is none. Seams cross a few cells in a hundred, so the figure is the quantile of 99 %.
What blends hide over many cells is no step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray
from osgeo import gdal
from rasterio.enums import Resampling
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window
from scipy.spatial import cKDTree

from geomosaic.composition.model import OutputGrid
from geomosaic.errors import GeomosaicError, InputError
from geomosaic.matching.displacement import PatchMatching, measure_displacements, patch_corners
from geomosaic.matching.least_squares_matching import MaskedImage
from geomosaic.projection.warp import frame_from_map, ground_window
from geomosaic.quality.compare import Comparison, compare
from geomosaic.quality.compared_block import ComparisonOptions
from geomosaic.quality.figures import Similarity
from geomosaic.quality.ssim import luma
from geomosaic.survey.pixels import read_pixels
from tools.bench.bench_speed_floor import solved
from tools.bench.bench_speed_parts import Parts, valid_pixels

gdal.UseExceptions()
Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
FINE_PX = 8
"""Of the grid, at which mosaic and frames are resampled, by as much reduced; a cell is as many of these."""
CELL = 8
FAR_M, NEAR_PX = 6.0, 64
"""A mosaic is looked for that far off; after the best similarity, so many pixels around."""
PATCH_PX = 64
"""`compare`'s."""
MOST_SMALL_PX = 4096
"""Longer side of mosaics in which each other patch is looked for, instead of each eighth."""
PATCH, SHIFTED = 32, 5
"""Side of the patches, of the grid's pixels, by which a mosaic is registered to another before its steps are
measured; and how many of them count in a cell."""
PLACED_PX, LEAST_PAIRS = 1600, 30
"""Longer side of images by whose keypoints a mosaic without a place is registered to another, and how many of
them have to agree."""


def similarity_of(s: Similarity) -> Affine:
    """Map coordinates in the mosaic from those in the reference."""
    return (
        Affine.translation(s.centre_east_m + s.shift_east_m, s.centre_north_m + s.shift_north_m)
        @ Affine.rotation(np.degrees(s.rotation_rad))
        @ Affine.scale(s.scale)
        @ Affine.translation(-s.centre_east_m, -s.centre_north_m)
    )


def moved(raster: Path, by: Affine, to: Path) -> Path:
    """A raster on another place of its map, as a VRT."""
    with rasterio.open(raster) as tiff:
        transform = by @ tiff.transform
    gdal.Translate(str(to), str(raster), format="VRT").SetGeoTransform(transform.to_gdal())
    return to


def far_off(mosaic: Path, reference: Path, step_px: int, parts: Sequence[Window] | None = None) -> Comparison:
    """The comparison of few patches, looked for far off. Raises `GeomosaicError` without overlap."""
    with rasterio.open(mosaic) as tiff:
        search_px = min(int(FAR_M / tiff.res[0]), 512)
    return compare(mosaic, reference, ComparisonOptions(step_px=step_px, search_px=search_px), parts=parts)


def against_truth(
    mosaic: Path, ortho: Path, scratch: Path, georeferenced: bool, squares: Parts | None = None
) -> dict[str, float]:
    """Displacements and SSIM of a georeferenced mosaic; empty where nothing of it is found in the ortho.

    All but area_m2 is of the squares, if there are some, else of the whole.

    absolute_m: root mean square of the displacements. after_px, jumps_px: see `quality.figures`, after the
    best similarity, in pixels of the mosaic. ssim: after it too, and after one gain and offset.
    found: share of the patches that were found again. area_m2: true ground, by the similarity's scale.
    """
    parts = squares and squares.windows(mosaic, PATCH_PX)
    try:
        far = far_off(mosaic, ortho, 2 * PATCH_PX if parts or _is_small(mosaic) else 8 * PATCH_PX, parts)
        if not np.isfinite(far.figures.similarity.scale):
            return {}
        true = moved(ortho, similarity_of(far.figures.similarity), scratch / "ortho-moved.vrt")
        near = compare(mosaic, true, ComparisonOptions(search_px=NEAR_PX, match_tone=True), parts=parts)
    except GeomosaicError:
        return {}
    figures = near.figures
    absolute = {"absolute_m": far.figures.absolute_rmse_m} if georeferenced else {}
    return {
        **absolute,
        "after_px": figures.after_similarity_m / near.gsd_m,
        "jumps_px": figures.jump_99_px,
        "ssim": near.ssim.ssim,
        "area_m2": area_m2(mosaic) / far.figures.similarity.scale**2,
        "found": figures.share_measured,
    }


def _is_small(mosaic: Path) -> bool:
    """Whether patches far from each other are too few in it to find where it lies."""
    with rasterio.open(mosaic) as tiff:
        return max(tiff.shape) < MOST_SMALL_PX


def placed(image: Path, reference: Path, to: Path) -> Path | None:
    """An image without a place, its fourth band its mask, registered to a georeferenced raster by keypoints.

    None where they disagree.
    """
    (small, scale), (other, other_scale) = _small(image), _small(reference)
    sift, matcher = cv2.SIFT_create(20_000), cv2.BFMatcher()
    (a, of_a), (b, of_b) = (sift.detectAndCompute(i, None) for i in (small, other))
    if of_a is None or of_b is None:
        return None
    pairs = [
        p for p in matcher.knnMatch(of_a, of_b, k=2) if len(p) == 2 and p[0].distance < 0.8 * p[1].distance
    ]
    if len(pairs) < LEAST_PAIRS:
        return None
    here = np.array([a[p.queryIdx].pt for p, _ in pairs]) + 0.5
    there = np.array([b[p.trainIdx].pt for p, _ in pairs]) + 0.5
    found, inside = cv2.estimateAffinePartial2D(here, there, ransacReprojThreshold=3.0)
    if found is None or inside.sum() < LEAST_PAIRS:
        return None
    with rasterio.open(reference) as tiff:
        crs, transform = tiff.crs.to_wkt(), tiff.transform
    onto = transform @ Affine.scale(1.0 / other_scale) @ Affine(*found.ravel()) @ Affine.scale(scale)
    vrt = gdal.Translate(str(to), str(image), format="VRT", options="-colorinterp red,green,blue,alpha")
    vrt.SetProjection(crs)
    vrt.SetGeoTransform(onto.to_gdal())
    return to


def _small(raster: Path) -> tuple[NDArray[np.uint8], float]:
    """A grey image of it, and how much smaller it is."""
    with rasterio.open(raster) as tiff:
        scale = min(PLACED_PX / max(tiff.shape), 1.0)
        shape = 3, round(tiff.height * scale), round(tiff.width * scale)
        pixels = tiff.read([1, 2, 3], out_shape=shape, resampling=Resampling.average)
    return cv2.cvtColor(np.ascontiguousarray(np.moveaxis(pixels, 0, -1)), cv2.COLOR_RGB2GRAY), scale


def area_m2(mosaic: Path) -> float:
    """Ground that a mosaic shows, of a reduced read."""
    with rasterio.open(mosaic) as tiff:
        return float(valid_pixels(tiff).mean() * tiff.height * tiff.width * abs(tiff.transform.determinant))


class Frames:
    """The frames of a solved run, averaged over cells of its mosaic's grid.

    grid: of FINE_PX pixels. seen (n, rows, cols, 3): NaN where a frame doesn't fill a cell.
    """

    def __init__(self, run: Path) -> None:
        survey, adjusted, ground, grid = solved(run)
        side = FINE_PX * CELL
        rows, cols = grid.height_px // side, grid.width_px // side
        self.grid = OutputGrid(
            grid.crs, grid.west_m, grid.north_m, FINE_PX * grid.gsd_m, CELL * cols, CELL * rows
        )
        window = ground_window(self.grid, survey.work_frame, ground)
        seen = []
        for i, status in enumerate(adjusted.status):
            if status == "rejected":
                continue
            pixels, _ = read_pixels(survey.frames[i], FINE_PX)
            col, row = (
                a / np.float32(FINE_PX)
                for a in frame_from_map(window, adjusted.poses[i], adjusted.cameras[i])
            )
            inside = (col > 0.5) & (row > 0.5) & (col < pixels.shape[1] - 0.5) & (row < pixels.shape[0] - 0.5)
            at = [np.where(inside, a, np.float32(1.0)) - np.float32(0.5) for a in (col, row)]
            seen.append(cells(cv2.remap(pixels[..., :3], *at, cv2.INTER_LINEAR), inside))
        self.seen = np.stack(seen)

        self.own = self._read(run / "mosaic.tif")

    def steps(self, mosaic: Path) -> Floats:
        """Steps (n,) of all neighbouring cells of a georeferenced mosaic that some frame sees, grey levels.

        It is first registered to the run's own mosaic, since a peer has its own idea of where the ground
        lies.
        Raises `InputError` where they have too little in common.
        """
        shown, valid = self._read(mosaic)
        at = self._where(shown, valid)
        shown = cv2.remap(shown, *at, cv2.INTER_LINEAR)
        valid = cv2.remap(valid.astype(np.uint8), *at, cv2.INTER_NEAREST) > 0
        return steps_of(cells(shown, valid), self.seen)

    def _read(self, mosaic: Path) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Colours (rows, cols, 3) and valid pixels on the grid."""
        g = self.grid
        transform = Affine(g.gsd_m, 0.0, g.west_m, 0.0, -g.gsd_m, g.north_m)
        grid = {"crs": g.crs, "transform": transform, "width": g.width_px, "height": g.height_px}
        with (
            rasterio.open(mosaic) as tiff,
            WarpedVRT(tiff, **grid, resampling=Resampling.average) as vrt,
        ):
            shown, valid = np.moveaxis(vrt.read([1, 2, 3]), 0, -1), vrt.dataset_mask() == 255
        return np.ascontiguousarray(shown), valid

    def _where(
        self, shown: NDArray[np.uint8], valid: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Where a mosaic has what the run's has at each pixel of the grid: col and row, centre origin.

        In a cell the median displacement of the patches next to it, made smooth.
        """
        own, own_valid = self.own
        here, there = (luma(np.moveaxis(image, -1, 0)) for image in (shown, own))
        corners = patch_corners(valid.shape, PATCH, PATCH // 2)
        search = int(FAR_M / self.grid.gsd_m)
        found = measure_displacements(
            MaskedImage(here, valid), MaskedImage(there, own_valid), corners, PatchMatching(PATCH, search)
        )
        if len(found.displacement_px) < 2 * SHIFTED:
            raise InputError("nearly nothing of it is found in the run's mosaic", fix="look at it")
        shape = valid.shape[0] // CELL, valid.shape[1] // CELL
        rows, cols = np.indices(shape) * float(CELL) + CELL / 2.0
        near = cKDTree(found.centres_px).query(np.stack([cols, rows], axis=-1), k=SHIFTED)[1]
        by_cell = np.median(found.displacement_px[near], axis=2).astype(np.float32)
        moved_px = cv2.resize(cv2.GaussianBlur(by_cell, (0, 0), 1.5), valid.shape[::-1])
        rows, cols = np.indices(valid.shape, dtype=np.float32)
        return cols + moved_px[..., 0], rows + moved_px[..., 1]


def cells(pixels: NDArray[np.uint8], valid: NDArray[np.bool_]) -> Floats32:
    """Means (rows, cols, 3) of cells of CELL x CELL pixels, NaN where one of them isn't valid."""
    rows, cols = (n // CELL for n in valid.shape)
    mean = cv2.resize(pixels.astype(np.float32), (cols, rows), interpolation=cv2.INTER_AREA)
    full = valid.reshape(rows, CELL, cols, CELL).all(axis=(1, 3))
    return np.where(full[..., None], mean, np.float32(np.nan))


TONES: tuple[tuple[Callable[[Floats32], Floats32], Callable[[Floats32], Floats32]], ...] = (
    (lambda v: v, np.ones_like),
    (np.log, lambda v: v),
    (lambda v: np.log(v / (255.0 - v)), lambda v: v * (255.0 - v) / 255.0),
)
"""Scales on which an offset, a gain, a factor of the odds adds the same to all greys v; and how many greys
one of the scale is worth there."""


def steps_of(mosaic: Floats32, frames: Floats32) -> Floats:
    """Steps (k,) between neighbouring cells of a mosaic (rows, cols, 3), by frames (n, rows, cols, 3)."""
    shown, seen = (np.clip(values, np.float32(1.0), np.float32(254.0)) for values in (mosaic, frames))
    found = []
    for axis in (0, 1):
        least = np.full(1, np.inf, dtype=np.float32)
        first, second = (np.take(shown, k, axis) for k in _neighbours(shown.shape[axis]))
        for scale, worth in TONES:
            off = np.diff(scale(shown), axis=axis) - np.diff(scale(seen), axis=axis + 1)
            off *= worth((first + second) / np.float32(2.0))
            length = np.sqrt(np.mean(off**2, axis=-1))
            least = np.minimum(least, np.where(np.isnan(length), np.inf, length).min(axis=0))
        found.append(least[np.isfinite(least)])
    return np.concatenate(found).astype(np.float64)


def _neighbours(cells: int) -> tuple[range, range]:
    return range(cells - 1), range(1, cells)


def steps_figure(steps: Floats) -> float:
    """99 % of the steps are smaller; NaN where there are none."""
    return float(np.quantile(steps, 0.99)) if steps.size else float("nan")
