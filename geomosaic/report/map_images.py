"""Images for the report's map: how many frames show the ground, a reference, what POS alone would give."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from osgeo import gdal
from rasterio import Affine
from rasterio.enums import Resampling
from rasterio.errors import RasterioError
from rasterio.vrt import WarpedVRT

from geomosaic.camera.interior import Camera
from geomosaic.doors.gdal_failures import close, gdal_failures
from geomosaic.errors import GeomosaicError
from geomosaic.mosaic.compose import compose
from geomosaic.mosaic.model import OutputGrid
from geomosaic.placement.model import Placement
from geomosaic.projection.ground import GroundSurface
from geomosaic.quality.rasters import open_map
from geomosaic.report.glance import Glance, data_uri, glance, glance_of, stretched
from geomosaic.survey.model import Frame, Survey
from geomosaic.survey.pixels import read_pixels

Floats = NDArray[np.float64]
_OVERLAP_PX: Final = 500
_COUNTS: Final = ("#d7301f", "#fc8d59", "#fee08b", "#a6d96a", "#1a9850")
"""Of ground that one, two, three, four, five and more frames show."""
_REFERENCE_PX: Final = 1400
_REDUCTIONS: Final = (8, 4, 2)

Mapped = Callable[..., Sequence[Any]]
"""`Context.map`."""


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


def reference_image(grid: OutputGrid, path: Path) -> Glance | None:
    """The reference in the mosaic's box, reduced; nothing where it can't be read any more."""
    coarse = coarser(grid, _REFERENCE_PX)
    try:
        with (
            open_map(path) as raster,
            WarpedVRT(
                raster, crs=coarse.crs, transform=Affine.from_gdal(*coarse.geotransform),
                width=coarse.width_px, height=coarse.height_px, resampling=Resampling.average, add_alpha=True,
            ) as warped,
        ):  # fmt: skip
            return glance_of(warped, _REFERENCE_PX)
    except (GeomosaicError, RasterioError, ValueError):
        return None


def coarser(grid: OutputGrid, longest_px: int) -> OutputGrid:
    """The same box in at most so many pixels a side."""
    scale = max(1.0, max(grid.width_px, grid.height_px) / longest_px)
    size = [max(1, int(np.ceil(n / scale))) for n in (grid.width_px, grid.height_px)]
    return replace(grid, gsd_m=grid.gsd_m * scale, width_px=size[0], height_px=size[1])


def given_image(
    survey: Survey,
    placement: Placement,
    ground: GroundSurface,
    grid: OutputGrid,
    longest_px: int,
    mapped: Mapped,
) -> Glance | None:
    """The mosaic as positions and attitudes alone would have it, without tones and blending.

    Frames are decoded at reduced size and composed as mosaics are. Nothing where no frame has a position or
    one's file is gone.
    Args: mapped: spreads the decoding, as `Context.map`.
    """
    gone = any(not Path(f.path).is_file() for f in survey.frames)
    if gone or not any(survey.located):
        return None
    coarse = coarser(grid, longest_px)
    fits = [r for r in _REDUCTIONS if r * placement.ground_pixel_m <= coarse.gsd_m]
    reduction = fits[0] if fits else 1
    shrink = partial(small_frame, reduction)
    reduced = mapped("reduced frames", shrink, survey.frames, [f.path for f in survey.frames])
    with TemporaryDirectory(prefix="geomosaic-") as name:
        folder = Path(name)
        small = tuple(
            _written(one, frame, folder / f"{i}.tif")
            for i, (one, frame) in enumerate(zip(reduced, survey.frames, strict=True))
        )
        kinds = {(f.bands, f.dtype) for f in small}
        if len(kinds) != 1:
            return None
        quarters = placement.turned or (0,) * len(small)
        cameras = [_reduced(survey.camera_of(i).turned(q), reduction) for i, q in enumerate(quarters)]
        raster = folder / "given.tif"
        used = [bool(np.isfinite(p).all()) for p in placement.poses.positions_m]
        try:
            compose(
                replace(survey, frames=small), placement.poses, cameras, used, ground, coarse, raster,
                blend="hard", resampling="bilinear",
            )  # fmt: skip
        except GeomosaicError:
            return None
        return glance(raster, longest_px)


@dataclass(frozen=True)
class Small:
    """A frame at reduced size, 8 bits: pixels (rows, cols, 1 or 3), and where they are valid if not all."""

    pixels: NDArray[np.uint8]
    valid: NDArray[np.bool_] | None


def small_frame(reduction: int, frame: Frame) -> Small:
    """A frame whose pixels are means of so many a side."""
    pixels, valid = read_pixels(frame, reduction)
    pixels = pixels[..., :3] if pixels.shape[2] >= 3 else pixels[..., :1]
    known = None if valid is None else valid > 0
    if pixels.dtype != np.uint8:
        whole = np.ones(pixels.shape[:2], bool) if known is None else known
        pixels = np.moveaxis(stretched(np.moveaxis(pixels, -1, 0), whole), 0, -1)
    return Small(np.ascontiguousarray(pixels), known)


def _written(small: Small, frame: Frame, path: Path) -> Frame:
    rows, cols, bands = small.pixels.shape
    with gdal_failures(path):
        tiff = gdal.GetDriverByName("GTiff").Create(str(path), cols, rows, bands, gdal.GDT_Byte)
        tiff.WriteArray(np.moveaxis(small.pixels, -1, 0) if bands > 1 else small.pixels[..., 0])
        if small.valid is not None:
            tiff.CreateMaskBand(gdal.GMF_PER_DATASET)
            tiff.GetRasterBand(1).GetMaskBand().WriteArray(np.where(small.valid, 255, 0).astype(np.uint8))
        close(tiff)
    return replace(
        frame, path=str(path), width_px=cols, height_px=rows, bands=bands, dtype="uint8", valid_mask=None,
        nodata=None, whole_rows=None,
    )  # fmt: skip


def _reduced(camera: Camera, reduction: int) -> Camera:
    """The camera of an image whose pixels are means of so many a side."""
    return replace(
        camera,
        width_px=-(-camera.width_px // reduction),
        height_px=-(-camera.height_px // reduction),
        focal_length_px=camera.focal_length_px / reduction,
        principal_col_px=camera.principal_col_px / reduction,
        principal_row_px=camera.principal_row_px / reduction,
    )
