"""The bands of a rig in one raster: each composed on one grid from its own files, then put side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rasterio.windows import Window as RasterWindow

from geomosaic.adjustment.procedure.rig import RigPoses, band_poses
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.composition.model import Mosaic, OutputGrid
from geomosaic.composition.plan import windows
from geomosaic.composition.pyramid import TILE_PX
from geomosaic.composition.raster import writing_mosaic
from geomosaic.composition.window import Composed
from geomosaic.doors.raster import OWN, open_raster
from geomosaic.survey.model import Survey

Composing = Callable[[Survey, Poses, Sequence[Camera], Sequence[bool], Path, Path | None], Mosaic]
"""`compose` with grid and ground: survey, poses, cameras, used, where the raster and the sources go."""


def compose_bands(
    composing: Composing,
    survey: Survey,
    poses: Poses,
    cameras: Sequence[Camera],
    used: Sequence[bool],
    rig: RigPoses,
    folder: Path,
    raster_path: Path,
    sources_path: Path | None,
) -> Mosaic:
    """The frames' own band, then every other one by its own files, lens and turn, as one raster.

    Args: folder: room for a raster a band, the caller's to delete.
    """
    rasters = [folder / f"{k}.tif" for k in range(1 + len(rig.bands))]
    mosaic = composing(survey, poses, cameras, used, rasters[0], sources_path)
    for band, path in zip(other_bands(survey, poses, used, rig), rasters[1:], strict=True):
        composing(band.survey, band.poses, band.cameras, band.used, path, None)
    names = band_names(survey)
    stack_bands(rasters, names, mosaic.grid, mosaic.dtype, raster_path)
    return replace(mosaic, raster=raster_path.name, bands=len(names), band_names=names)


@dataclass(frozen=True)
class BandOfRig:
    """What one of a rig's other bands shows, as a survey of its own: used (n,) where it has the capture."""

    survey: Survey
    poses: Poses
    cameras: tuple[Camera, ...]
    used: tuple[bool, ...]


def other_bands(survey: Survey, poses: Poses, used: Sequence[bool], rig: RigPoses) -> Iterator[BandOfRig]:
    """Each of the rig's other bands, with its own files, lens and turn."""
    for other, pose in zip(survey.other_bands, rig.bands, strict=True):
        none = (replace(frame, camera=pose.camera.name) for frame in survey.frames)  # not used
        frames = tuple(f or g for f, g in zip(other.frames, none, strict=True))
        there = tuple(use and f is not None for use, f in zip(used, other.frames, strict=True))
        shown = replace(survey, frames=frames, cameras=(pose.camera,))
        yield BandOfRig(shown, band_poses(poses, pose), (pose.camera,) * len(frames), there)


def with_all_bands(survey: Survey) -> list[bool]:
    """Which frames have a file of each of the rig's bands: the others would leave gaps in the mosaic."""
    return [all(files) for files in zip(survey.frames, *(b.frames for b in survey.other_bands), strict=True)]


def band_names(survey: Survey) -> tuple[str, ...]:
    """In the order of the mosaic's bands: the captures' own, then the others."""
    return survey.band, *(b.name for b in survey.other_bands)


def stack_bands(
    rasters: Sequence[Path], names: Sequence[str], grid: OutputGrid, dtype: str, path: Path
) -> bool:
    """Rasters of one band and one grid as one with named bands; valid is what all of them show, if anything.

    Raises: `OSError` if it can't be written.
    """
    shows = False
    with ExitStack() as files:
        bands = [files.enter_context(open_raster(raster, OWN)) for raster in rasters]
        out = files.enter_context(writing_mosaic(path, grid, len(bands), dtype, None, (), names))
        for window in windows(grid, TILE_PX):
            at = RasterWindow(window.col, window.row, window.width, window.height)
            valid = np.all([band.dataset_mask(window=at) for band in bands], axis=0)
            if valid.any():
                shows = True
                pixels = np.stack([band.read(1, window=at) for band in bands], axis=-1)
                pixels[~valid] = 0
                out.write(Composed(window, pixels, valid, valid.astype(np.int16) - 1, (0,), ()))
    return shows
