"""What stands on the ground as whole objects, and which of them lie on the surface."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mosaic_scenes import CAMERA, make_survey

from geomosaic.composition.object_choice import ObjectAgreement, agreement
from geomosaic.composition.objects import objects_between, standing_on, with_objects
from geomosaic.composition.views import PosedFrames, frame_views
from geomosaic.projection.ground import GroundSurface
from geomosaic.spread import AtOnce

CAMERA_WIDE = replace(
    CAMERA, width_px=300, height_px=220, focal_length_px=170.0, principal_col_px=151.0, principal_row_px=109.0
)


def ground(over_m: np.ndarray, kind: str = "dense") -> GroundSurface:
    """Heights over a slope, on nodes of 1 m about the origin."""
    rows, cols = over_m.shape
    slope = 0.2 * np.arange(cols)
    return GroundSurface(kind, -cols / 2.0, -rows / 2.0, 1.0, over_m + slope, np.full(over_m.shape, 0.2))


def house_and_tower() -> np.ndarray:
    """A house of 14 m x 10 m, 5 m high, a tower of 10 m x 10 m beside it, 12 m high, a shed apart, and
    a car of 1.5 m."""
    over = np.zeros((60, 80))
    over[20:30, 20:34] = 5.0
    over[20:30, 34:44] = 12.0
    over[45:52, 60:70] = 3.0
    over[10:15, 60:64] = 1.5
    return over


def test_objects_end_where_heights_leap_and_are_whole_where_they_do_not() -> None:
    over = house_and_tower()
    over[20:30, 20:34] += 0.5 * np.abs(np.arange(14) - 7)
    labels = objects_between(ground(over), ground(0.0 * over, "terrain")).labels
    of = [
        set(np.unique(labels[at])) for at in (np.s_[22:28, 22:32], np.s_[22:28, 36:42], np.s_[47:50, 62:68])
    ]
    assert all(len(numbers) == 1 for numbers in of)
    assert set.union(*of) == {1, 2, 3}
    assert not labels[40:44].any() and not labels[8:17, 55:].any()


def test_an_object_is_even_inside_and_ends_at_its_outline() -> None:
    """A crown of 10 m with flanks that were matched anywhere, and a house with a ramp at its foot."""
    rng = np.random.default_rng(2)
    over = np.zeros((60, 80))
    over[10:30, 10:30] = rng.uniform(4.0, 12.0, (20, 20))
    over[40:52, 40:60] = 4.0
    over[40:52, 39] = over[40:52, 60] = 2.5
    surface, terrain = ground(over), ground(0.0 * over, "terrain")
    objects = objects_between(surface, terrain)
    raised = with_objects(surface, terrain, objects)
    height = raised.up_m - terrain.up_m
    stands = objects.labels > 0
    assert np.abs(height[~stands]).max() < 1e-5
    whole = objects.cover == 1.0
    for axis in (0, 1):
        inside = whole & np.roll(whole, 1, axis) & (objects.labels == np.roll(objects.labels, 1, axis))
        step = np.abs(height - np.roll(height, 1, axis))[inside]
        assert step.max() <= 1.0 + 1e-4
    house = (objects.labels == objects.labels[46, 50]) & (objects.cover == 1.0)
    assert house.sum() > 150
    np.testing.assert_allclose(height[house], 4.0, atol=1e-5)
    alone = standing_on(terrain, raised, objects.labels == objects.labels[46, 50])
    assert np.abs(alone.up_m - terrain.up_m)[:35].max() < 1e-5 and alone.has_walls


def test_nothing_stands_on_bare_land() -> None:
    bare = ground(np.zeros((20, 30)))
    objects = objects_between(bare, bare)
    assert objects.boxes.shape == (0, 4)
    np.testing.assert_allclose(with_objects(bare, bare, objects).up_m, bare.up_m, atol=1e-5)


def hall(height_m: float) -> GroundSurface:
    """Land with a hall of 16 m x 16 m, or without."""
    axis = -80.0 + np.arange(161)
    east, north = np.meshgrid(axis, axis)
    inside = (abs(east) < 8.0) & (abs(north) < 8.0)
    return GroundSurface("dense", -80.0, -80.0, 1.0, np.where(inside, height_m, 0.0))


@pytest.mark.parametrize(("true_m", "frames_used"), [(8.0, 6), (0.0, 6), (8.0, 2)])
def test_frames_agree_on_what_stands_and_not_on_what_does_not(
    tmp_path: Path, true_m: float, frames_used: int
) -> None:
    """A hall that was added to flat land agrees better below; of two frames alone nothing is asked."""
    survey, poses, _ = make_survey(tmp_path, ground=hall(true_m), camera=CAMERA_WIDE)
    used = [i < frames_used for i in range(len(poses))]
    frames = PosedFrames(survey, poses, [CAMERA_WIDE] * len(poses), used, hall(0.0))
    objects = objects_between(hall(8.0), hall(0.0))
    assert len(objects.boxes) == 1
    views = frame_views(frames, survey.map_crs)
    found = agreement(survey, views, objects, (hall(8.0), hall(0.0)), AtOnce())
    gain = found.on_surface[0] - found.on_terrain[0]
    if frames_used == 2:
        assert found.views[0] <= 2 and np.isnan(gain)
    else:
        assert gain * (true_m - 4.0) > 0.0 and found.views[0] >= 3
    assert not found.chosen.any() or true_m > 0.0


def test_an_object_is_raised_if_three_frames_surely_agree_there_alone() -> None:
    """Not by two frames, where they agree on the terrain too or on neither, or by chance."""
    views = np.array([3, 2, 3, 3, 3])
    on_surface, on_terrain = np.array([0.8, 0.8, 0.8, 0.4, 0.6]), np.array([0.1, 0.1, 0.7, 0.1, 0.4])
    found = ObjectAgreement(views, on_surface, on_terrain, np.array([0.05, 0.05, 0.01, 0.05, 0.2]))
    assert found.chosen.tolist() == [True, False, False, False, False]
