"""Each frame by itself on the mosaic's grid: its pixels before they are one image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from geomosaic.composition.area import Area
from geomosaic.composition.bands import band_names, common_dtype, common_kind, other_bands, stack_bands
from geomosaic.composition.compose import composed_views
from geomosaic.composition.frame_part import Asked, Patch, Warping, patches
from geomosaic.composition.model import OutputGrid
from geomosaic.composition.ownership import Ownership
from geomosaic.composition.raster import MosaicFiles, Raster, writing_mosaic
from geomosaic.composition.scene import CELL_PX, Scene, bounds_window
from geomosaic.composition.tiles import TileKind
from geomosaic.composition.tones import Tones
from geomosaic.composition.views import PosedFrames
from geomosaic.composition.visibility import FrameOnMap, cells_in_view
from geomosaic.composition.window import Composed, Window
from geomosaic.doors.raster import unreferenced_is_fine
from geomosaic.matching.band_registration import RigPoses


@dataclass(frozen=True)
class OrthoPlan:
    """What all frames' orthos have in common, and the frames that may show something: by their index in
    `Survey.frames`, each with all its bands. names: of a rig's bands, in their order."""

    warping: Warping
    area: Area | None
    names: tuple[str, ...]
    frames: dict[int, tuple[FrameOnMap, ...]]


def plan_orthos(
    frames: PosedFrames, ownership: Ownership, rig: RigPoses, resampling: str, tones: Tones | None
) -> OrthoPlan:
    """The orthos of all frames that may give pixels. Of a rig a frame is a capture with all its bands.

    Raises: `InputError` if frames don't go together or can't be resampled.
    """
    grid = ownership.grid
    bands = [frames, *(other_bands(frames, rig) if rig.bands else ())]
    views = [composed_views(band, ownership) for band in bands]
    kinds = [common_kind([b.survey.frames[v.frame] for v in of]) for b, of in zip(bands, views, strict=True)]
    lying: dict[int, list[FrameOnMap]] = {}
    for band, of in zip(bands, views, strict=True):
        for view in of:
            lying.setdefault(view.frame, []).append(FrameOnMap(band.survey.frames[view.frame], view))
    scene = Scene(frames.survey.work_frame, frames.ground, grid, ())
    return OrthoPlan(
        Warping(scene, resampling, tones, kinds[0].dtype, np.inf),
        ownership.area,
        band_names(frames.survey) if rig.bands else (),
        {n: tuple(of) for n, of in sorted(lying.items()) if len(of) == len(bands)},
    )


def write_ortho(
    warping: Warping, area: Area | None, names: Sequence[str], frame: Sequence[FrameOnMap], path: Path
) -> bool:
    """One frame's raster with its mask, and whether it shows anything; none is written where it lies beyond
    the grid. Pixels are those of the mosaic where the frame alone gives them, cut to its area; of a rig valid
    is what all bands show.

    Raises: `FileError` if a frame can't be read, `OSError` if the raster can't be written.
    """
    grid = warping.scene.grid
    within = _window(grid, frame)
    if within is None:
        return False
    if len(frame) == 1:
        return _write(warping, area, frame[0], within, path)
    rasters = [path.with_suffix(f".{k}.tif") for k in range(len(frame))]
    shows = [_write(warping, area, frame[0], within, rasters[0])]
    for band, raster in zip(frame[1:], rasters[1:], strict=True):
        shows.append(_write(replace(warping, tones=None, dtype=band.frame.dtype), area, band, within, raster))
    dtype = common_dtype([band.frame.dtype for band in frame])
    try:
        return all(shows) and stack_bands(rasters, names, _part(grid, within), dtype, path)
    finally:
        for raster in rasters:
            raster.unlink(missing_ok=True)


def _write(warping: Warping, area: Area | None, on_map: FrameOnMap, within: Window, path: Path) -> bool:
    grid, shows = warping.scene.grid, False
    cells = cells_in_view(warping.scene, on_map.view).cells
    if area is not None:
        cells.flags[:] &= area.cells(grid, cells.window, CELL_PX)
    if not cells.flags.any():
        return False
    kind = TileKind(on_map.frame.bands, np.dtype(warping.dtype))
    with (
        unreferenced_is_fine(),
        writing_mosaic(MosaicFiles(path), _part(grid, within), kind) as raster,
    ):
        for patch in patches(warping, Asked(on_map, cells)):
            shows |= _written(raster, grid, area, within, patch)
    return shows


def _written(raster: Raster, grid: OutputGrid, area: Area | None, within: Window, patch: Patch) -> bool:
    """Writes what of a patch lies in a window and is valid, and whether anything is."""
    height, width = patch.pixels.shape[:2]
    top, left = max(patch.row, within.row), max(patch.col, within.col)
    bottom = min(patch.row + height, within.row + within.height)
    right = min(patch.col + width, within.col + within.width)
    if bottom <= top or right <= left:
        return False
    at = slice(top - patch.row, bottom - patch.row), slice(left - patch.col, right - patch.col)
    window = Window(left, top, right - left, bottom - top)
    valid = patch.valid[at]
    if area is not None:
        valid = valid & area.mask(grid, window)
    if not valid.any():
        return False
    pixels = np.where(valid[..., None], patch.pixels[at], patch.pixels.dtype.type(0))
    moved = replace(window, col=left - within.col, row=top - within.row)
    raster.write(Composed(moved, pixels, valid, valid.astype(np.int16) - np.int16(1), (0,), ()))
    return True


def _window(grid: OutputGrid, frame: Sequence[FrameOnMap]) -> Window | None:
    """What of the grid a frame may show, from whole cells on."""
    cells = bounds_window(grid, frame[0].view.widened(), CELL_PX)
    width, height = min(cells.width, grid.width_px - cells.col), min(cells.height, grid.height_px - cells.row)
    return replace(cells, width=width, height=height) if width > 0 and height > 0 else None


def _part(grid: OutputGrid, window: Window) -> OutputGrid:
    """The grid of a window."""
    west_m, north_m = grid.west_m + window.col * grid.gsd_m, grid.north_m - window.row * grid.gsd_m
    return replace(grid, west_m=west_m, north_m=north_m, width_px=window.width, height_px=window.height)
