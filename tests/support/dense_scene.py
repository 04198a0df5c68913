"""A small simulated town, matched by the poses that took its frames, with true heights to compare with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from small_surveys import small_survey

from geomosaic.camera.interior import Camera
from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.cells import Cells
from geomosaic.surface.consistency_filter import RIM_CELLS, MatchCounts, consistent_heights
from geomosaic.surface.model import DenseSurface
from geomosaic.surface.plane_sweep import SweepView
from geomosaic.surface.pyramid import PyramidLevel, pyramid_levels
from geomosaic.surface.tile_mosaic import mosaic_tiles, with_rim
from geomosaic.surface.tile_sgm import census_image, match_tile
from geomosaic_simulate.flight import fly
from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.standing import heights_on_grid
from geomosaic_simulate.survey import landscape_of, world_of

GSD_M = 0.1
CELL_M = 0.4
_FINE_M = 0.1


@dataclass(frozen=True)
class Scene:
    """Frames of a town from true poses, over a level base."""

    plan: SurveyPlan
    greys: list[NDArray[np.uint8]]
    sighted: list[SweepView]
    base: GroundSurface
    flying_m: float

    def cells(self, side_m: float, east_m: float = 0.0, north_m: float = 0.0) -> Cells:
        """Cells of a square about a place."""
        n = round(side_m / CELL_M)
        return Cells(east_m - side_m / 2.0, north_m - side_m / 2.0, CELL_M, n, n)

    def matched(
        self, cells: Cells, base: GroundSurface | None = None, backwards: bool = False
    ) -> tuple[DenseSurface, MatchCounts, PyramidLevel]:
        """The surface, what its cells count, and the fine level."""
        base = base or self.base
        above = None
        both = pyramid_levels(cells, self.flying_m)
        for level in both:
            by = round(level.pixel_m / GSD_M)
            frames = [SweepView(s.pose, s.camera, by) for s in self.sighted]
            pictures = [
                census_image(grey, None, s.turn_rad, by)
                for grey, s in zip(self.greys, self.sighted, strict=True)
            ]
            tasks = level.tasks(frames, base, above)
            done = {
                t.tile: match_tile(
                    t.search, base, [frames[k] for k in t.frames], [pictures[k] for k in t.frames]
                )
                for t in (tasks[::-1] if backwards else tasks)
            }
            above = level.assembled(base, tasks, [done[t.tile] for t in tasks])
        reach_m = both[-1].lowest_m, both[-1].highest_m
        parts = []
        for tile in done:
            near = with_rim(
                tile, cells, base, [(t, h) for t, h in done.items() if t.touches(tile, RIM_CELLS)]
            )
            parts.append((tile, consistent_heights(near, tile.around(cells, RIM_CELLS), base, reach_m)))
        counted = sum((part.counted for _, part in parts), MatchCounts())
        return mosaic_tiles(cells, base, parts), counted, both[-1]

    def truth(self, surface: DenseSurface) -> tuple[NDArray[np.floating], NDArray[np.uint8]]:
        """Errors (m) of each cell, and what is there: 0 ground, 1 roof, 2 crown, 3 within 1 m of a wall, 4 of
        a crown."""
        world = world_of(self.plan, fly(self.plan))
        land = landscape_of(self.plan)
        east, north = surface.cells.axes_m()
        enu = np.stack(np.broadcast_arrays(east, north[:, None], surface.up_m.astype(float)), axis=-1)
        at = world.map_from_enu(enu)
        west_m, south_m = at[..., 0].min() - 2.0, at[..., 1].min() - 2.0
        east_m, north_m = at[..., 0].max() + 2.0, at[..., 1].max() + 2.0
        shape = int((north_m - south_m) / _FINE_M), int((east_m - west_m) / _FINE_M)
        bounds = west_m - 20.0, south_m - 20.0, east_m + 20.0, north_m + 20.0
        plan = self.plan
        height, kind = heights_on_grid(
            world.relief,
            land.buildings_in(bounds) if plan.buildings_stand else (),
            land.trees_in(bounds) if plan.trees_stand else None,
            *(west_m, north_m, _FINE_M, shape),
        )
        kind = _with_edges(kind)
        row = ((north_m - at[..., 1]) / _FINE_M).astype(int).clip(0, shape[0] - 1)
        col = ((at[..., 0] - west_m) / _FINE_M).astype(int).clip(0, shape[1] - 1)
        return at[..., 2] - height[row, col], kind[row, col]

    def frames_seeing(self, surface: DenseSurface) -> NDArray[np.int_]:
        """How many frames see each cell, where it was found."""
        east, north = surface.cells.axes_m()
        points = np.stack(np.broadcast_arrays(east, north[:, None], surface.up_m), axis=-1)
        found = np.zeros(surface.up_m.shape, dtype=int)
        for s in self.sighted:
            col, row = np.moveaxis(s.pose.image_from_ground(s.camera, points), -1, 0)
            found += (col >= 0) & (col < s.camera.width_px) & (row >= 0) & (row < s.camera.height_px)
        return found


def scene(out: Path, **plan: Any) -> Scene:
    """Simulates it below a folder."""
    import cv2

    asked = {"buildings": 2.0, "buildings_stand": True, "trees_stand": True, "frames_per_line": 5, **plan}
    survey = small_survey(out, **asked)
    usual = {"lines": 2, "width_px": 480, "height_px": 360, "seed": 3, "height_above_ground_m": 50.0}
    full = SurveyPlan(**{**usual, **asked})
    flight = fly(full)
    camera: Camera = full.camera()
    files = sorted(survey.frames.iterdir())
    greys = [cv2.imread(str(f), cv2.IMREAD_GRAYSCALE) for f in files]
    sighted = [SweepView(flight.poses[i], camera, 1.0) for i in range(len(files))]
    world = world_of(full, flight)
    level_m = world.relief.base_m - flight.work_frame.height_ellipsoidal_m
    base = GroundSurface("flat", 0.0, 0.0, 1.0, np.full((1, 1), level_m))
    return Scene(full, greys, sighted, base, 50.0)


def _with_edges(kind: NDArray[np.uint8]) -> NDArray[np.uint8]:
    import cv2

    side = 2 * round(1.0 / _FINE_M) + 1
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    roof, crown = ((kind == k).astype(np.uint8) for k in (1, 2))
    wall = (cv2.dilate(roof, disk) > 0) & (cv2.erode(roof, disk) == 0)
    found = np.where((kind == 0) & (cv2.dilate(crown, disk) > 0), 4, kind)
    return np.asarray(np.where(wall, 3, found), dtype=np.uint8)
