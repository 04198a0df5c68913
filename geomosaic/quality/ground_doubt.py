"""How far the ground's own deviations may move what a mosaic shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.ndimage import binary_fill_holes
from scipy.special import erfc

from geomosaic.arrays import Bools, Floats
from geomosaic.camera.exterior import Poses
from geomosaic.composition.ownership import Ownership
from geomosaic.composition.trim import OFF_PX, looked_at, whole_of
from geomosaic.geodesy.local import LocalFrame
from geomosaic.projection.ground import WALLED, GroundSurface
from geomosaic.quality.height_fit import MOST_POINTS
from geomosaic.surface.dtm import TERRAIN

MATCHED: Final = (WALLED, TERRAIN)
"""Kinds of ground that were matched between the frames."""


@dataclass(frozen=True)
class LandDoubt:
    """Shares of the mosaic's land that have to be expected off by more than is asked.

    ground_share: since the ground may be higher or lower, amid land that is surely enough known; rim_share:
    beyond all of that; NaN where its deviations aren't known, or no frame gives anything. surface_share:
    since what was matched is unsure; NaN without a matched surface.
    """

    ground_share: float
    rim_share: float
    surface_share: float


@dataclass(frozen=True)
class Land:
    """What a mosaic shows, by whom, and on what ground; known: the ground known before a surface was matched,
    the same without one."""

    ownership: Ownership
    poses: Poses
    work_frame: LocalFrame
    ground: GroundSurface
    known: GroundSurface


def land_doubt(land: Land, within_px: float) -> LandDoubt:
    """How far the land of a mosaic may lie off, and how much of it by more than is asked, in its pixels.

    Where a matched surface lies on the ground known before, the surer of both counts. The surface counts by
    its own deviation, the known ground by its deviation and the distance between both. Elsewhere there are
    two cases. If something stands on the ground (or the ground is unknown), the surer of both deviations
    counts. Rims of roofs and woods say nothing against the ground around, and what they leave open is the
    surface's share. If nothing stands there, the surface has strayed by all that lies between. This is as
    likely as its deviation reaches so far.
    """
    ground, known = land.ground, land.known
    at_m, tangent, given = places_of(land)
    px_per_m = tangent / land.ownership.grid.gsd_m
    known_px = px_per_m * known.sd_at(at_m[:, 0], at_m[:, 1])
    if ground.kind not in MATCHED:
        some = known_px > 0.0
        return _doubt(_beyond(within_px, known_px[some]), _among(given, some), np.nan)
    matched_px = px_per_m * ground.sd_at(at_m[:, 0], at_m[:, 1])
    apart_m = ground.up_at(at_m[:, 0], at_m[:, 1]) - known.up_at(at_m[:, 0], at_m[:, 1])
    apart_px = px_per_m * np.abs(apart_m)
    off = _beyond(within_px, matched_px[np.isfinite(matched_px)])
    some = (matched_px > 0.0) & (known_px > 0.0)
    matched_px, known_px, apart_px = matched_px[some], known_px[some], apart_px[some]
    strayed = _beyond(apart_px, matched_px)
    matched, strays = _beyond(within_px, matched_px), _beyond(within_px, known_px, apart_px)
    stands = strayed * strays + (1.0 - strayed) * np.minimum(matched, _beyond(within_px, known_px))
    beyond = np.where(apart_px <= OFF_PX, np.minimum(matched, strays), stands)
    return _doubt(beyond, _among(given, some), float(off.mean()) if off.size else np.nan)


def places_of(land: Land) -> tuple[Floats, Floats, Bools]:
    """Places (k, 3) of the work frame, m, all over what frames give. Also the tangents (k,) of the angles at
    which their frames look at them, and which cells of an even choice they are (rows, cols). A place moves by
    its height's error times its tangent."""
    its = land.ownership
    step = int(np.ceil(np.sqrt(its.owner.size / MOST_POINTS)))
    at_m, tangent = looked_at(its, land.poses, land.work_frame, land.ground, step)
    given = np.isfinite(tangent)
    if its.area is not None:
        given &= its.area.cells(its.grid, whole_of(its.grid), its.cell_px)[::step, ::step]
    return at_m[given], tangent[given], given


def _among(given: Bools, some: Bools) -> Bools:
    """Cells (rows, cols) of some (k,) of the places given."""
    cells = np.zeros_like(given)
    cells[given] = some
    return cells


def _doubt(beyond: Floats, cells: Bools, surface_share: float) -> LandDoubt:
    """beyond (k,): how likely the places in cells (rows, cols) lie farther off than is asked."""
    if not beyond.size:
        return LandDoubt(float("nan"), float("nan"), surface_share)
    known = np.zeros_like(cells)
    known[cells] = beyond < 0.5  # more likely within it than not
    amid = binary_fill_holes(known)[cells]
    return LandDoubt(
        float(beyond[amid].sum()) / beyond.size, float(beyond[~amid].sum()) / beyond.size, surface_share
    )


def _beyond(within_px: float | Floats, sd_px: Floats, apart_px: float | Floats = 0.0) -> Floats:
    """How likely each place lies farther off, if it is expected to lie apart_px off by sd_px."""
    per_sd = np.sqrt(0.5) / np.maximum(sd_px, 1e-9)
    ends = erfc((within_px - apart_px) * per_sd), erfc((within_px + apart_px) * per_sd)
    return np.asarray(0.5 * (ends[0] + ends[1]))
