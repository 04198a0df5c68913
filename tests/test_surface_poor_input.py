"""Surveys that show too little for a surface, or more relief than is looked for."""

from __future__ import annotations

import numpy as np
from dense_scene import GSD_M, scene

from geomosaic.projection.ground import GroundSurface
from geomosaic.simulate.flight import fly
from geomosaic.simulate.survey import world_of
from geomosaic.surface.doubts import doubts


def test_no_place_that_three_frames_see_is_told(tmp_path) -> None:
    line = scene(tmp_path, lines=1, frames_per_line=3, forward_overlap=0.45)
    surface, counted, level = line.matched(line.cells(12.0))
    assert line.frames_seeing(surface).max() == 2
    assert surface.views.max() <= 2
    told = dict(doubts(counted, level))
    assert told.keys() & {"surface-two-views", "surface-not-matched"}
    assert np.isfinite(surface.up_m).all()


def test_a_dem_given_as_well_is_where_the_search_starts(tmp_path) -> None:
    """Hills of 45 m below a flight of 50 m, farther down than the search from level ground reaches."""
    hills = scene(tmp_path, relief_m=45.0, relief_wavelength_m=120.0, frames_per_line=3)
    world = world_of(hills.plan, fly(hills.plan))
    axis = np.arange(-90.0, 91.0)
    east, north = np.meshgrid(axis, axis)
    up = np.full(east.shape, hills.base.up_m.item())
    for _ in range(3):
        at = world.map_from_enu(np.stack([east, north, up], axis=-1))
        up += world.relief.height_at(at[..., 0], at[..., 1]) - at[..., 2]
    dem = GroundSurface("dem", -90.0, -90.0, 1.0, up)
    off = {}
    for name, base in (("level", hills.base), ("dem", dem)):
        surface, _, _ = hills.matched(hills.cells(16.0), base)
        errors_m, kind = hills.truth(surface)
        seen = (kind == 0) & (hills.frames_seeing(surface) >= 3)
        off[name] = float(np.mean(np.abs(errors_m[seen]) > 10.0 * GSD_M))
    assert off["dem"] < 0.05 < off["level"]
