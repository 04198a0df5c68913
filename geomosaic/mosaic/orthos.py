"""Each frame by itself on the mosaic's grid: its pixels before they are one image."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.adjustment.rig import RigPoses
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import CHOSEN, Because
from geomosaic.doors.raster import unreferenced_is_fine
from geomosaic.mosaic.bands import band_names, other_bands, stack_bands
from geomosaic.mosaic.blends import BLENDS, STEP_PX
from geomosaic.mosaic.compose import WINDOW_PX, common_kind, walk
from geomosaic.mosaic.frame_source import FrameSource
from geomosaic.mosaic.frames import decoded_bytes
from geomosaic.mosaic.model import OutputGrid
from geomosaic.mosaic.ownership import Ownership
from geomosaic.mosaic.plan import Planning, windows
from geomosaic.mosaic.raster import writing_mosaic
from geomosaic.mosaic.scene import Scene
from geomosaic.mosaic.tones import Tones
from geomosaic.mosaic.views import FrameView, frame_views
from geomosaic.mosaic.window import Manner, Window
from geomosaic.projection.ground import GroundSurface
from geomosaic.survey.model import Frame, Survey

_SPARE: Annotated[
    float,
    Because(
        "share of a frame's bounds",
        "bounds are those of places along a frame's edges, and a bent edge reaches a little "
        "farther: with less, its ortho may be cut there",
        CHOSEN,
    ),
] = 0.02


@dataclass(frozen=True)
class Ortho:
    """A frame (an index into `Survey.frames`) as a raster, and how many cells of the mosaic it gives."""

    frame: int
    raster: Path
    cells: int


def orthos(
    survey: Survey,
    adjusted: Adjusted,
    ground: GroundSurface,
    ownership: Ownership,
    folder: Path,
    *,
    rig: RigPoses | None = None,
    resampling: str = "cubic",
    tones: Tones | None = None,
    threads: int = 2,
    check_cancelled: Callable[[], None] | None = None,
) -> Iterator[Ortho | None]:
    """For each frame that may give pixels its raster in folder, with a mask; None where it shows nothing.

    A raster is the caller's to take away before the next one is asked for. Pixels are those of the mosaic
    where the frame alone gives them, cut to its area. Of a rig a frame is a capture with all its bands, and
    valid is what all of them show. In memory are one frame and the windows at work.

    Raises: as `compose`.
    """
    used = ownership.used.tolist()
    bands = [_BandOrthos.of(survey, adjusted.poses, adjusted.cameras, used, ground, ownership)]
    if rig is not None and rig.bands:
        for band in other_bands(survey, adjusted.poses, used, rig):
            bands.append(_BandOrthos.of(band.survey, band.poses, band.cameras, band.used, ground, ownership))
    cells = np.bincount(ownership.owner.ravel(), minlength=len(survey.frames) + 1)
    for number, view in bands[0].views.items():
        path, within = folder / f"{number}.tif", _window(ownership.grid, view)
        shows = within is not None and all(number in band.views for band in bands)
        if shows and within is not None:
            rasters = [path] if len(bands) == 1 else [folder / f"{number}.{k}.tif" for k in range(len(bands))]
            shows = all(
                band.write(number, within, raster, resampling, tones, threads, check_cancelled)
                for band, raster in zip(bands, rasters, strict=True)
            )
            if shows and len(bands) > 1:
                part = _part(ownership.grid, within)
                shows = stack_bands(rasters, band_names(survey), part, bands[0].kind.dtype, path)
            for raster in rasters if len(bands) > 1 else ():
                raster.unlink(missing_ok=True)
        yield Ortho(number, path, int(cells[number + 1])) if shows else None


@dataclass(frozen=True)
class _BandOrthos:
    """One band of all frames: their views by number, and the scene that they are of."""

    survey: Survey
    ownership: Ownership
    scene: Scene
    views: dict[int, FrameView]
    kind: Frame

    @classmethod
    def of(
        cls,
        survey: Survey,
        poses: Poses,
        cameras: Sequence[Camera],
        used: Sequence[bool],
        ground: GroundSurface,
        ownership: Ownership,
    ) -> _BandOrthos:
        grid = ownership.grid
        views = frame_views(survey.work_frame, grid.crs, poses, cameras, used, ground)
        kind = common_kind([survey.frames[v.frame] for v in views])
        scene = Scene(survey.work_frame, ground, grid, views)
        return cls(survey, ownership, scene, {v.frame: v for v in views}, kind)

    def write(
        self,
        number: int,
        within: Window,
        path: Path,
        resampling: str,
        tones: Tones | None,
        threads: int,
        check_cancelled: Callable[[], None] | None,
    ) -> bool:
        """One frame's raster of a window, and whether it shows anything."""
        source = FrameSource(self.scene, self.ownership, self.views[number], resampling, tones)
        grid, frames, kind = self.ownership.grid, self.survey.frames, self.kind
        planning = Planning({number: source}, 0, 0.0, self.ownership.area)
        manner = Manner(BLENDS["hard"], kind.bands, kind.dtype, self.scene.lattice)
        part, shows = _part(grid, within), False
        order = [_moved(w, within.col, within.row) for w in windows(part, WINDOW_PX)]
        with unreferenced_is_fine(), ThreadPoolExecutor(threads) as pool:
            _, done = walk(
                planning, manner, grid, frames, order, resampling,
                memory_bytes=decoded_bytes(frames[number]), pool=pool, threads=threads,
                check_cancelled=check_cancelled,
            )  # fmt: skip
            with writing_mosaic(path, part, kind.bands, kind.dtype, None, ()) as raster:
                for window in done:
                    shows |= bool(window.valid.any())
                    raster.write(replace(window, window=_moved(window.window, -within.col, -within.row)))
        return shows


def _moved(window: Window, cols: int, rows: int) -> Window:
    return replace(window, col=window.col + cols, row=window.row + rows)


def _window(grid: OutputGrid, view: FrameView) -> Window | None:
    """What of the grid a frame may show, from whole steps on, as the mosaic's windows are."""
    west, south, east, north = view.bounds_m
    spare_px = math.ceil(_SPARE * max(east - west, north - south) / grid.gsd_m)
    first_col, last_col = ((x - grid.west_m) / grid.gsd_m for x in (west, east))
    first_row, last_row = ((grid.north_m - y) / grid.gsd_m for y in (north, south))
    col, row = (max((math.floor(a) - spare_px) // STEP_PX * STEP_PX, 0) for a in (first_col, first_row))
    width = min(math.ceil(last_col) + spare_px, grid.width_px) - col
    height = min(math.ceil(last_row) + spare_px, grid.height_px) - row
    return Window(col, row, width, height) if width > 0 and height > 0 else None


def _part(grid: OutputGrid, window: Window) -> OutputGrid:
    """The grid of a window."""
    west_m, north_m = grid.west_m + window.col * grid.gsd_m, grid.north_m - window.row * grid.gsd_m
    return replace(grid, west_m=west_m, north_m=north_m, width_px=window.width, height_px=window.height)
