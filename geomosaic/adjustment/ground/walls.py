"""Tall houses in a surface of tie points: islands of it that stand on walls.

A surface that climbs houses bends their roofs and the streets between them. Without their points it is the
ground that they stand on, as in an orthophoto on a terrain model: streets are straight, and houses lean.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import (
    binary_dilation,
    binary_erosion,
    binary_opening,
    grey_dilation,
    grey_erosion,
    label,
)
from scipy.spatial import KDTree

from geomosaic.arrays import Bools, Floats
from geomosaic.constants import tuned
from geomosaic.projection.ground import GroundSurface
from geomosaic.survey.model import Warn

_WALL = tuned(
    1.73, "m per m", "60 degrees, a cliff or a wall; less: hillsides count; more: bent walls do not"
)
_WALLS = tuned(0.02, "share of the land", "less: steep banks count; more: a block with few towers stays bent")
_WIDEST = tuned(0.5, "flying heights", "half the width of a house; less: wide ones stay; more: plateaus go")
_RAISED = tuned(
    0.05, "flying heights", "above the land around; less: bumps join houses; more: low wings stay"
)
_ALL_ROUND = tuned(
    0.6, "share of an island's edge", "with walls; less: terraces go; more: houses on slopes stay"
)
_MOST = tuned(0.5, "share of the land", "of houses; more: the plain between cliffs would be the land")
_NEAR = tuned(0.2, "flying heights", "from a tie point; farther, slopes are those of no land")


def points_on_walls(surface: GroundSurface, points_m: Floats, height_m: float) -> tuple[Bools, float]:
    """Which points (p, 3) of a surface through them stand on walls, as those on roofs of tall houses, and the
    share of the land under these.

    An opening by reconstruction (Vincent 1993) shows what rises above the land around and is narrower than a
    flying height. Of that, islands count that walls enclose. No point does where steep land is rare, as
    everywhere without such houses, or where islands take most of the land.

    Args: height_m: of flying.
    """
    none = np.zeros(len(points_m), dtype=bool)
    side_m = surface.spacing_m
    known = KDTree(points_m[:, :2]).query(surface.nodes_m())[0] <= _NEAR * height_m
    steep = known & (np.hypot(*np.gradient(surface.up_m, side_m)) > _WALL)
    if steep.sum() < _WALLS * known.sum():
        return none, 0.0
    reach = np.arange(-(n := int(np.ceil(_WIDEST * height_m / side_m))), n + 1)
    disc = np.hypot(*np.meshgrid(reach, reach)) * side_m <= _WIDEST * height_m
    land_m, around = grey_erosion(surface.up_m, footprint=disc), np.ones((3, 3), dtype=bool)
    for _ in range(2 * len(reach)):
        land_m = np.minimum(grey_dilation(land_m, footprint=around), surface.up_m)
    above_m = land_m + _RAISED * height_m
    raised = binary_opening(known & (surface.up_m > above_m), around)  # specks and strips are no houses
    islands, count = label(raised, around)
    edge = raised & ~binary_erosion(raised, around) & binary_erosion(known, around)
    length, walled = (
        np.bincount(islands[its], minlength=count + 1)
        for its in (edge, edge & binary_dilation(steep, around))
    )
    houses = raised & (walled > _ALL_ROUND * np.maximum(length, 1))[islands]
    share = float(houses[known].mean())
    if share > _MOST:
        return none, 0.0
    at = np.rint((points_m[:, :2] - [surface.east_0_m, surface.north_0_m]) / side_m).astype(np.intp)
    col, row = np.clip(at, 0, np.array(houses.shape[::-1]) - 1).T
    return binary_dilation(houses, around)[row, col] & (points_m[:, 2] > above_m[row, col]), share


def leaning_houses(share: float) -> list[Warn]:
    """A warning where such houses take a share of the land. A single thing on less than walls need to count
    explains no seams."""
    if share < _WALLS:
        return []
    text = (
        f"tall houses stand on {100.0 * share:.0f} % of the land: the map lies on the ground between them, "
        "and they lean away from each frame; fly higher to see less of their walls"
    )
    return [Warn("houses-lean", "", text)]
