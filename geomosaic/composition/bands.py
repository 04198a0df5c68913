"""The bands of a rig in one raster: each composed on one grid from its own files, then put side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
from rasterio.windows import Window as RasterWindow

from geomosaic.composition.model import Mosaic, OutputGrid
from geomosaic.composition.plan import windows
from geomosaic.composition.raster import COLOURS, MosaicFiles, writing_mosaic
from geomosaic.composition.tiles import TILE_PX, TileKind
from geomosaic.composition.views import PosedFrames
from geomosaic.composition.window import DTYPES, Composed
from geomosaic.doors.raster import OWN, open_raster
from geomosaic.errors import InputError
from geomosaic.matching.band_registration import RigPoses, band_poses
from geomosaic.radiometry.quantity import quantity_of
from geomosaic.survey.model import Frame, Survey

Composing = Callable[[PosedFrames, MosaicFiles], Mosaic]
"""`compose` by an ownership, with options."""


def compose_bands(
    composing: Composing, frames: PosedFrames, rig: RigPoses, folder: Path, files: MosaicFiles
) -> Mosaic:
    """The frames' own band, then every other one by its own files, lens and turn, as one raster.

    Args: folder: room for a raster a band, the caller's to delete.
    """
    rasters = [folder / f"{k}.tif" for k in range(1 + len(rig.bands))]
    mosaic = composing(frames, replace(files, raster=rasters[0]))
    dtypes = [mosaic.dtype]
    for band, path in zip(other_bands(frames, rig), rasters[1:], strict=True):
        dtypes.append(composing(band, MosaicFiles(path)).dtype)
    names, dtype = band_names(frames.survey), common_dtype(dtypes)
    stack_bands(rasters, names, mosaic.grid, dtype, files.raster)
    return replace(mosaic, raster=files.raster.name, bands=len(names), band_names=names, dtype=dtype)


def common_kind(frames: Sequence[Frame]) -> Frame:
    """A frame whose bands and data type all share."""
    if not frames:
        raise InputError(
            ("no frame can be used, so there is no mosaic"), fix="correct the positions in the --pos file"
        )
    first = frames[0]
    for frame in frames:
        if (frame.bands, frame.dtype) != (first.bands, first.dtype):
            raise InputError(
                f"has {frame.bands} bands of {frame.dtype}, {first.name} {first.bands} of {first.dtype}",
                file=frame.path,
                fix="mosaic frames of one kind at a time",
            )
    if first.dtype not in DTYPES:
        raise InputError(
            f"pixels of type {first.dtype} can't be resampled",
            file=first.path,
            fix=f"convert the frames to one of {', '.join(DTYPES)}",
        )
    return first


def common_dtype(dtypes: Sequence[str]) -> str:
    """The type of a raster's pixels that takes the values of all bands: one of DTYPES."""
    dtype = str(np.result_type(*dtypes))
    return dtype if dtype in DTYPES else "float32"


def other_bands(frames: PosedFrames, rig: RigPoses) -> Iterator[PosedFrames]:
    """Each of the rig's other bands as a survey of its own, with its own files, lens and turn; used where it
    has the capture."""
    survey = frames.survey
    for other, pose in zip(survey.other_bands, rig.bands, strict=True):
        none = (replace(frame, camera=pose.camera.name) for frame in survey.frames)  # not used
        files = tuple(f or g for f, g in zip(other.frames, none, strict=True))
        there = tuple(use and f is not None for use, f in zip(frames.used, other.frames, strict=True))
        shown = replace(survey, frames=files, cameras=(pose.camera,), quantity=other.quantity)
        cameras = (pose.camera,) * len(files)
        yield PosedFrames(shown, band_poses(frames.poses, pose), cameras, there, frames.ground)


def narrowest(frames: PosedFrames, rig: RigPoses) -> PosedFrames | None:
    """The band whose camera sees least, and nothing that the frames do not: a thermal one with a wide one.

    None where each band sees beyond the frames.
    """
    if not rig.bands or not any(frames.used):
        return None
    own = frames.cameras[list(frames.used).index(True)]
    size = np.array([own.width_px, own.height_px])
    inside: list[tuple[float, PosedFrames]] = []
    for band, pose in zip(other_bands(frames, rig), rig.bands, strict=True):
        rays = pose.camera.ray_from_image(pose.camera.border_px()) @ pose.own_from_band.T
        at_px = own.image_from_camera(rays)
        if (at_px > 0.0).all() and (at_px < size).all():
            inside.append((float(np.ptp(at_px, axis=0).prod()), band))
    return min(inside, key=lambda one: one[0])[1] if inside else None


def with_all_bands(survey: Survey) -> list[bool]:
    """Which frames have a file of each of the rig's bands: the others would leave gaps in the mosaic."""
    return [all(files) for files in zip(survey.frames, *(b.frames for b in survey.other_bands), strict=True)]


def band_names(survey: Survey) -> tuple[str, ...]:
    """In the order of the mosaic's bands: the captures' own, or its colours, then the others."""
    own = COLOURS if survey.frames[0].bands == len(COLOURS) else (survey.band,)
    return *own, *(b.name for b in survey.other_bands)


def stack_bands(
    rasters: Sequence[Path], names: Sequence[str], grid: OutputGrid, dtype: str, path: Path
) -> bool:
    """Rasters of one grid as one with named bands; valid is what all of them show, if anything.

    Raises: `OSError` if it can't be written.
    """
    shows = False
    with ExitStack() as files:
        opened = [files.enter_context(open_raster(raster, OWN)) for raster in rasters]
        bands = [(raster, k) for raster in opened for k in raster.indexes]
        kind = TileKind(len(bands), np.dtype(dtype))
        meant = {name: quantity_of(*band) for name, band in zip(names, bands, strict=True)}
        out = files.enter_context(writing_mosaic(MosaicFiles(path), grid, kind, bands=meant))
        for window in windows(grid, TILE_PX):
            at = RasterWindow(window.col, window.row, window.width, window.height)
            valid = np.all([raster.dataset_mask(window=at) for raster in opened], axis=0)
            if valid.any():
                shows = True
                pixels = np.stack([raster.read(k, window=at) for raster, k in bands], axis=-1).astype(dtype)
                pixels[~valid] = 0
                out.write(Composed(window, pixels, valid, valid.astype(np.int16) - 1, (0,), ()))
    return shows
