"""The output grid that holds all frames, and the guard against one that holds the whole country."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.composition.blends import STEP_PX
from geomosaic.composition.limits import COARSER
from geomosaic.composition.model import MapPixels, OutputGrid
from geomosaic.composition.tiles import TILE_PX
from geomosaic.composition.views import FrameView
from geomosaic.constants import tuned
from geomosaic.errors import InputError

MAX_GIGAPIXELS = tuned(100.0, "gigapixels", "1000 km² at 0.1 m; more is mostly due to a wrong position")
MOST_PIXELS_PER_FRAME_PIXEL = tuned(200.0, "1", "more is nearly empty; a diagonal line fills 1 %")
_ROUNDED = tuned(0.05, "share", "off the frames' GSD, for two digits: below 0.048 some have none")
_FINER = tuned(0.5, "frame GSDs", "warns below: four times the space for nothing; more warns too often")
SAME_CELL = tuned(1e-3, "cells", "corners of two grids may be apart: less is rounding; more misplaces")
_LEFT_OUT_SHARE = tuned(0.1, "share", "frames dropped as too far: more drops survey; less lets a few stop it")
LEAST_CELL_PX = tuned(8, "mosaic px", "finest cell of an owner: smaller follows leaves and takes long")
MOST_CELL_PX = tuned(512, "mosaic px", "coarsest cell: larger cannot follow a road")
_CELLS_ACROSS = tuned(250, "cells", "along a frame: fewer cut objects; more take over 10 % of the time")
_STRETCHED = tuned(4.0, "grids", "growth by one frame that warns: less names line ends; more stays silent")


def auto_gsd_m(ground_pixel_m: float) -> float:
    """The roundest number within 5 % of a survey's median ground sampling distance: one digit, else two.

    Two digits are never farther off than 4.8 %.
    Raises: `InputError` where it isn't known.
    """
    if not (math.isfinite(ground_pixel_m) and ground_pixel_m > 0.0):
        raise InputError(
            "no frame sees the ground",
            fix=("correct positions, heights and attitudes (--pos, --dem, --ground-height)"),
        )
    rounded = (float(f"{ground_pixel_m:.{digits}g}") for digits in (1, 2))
    return next(gsd_m for gsd_m in rounded if abs(gsd_m / ground_pixel_m - 1.0) <= _ROUNDED)


def far_from_own(gsd_m: float, ground_pixel_m: float) -> str:
    """What a ground pixel far from the frames' own means, in words; empty where it isn't far."""
    both = f"the mosaic's pixel is {gsd_m:.3g} m, the frames' own is {ground_pixel_m:.3g} m"
    if gsd_m < _FINER * ground_pixel_m:
        return f"{both}: it can't show more than the frames do, and takes room and time; leave out --gsd"
    if gsd_m > COARSER * ground_pixel_m:
        return f"{both}: most of what the frames show is lost; give a finer --gsd to keep it"
    return ""


def output_grid(
    pixels: MapPixels,
    views: Sequence[FrameView],
    names: Sequence[str],
    max_gigapixels: float = MAX_GIGAPIXELS,
) -> OutputGrid:
    """The smallest grid that holds every frame's bounds. Its corner lies whole cells of seams and whole steps
    of blends from the pixels' origin, or whole tiles from that of an earlier mosaic.

    Args: names: of all the survey's frames, for the message.
    Raises: `InputError` if there is no frame, or if the mosaic would be larger than max_gigapixels or than
    200 times all the frames' pixels. The error names the frame that stretches the mosaic, or says that the
    ground pixel is far too fine.
    """
    if not views:
        raise InputError(
            "no frame sees the ground",
            fix=("correct positions, heights and attitudes (--pos, --dem, --ground-height)"),
        )
    gsd_m, origin_m = pixels.gsd_m, pixels.origin_m
    if not _fits(views, gsd_m, max_gigapixels):
        raise _too_large(views, names, gsd_m, max_gigapixels)
    west, south, east, north = _edges(views, gsd_m, origin_m)
    first, top, step = 0, 0, max(cell_px_by(views, gsd_m), STEP_PX)
    if pixels.earlier is not None:
        first = round((pixels.earlier.west_m - origin_m[0]) / gsd_m)
        top, step = round((pixels.earlier.north_m - origin_m[1]) / gsd_m), TILE_PX
    west, north = first + (west - first) // step * step, top + -((top - north) // step) * step
    west_m, north_m = origin_m[0] + west * gsd_m, origin_m[1] + north * gsd_m
    return OutputGrid(
        pixels.crs, west_m, north_m, gsd_m, max(int(east - west), 1), max(int(north - south), 1)
    )


def cell_px_by(views: Sequence[FrameView], gsd_m: float) -> int:
    """The side of a mosaic's cells, a power of two, by how many ground pixels most frames are long."""
    across_px = [v.gsd_m / gsd_m * max(v.camera.width_px, v.camera.height_px) for v in views]
    longest_px, side = float(np.median(across_px)) if across_px else 0.0, LEAST_CELL_PX
    while side < MOST_CELL_PX and longest_px >= 2 * side * _CELLS_ACROSS:
        side *= 2
    return side


def coarser(grid: OutputGrid, longest_px: int) -> OutputGrid:
    """The same box in at most so many pixels a side."""
    scale = max(1.0, max(grid.width_px, grid.height_px) / longest_px)
    size = [max(1, int(np.ceil(n / scale))) for n in (grid.width_px, grid.height_px)]
    return replace(grid, gsd_m=grid.gsd_m * scale, width_px=size[0], height_px=size[1])


def without_flung(
    views: Sequence[FrameView], gsd_m: float, max_gigapixels: float = MAX_GIGAPIXELS
) -> tuple[tuple[FrameView, ...], tuple[FrameView, ...]]:
    """The views whose grid can be, and those left out for it: the farthest, at most a tenth of all or one.

    All stay where that doesn't help.
    """
    if len(views) < 3 or _fits(views, gsd_m, max_gigapixels):
        return tuple(views), ()
    far = np.argsort(-_reach_m(views), kind="stable")
    for count in range(1, max(1, int(_LEFT_OUT_SHARE * len(views))) + 1):
        out = {int(i) for i in far[:count]}
        kept = tuple(v for i, v in enumerate(views) if i not in out)
        if _fits(kept, gsd_m, max_gigapixels):
            return kept, tuple(v for i, v in enumerate(views) if i in out)
    return tuple(views), ()


def stretching(views: Sequence[FrameView], gsd_m: float) -> tuple[FrameView, float] | None:
    """The one of at least four frames without which the grid were less than a quarter, and how much less."""
    if len(views) < 4:
        return None
    far = int(_reach_m(views).argmax())
    whole = _pixels(views, gsd_m)
    share = _pixels([v for i, v in enumerate(views) if i != far], gsd_m) / whole
    return (views[far], share) if share * _STRETCHED < 1.0 else None


def _edges(
    views: Sequence[FrameView], gsd_m: float, origin_m: tuple[float, float] = (0.0, 0.0)
) -> tuple[float, float, float, float]:
    """West, south, east and north in whole ground pixels from an origin."""
    bounds = np.array([v.bounds_m for v in views]) - np.tile(origin_m, 2)
    west, south = np.floor(bounds[:, :2].min(axis=0) / gsd_m + 1e-6).tolist()
    east, north = np.ceil(bounds[:, 2:].max(axis=0) / gsd_m - 1e-6).tolist()
    return west, south, east, north


def _pixels(views: Sequence[FrameView], gsd_m: float) -> float:
    west, south, east, north = _edges(views, gsd_m)
    return (east - west) * (north - south)


def _fits(views: Sequence[FrameView], gsd_m: float, max_gigapixels: float) -> bool:
    taken = sum(v.camera.width_px * v.camera.height_px for v in views)
    return _pixels(views, gsd_m) <= min(max_gigapixels * 1e9, MOST_PIXELS_PER_FRAME_PIXEL * taken)


def _reach_m(views: Sequence[FrameView]) -> Floats:
    """How far from the survey's middle each frame sees."""
    bounds = np.array([v.bounds_m for v in views])
    middle = np.median((bounds[:, :2] + bounds[:, 2:]) / 2.0, axis=0)
    return np.asarray(np.abs(bounds - np.tile(middle, 2)).max(axis=1))


def _too_large(
    views: Sequence[FrameView], names: Sequence[str], gsd_m: float, max_gigapixels: float
) -> InputError:
    west, south, east, north = _edges(views, gsd_m)
    width, height = east - west, north - south
    gigapixels = width * height / 1e9
    size = (
        f"the mosaic would be {width * gsd_m / 1000.0:,.1f} x {height * gsd_m / 1000.0:,.1f} km, "
        f"{gigapixels:,.3g} gigapixels at {gsd_m:g} m"
    )
    typical = float(np.median([v.gsd_m for v in views]))
    far = int(_reach_m(views).argmax())
    bounds = views[far].bounds_m
    rest = [v for i, v in enumerate(views) if i != far]
    if gsd_m < 0.2 * typical:
        return InputError(
            size, fix=f"this ground pixel is too fine for frames of {typical:.3g} m; make --gsd coarser"
        )
    if rest and _fits(rest, gsd_m, max_gigapixels):
        side_km = max(bounds[2] - bounds[0], bounds[3] - bounds[1]) / 1000.0
        return InputError(
            f"{size}, {_pixels(rest, gsd_m) / 1e9:,.3g} without frame {names[views[far].frame]}: it "
            f"reaches {_reach_m(views)[far] / 1000.0:,.1f} km from the middle and is {side_km:,.1f} km wide",
            fix="check its position, height and attitude, or leave it out",
        )
    if gigapixels > max_gigapixels:
        return InputError(
            f"{size}, more than {max_gigapixels:g}; frame {names[views[far].frame]} lies farthest out, "
            f"{_reach_m(views)[far] / 1000.0:,.1f} km from the middle",
            fix=f"check its position, make --gsd coarser, "
            f"or --set mosaic.seams.max_gigapixels={math.ceil(gigapixels)}",
        )
    return InputError(
        f"{size}, and nearly all of it empty; frame {names[views[far].frame]} lies farthest out, "
        f"{_reach_m(views)[far] / 1000.0:,.1f} km from the middle",
        fix="check its position and the others', or make --gsd coarser",
    )
