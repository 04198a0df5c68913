"""The surface matched between frames of a simulated town, against its true heights."""

from __future__ import annotations

from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dense_scene import GSD_M, Scene, scene
from small_surveys import geomosaic, small_survey, summary

from geomosaic.adjustment.model import Adjusted
from geomosaic.pipeline.context import Context
from geomosaic.pipeline.run_results import load_artefact
from geomosaic.projection.ground import GroundSurface
from geomosaic.stages import surface_dense as stage_module
from geomosaic.stages.surface_dense import surface_dense
from geomosaic.surface import pyramid as levels_module
from geomosaic.surface.cells import Cells
from geomosaic.surface.consistency_filter import consistent_heights
from geomosaic.surface.match_warnings import match_warnings
from geomosaic.surface.model import DenseSurface
from geomosaic.surface.pyramid import pyramid_levels
from geomosaic.surface.tile_sgm import TileHeights
from geomosaic.survey.model import Survey

GROUND, ROOF, CROWN, WALL = range(4)


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return scene(tmp_path_factory.mktemp("town"), relief_m=4.0)


@pytest.fixture(scope="module")
def found(town: Scene):
    return town.matched(town.cells(52.0))


@pytest.fixture(scope="module")
def judged(town: Scene, found):
    errors_m, kind = town.truth(found[0])
    return errors_m, np.where(town.frames_seeing(found[0]) >= 3, kind, -1)


def test_ground_and_roofs_lie_right(judged) -> None:
    errors_m, kind = judged
    for what, off_px in ((GROUND, 0.5), (ROOF, 0.6)):
        assert float(np.median(np.abs(errors_m[kind == what]))) < off_px * GSD_M


@pytest.mark.parametrize(("what", "share"), [(WALL, 0.3), (CROWN, 0.35)])
def test_few_cells_next_to_walls_and_in_crowns_are_off_by_a_metre(judged, what: int, share: float) -> None:
    errors_m, kind = judged
    assert (kind == what).sum() > 200
    assert float(np.mean(np.abs(errors_m[kind == what]) > 1.0)) < share


@pytest.mark.parametrize("what", [GROUND, ROOF, CROWN, WALL])
def test_deviations_are_what_errors_are(judged, found, what: int) -> None:
    errors_m, kind = judged
    there = (kind == what) & (found[0].views > 0)
    off = np.abs(errors_m[there]) / found[0].sd_m[there]
    assert float(np.mean(off < 1.0)) > 0.6
    assert float(np.mean(off < 2.0)) > 0.85
    assert float(np.sqrt(np.mean(np.minimum(off, 5.0) ** 2))) > 0.3  # nor are they far too large


def test_what_one_frame_sees_is_filled(town: Scene, found) -> None:
    surface = found[0]
    seeing = town.frames_seeing(surface)
    assert (seeing < 2).any()
    assert surface.views[seeing < 2].max() == 0
    assert np.isfinite(surface.up_m).all()


def test_no_spikes_at_the_rim(town: Scene) -> None:
    places = np.array([s.pose.position_m for s in town.sighted])
    surface = town.matched(town.cells(64.0, *(places[4, :2] + [0.0, 20.0])))[0]
    errors_m, kind = town.truth(surface)
    seeing = town.frames_seeing(surface)
    open_ground = kind == GROUND
    assert (open_ground & (seeing < 2)).sum() > 1000
    for least, share in ((2, 0.02), (0, 0.005)):
        there = open_ground & (seeing >= least) & (seeing < least + 2)
        assert float(np.mean(np.abs(errors_m[there]) > 5.0)) < share


@pytest.mark.parametrize(("seeing", "alike", "kept"), [(2, 0.1, False), (2, 0.9, True), (3, 0.1, True)])
def test_two_frames_have_to_look_alike_where_three_need_not(seeing: int, alike: float, kept: bool) -> None:
    """Between two some height costs little by chance; before, it stood as a mast of 20 m at the rim."""
    flat, shape = GroundSurface("flat", 0.0, 0.0, 1.0, np.zeros((1, 1))), (40, 40)
    heights = TileHeights(
        np.full(shape, 20.0, dtype=np.float32),
        np.full(shape, alike, dtype=np.float32),
        np.full(shape, seeing if alike > 0.6 else 0, dtype=np.uint8),
        np.full(shape, seeing, dtype=np.uint8),
        np.full(shape, 5.5, dtype=np.float32),
    )
    part = consistent_heights(heights, Cells(0.0, 0.0, 0.4, *shape), flat, (-5.0, 30.0))
    assert ((part.views > 0) == kept).all()
    assert np.allclose(part.over_m, 20.0 if kept else 0.0)


@pytest.mark.parametrize(("every", "kept"), [(25, False), (6, True)])
def test_groves_with_some_sure_cells_stay_where_water_with_fewer_is_filled(every: int, kept: bool) -> None:
    """A sixth of a grove's cells is sure where frames see it aslant, of water's a twenty-fifth by chance."""
    flat, shape = GroundSurface("flat", 0.0, 0.0, 1.0, np.zeros((1, 1))), (40, 40)
    alike = np.full(shape, 0.2, dtype=np.float32)
    alike.ravel()[::every] = 0.9
    views = np.where(alike > 0.6, 3, 0).astype(np.uint8)
    heights = TileHeights(
        np.full(shape, 8.0, dtype=np.float32),
        alike,
        views,
        np.full(shape, 3, dtype=np.uint8),
        np.full(shape, 2.5, dtype=np.float32),
    )
    part = consistent_heights(heights, Cells(0.0, 0.0, 0.4, *shape), flat, (-5.0, 30.0))
    assert np.allclose(part.over_m, 8.0 if kept else 0.0)
    assert part.over_m.dtype == part.sd_m.dtype == np.float32


def test_tiles_end_where_two_frames_do(town: Scene) -> None:
    """What one frame sees, and a margin about it, is not worked on, and hardly anything that two see is left out."""
    cells = town.cells(160.0)
    level = pyramid_levels(cells, town.flying_m)[-1]
    flat = np.zeros((cells.rows, cells.cols), dtype=np.float32)
    nothing = DenseSurface(cells, flat + np.float32(town.base.up_m.item()), flat, flat.astype(np.uint8))
    seeing = town.frames_seeing(nothing)
    worked_on = np.zeros(seeing.shape, dtype=int)
    for task in level.tasks(town.sighted, town.base, flat[::2, ::2]):
        worked_on[task.tile.at] += 1
    assert worked_on.max() == 1
    assert float(np.mean(worked_on[seeing > 1] == 0)) < 0.01  # slivers between the places that are asked
    assert worked_on.mean() < 0.75


def test_tiles_in_any_order_give_the_same_bytes(town: Scene, found) -> None:
    again = town.matched(town.cells(52.0), backwards=True)[0]
    for one, other in zip(vars(found[0]).values(), vars(again).values(), strict=True):
        if isinstance(one, np.ndarray):
            assert one.tobytes() == other.tobytes()


def test_cells_that_no_frame_sees_keep_the_base(town: Scene) -> None:
    surface, counted, level = town.matched(town.cells(20.0, 500.0, 500.0))
    assert (surface.views == 0).all()
    assert np.allclose(surface.up_m, town.base.up_m)
    by_code = dict(match_warnings(counted, level, town.base.kind))
    assert list(by_code) == ["surface-not-matched"]


def test_two_frames_give_a_surface_that_says_so(town: Scene) -> None:
    middle = town.sighted[1].pose.position_m[:2]
    pair = replace(town, sighted=town.sighted[1:3], greys=town.greys[1:3])
    surface, counted, level = pair.matched(pair.cells(16.0, *middle))
    errors_m, kind = pair.truth(surface)
    seen = (pair.frames_seeing(surface) == 2) & (kind == GROUND)
    assert float(np.median(np.abs(errors_m[seen]))) < GSD_M
    by_code = dict(match_warnings(counted, level, town.base.kind))
    assert "surface-two-views" in by_code


def test_hills_beyond_the_search_are_reported_and_a_base_that_knows_them_finds_them(
    town: Scene, found
) -> None:
    deep = GroundSurface("flat", 0.0, 0.0, 1.0, town.base.up_m - 17.0)
    _, counted, level = town.matched(town.cells(24.0), deep)
    by_code = dict(match_warnings(counted, level, town.base.kind))
    assert by_code.keys() & {"surface-out-of-reach", "surface-not-matched"}
    by_code = dict(match_warnings(*found[1:], town.base.kind))
    assert not by_code


def test_water_stays_as_it_was(tmp_path) -> None:
    lake = scene(tmp_path, water_share=1.0, frames_per_line=3)
    surface, counted, level = lake.matched(lake.cells(24.0))
    land = np.abs(lake.truth(surface)[0]) > 1.0
    assert counted.looked_at > 1000
    assert counted.share < 0.3
    assert float(np.mean(land)) < 0.1
    by_code = dict(match_warnings(counted, level, lake.base.kind))
    assert "surface-not-matched" in by_code


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs of the same frames by one process and by two."""
    out = tmp_path_factory.mktemp("flown")
    survey = small_survey(
        out / "town", buildings=2.0, buildings_stand=True, frames_per_line=3, width_px=400, height_px=300
    )
    for workers in (1, 2):
        asked = ("--workers", workers, "--surface", "dense", "--pos", survey.pos, "--camera", survey.camera)
        assert geomosaic("mosaic", survey.frames, "-o", out / str(workers), *asked) == 0
    return out


@pytest.mark.proof
def test_one_and_two_workers_write_the_same_surface(flown: Path) -> None:
    one, two = ((flown / name / "surface.tif").read_bytes() for name in "12")
    assert one == two
    assert summary(flown / "1")["metrics"]["surface"]["matched"] > 0.3


@pytest.mark.proof
def test_a_killed_run_goes_on_with_the_tile_it_was_at(flown: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Any tile: of the coarse level, of the fine one, and of the surface."""
    run_summary = summary(flown / "1")
    inputs = {
        name: load_artefact(flown / "1", run_summary, of, kind)
        for name, of, kind in (
            ("survey", "survey", Survey),
            ("adjusted", "adjusted", Adjusted),
            ("ground", "prior_ground", GroundSurface),
        )
    }
    monkeypatch.setattr(levels_module, "TILE_CELLS", 64)
    made: list[str] = []
    last: list[int] = []

    def counting(name: str) -> None:
        own = getattr(stage_module, name)

        @wraps(own)
        def work(*given: Any) -> Any:
            if last and len(made) == last[0]:
                raise KeyboardInterrupt
            made.append(name)
            return own(*given)

        monkeypatch.setattr(stage_module, name, work)

    for name in ("_heights", "_part"):
        counting(name)

    def run(folder: str) -> DenseSurface:
        context = Context(flown / folder, key="some", work_folder=flown / folder / "work")
        found = surface_dense().run(inputs, surface_dense.Params(), context)["surface"]
        assert isinstance(found, DenseSurface)
        return found

    whole, tiles = run("undisturbed"), len(made)
    assert tiles > 12
    made.clear()
    for at in (1, tiles // 2, tiles - 2):
        last[:] = [at]
        with pytest.raises(KeyboardInterrupt):
            run("killed")
    last.clear()
    again = run("killed")
    assert len(made) == tiles
    assert again.up_m.tobytes() == whole.up_m.tobytes()
    assert again.sd_m.tobytes() == whole.sd_m.tobytes()
