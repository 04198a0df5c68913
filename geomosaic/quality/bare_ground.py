"""Ground that several frames see and on which none has tie points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geomosaic.adjustment.model import Adjusted
from geomosaic.arrays import Bools, Floats
from geomosaic.constants import FEW, sourced, tuned
from geomosaic.matching.model import TiePoints
from geomosaic.matching.tracks import FEW_CELLS
from geomosaic.projection.footprint import footprint, ground_from_image
from geomosaic.survey.extent import TOO_FAR_M

_SEEN_BY = tuned(2, "frames", "others that see the ground: fewer expect ties at single coverage")
_BARE = sourced(0.05, "share", "without tie points", "ten simulated surveys: land up to 3 %, water 75 %")


@dataclass(frozen=True)
class BareGround:
    """Cells of tied frames, and which have tie points.

    frames: numbers of the frames. seen (k, cells): which of their cells two other tied frames see, too. tied
    (k, cells): which have tie points. corners_m (k, cells, 4, 2): their corners on the ground, east and
    north.
    """

    frames: tuple[int, ...]
    seen: Bools
    tied: Bools
    corners_m: Floats

    @property
    def share(self) -> float:
        """Of the cells that others see too, those without tie points."""
        return float((self.seen & ~self.tied).sum() / max(self.seen.sum(), 1))

    @cached_property
    def parts(self) -> list[Any]:
        """Polygons of ground without tie points, the largest first: where no frame has any."""
        known = (np.abs(self.corners_m) < TOO_FAR_M).all(axis=(2, 3))
        bare = shapely.union_all(_squares(self.corners_m[known & self.seen & ~self.tied]))
        tied = _squares(self.corners_m[known & self.tied])
        adjacent = shapely.union_all(tied[shapely.STRtree(tied).query(bare, "intersects")])
        parts = [p for p in shapely.get_parts(bare.difference(adjacent)) if p.geom_type == "Polygon"]
        return sorted(parts, key=lambda p: -float(p.area))

    @property
    def matters(self) -> bool:
        """Whether it is worth a word."""
        if self.share > _BARE or not self.parts:
            return self.share > _BARE
        cell_m2 = np.nanmedian(shapely.area(_squares(self.corners_m.reshape(-1, 4, 2))))
        return bool(self.parts[0].area > FEW * FEW_CELLS**2 * cell_m2)

    def worst(self) -> list[int]:
        """Frames of which most is bare, worst first."""
        seen = self.seen.sum(axis=1)
        share = (self.seen & ~self.tied).sum(axis=1) / np.maximum(seen, 1)
        least = min(_BARE, share.max(initial=0.0) / 2.0)
        return [self.frames[k] for k in np.argsort(-share, kind="stable") if share[k] > least]


def bare_ground(adjusted: Adjusted, ties: TiePoints) -> BareGround:
    """What tied frames see and have no tie points on."""
    outlines = {
        i: footprint(adjusted.poses[i], adjusted.cameras[i], adjusted.ground, 4)[:, :2]
        for i, status in enumerate(adjusted.status)
        if status == "tied"
    }
    rings = {i: o for i, o in outlines.items() if np.isfinite(o).all()}
    tree = shapely.STRtree([shapely.Polygon(ring) for ring in rings.values()])
    lattice = np.stack(np.meshgrid(*[np.arange(2 * FEW_CELLS + 1) / (2.0 * FEW_CELLS)] * 2), axis=-1)
    seen = np.zeros((len(rings), FEW_CELLS**2), dtype=bool)
    corners_m = np.full((len(rings), FEW_CELLS**2, 4, 2), np.nan)
    for k, i in enumerate(rings):
        camera = adjusted.cameras[i]
        px = lattice * [camera.width_px, camera.height_px]
        at = ground_from_image(adjusted.poses[i], camera, adjusted.ground, px)[..., :2]
        middle = at[1::2, 1::2].reshape(-1, 2)
        cell, _ = tree.query(shapely.points(np.nan_to_num(middle)), predicate="intersects")
        others = np.bincount(cell, minlength=len(middle)) - 1
        seen[k] = np.isfinite(middle).all(axis=1) & (others >= _SEEN_BY)
        corner = at[::2, ::2]
        around = (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1])
        corners_m[k] = np.stack(around, axis=2).reshape(-1, 4, 2)
    return BareGround(tuple(rings), seen, _tied_cells(adjusted, ties)[list(rings)], corners_m)


def _tied_cells(adjusted: Adjusted, ties: TiePoints) -> Bools:
    """Which cells of each frame have tie points, (n, cells)."""
    tied = np.zeros((len(adjusted.status), FEW_CELLS**2), dtype=bool)
    for t in ties.pairs:
        for i, px in ((t.left, t.left_px), (t.right, t.right_px)):
            camera = adjusted.cameras[i]
            share = px / [max(camera.width_px, 1), max(camera.height_px, 1)]
            col, row = np.clip(np.nan_to_num(share) * FEW_CELLS, 0, FEW_CELLS - 1).astype(np.int64).T
            tied[i, row * FEW_CELLS + col] = True
    return tied


def bare_outlines(adjusted: Adjusted, ties: TiePoints) -> list[Floats]:
    """Outlines (k, 2), east and north, of ground without tie points, the largest first; none where it isn't
    worth a word."""
    bare = bare_ground(adjusted, ties)
    return [np.asarray(p.exterior.coords) for p in bare.parts] if bare.matters else []


def _squares(corners_m: Floats) -> NDArray[np.object_]:
    return np.asarray(shapely.convex_hull(shapely.polygons(corners_m)))
