"""The ground that goes with a solved bundle: a DEM, flat land, or the surface of the tie points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.ground.tie_surface import level_m, tie_surface
from geomosaic.adjustment.model import Block
from geomosaic.adjustment.solver.solution import Solution
from geomosaic.adjustment.terms.image_observations import IMAGE
from geomosaic.constants import NORMAL_PER_MAD, sourced, tuned
from geomosaic.estimation.linear import least_squares
from geomosaic.placement.reach import flying_heights_m, heights_above_ground_m
from geomosaic.projection.footprint import footprint
from geomosaic.projection.ground import GroundSurface
from geomosaic.spread import Spread

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
DEM_SD_M = tuned(
    1.0,
    "m",
    "what a DEM without a stated deviation is good to: national models of 1 to 10 m nodes state less,"
    " those of satellites more",
)
LEAST_POINTS = tuned(
    50,
    "points",
    "fewer make no surface: a dozen nodes of three points each, and some to judge it by",
)
_SEEN_THRICE = tuned(
    0.1,
    "share of the tie points",
    "seen in three frames or more, without which nothing distinguishes relief from tilts",
)
_AS_WELL = tuned(
    1.1,
    "times the image deviation",
    "of the free block, up to which one that is bound to level ground fits as well: with less, level "
    "land would get a surface that follows noise",
)
_NEAR_FLAT = tuned(
    3.0,
    "px",
    "that relief may move the image by where land counts as flat: with more, hills would be pressed flat",
)
_FLAT_PX = tuned(0.5, "ground pixels", "that relief may move points by on flat land: less is not seen")
_LEVEL = sourced(
    11.3,
    "variances of the free block",
    "by which the squares of heights or tilts may grow if it is bound to level ground, three degrees "
    "of freedom: the block's level and its two tilts. Over land that slopes by 3 degrees they grow by"
    " 70 and more, over level land by 1",
    "chi-squared, 3 degrees of freedom, 99 %",
)


def flying_height_m(block: Block) -> float:
    return float(np.median(flying_heights_m(block.poses, block.ground)))


def _view(block: Block) -> float:
    """How far relief moves the middle of a frame's outer half, per metre of height."""
    return max(float(np.hypot(c.width_px, c.height_px)) / 4.0 / c.focal_length_px for c in block.cameras)


def _least_relief_m(block: Block) -> float:
    """Relief that moves a point by _FLAT_PX: less than that is flat."""
    return _FLAT_PX * block.ground_pixel_m / _view(block)


def off_ground_m(block: Block, ground: GroundSurface, bundle: Solution, part: Ints) -> float:
    """How far points lie off the ground: the spread about it of the best determined quarter as solved so
    far, less what their own deviations explain; of flat ground less each part's bend, and at most what is
    flat. part: see `chosen_ground`."""
    flat, least_m = ground.kind == "flat", _least_relief_m(block)
    off = bundle.points_m[:, 2] - ground.up_at(bundle.points_m[:, 0], bundle.points_m[:, 1])
    off = off - _bends(bundle.points_m, off, part) if flat else off
    well = bundle.points_sd_m[:, 2] <= np.quantile(bundle.points_sd_m[:, 2], 0.25)
    spread = NORMAL_PER_MAD * float(np.median(np.abs(off[well] - np.median(off[well]))))
    own = float(np.median(bundle.points_sd_m[well, 2]))
    rough = float(np.sqrt(max(spread**2 - own**2, 0.0)))
    return float(np.clip(rough, 0.1 * least_m, least_m if flat else DEM_SD_M))


def levelled(ground: GroundSurface, bundle: Solution) -> GroundSurface:
    """The ground's own shape at the level of the points: the frames' heights are theirs, also over a DEM
    of another datum."""
    above = bundle.points_m[:, 2] - ground.up_at(bundle.points_m[:, 0], bundle.points_m[:, 1])
    return replace(ground, up_m=ground.up_m + level_m(above, bundle.points_sd_m[:, 2]))


def chosen_ground(
    block: Block, asked: str, bundle: Solution, lengths: Ints, part: Ints
) -> tuple[GroundSurface, float]:
    """A DEM stays; else flat at the points' own level, or their surface where relief shows: by how many
    ground pixels it moves points is the second, NaN where not known. The surface is a rough one.

    Where hardly a point is seen from three frames, frames' tilts and relief can't be distinguished, and flat
    ground is to be tried first, see `lies_flat`.

    Args: asked: see `Settings.ground`; lengths (p,): in how many frames each point is seen; part (p,): the
        number of the connected part of the block that each belongs to: each may lie at its own level.
    """
    if block.ground.kind == "dem":
        return block.ground, float("nan")
    flat, points = levelled(block.ground, bundle), bundle.points_m
    few = len(points) < LEAST_POINTS
    if asked == "flat" or few or (asked == "auto" and np.mean(lengths > 2) < _SEEN_THRICE):
        return flat, float("nan")
    surface = surface_of(block, flat, bundle, rough=True)
    relief = surface.up_at(points[:, 0], points[:, 1]) - flat.up_at(points[:, 0], points[:, 1])
    relief_px = _moves_px(block, relief - _bends(points, relief, part))
    return surface if asked == "tie_surface" or relief_px > _FLAT_PX else flat, relief_px


def _moves_px(block: Block, relief: Floats) -> float:
    """By how many ground pixels relief (p,) in metres moves points, root mean square."""
    return _view(block) * float(np.sqrt(np.mean(np.square(relief)))) / block.ground_pixel_m


def surface_and_relief(block: Block, flat: GroundSurface, bundle: Solution) -> tuple[GroundSurface, float]:
    """The rough surface of the points, and by how many ground pixels its relief moves them, bends and all."""
    surface = surface_of(block, flat, bundle, rough=True)
    up_m = surface.up_at(bundle.points_m[:, 0], bundle.points_m[:, 1])
    return surface, _moves_px(block, up_m - np.median(up_m))


def lies_flat(block: Block, flat: GroundSurface, free: Solution, bound: Solution) -> bool:
    """Whether flat ground explains the images as well as free points do: the image residuals don't grow,
    most points come to lie on it, no bend stays that images could have given up (a block without height
    control may have bent so: drawn to level ground it straightens, but over a land that is bent), and neither
    tilts nor heights leave what POS says of them, as far as it is believed beside free points: land that
    slopes would tilt the whole block."""
    off_m = np.abs(bound.points_m[:, 2] - flat.up_at(bound.points_m[:, 0], bound.points_m[:, 1]))
    return bool(
        bound.components[IMAGE] < _AS_WELL * free.components[IMAGE]
        and np.median(off_m) < _NEAR_FLAT * _least_relief_m(block)
        and all(_grown(free, bound, g, n) < _LEVEL for g, n in (("tilt", 2), ("vertical", 1)))
        and surface_and_relief(block, flat, bound)[1] <= _FLAT_PX
    )


def _grown(free: Solution, bound: Solution, group: str, numbers: int) -> float:
    """By how many variances the squares of a group's misses have grown, of so many numbers a frame."""
    shares = (bound.components[group] / free.components[group]) ** 2 - 1.0
    return shares * numbers * float((~bound.left_out).sum())


def surface_of(
    block: Block,
    flat: GroundSurface,
    bundle: Solution,
    *,
    rough: bool = False,
    spread: Spread | None = None,
) -> GroundSurface:
    """The surface of the points, over all that points and frames cover; flat: about their level; rough,
    spread: see `tie_surface`."""
    outlines = [footprint(bundle.poses[i], c, flat, 2)[:, :2] for i, c in enumerate(block.cameras)]
    at = np.concatenate([bundle.points_m[:, :2], *outlines])
    low_m, high_m = np.nanmin(at, axis=0), np.nanmax(at, axis=0)
    height_m = float(np.median(heights_above_ground_m(bundle.poses, flat)))
    sd_up_m = bundle.points_sd_m[:, 2]
    return tie_surface(bundle.points_m, sd_up_m, low_m, high_m, height_m, rough=rough, spread=spread)


def _bends(points: Floats, relief: Floats, part: Ints) -> Floats:
    """What of the relief each part of a block without height control may have bent in, (p,)."""
    out = np.zeros(len(points))
    for k in np.unique(part):
        out[part == k] = _bend(points[part == k], relief[part == k])
    return out


def _bend(points: Floats, relief: Floats) -> Floats:
    """The paraboloid that is nearest to the relief."""
    extent_m = max(float(np.ptp(points[:, :2], axis=0).max()), 1.0)
    e, n = ((points[:, :2] - points[:, :2].mean(axis=0)) / extent_m).T
    terms = np.column_stack([np.ones_like(e), e, n, e * e, e * n, n * n])
    return np.asarray(terms @ least_squares(terms, relief))
