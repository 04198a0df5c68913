"""The ground of an adjusted block: a DEM, a level plane, or the surface of the tie points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomosaic.adjustment.ground.tie_surface import tie_surface
from geomosaic.adjustment.ground.trial_surface import Heights
from geomosaic.adjustment.ground.walls import points_on_walls
from geomosaic.adjustment.model import Block
from geomosaic.adjustment.solver.solution import Solution
from geomosaic.adjustment.terms.image_observations import IMAGE
from geomosaic.arrays import Floats, Ints
from geomosaic.constants import NORMAL_PER_MAD, sourced, tuned
from geomosaic.estimation.linear import least_squares, paraboloid_design
from geomosaic.estimation.robust import irls
from geomosaic.placement.reach import flying_heights_m, heights_above_ground_m
from geomosaic.projection.footprint import FEW, footprint
from geomosaic.projection.ground import GroundSurface
from geomosaic.spread import Spread

DEM_SD_M = tuned(1.0, "m", "of a DEM that states no deviation; national models are better, satellites' worse")
LEAST_POINTS = tuned(50, "points", "fewer make no surface and judge no lens: a dozen nodes, some to judge by")
_AS_WELL = tuned(1.1, "of the free image deviation", "less: level land gets a surface that follows noise")
_FLAT_PX = tuned(0.5, "ground pixels", "offset by the relief of flat land; less does not show")
_FARTHEST = sourced(5.0, "flying heights", "a pixel there is 26 times as long as at the nadir", "1 + tan²")
_LEVEL = sourced(11.3, "variances", "growth of heights or tilts over level land", "chi-squared, 3 dof, 99 %")


def flying_height_m(block: Block) -> float:
    """The median flying height."""
    return float(np.median(flying_heights_m(block.poses, block.ground)))


def _offset_per_height(block: Block) -> float:
    """Relief displacement halfway from a frame's middle to its corner, per metre of height."""
    return max(float(np.hypot(c.width_px, c.height_px)) / 4.0 / c.focal_length_px for c in block.cameras)


def off_ground_m(block: Block, ground: GroundSurface, bundle: Solution, part: Ints) -> float:
    """Deviation in m of the points from the ground: the robust spread of the best determined quarter, without
    their own deviations. Over flat ground, each part's bend is removed first, and the result is at most the
    relief of flat land. Args: part (p,): see `chosen_ground`."""
    flat, least_m = ground.kind == "flat", _FLAT_PX * block.ground_pixel_m / _offset_per_height(block)
    off = _above(ground, bundle)
    off = off - _bends(bundle.points_m, off, part) if flat else off
    well = bundle.points_sd_m[:, 2] <= np.quantile(bundle.points_sd_m[:, 2], 0.25)
    spread = NORMAL_PER_MAD * float(np.median(np.abs(off[well] - np.median(off[well]))))
    own = float(np.median(bundle.points_sd_m[well, 2]))
    rough = float(np.sqrt(max(spread**2 - own**2, 0.0)))
    return float(np.clip(rough, 0.1 * least_m, least_m if flat else np.inf))


def _above(ground: GroundSurface, bundle: Solution) -> Floats:
    """Heights of the points above the ground, (p,)."""
    return np.asarray(bundle.points_m[:, 2] - ground.up_at(bundle.points_m[:, 0], bundle.points_m[:, 1]))


def levelled(ground: GroundSurface, bundle: Solution) -> GroundSurface:
    """The ground shifted up to the robust level of the points, also of a DEM with another datum."""
    above, sd_m = _above(ground, bundle), bundle.points_sd_m[:, 2]

    def weigh(left: Floats) -> Floats:
        scale = np.maximum(1.5 * float(np.median(np.abs(left))), sd_m)
        return np.asarray(1.0 / (1.0 + (left / scale) ** 2) / sd_m**2)

    level_m, _ = irls(np.ones((len(above), 1)), above, weigh, rounds=20)
    return replace(ground, up_m=ground.up_m + level_m[0])


def chosen_ground(
    block: Block, setting: str, bundle: Solution, lengths: Ints, part: Ints
) -> tuple[GroundSurface, float]:
    """The DEM; else level ground, or the rough surface of the points where relief shows; and the root mean
    square offset by relief in ground pixels, NaN where unknown. With few points in three frames, tilts and
    relief are not separable: level ground comes first, see `lies_flat`. Args: setting: see `Settings.ground`;
    lengths (p,): frames of each point; part (p,): its connected part of the block, with a level of its
    own."""
    if block.ground.kind == "dem":
        return block.ground, float("nan")
    flat, points = levelled(block.ground, bundle), bundle.points_m
    few = len(points) < LEAST_POINTS
    if setting == "flat" or few or (setting == "auto" and np.mean(lengths > 2) < FEW):
        return flat, float("nan")
    surface = rough_surface(block, flat, bundle)
    relief = surface.up_at(points[:, 0], points[:, 1]) - flat.up_at(points[:, 0], points[:, 1])
    relief_px = _offset_px(block, relief - _bends(points, relief, part))
    return surface if setting == "tie_surface" or relief_px > _FLAT_PX else flat, relief_px


def _offset_px(block: Block, relief: Floats) -> float:
    """Root mean square offset of points by relief (p,) in m, in ground pixels."""
    return _offset_per_height(block) * float(np.sqrt(np.mean(np.square(relief)))) / block.ground_pixel_m


def surface_and_relief(block: Block, flat: GroundSurface, bundle: Solution) -> tuple[GroundSurface, float]:
    """The rough surface of the points, and the offset by its relief in ground pixels, bends included."""
    surface = rough_surface(block, flat, bundle)
    up_m = surface.up_at(bundle.points_m[:, 0], bundle.points_m[:, 1])
    return surface, _offset_px(block, up_m - np.median(up_m))


def lies_flat(block: Block, flat: GroundSurface, free: Solution, bound: Solution) -> bool:
    """Whether level ground explains the images as well as free points: image residuals, tilts and heights do
    not grow, and no relief remains. Sloping land would tilt the whole block."""

    def growth(group: str, numbers: int) -> float:
        """Of a group's squared residuals in variances; numbers: of them a frame."""
        shares = (bound.components[group] / free.components[group]) ** 2 - 1.0
        return shares * numbers * float((~bound.left_out).sum())

    return bool(
        bound.components[IMAGE] < _AS_WELL * free.components[IMAGE]
        and growth("tilt", 2) < _LEVEL
        and growth("vertical", 1) < _LEVEL
        and surface_and_relief(block, flat, bound)[1] <= _FLAT_PX
    )


def rough_surface(block: Block, flat: GroundSurface, bundle: Solution) -> GroundSurface:
    """The surface of the points, see `tie_surface`. flat: their level."""
    return tie_surface(_heights(block, flat, bundle), rough=True)


def surface_of(
    block: Block, flat: GroundSurface, bundle: Solution, spread: Spread | None = None
) -> tuple[GroundSurface, float]:
    """The surface of the points on the ground, and the share of the land under tall houses, whose points it
    lacks (`points_on_walls`). flat: the level of all points; spread: see `tie_surface`."""
    heights = _heights(block, flat, bundle)
    surface = tie_surface(heights, spread=spread)
    on_walls, share = points_on_walls(surface, heights.points_m, heights.height_m)
    if on_walls.any():
        surface = tie_surface(heights.without(on_walls), spread=spread)
    return surface, share


def _heights(block: Block, flat: GroundSurface, bundle: Solution) -> Heights:
    """All points, and a grid over them and all frames, as far as `_FARTHEST` around the frames."""
    outlines = [footprint(bundle.poses[i], c, flat, 2)[:, :2] for i, c in enumerate(block.cameras)]
    at = np.concatenate([bundle.points_m[:, :2], *outlines])
    low_m, high_m = np.nanmin(at, axis=0), np.nanmax(at, axis=0)
    height_m = float(np.median(heights_above_ground_m(bundle.poses, flat)))
    heights = Heights(bundle.points_m, bundle.points_sd_m[:, 2], low_m, high_m, height_m)
    return _around(heights, bundle.poses.positions_m[:, :2])


def _around(heights: Heights, nadirs_m: Floats) -> Heights:
    """The points in a rectangle that goes `_FARTHEST` beyond nadir points (n, 2), and that as the grid: a
    view of the horizon would make the nodes coarse everywhere. All, where few points would be left."""
    reach_m = _FARTHEST * heights.height_m
    low_m = np.maximum(heights.low_m, nadirs_m.min(axis=0) - reach_m)
    high_m = np.minimum(heights.high_m, nadirs_m.max(axis=0) + reach_m)
    at = heights.points_m[:, :2]
    far = np.any((at < low_m) | (at > high_m), axis=1)
    if np.count_nonzero(~far) < LEAST_POINTS:
        return heights
    return replace(heights.without(far), low_m=low_m, high_m=high_m)


def _bends(points: Floats, relief: Floats, part: Ints) -> Floats:
    """The nearest paraboloid to the relief in each part (p,): a block without height control may bend so."""
    out = np.zeros(len(points))
    for k in np.unique(part):
        mine = part == k
        design = paraboloid_design(points[mine, :2])
        out[mine] = design @ least_squares(design, relief[mine])
    return out
