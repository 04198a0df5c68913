"""How far the ground's own deviations may move what a mosaic shows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfc

from geomosaic.camera.exterior import Poses
from geomosaic.constants import tuned
from geomosaic.geodesy.local import LocalFrame
from geomosaic.mosaic.ownership import Ownership
from geomosaic.mosaic.trim import OFF_PX, looked_at, whole_of
from geomosaic.projection.ground import WALLED, GroundSurface
from geomosaic.surface.terrain import TERRAIN

Floats = NDArray[np.float64]
MATCHED: Final = (WALLED, TERRAIN)
"""Kinds of ground that were matched between the frames."""
SHARE = tuned(0.99, "share", "of land within it: less passes a bad strip; more lets a corner decide")
_MOST_PLACES = tuned(100_000, "places", "tested evenly, a thousand in the tail: more take time and memory")
_WITHIN_PX = tuned(1e6, "px", "end of the search for a displacement: less hides figures that matter")


@dataclass(frozen=True)
class LandDoubt:
    """ground_px: what 99 % of the mosaic's land keeps below, since the ground may be higher or lower; NaN
    where its deviations aren't known, or no frame gives anything. surface_share: of the land, what has to be
    expected off by more than is asked, since what was matched is unsure; NaN without a matched surface.
    ground_share: of the land, what has to be expected off by more since the ground is unknown."""

    ground_px: float
    surface_share: float
    ground_share: float


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

    Where a matched surface lies on the ground known before, the surer of both says how far it may be off: its
    own deviation, or how far it lies from the other, whose deviation is added. Elsewhere something stands on
    the ground (or none knows it), of which the surface is surely as far off as it may be: rims of roofs and
    woods say nothing against the ground around, and what they leave open is the surface's share. Or nothing
    stands there, and the surface has strayed by all that lies between, as likely as its deviation reaches so
    far.
    """
    ground, known = land.ground, land.known
    at_m, tangent = places_of(land.ownership, land.poses, land.work_frame, ground)
    px_per_m = tangent / land.ownership.grid.gsd_m
    known_px = px_per_m * known.sd_at(at_m[:, 0], at_m[:, 1])
    if ground.kind not in MATCHED:
        some = known_px > 0.0
        return _doubt(lambda px: _beyond(px, known_px[some]), some, within_px, np.nan)
    matched_px = px_per_m * ground.sd_at(at_m[:, 0], at_m[:, 1])
    apart_m = ground.up_at(at_m[:, 0], at_m[:, 1]) - known.up_at(at_m[:, 0], at_m[:, 1])
    apart_px = px_per_m * np.abs(apart_m)
    off = _beyond(within_px, matched_px[np.isfinite(matched_px)])
    some = (matched_px > 0.0) & (known_px > 0.0)
    matched_px, known_px, apart_px = matched_px[some], known_px[some], apart_px[some]
    strayed = _beyond(apart_px, matched_px)

    def beyond(px: float) -> Floats:
        matched, strays = _beyond(px, matched_px), _beyond(px, known_px, apart_px)
        stands = strayed * strays + (1.0 - strayed) * np.minimum(matched, _beyond(px, known_px))
        return np.where(apart_px <= OFF_PX, np.minimum(matched, strays), stands)

    return _doubt(beyond, some, within_px, float(off.mean()) if off.size else np.nan)


def places_of(
    ownership: Ownership, poses: Poses, work_frame: LocalFrame, ground: GroundSurface
) -> tuple[Floats, Floats]:
    """Places (k, 3) of the work frame, m, all over what frames give, and the tangents (k,) of the angles at
    which their frames look at them: a place moves by its height's error times that."""
    step = int(np.ceil(np.sqrt(ownership.owner.size / _MOST_PLACES)))
    at_m, tangent = looked_at(ownership, poses, work_frame, ground, step)
    given = np.isfinite(tangent)
    if ownership.area is not None:
        grid = ownership.grid
        given &= ownership.area.cells(grid, whole_of(grid), ownership.cell_px)[::step, ::step]
    return at_m[given], tangent[given]


def _doubt(
    beyond: Callable[[float], Floats], some: NDArray[np.bool_], within_px: float, surface_share: float
) -> LandDoubt:
    """beyond: see `_kept_by_99`."""
    share = float(beyond(within_px).mean()) if some.any() else float("nan")
    return LandDoubt(_kept_by_99(beyond, some), surface_share, share)


def _kept_by_99(beyond: Callable[[float], Floats], some: NDArray[np.bool_]) -> float:
    """The displacement that all but a hundredth of places keep below; beyond: how likely each of some lies
    farther off than a displacement."""
    from scipy.optimize import brentq

    if not some.any():
        return float("nan")

    def too_many(within_px: float) -> float:
        return float(beyond(within_px).mean()) - (1.0 - SHARE)

    return float(brentq(too_many, 0.0, _WITHIN_PX)) if too_many(_WITHIN_PX) < 0.0 else _WITHIN_PX


def _beyond(within_px: float | Floats, sd_px: Floats, apart_px: float | Floats = 0.0) -> Floats:
    """How likely each place lies farther off, if it is expected to lie apart_px off by sd_px."""
    per_sd = np.sqrt(0.5) / np.maximum(sd_px, 1e-9)
    ends = erfc((within_px - apart_px) * per_sd), erfc((within_px + apart_px) * per_sd)
    return np.asarray(0.5 * (ends[0] + ends[1]))
