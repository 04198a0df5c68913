"""Where a mosaic ends: beyond lies what is seen too aslant, too coarsely, or on ground that is a guess."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum, auto
from typing import Final

import cv2
import numpy as np
import rasterio
import shapely
from rasterio.features import shapes
from scipy.ndimage import distance_transform_edt

from geomosaic.arrays import Bools, Bytes, Floats, Floats32, Ints32
from geomosaic.camera.exterior import Poses
from geomosaic.composition.area import Area, rings_of
from geomosaic.composition.limits import Limits
from geomosaic.composition.model import OutputGrid, Trimmed, TrimmedPart
from geomosaic.composition.ownership import Ownership, cell_px_of, nearest_nadir
from geomosaic.composition.scene import Scene
from geomosaic.composition.views import FrameView
from geomosaic.composition.window import Window
from geomosaic.constants import tuned
from geomosaic.geodesy.local import LocalFrame
from geomosaic.placement.reach import half_extent_m
from geomosaic.projection.footprint import ground_from_image
from geomosaic.projection.ground import GroundSurface
from geomosaic.projection.map_grid import MapGrid
from geomosaic.projection.warp import ground_window

OFF_PX = tuned(3.0, "px", "shift that makes land wrong: less trims roof rims, unsure by 1 or 2")
_MOST_PLACES = tuned(1_000_000, "places", "where angles and deviations are computed: more take time and room")
_WIDE_CELLS = tuned(1000, "cells", "along the seen area, to measure it: fewer are coarse; more take time")
_SLIVER = tuned(1e-3, "of a neighbour's area", "left alone by trimming; less keeps specks")
_ASIDE = tuned(0.5, "of a level frame's reach", "aside in a nadir view: more keeps rims of oblique frames")
_HORIZON_DEG = tuned(85.0, "degrees", "of the horizon, which is no land: more makes any trimmed share 100 %")
HORIZON: Final = Limits(float(np.tan(np.radians(_HORIZON_DEG))), np.inf)


class _Why(IntEnum):
    """Why a cell is trimmed."""

    ASLANT = auto()
    COARSE = auto()
    GUESSED = auto()


REASONS: Final = {
    _Why.ASLANT: "seen too far off the vertical",
    _Why.COARSE: "seen too coarsely",
    _Why.GUESSED: "ground extrapolated too far",
}


@dataclass(frozen=True)
class Edges:
    """Where a mosaic ends: kept, lost: polygons of shapely's on the map; filling: frames that fill cells
    inside which none sees well; trimmed: what was left out, and why."""

    kept: shapely.MultiPolygon
    lost: shapely.MultiPolygon
    filling: frozenset[int]
    trimmed: Trimmed

    def area(self, asked: Area | None) -> Area:
        """What the mosaic is cut to, of an area that was asked for or of all."""
        if asked is None:
            return Area(rings_of(self.kept), asked=False)
        return replace(asked, polygons=rings_of(shapely.difference(asked.geometry, self.lost)))

    def views(self, well: Sequence[FrameView], seeing: Sequence[FrameView]) -> tuple[FrameView, ...]:
        """Of the frames that give pixels, as far as they reach into what is kept. well: of what they see
        well; seeing: of all up to `HORIZON`."""
        low, high = np.split(np.array(self.kept.bounds), 2)
        of = {view.frame: view for view in well}
        for view in seeing:
            if view.frame in self.filling:
                own = of.get(view.frame)
                nothing = np.zeros((2, 2), dtype=np.float32)
                of[view.frame] = replace(view, quality=nothing if own is None else own.quality)
        found = []
        for _, view in sorted(of.items()):
            least, most = np.maximum(view.bounds_m[:2], low), np.minimum(view.bounds_m[2:], high)
            if (most > least).all():
                found.append(replace(view, bounds_m=np.concatenate([least, most])))
        return tuple(found)


@dataclass(frozen=True)
class ViewingGeometry:
    """How a survey's frames look at the ground.

    views: of all they see up to `HORIZON`. limits: of what they see well. known: the ground before a surface
    was matched, the same without one. area: what the mosaic is cut to.
    """

    poses: Poses
    views: tuple[FrameView, ...]
    limits: Limits
    known: GroundSurface
    area: Area | None = None


def mosaic_edges(scene: Scene, looks: ViewingGeometry) -> Edges:
    """What of all that frames see is left out: what no frame sees within the limits, and extrapolated ground.
    There the growth of its deviation moves it by more than `OFF_PX`. It is left out only beyond the land that
    was flown over, and only as far as it reaches the mosaic's outside.

    Of a matched surface and the ground known before it, the surer counts. scene: its views are of what is
    seen well.
    """
    n, cell_px = len(looks.poses), cell_px_of(scene)
    grid, whole = scene.grid, replace(scene, views=looks.views)
    well, seen = (nearest_nadir(of, [True] * n, cell_px)[0] for of in (scene, whole))
    outside = seen.owner == 0
    if looks.area is not None:
        outside |= ~looks.area.cells(grid, whole_of(grid), cell_px)
    shown = (well.owner > 0) & ~outside
    why = np.where(outside | shown, 0, _why(seen, scene, looks)).astype(np.uint8)
    guessed = shown & (_off_px(well, scene, looks) > OFF_PX)
    guessed &= ~_flown_over(scene)
    if not guessed[shown].all():
        why[guessed] = _Why.GUESSED
    inside = ~_outer(why > 0, outside)
    filling = np.unique(seen.owner[inside & (why > 0) & (well.owner == 0)]) - 1
    why[inside] = 0
    narrow = slivers(~outside & (why == 0), why > 0)
    why[narrow] = _nearest_reason(why, narrow)
    kept, cell_m2 = ~outside & (why == 0), (cell_px * grid.gsd_m) ** 2
    about = (cv2.dilate(kept.view(np.uint8), np.ones((5, 5), np.uint8)) > 0) & (why == 0)
    parts = {code: _polygons(grid, cell_px, why == code) for code in REASONS}
    areas = {code: float((why == code).sum()) * cell_m2 for code in REASONS}
    for code, polygons in _beyond(scene, looks).items():
        parts[code] = shapely.union_all([parts[code], polygons])
        areas[code] += float(polygons.area)
    trimmed = Trimmed(
        float(kept.sum()) * cell_m2 + sum(areas.values()),
        tuple(
            TrimmedPart(REASONS[code], area_m2, rings_of(parts[code]))
            for code, area_m2 in areas.items()
            if area_m2 > 0.0
        ),
    )
    lies = grid, cell_px
    return Edges(_polygons(*lies, about), _polygons(*lies, why > 0), frozenset(filling.tolist()), trimmed)


def _nearest_reason(why: Bytes, some: Bools) -> Bytes:
    """Of some cells, the reason of the nearest cell that is left out."""
    if not some.any():
        return why[some]
    rows, cols = distance_transform_edt(why == 0, return_distances=False, return_indices=True)
    return np.asarray(why[rows[some], cols[some]])


def filled(nearest: Ownership, nearest_m: Floats32, scene: Scene, filling: frozenset[int]) -> Ownership:
    """With what no frame sees well given by the nearest of the frames that fill, as is `nearest_m`."""
    views = tuple(replace(view, quality=None) for view in scene.views if view.frame in filling)
    if not views:
        return nearest
    other, other_m = nearest_nadir(replace(scene, views=views), nearest.used.tolist(), nearest.cell_px)
    empty = (nearest.owner == 0) & (other.owner > 0)
    nearest_m[empty] = other_m[empty]
    return replace(nearest, owner=np.where(empty, other.owner, nearest.owner))


def looked_at(
    ownership: Ownership, poses: Poses, work_frame: LocalFrame, ground: GroundSurface, step: int = 1
) -> tuple[Floats, Floats]:
    """The place (h, w, 3) of every step-th cell in the work frame, m, and a tangent (h, w). The tangent is of
    the angle at which its frame looks at it, NaN where none does."""
    grid, owner = ownership.grid, ownership.owner[::step, ::step]
    side_m = step * ownership.cell_px * grid.gsd_m
    cells = MapGrid(grid.crs, grid.west_m, grid.north_m, side_m, owner.shape[1], owner.shape[0])
    at_m = ground_window(cells, work_frame, ground).points_m()
    sight = at_m - poses.positions_m[np.maximum(owner, 1) - 1]
    tangent = np.linalg.norm(sight[..., :2], axis=-1) / np.maximum(-sight[..., 2], 1e-6)
    return at_m, np.where(owner > 0, tangent, np.nan)


def _flown_over(scene: Scene) -> Bools:
    """Cells no farther from below a frame, or from where it looks, than a level frame would reach: seen by
    one frame alone, say, but not extrapolated far. Where a frame looks counts if that is nearly below it.
    The frames need no tie points: positions alone place those without, metres off as the verdict says, and a
    rim cut off makes them no better."""
    circles = []
    for view in scene.views:
        camera, (east, north, up) = view.camera, view.pose.position_m.tolist()
        reach_m = half_extent_m(camera, max(up - float(scene.ground.up_at(east, north)), 0.0))
        middle_px = np.array([[camera.width_px / 2.0, camera.height_px / 2.0]])
        aside_m = ground_from_image(view.pose, camera, scene.ground, middle_px)[0, :2] - [east, north]
        looked_m = view.nadir_m + (aside_m if np.hypot(*aside_m) <= _ASIDE * reach_m else 0.0)
        circles.append(shapely.MultiPoint([view.nadir_m, looked_m]).buffer(reach_m))
    over = Area(rings_of(shapely.union_all(circles)))
    return over.cells(scene.grid, whole_of(scene.grid), cell_px_of(scene))


def _looked_at(of: Ownership, scene: Scene, looks: ViewingGeometry) -> tuple[Floats, Floats, int]:
    """As `looked_at`, of cells as much larger as the third, one of whose owners stands for all."""
    step, (down, across) = int(np.ceil(np.sqrt(of.owner.size / _MOST_PLACES))), of.owner.shape
    whole = np.pad(of.owner, [(0, -down % step), (0, -across % step)])
    blocks = whole.reshape(len(whole) // step, step, -1, step).max(axis=(1, 3))
    larger = replace(of, owner=blocks, cell_px=step * of.cell_px)
    return *looked_at(larger, looks.poses, scene.work_frame, scene.ground), step


def _at_all(values: Floats, step: int, of: Ownership) -> Floats:
    """Values of larger cells at all that they hold."""
    down, across = of.owner.shape
    return values.repeat(step, axis=0).repeat(step, axis=1)[:down, :across]


def _why(seen: Ownership, scene: Scene, looks: ViewingGeometry) -> Bytes:
    """Of cells that frames see badly, why, 0 where none sees anything."""
    _, tangent, step = _looked_at(seen, scene, looks)
    aslant = _at_all(tangent, step, seen) > looks.limits.tangent
    return np.where(seen.owner > 0, np.where(aslant, _Why.ASLANT, _Why.COARSE), 0).astype(np.uint8)


def _off_px(well: Ownership, scene: Scene, looks: ViewingGeometry) -> Floats:
    """By how much the growth of the ground's deviation, one sigma, moves cells, NaN where it isn't known."""
    at_m, tangent, step = _looked_at(well, scene, looks)
    growth_m = np.fmin(_sd_growth_m(scene.ground, at_m), _sd_growth_m(looks.known, at_m))
    return _at_all(growth_m * tangent / looks.limits.own_m, step, well)


def _sd_growth_m(ground: GroundSurface, at_m: Floats) -> Floats:
    """Deviations of heights (h, w) at places (h, w, 3), beyond the least one, common to all places; in m."""
    sd_m = ground.sd_at(at_m[..., 0], at_m[..., 1])
    least_m = 0.0 if ground.sd_m is None else np.nanmin(ground.sd_m, initial=np.inf)
    return np.sqrt(np.maximum(sd_m**2 - least_m**2, 0.0))


def whole_of(grid: OutputGrid) -> Window:
    """All of a grid."""
    return Window(0, 0, grid.width_px, grid.height_px)


def _outer(lost: Bools, unseen: Bools) -> Bools:
    """What is lost as far as it hangs together with the outside."""
    open_ = np.pad(lost | unseen, 1, constant_values=True).view(np.uint8)
    _, part = cv2.connectedComponents(open_, connectivity=4)
    return np.asarray(lost & (part == part[0, 0])[1:-1, 1:-1])


def slivers(kept: Bools, lost: Bools) -> Bools:
    """Kept cells that lost ones part from a piece a thousand times as large."""

    def pieces(cells: Bools) -> Ints32:
        return np.asarray(cv2.connectedComponents(cells.view(np.uint8), connectivity=8)[1])

    piece, together = pieces(kept), pieces(kept | lost)
    size = np.bincount(piece.ravel())
    whole = np.zeros(len(size), dtype=np.intp)
    whole[piece] = together  # each piece lies in one of what is seen
    largest = np.zeros(int(together.max()) + 1, dtype=np.intp)
    np.maximum.at(largest, whole[1:], size[1:])
    small = size < _SLIVER * largest[whole]
    small[0] = False
    return np.asarray(small[piece])


def _beyond(scene: Scene, looks: ViewingGeometry) -> dict[_Why, shapely.Geometry]:
    """What frames see outside the scene's grid, by reason."""
    grid = scene.grid
    inner = shapely.box(grid.west_m, grid.south_m, grid.east_m, grid.north_m)
    bounds = np.array([view.bounds_m for view in looks.views])
    low, high = bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)
    if shapely.contains(inner, shapely.box(*low, *high)):
        return {}
    side_m = float((high - low).max()) / _WIDE_CELLS
    size = np.ceil((high - low) / side_m).astype(int) + 1
    wide = OutputGrid(grid.crs, float(low[0]), float(high[1]), side_m, int(size[0]), int(size[1]))
    whole = replace(scene, grid=wide, views=looks.views)
    why = _why(nearest_nadir(whole, [True] * len(looks.poses), 1)[0], whole, looks)
    found = {
        code: shapely.difference(_polygons(wide, 1, why == code), inner)
        for code in (_Why.ASLANT, _Why.COARSE)
    }
    if looks.area is not None:
        found = {code: shapely.intersection(of, looks.area.geometry) for code, of in found.items()}
    return found


def _polygons(grid: OutputGrid, cell_px: int, cells: Bools) -> shapely.MultiPolygon:
    """Cells on the map, their stairs made lines."""
    side_m = cell_px * grid.gsd_m
    transform = rasterio.Affine(side_m, 0.0, grid.west_m, 0.0, -side_m, grid.north_m)
    found = [
        shapely.geometry.shape(geometry)
        for geometry, _ in shapes(cells.astype(np.uint8), mask=cells, transform=transform)
    ]
    smooth = shapely.simplify(shapely.union_all(found), side_m)
    return shapely.MultiPolygon(
        [p for p in shapely.get_parts(shapely.make_valid(smooth)) if p.geom_type == "Polygon"]
    )
