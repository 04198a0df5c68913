"""What positions and attitudes alone would give: a small mosaic for the report's swipe."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from osgeo import gdal

from geomosaic.arrays import Bools, Bytes
from geomosaic.camera.interior import Camera
from geomosaic.composition.compose import CompositionOptions, compose
from geomosaic.composition.grid import coarser, output_grid, without_flung
from geomosaic.composition.limits import limits_of
from geomosaic.composition.model import MapPixels, OutputGrid
from geomosaic.composition.ownership import by_nearest_nadir
from geomosaic.composition.raster import MosaicFiles
from geomosaic.composition.views import PosedFrames, frame_views
from geomosaic.doors.gdal_failures import close, gdal_failures
from geomosaic.errors import CancelledError, GeomosaicError
from geomosaic.placement.model import Placement
from geomosaic.projection.ground import GroundSurface
from geomosaic.report.glance import Glance, glance, stretched
from geomosaic.survey.model import Frame, Survey
from geomosaic.survey.pixels import read_pixels
from geomosaic.survey.small import FrameToDecode, Spare

_REDUCTIONS: Final = (8, 4, 2)

Spooled = Callable[..., AbstractContextManager[Sequence[Any]]]
"""`Context.spooled`."""


@dataclass(frozen=True)
class GivenMosaic:
    """The mosaic before anything was adjusted, if there can be one."""

    image: Glance | None


@dataclass(frozen=True)
class Decoding:
    """How frames are decoded at reduced size: spooled spreads them, as `Context.spooled`, so that no more
    than one of them is in hand; spares: where what a frame shows small may lie."""

    spooled: Spooled
    spares: Callable[[Frame], Spare]


def given_image(
    survey: Survey, placement: Placement, ground: GroundSurface, longest_px: int, decoding: Decoding
) -> Glance | None:
    """The mosaic as positions and attitudes alone would have it, without tones and blending.

    Frames are decoded at reduced size and composed as mosaics are. Nothing where no frame has a position,
    one's file is gone, or nothing can be composed.
    """
    if any(not Path(f.path).is_file() for f in survey.frames) or not any(survey.located):
        return None
    used = [bool(np.isfinite(p).all()) for p in placement.poses.positions_m]
    own_m, names = placement.ground_pixel_m, [f.name for f in survey.frames]
    cameras = [survey.camera_of(i) for i in range(len(names))]
    limits = limits_of(placement.poses, cameras, used, ground, own_m)
    frames = PosedFrames(survey, placement.poses, cameras, used, ground)
    views = frame_views(frames, survey.map_crs, limits) or frame_views(frames, survey.map_crs)
    try:
        grid = output_grid(MapPixels(survey.map_crs, own_m), without_flung(views, own_m)[0], names)
        return _composed(frames, placement, coarser(grid, longest_px), decoding)
    except CancelledError:
        raise
    except GeomosaicError:
        return None


def _composed(
    frames: PosedFrames, placement: Placement, grid: OutputGrid, decoding: Decoding
) -> Glance | None:
    survey = frames.survey
    unseen = [FrameToDecode(frame, decoding.spares(frame)) for frame in survey.frames]
    fits = [r for r in _REDUCTIONS if r * placement.ground_pixel_m <= grid.gsd_m]
    reduction = fits[0] if fits else 1
    shrink = partial(small_frame, reduction)
    paths = [f.path for f in survey.frames]
    with TemporaryDirectory(prefix="geomosaic-") as name:
        folder = Path(name)
        with decoding.spooled("reduced frames", shrink, unseen, paths) as reduced:
            small = tuple(
                _written(one.load(), frame, folder / f"{i}.tif")
                for i, (one, frame) in enumerate(zip(reduced, survey.frames, strict=True))
            )
        kinds = {(f.bands, f.dtype) for f in small}
        if len(kinds) != 1:
            return None
        quarters = placement.turned or (0,) * len(small)
        cameras = [_reduced(survey.camera_of(i).turned(q), reduction) for i, q in enumerate(quarters)]
        raster = folder / "given.tif"
        reduced_frames = replace(frames, survey=replace(survey, frames=small), cameras=cameras)
        ownership = by_nearest_nadir(reduced_frames, grid)
        options = CompositionOptions("hard", resampling="bilinear")
        compose(reduced_frames, ownership, MosaicFiles(raster), options)
        return glance(raster, max(grid.width_px, grid.height_px))


@dataclass(frozen=True)
class ReducedFrame:
    """A frame at reduced size, 8 bits: pixels (rows, cols, 1 or 3), and where they are valid if not all."""

    pixels: Bytes
    valid: Bools | None


def small_frame(reduction: int, unseen: FrameToDecode) -> ReducedFrame:
    """A frame whose pixels are means of so many a side."""
    pixels, valid = read_pixels(unseen.frame, reduction, spare=unseen.spare)
    pixels = pixels[..., :3] if pixels.shape[2] >= 3 else pixels[..., :1]
    known = None if valid is None else valid > 0
    if pixels.dtype != np.uint8:
        whole = np.ones(pixels.shape[:2], bool) if known is None else known
        pixels = np.moveaxis(stretched(np.moveaxis(pixels, -1, 0), whole), 0, -1)
    return ReducedFrame(np.ascontiguousarray(pixels), known)


def _written(small: ReducedFrame, frame: Frame, path: Path) -> Frame:
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
        nodata=None, whole_rows=None, calibration=None,
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
