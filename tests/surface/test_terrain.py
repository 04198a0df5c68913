"""The ground model: what stands on the land goes, the land stays."""

from __future__ import annotations

import time
import tracemalloc

import cv2
import numpy as np
import pytest

from geomosaic.pipeline.stage import Context
from geomosaic.stages.surface_terrain import surface_terrain
from geomosaic.surface.cells import Cells
from geomosaic.surface.dtm import TERRAIN, filled, terrain_model
from geomosaic.surface.model import DenseSurface
from geomosaic_simulate.landscape import Landscape
from geomosaic_simulate.relief import Relief
from geomosaic_simulate.standing import CROWN, GROUND, ROOF, heights_on_grid

CELL_M = 0.5
SIDE = 440
MIDDLE_M = 671_300.0, 5_330_000.0


def surface_of(up_m: np.ndarray, cell_m: float = CELL_M, sd_m: float = 0.1) -> DenseSurface:
    sd = np.full(up_m.shape, sd_m, dtype=np.float32)
    views = np.full(up_m.shape, 4, dtype=np.uint8)
    return DenseSurface(Cells(-20.0, 30.0, cell_m, *up_m.shape), up_m.astype(np.float32), sd, views)


def town(seed: int, relief_m: float) -> tuple[DenseSurface, np.ndarray, np.ndarray]:
    """A town as matching shows it (edges smeared, noise, blunders), the land below, and what is seen."""
    west, north = MIDDLE_M[0] - SIDE * CELL_M / 2.0, MIDDLE_M[1] + SIDE * CELL_M / 2.0
    bounds = west - 20.0, north - SIDE * CELL_M - 20.0, west + SIDE * CELL_M + 20.0, north + 20.0
    land, relief = Landscape(seed, 2.0), Relief(seed, 520.0, 1.6 * relief_m)
    place = west, north, CELL_M, (SIDE, SIDE)
    true, _ = heights_on_grid(relief, (), None, *place)
    tops, kind = heights_on_grid(relief, land.buildings_in(bounds), land.trees_in(bounds), *place)
    rng = np.random.default_rng(seed)
    seen = cv2.medianBlur(cv2.GaussianBlur(tops, (0, 0), 0.8), 5)
    noise = cv2.GaussianBlur(rng.standard_normal(seen.shape).astype(np.float32), (0, 0), 1.0)
    seen += noise * np.float32(0.12 / noise.std())
    blunders = rng.random(seen.shape) < 5e-4
    seen[blunders] += rng.normal(0.0, 2.0, blunders.sum())
    return surface_of(seen[::-1], sd_m=0.12), true[::-1], kind[::-1]


@pytest.fixture(scope="module", params=[(5, 10.0), (6, 25.0), (7, 10.0)], ids=str)
def found(request):
    surface, true, kind = town(*request.param)
    return terrain_model(surface), true, kind


def test_nearly_all_the_land_is_found_within_three_decimetres(found):
    model, true, kind = found
    near = np.abs(model.up_m - true) <= 0.3
    assert [near[kind == k].mean() > least for k, least in ((GROUND, 0.98), (ROOF, 0.95), (CROWN, 0.92))] == [
        True
    ] * 3
    assert abs(np.median((model.up_m - true)[kind != GROUND])) < 0.1


def test_what_stands_is_not_said_to_be_seen_ground(found):
    model, _, kind = found
    assert model.seen[kind == ROOF].mean() < 0.001
    assert model.seen[kind == CROWN].mean() < 0.001
    assert model.seen[kind == GROUND].mean() > 0.85


def test_deviations_hold_under_what_stands_as_well(found):
    model, true, _ = found
    off = np.abs(model.up_m - true)[~model.seen]
    assert np.isfinite(model.sd_m).all()
    assert 0.6 < np.mean(off <= model.sd_m[~model.seen]) < 0.97
    assert np.mean(off <= 3.0 * model.sd_m[~model.seen]) > 0.97


@pytest.mark.parametrize(("height_m", "wavelength_m"), [(10.0, 300.0), (25.0, 300.0), (20.0, 120.0)])
def test_hills_stay(height_m, wavelength_m):
    east, north = np.meshgrid(np.arange(SIDE) * CELL_M, np.arange(SIDE) * CELL_M)
    turns = 2.0 * np.pi / wavelength_m
    hills = height_m / 4.0 * (np.sin(turns * east + 0.4) + np.sin(turns * north))
    model = terrain_model(surface_of(hills))
    assert np.abs(model.up_m - hills).max() < 0.1
    assert model.seen.mean() > 0.99


@pytest.mark.parametrize("across", [0.0, 1.0])
@pytest.mark.parametrize(
    ("side_m", "slope"),
    [(15.0, 1.0), (15.0, 1.5), (20.0, 0.6), (20.0, 1.5), (40.0, 0.45), (60.0, 0.6), (60.0, 1.5)],
)
def test_even_land_stays_up_to_the_border_however_steep(side_m: float, slope: float, across: float):
    east = slope * CELL_M * np.arange(round(side_m / CELL_M))
    land = 300.0 + np.add.outer(across * east, east)
    model = terrain_model(surface_of(land))
    assert np.abs(model.up_m - land).max() < 0.1
    assert model.seen.mean() > 0.99


@pytest.mark.parametrize("slope", [0.6, 1.0])
def test_valleys_and_hillsides_stay_up_to_the_border(slope: float):
    """A valley rises to two borders, a hillside from a plain to one."""
    east = CELL_M * np.arange(300)
    for profile in (np.abs(east - 75.0), np.maximum(east - 100.0, 0.0)):
        land = np.add.outer(np.zeros(300), slope * profile)
        model = terrain_model(surface_of(land))
        assert np.abs(model.up_m - land).max() < 0.2
        assert model.seen.mean() > 0.98


def test_what_stands_at_the_border_of_a_steep_slope_goes():
    land = np.add.outer(0.5 * CELL_M * np.arange(200), 0.6 * CELL_M * np.arange(200))
    up = land.copy()
    for at in (np.s_[90:110, 180:], np.s_[:16, 60:90], np.s_[-20:, :24]):
        up[at] = land[at].mean() + 9.0
    standing = up != land
    model = terrain_model(surface_of(up))
    assert not model.seen[standing].any()
    assert model.seen[~standing].mean() > 0.97
    assert np.abs(model.up_m - land)[~standing].max() < 1.5
    assert np.median(np.abs(model.up_m - land)[standing]) < 1.5


def rough(side: int) -> DenseSurface:
    """Heights 300 m above the work frame's origin that leap by metres from cell to cell."""
    return surface_of(np.random.default_rng(1).normal(300.0, 5.0, (side, side)))


def test_where_no_cell_is_ground_the_surface_keeps_its_heights():
    surface = rough(40)
    model = terrain_model(surface)
    np.testing.assert_array_equal(model.up_m, surface.up_m)
    assert not model.seen.any() and np.isnan(model.sd_m).all()


def test_the_stage_warns_where_no_cell_is_ground(tmp_path):
    context = Context(tmp_path, stage_id="surface.terrain")
    surface_terrain().run({"surface": rough(40)}, surface_terrain.Params(), context)
    [warning] = context.notes.warnings
    assert warning["code"] == "terrain-not-found"
    assert "may contain houses and trees" in warning["text"]


@pytest.mark.parametrize("cell_m", [0.5, 0.02])
def test_a_rim_of_a_metre_about_what_stands_is_not_seen_ground(cell_m: float):
    side = round(5.0 / cell_m)
    up = np.zeros((side, side), dtype=np.float32)
    middle = side // 2
    up[middle - 2 : middle + 3, middle - 2 : middle + 3] = 6.0
    seen = terrain_model(surface_of(up, cell_m, sd_m=0.01)).seen
    rows, cols = np.indices(up.shape)
    away = np.hypot(*(np.maximum(np.abs(of - middle) - 2, 0) for of in (rows, cols))) * cell_m
    assert not seen[away <= 0.97].any()
    assert seen[away > 1.03].all()


def test_fine_cells_take_no_longer_than_coarse_ones():
    """The rim of a metre about what stands is 250 cells of 4 mm wide, and 4 cells of 0.25 m."""
    up = np.zeros((800, 800), dtype=np.float32)
    up[300:500, 300:500] = 4.0
    took_s = []
    for cell_m in (0.25, 0.004):
        surface = surface_of(up, cell_m, sd_m=0.01)
        start_s = time.process_time()
        terrain_model(surface)
        took_s.append(time.process_time() - start_s)
    assert took_s[1] < 4.0 * took_s[0]


def test_a_hall_goes_if_it_is_no_wider_than_was_said():
    up = np.zeros((240, 240), dtype=np.float32)
    up[80:160, 80:170] = 9.0
    assert np.abs(terrain_model(surface_of(up)).up_m).max() < 0.3
    assert terrain_model(surface_of(up), widest_m=20.0).up_m[120, 120] > 8.0


def test_cells_that_no_frame_showed_are_not_seen_ground():
    surface = surface_of(np.zeros((60, 50)))
    surface.views[:, :20] = 0
    model = terrain_model(surface)
    assert not model.seen[:, :20].any() and model.seen[:, 20:].all()
    assert np.abs(model.up_m).max() == 0.0


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (2, 2), (5, 3)])
def test_small_surfaces_and_unknown_deviations_pass(shape):
    surface = surface_of(np.full(shape, 3.0), cell_m=4.0)
    surface.sd_m[:] = np.nan
    surface.views[:] = 0
    model = terrain_model(surface)
    np.testing.assert_array_equal(model.up_m, np.full(shape, 3.0, dtype=np.float32))
    assert np.isnan(model.sd_m).all() and not model.seen.any()


def test_coarse_cells_keep_their_noise_and_lose_their_houses():
    rng = np.random.default_rng(4)
    up = 0.02 * np.arange(150.0) + rng.normal(0.0, 0.4, (150, 150))
    land = up.copy()
    up[60:66, 70:76] += 12.0
    model = terrain_model(surface_of(up, cell_m=2.0, sd_m=0.4))
    assert np.abs(model.up_m - land)[60:66, 70:76].max() < 2.0
    assert model.seen.mean() > 0.95


@pytest.mark.parametrize("sd_m", [0.05, 3.0])
def test_houses_go_whatever_the_stated_deviation(sd_m: float):
    """Stated deviations include what all heights have in common; the noise is that of neighbours."""
    rng = np.random.default_rng(4)
    land = 0.1 * np.add.outer(np.arange(120.0), np.arange(150.0)) + rng.normal(0.0, 0.05, (120, 150))
    up = land.copy()
    up[40:60, 50:80] += 8.0
    model = terrain_model(surface_of(up, cell_m=1.0, sd_m=sd_m))
    assert np.abs(model.up_m - land).max() < 0.5
    assert model.seen.mean() > 0.9


def test_a_gap_is_filled_evenly_from_its_border():
    slope = np.add.outer(0.3 * np.arange(64.0), 0.1 * np.arange(50.0)).astype(np.float32)
    known = np.ones(slope.shape, dtype=bool)
    known[20:40, 15:33] = False
    np.testing.assert_allclose(filled(np.where(known, slope, -99.0), known), slope, atol=0.15)


def test_as_ground_it_lies_on_the_middles_of_its_cells():
    surface = surface_of(np.add.outer(np.arange(40.0), np.zeros(40)) * 0.01)
    ground = terrain_model(surface).ground()
    assert ground.kind == TERRAIN
    east, north = surface.cells.axes_m()
    assert ground.up_at(east[7], north[20]) == pytest.approx(0.2, abs=1e-6)
    assert ground.sd_at(east[7], north[20]) == pytest.approx(0.1, abs=1e-6)


def test_the_stage_takes_the_surface_and_says_how_much_is_ground(tmp_path):
    up = np.zeros((100, 100), dtype=np.float32)
    up[:, :30] = 8.0
    context = Context(tmp_path, stage_id="surface.terrain")
    given = {"surface": surface_of(up)}
    given["surface"].views[:, 80:] = 0
    out = surface_terrain().run(given, surface_terrain.Params(widest_m=60.0), context)
    assert np.abs(out["terrain"].up_m).max() < 0.3
    assert 0.55 < context.notes.metrics["surface"]["ground_share"] <= 0.625


def test_what_was_known_before_counts_by_its_deviation_and_the_distance():
    """Filled cells of a wood's crowns, 5 m up and 80 m wide: near seen ground that goes on, far away they count."""
    up = np.zeros((100, 400), dtype=np.float32)
    up[:, 160:] = 5.0
    surface = surface_of(up)
    surface.views[:, 160:], surface.sd_m[:, 160:] = 0, 1.0
    model = terrain_model(surface)
    near, far = model.up_m[50, 160 + 12], model.up_m[50, 160 + 200]
    assert near < 0.5 and far > 4.8
    assert 0.1 < model.sd_m[50, 160 + 12] < model.sd_m[50, 160 + 200] < 1.01
    assert not model.seen[:, 160:].any()


def test_arrays_go_once_they_are_of_no_more_use():
    """Bytes a cell at most, without the surface: 34, and 51 where what judged the cells lives until the end."""
    up_m = np.zeros((SIDE, SIDE), dtype=np.float32)
    up_m[200:240, 200:240] = 6.0
    surface = surface_of(up_m)
    terrain_model(surface)
    tracemalloc.start()
    try:
        terrain_model(surface)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 42 * up_m.size
