"""Roofs in place in a mosaic on the tie points' ground: which, how, and that nothing else changes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from mosaic_scenes import CAMERA, HOME, make_survey, truth

from geomosaic.camera.exterior import Poses
from geomosaic.composition.compose import compose
from geomosaic.composition.grid import output_grid
from geomosaic.composition.mosaic_scene import MapPixels
from geomosaic.composition.objects import objects_between
from geomosaic.composition.ownership import by_nearest_nadir
from geomosaic.composition.raster import MosaicFiles
from geomosaic.composition.roof_ownership import with_roofs
from geomosaic.composition.roof_planes import roof_planes
from geomosaic.composition.roofs import FoundRoofs, raised_roofs
from geomosaic.composition.scene import CELL_PX, Scene, ground_of
from geomosaic.composition.views import FrameView, PosedFrames, frame_views
from geomosaic.composition.window import Window
from geomosaic.constants import varied
from geomosaic.projection.ground import GroundSurface, flat_ground
from geomosaic.projection.lattice import MapLattice
from geomosaic.spread import AtOnce
from geomosaic.survey.model import Survey

CAMERA_WIDE = replace(
    CAMERA, width_px=300, height_px=220, focal_length_px=170.0, principal_col_px=151.0, principal_row_px=109.0
)
HIGH_M = 10.0


def ground(over_m: np.ndarray, kind: str = "dense") -> GroundSurface:
    """Heights over a slope, on nodes of 1 m about the origin."""
    rows, cols = over_m.shape
    return GroundSurface(kind, -cols / 2.0, -rows / 2.0, 1.0, over_m + 0.2 * np.arange(cols))


def hall(height_m: float, kind: str = "dense") -> GroundSurface:
    """Land with a hall of 9 m x 9 m, or without."""
    axis = -80.0 + np.arange(161)
    east, north = np.meshgrid(axis, axis)
    inside = (abs(east) < 4.5) & (abs(north) < 4.5)
    return GroundSurface(kind, -80.0, -80.0, 1.0, np.where(inside, height_m, 0.0))


def test_objects_end_where_heights_leap_and_cars_are_none() -> None:
    over = np.zeros((60, 80))
    over[20:30, 20:34] = 5.0 + 0.5 * np.abs(np.arange(14) - 7)
    over[20:30, 34:44] = 14.0
    over[45:52, 60:70] = 3.0
    over[10:15, 60:64] = 1.5
    labels = objects_between(ground(over), ground(0.0 * over, "terrain"))
    of = [set(labels[at].ravel()) for at in (np.s_[22:28, 22:32], np.s_[22:28, 36:42], np.s_[47:50, 62:68])]
    assert all(len(numbers) == 1 for numbers in of)
    assert set.union(*of) == {1, 2, 3}
    assert not labels[8:17, 55:].any()


def test_planes_fit_a_hipped_roof_up_to_its_eaves_and_no_crown() -> None:
    row, col = np.mgrid[0:40, 0:60]
    own = (row >= 8) & (row < 32) & (col >= 8) & (col < 52)
    hipped = 4.0 + 0.15 * np.minimum.reduce([row - 8, 31 - row, col - 8, 51 - col])
    noise = np.random.default_rng(3).normal(0.0, 0.02, own.shape)
    found = roof_planes((hipped + noise).astype(np.float32), own, 0.3)
    assert found.share > 0.9 and len(found.terms) == 4
    off_m = np.abs(found.heights_m(1) - hipped)[own]
    assert np.quantile(off_m, 0.98) < 0.15 and off_m.max() < 0.5
    crown = np.random.default_rng(4).uniform(3.0, 8.0, own.shape).astype(np.float32)
    assert roof_planes(crown, own, 0.3).share < 0.5


def found_roofs(
    survey: Survey, frames: PosedFrames, surface: GroundSurface
) -> tuple[FoundRoofs, tuple[FrameView, ...]]:
    views = frame_views(frames, survey.map_crs)
    grounds = surface, hall(0.0, "terrain"), frames.ground
    return raised_roofs(grounds, survey.frames, views, AtOnce()), views


@pytest.mark.parametrize(
    ("true_m", "frames_used", "raised"),
    [(HIGH_M, 6, 1), (0.0, 6, 0), pytest.param(HIGH_M, 2, 0, marks=pytest.mark.proof)],
)
def test_a_roof_is_raised_that_three_frames_agree_on(
    tmp_path: Path, true_m: float, frames_used: int, raised: int
) -> None:
    """Not a hall that was added to flat land, and not one that two frames see. Its walls are where they are."""
    survey, poses, _ = make_survey(tmp_path, ground=hall(true_m), camera=CAMERA_WIDE)
    used = [i < frames_used for i in range(len(poses))]
    frames = PosedFrames(survey, poses, [CAMERA_WIDE] * len(poses), used, hall(0.0, "tie_surface"))
    found, _ = found_roofs(survey, frames, hall(HIGH_M))
    assert len(found.raised) == raised
    for one in found.raised:
        np.testing.assert_allclose(one.on_ground.ends_m, [[-4.5, -4.5], [4.5, 4.5]], atol=2.0)
        np.testing.assert_allclose(one.on_ground.up_m[one.mask], HIGH_M, atol=0.05)


@pytest.fixture(scope="module")
def hall_survey(tmp_path_factory: pytest.TempPathFactory) -> tuple[Survey, Poses]:
    survey, poses, _ = make_survey(tmp_path_factory.mktemp("hall"), ground=hall(HIGH_M), camera=CAMERA_WIDE)
    return survey, poses


@pytest.fixture(scope="module", params=["tie_surface", "flat"])
def hall_flight(
    request: pytest.FixtureRequest, hall_survey: tuple[Survey, Poses]
) -> tuple[PosedFrames, Scene, FoundRoofs]:
    """On level ground, and the roofs that are found."""
    survey, poses = hall_survey
    flat = hall(0.0, "tie_surface") if request.param == "tie_surface" else flat_ground(HOME, 400.0, 400.0)
    assert flat.kind == request.param
    frames = PosedFrames(survey, poses, [CAMERA_WIDE] * len(poses), [True] * len(poses), flat)
    found, views = found_roofs(survey, frames, hall(HIGH_M))
    grid = output_grid(MapPixels(survey.map_crs, 0.25), views, [f.name for f in survey.frames], 1.0)
    return frames, Scene(survey.work_frame, flat, grid, views), found


def test_a_mosaic_keeps_its_bytes_but_about_the_roof(
    hall_flight: tuple[PosedFrames, Scene, FoundRoofs], tmp_path: Path
) -> None:
    """And is nearer to the truth there."""
    frames, scene, found = hall_flight
    before = by_nearest_nadir(frames, scene.grid)
    after = with_roofs(before, scene, hall(HIGH_M), found.raised, AtOnce())
    raised = replace(scene.ground, raised=tuple(one.on_ground for one in found.raised))
    shown = []
    for name, ground_of_it, ownership in (("flat", scene.ground, before), ("raised", raised, after)):
        raster = tmp_path / f"{name}.tif"
        compose(replace(frames, ground=ground_of_it), ownership, MosaicFiles(raster))
        with rasterio.open(raster) as file:
            shown.append(file.read().astype(np.float32))
            easting, northing = _places(file)
    at = ground_of(scene, Window(0, 0, scene.grid.width_px, scene.grid.height_px), 1).points_m()
    off_m = np.abs(at[..., :2]).max(axis=-1)
    differ = (shown[0] != shown[1]).any(axis=0)
    true = np.moveaxis(truth(easting, northing), -1, 0)
    roof = off_m < 3.5
    wrong = [np.abs(image - true)[:, roof].mean() for image in shown]
    assert differ[roof].mean() > 0.5 and wrong[1] < wrong[0] / 3.0
    assert not differ[off_m > 15.0].any()


def _places(file: rasterio.DatasetReader) -> tuple[np.ndarray, np.ndarray]:
    row, col = np.indices(file.shape) + 0.5
    return file.transform.c + file.transform.a * col, file.transform.f + file.transform.e * row


def test_one_frame_gives_a_roof_and_all_that_is_far_from_it_stays(
    hall_flight: tuple[PosedFrames, Scene, FoundRoofs],
) -> None:
    """Owners, what is hidden, and where frames see the map's pixels."""
    frames, scene, found = hall_flight
    before = by_nearest_nadir(frames, scene.grid)
    after = with_roofs(before, scene, hall(HIGH_M), found.raised, AtOnce())
    side, (rows, cols) = before.cell_px, before.owner.shape
    places = ground_of(scene, Window(0, 0, cols * side, rows * side), side).points_m()
    off_m = np.abs(places[..., :2]).max(axis=-1)
    assert len(np.unique(after.owner[off_m < 2.5])) == 1
    assert (after.owner == before.owner)[off_m > 20.0].all()
    assert (after.owner != before.owner).any() and after.hidden
    flat, grid = scene.ground, scene.grid
    raised = replace(flat, raised=tuple(one.on_ground for one in found.raised))
    part = grid.part(0, 0, (grid.height_px // CELL_PX * CELL_PX, grid.width_px // CELL_PX * CELL_PX))
    both = [
        MapLattice(part, scene.work_frame, of).seen(
            frames.poses[0], CAMERA_WIDE, slice(0, part.height_px), slice(0, part.width_px)
        )
        for of in (flat, raised)
    ]
    inside = (both[0].cols > 0) & (both[0].cols < CAMERA_WIDE.width_px)
    inside &= (both[0].rows > 0) & (both[0].rows < CAMERA_WIDE.height_px)
    moved = inside & (both[0].cols != both[1].cols)
    at = ground_of(scene, Window(0, 0, part.width_px, part.height_px), 1).points_m()
    roof = np.abs(at[..., :2]).max(axis=-1) < 11.0
    assert moved[roof].any() and not moved[~roof].any()


class _Watched(AtOnce):
    """Counts the frames that are decoded, and the most roofs that are looked at in one."""

    def __init__(self) -> None:
        self.decoded, self.roofs = 0, 0

    def map(
        self,
        name: str,
        function: Callable[[Any], Any],
        items: Sequence[Any],
        keys: Sequence[Any] | None = None,
    ) -> list[Any]:
        self.decoded += len(items)
        self.roofs = max(self.roofs, *(len(item.roofs) for item in items))
        return super().map(name, function, items, keys)


def test_roofs_are_judged_in_batches_and_each_alone_comes_out_the_same(
    hall_survey: tuple[Survey, Poses],
) -> None:
    """The hall, and one that the surface has and the land has not."""
    survey, poses = hall_survey
    base, surface = hall(0.0, "tie_surface"), hall(HIGH_M)
    surface.up_m[95:104, 76:85] = HIGH_M
    views = frame_views(
        PosedFrames(survey, poses, [CAMERA_WIDE] * len(poses), [True] * len(poses), base), survey.map_crs
    )
    grounds, found, watched = (surface, hall(0.0, "terrain"), base), [], []
    for together_px in (1e9, 1.0):
        watched.append(_Watched())
        with varied(_TOGETHER_PX=together_px):
            found.append(raised_roofs(grounds, survey.frames, views, watched[-1]))
    assert [(of.candidates, len(of.raised)) for of in found] == [(2, 1), (2, 1)]
    one, other = (of.raised[0] for of in found)
    assert one.frame == other.frame
    np.testing.assert_array_equal(one.on_ground.up_m, other.on_ground.up_m)
    np.testing.assert_array_equal(one.on_ground.ends_m, other.on_ground.ends_m)
    assert [of.roofs for of in watched] == [2, 1] and watched[0].decoded <= 6 < watched[1].decoded


def test_many_small_objects_are_passed_over_in_little_time() -> None:
    """2,300 sheds on 1.4 million nodes: a search of all nodes for each takes half a minute."""
    at = np.arange(1200) % 25 < 14
    up_m = np.where(at & at[:, None], 6.0, 0.0)
    surface = GroundSurface("dense", -60.0, -60.0, 0.1, up_m)
    flat = replace(surface, kind="terrain", up_m=0.0 * up_m)
    began = time.process_time()
    found = raised_roofs((surface, flat, flat), (), (), AtOnce())
    assert time.process_time() - began < 10.0
    assert found == FoundRoofs((), 0)
