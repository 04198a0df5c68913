"""What is kept where two frames alone see it, and the heights of cells in which nothing was matched."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.cells import Cells, Tile
from geomosaic.surface.consistency_filter import RIM_CELLS, FilteredTile, MatchCounts, consistent_heights
from geomosaic.surface.tile_mosaic import mosaic_tiles
from geomosaic.surface.tile_sgm import TileHeights
from geomosaic.surface.void_fill import void_heights

FLAT = GroundSurface("flat", 0.0, 0.0, 1.0, np.zeros((1, 1)))
CELL_M = 0.4
ROOF_M = 10.0


def filled(over_m: NDArray[np.float32], filled_cells: NDArray[np.bool_]) -> NDArray[np.float32]:
    """A surface's heights over a level base, of a part that holds some cells."""
    cells = Cells(0.0, 0.0, CELL_M, *over_m.shape)
    sd_m = np.where(filled_cells, np.float32(np.nan), np.float32(0.1))
    part = FilteredTile(
        np.where(filled_cells, np.float32(0.0), over_m), sd_m, (~filled_cells).astype(np.uint8), MatchCounts()
    )
    return mosaic_tiles(cells, FLAT, [(Tile(0, 0, *over_m.shape), part)]).up_m


def house(rows: int = 60, cols: int = 80) -> NDArray[np.float32]:
    """A roof over the western 30 columns but for a yard of 15 rows."""
    over_m = np.zeros((rows, cols), dtype=np.float32)
    over_m[15:, :30] = ROOF_M
    return over_m


def test_what_a_wall_hides_lies_at_its_foot() -> None:
    """A mean of what lies around was a ramp: 9, 5, 3, 2 m, on which the ortho drew the roof on."""
    over_m = house()
    hidden = np.zeros(over_m.shape, dtype=bool)
    hidden[15:, 30:40] = True
    assert np.abs(filled(over_m, hidden)[hidden]).max() < 0.1


def test_a_hole_in_a_roof_is_the_roofs() -> None:
    over_m = house()
    hole = np.zeros(over_m.shape, dtype=bool)
    hole[30:40, 10:20] = True
    assert np.allclose(filled(over_m, hole)[hole], ROOF_M)


def test_one_wrong_low_cell_drags_nothing_down() -> None:
    over_m = house()
    hole = np.zeros(over_m.shape, dtype=bool)
    hole[30:40, 10:20] = True
    over_m[35, 9] = -20.0
    assert np.allclose(filled(over_m, hole)[hole], ROOF_M)


def test_far_from_anything_the_base_stays() -> None:
    over_m = house(60, 400)
    filled_cells = np.zeros(over_m.shape, dtype=bool)
    filled_cells[:, 30:] = True
    up_m = filled(over_m, filled_cells)
    assert np.abs(up_m[:, -100:]).max() < 0.1 * ROOF_M
    assert np.isfinite(up_m).all()


def test_a_roof_at_the_rim_is_not_carried_on() -> None:
    """Its height stood 13 m beyond the last roof that two frames see: 99 % of open ground rose from 15 to 23 px."""
    over_m = house()
    filled_cells = np.zeros(over_m.shape, dtype=bool)
    filled_cells[:, 30:] = True
    up_m = filled(over_m, filled_cells)
    assert up_m[30:50, 40:].max() < 0.5 * ROOF_M
    assert up_m[30:50, 60:].max() < 0.2 * ROOF_M


def test_filled_heights_do_not_depend_on_where_squares_meet() -> None:
    rng = np.random.default_rng(1)
    over_m = rng.normal(0.0, 3.0, (520, 540)).astype(np.float32)
    known = rng.uniform(size=over_m.shape) < 0.4
    whole, enclosed = void_heights(over_m, known)
    there = enclosed & ~known
    assert there[~known].mean() > 0.9
    assert np.array_equal(filled(over_m, ~known)[there], whole[there])


def kept(alike: NDArray[np.float32], up_m: NDArray[np.float32], frames: int = 2) -> NDArray[np.bool_]:
    """Which cells stay where two frames see them, or more."""
    nothing = np.zeros(up_m.shape, dtype=np.float32)
    seeing = np.full(up_m.shape, frames, dtype=np.uint8)
    heights = TileHeights(up_m, alike, np.where(alike > 0.6, seeing, 0).astype(np.uint8), seeing, nothing)
    cells = Cells(0.0, 0.0, CELL_M, *up_m.shape)
    return np.isfinite(
        np.pad(consistent_heights(heights, cells, FLAT, (-5.0, 30.0)).sd_m, RIM_CELLS, constant_values=np.nan)
    )


def test_the_corner_of_a_roof_that_two_frames_see_is_kept() -> None:
    """Half of all cells around had to be sure, of whatever height: corners have a quarter, and were cut off."""
    up_m = house()
    alike = np.where(up_m > 0.0, np.float32(0.9), np.float32(-0.2))
    alike[15, :30] = alike[15:, 29] = 0.4
    found = kept(alike, up_m)
    roof = np.zeros(up_m.shape, dtype=bool)
    roof[17 : 60 - RIM_CELLS, RIM_CELLS:28] = True
    assert found[roof].all()
    assert found[16, 26] and found[15, 24] and found[20, 29]
    assert not found[:, 30:].any()


def test_cells_of_two_frames_that_nothing_of_their_height_stands_by_are_filled() -> None:
    up_m, alike = house(), np.full((60, 80), 0.9, dtype=np.float32)
    up_m[30:33, 50:53] = 20.0
    found = kept(alike, up_m)
    assert not found[30:33, 50:53].any()
    assert found[30:33, 56:60].all()


def test_islands_that_two_frames_agree_on_are_filled() -> None:
    """On water, and in woods that wind moves."""
    up_m = np.full((60, 80), 2.0, dtype=np.float32)
    alike = np.full((60, 80), 0.3, dtype=np.float32)
    alike[30:36, 40:46] = 0.9
    assert not kept(alike, up_m).any()


def test_what_few_cells_are_known_of_has_no_lower_side() -> None:
    """A mean stays, where cells were matched by chance: eight directions drew stars over the sea."""
    rng = np.random.default_rng(4)
    over_m = rng.normal(0.0, 5.0, (90, 90)).astype(np.float32)
    known = rng.uniform(size=over_m.shape) < 0.05
    assert np.abs(filled(over_m, ~known)[~known]).mean() < 3.0


def test_crowns_that_few_cells_are_sure_of_are_kept() -> None:
    up_m = np.abs(np.arange(80) - 40.0)[None] * np.full((60, 1), -0.6) + 9.0
    alike = np.full(up_m.shape, 0.2, dtype=np.float32)
    alike.ravel()[::6] = 0.9
    found = kept(alike, up_m.astype(np.float32), frames=3)[RIM_CELLS:-RIM_CELLS, RIM_CELLS:-RIM_CELLS]
    assert found.mean() > 0.9
