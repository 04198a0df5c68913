"""virtual_line: offsets by model and DEM against simulated truth, signs by physics, what the deviations say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from geomosaic.ccd.line_poses import LinePoses, on_height
from geomosaic.ccd.model import BRIDGED, UNRELIABLE, CcdSettings
from geomosaic.ccd.object_space import ObjectSpace, level_ground, read_object_space
from geomosaic.ccd.overlaps import StripFiles
from geomosaic.ccd.virtual_line import relief_px, virtual_line
from geomosaic.errors import InputError
from geomosaic.geodesy.local import ecef_from_geodetic
from geomosaic.survey.strips import read_geometry
from geomosaic_simulate.strip_files import given_heights
from geomosaic_simulate.strip_overlaps import strips_in_memory
from geomosaic_simulate.strip_plan import StripPlan
from geomosaic_simulate.strip_scene import StripWorld
from geomosaic_simulate.strips import simulate_strips

STILL: dict[str, Any] = {
    "jitter_1hz_px": 0.0, "jitter_5hz_px": 0.0, "jitter_22hz_px": 0.0, "drift_px_per_s": 0.0,
    "drift_angle_deg": 0.0, "mounting_px": 0.0, "thermal_px": 0.0, "course_deg": 180.0,
}  # fmt: skip


def quiet(_done: int, _total: int) -> None:
    return None


def space_of(scene: StripWorld) -> ObjectSpace:
    """Model and heights as they are reported."""
    heights = given_heights(scene)

    def height_at(lon: Any, lat: Any) -> Any:
        xy = scene.projection.map_from_geodetic(lon, lat)
        return heights.height_at(xy[..., 0], xy[..., 1])

    return ObjectSpace(scene.cameras.reported, height_at, scene.relief.base_m)


def found(plan: StripPlan, space: ObjectSpace | None = None):
    strips = strips_in_memory(plan.geometry(), [])
    strips.object_space = space_of(StripWorld(plan)) if space is None else space
    return virtual_line(strips, CcdSettings(), quiet)


def test_model_and_dem_out_of_their_files_give_the_true_offsets(tmp_path: Path) -> None:
    plan = StripPlan(ccds=3, width_px=256, lines=3000, seed=3, relief_m=600.0, first_row=2, dem_pixel_m=45.0)
    made = simulate_strips(tmp_path, plan, scene=False)
    geometry = read_geometry(made.geometry)
    reports: list[tuple[int, int]] = []
    with StripFiles(geometry) as strips:
        strips.object_space = read_object_space(geometry)
        pairs = virtual_line(strips, CcdSettings(), lambda done, total: reports.append((done, total)))
    assert reports[-1] == (6000, 6000)
    truth = np.genfromtxt(made.true_offsets, delimiter=",", names=True)
    for offsets in pairs:
        true = truth[truth["pair"] == offsets.pair]
        assert np.ptp(true["dline_px"]) > 2.0
        np.testing.assert_allclose(offsets.dcol_px, true["dcol_px"], atol=0.002)
        np.testing.assert_allclose(offsets.dline_px, true["dline_px"], atol=0.002)
        assert (offsets.label == BRIDGED).all()
        np.testing.assert_allclose(offsets.sd_line_px, np.hypot(0.1, 10.0 / 233.0), atol=0.002)
        np.testing.assert_allclose(offsets.sd_col_px, 0.1, atol=0.002)


def test_at_full_width_across_pieces_and_strips_that_differ() -> None:
    """Longer than a piece of lines; a dead CCD and a short one."""
    plan = StripPlan(ccds=6, width_px=4096, lines=9001, seed=8, relief_m=900.0, dead="2", short="4:5000")
    scene = StripWorld(plan)
    pairs = found(plan)
    assert [p.pair for p in pairs] == [2, 3, 4]
    assert [len(p.dcol_px) for p in pairs] == [9001, 5000, 9001]
    for offsets in pairs:
        true = scene.truth(offsets.pair)
        np.testing.assert_allclose(offsets.dcol_px, true.dcol_px, atol=0.001)
        np.testing.assert_allclose(offsets.dline_px, true.dline_px, atol=0.001)


def test_higher_ground_has_one_sign() -> None:
    """233 m higher: a line later in the leading row, earlier in the trailing one."""
    plan = StripPlan(ccds=3, width_px=256, lines=2500, relief_m=0.0, **STILL)
    model = StripWorld(plan).cameras.true
    low, high = (found(plan, level_ground(model, h)) for h in (900.0, 1133.0))
    for pair, sign in ((0, -1.0), (1, 1.0)):
        np.testing.assert_allclose(low[pair].dline_px, 0.0, atol=0.003)
        np.testing.assert_allclose(high[pair].dline_px, sign, atol=0.005)
        np.testing.assert_allclose(high[pair].dcol_px, 0.0, atol=0.005)
        # Without a DEM heights are known to some 200 m: nothing that could be called measured.
        assert (high[pair].label == UNRELIABLE).all()


def test_without_a_model_the_error_says_what_to_give() -> None:
    strips = strips_in_memory(StripPlan(ccds=2, lines=2200).geometry(), [])
    with pytest.raises(InputError, match=r"virtual_line needs a rigorous model of the camera; give 'model'"):
        virtual_line(strips, CcdSettings(), quiet)


@pytest.mark.parametrize(("noise_urad", "label"), [(1.0, BRIDGED), (3.0, UNRELIABLE)])
def test_noise_of_the_attitudes_is_found_and_reported(noise_urad: float, label: int) -> None:
    """A microradian is 0.27 px, twice in each offset; between its samples a spline's noise is a bit less."""
    plan = StripPlan(ccds=2, lines=4000, seed=5, attitude_noise_urad=noise_urad)
    (offsets,) = found(plan)
    true = StripWorld(plan).truth(0)
    assert (offsets.label == label).all()
    noise_px = np.sqrt(2.0) * noise_urad * 0.266
    np.testing.assert_allclose(offsets.sd_col_px, np.hypot(0.1, noise_px), rtol=0.1)
    inside = np.abs(offsets.dline_px - true.dline_px) <= 1.645 * offsets.sd_line_px
    assert inside.mean() > 0.88


def test_attitudes_wilder_than_the_ground_goes_by_leave_finite_offsets() -> None:
    plan = StripPlan(ccds=2, lines=3000, seed=5, attitude_noise_urad=30.0)
    (offsets,) = found(plan)
    assert np.isfinite(offsets.dline_px).all()
    assert np.abs(offsets.dline_px).max() < 80.0
    assert (offsets.label == UNRELIABLE).all()


def test_lines_beyond_the_attitudes_are_unreliable() -> None:
    """The table ends at line 3000: the right strip, 2114 lines later, is known to the left one's line 886."""
    plan = StripPlan(ccds=2, lines=3000, seed=2)
    scene = StripWorld(plan)
    space = space_of(scene)
    known = space.model.attitude_time_s <= 3000.0 / plan.line_rate_hz
    model = replace(
        space.model,
        attitude_time_s=space.model.attitude_time_s[known],
        roll_pitch_yaw_rad=space.model.roll_pitch_yaw_rad[known],
    )
    (offsets,) = found(plan, replace(space, model=model))
    last = int(np.flatnonzero(offsets.label == BRIDGED)[-1])
    assert last == pytest.approx(886, abs=15)
    true = scene.truth(0)
    np.testing.assert_allclose(offsets.dline_px[:860], true.dline_px[:860], atol=0.01)
    assert np.abs(offsets.dline_px - true.dline_px).max() < 10.0


def test_relief_is_what_the_heights_make() -> None:
    plan = StripPlan(ccds=4, width_px=256, lines=3000, relief_m=900.0, seed=4, dead="4", **STILL)
    scene = StripWorld(plan)
    relief = relief_px(plan.geometry(), space_of(scene))
    assert sorted(relief) == [0, 1]
    for pair, sign in ((0, -1.0), (1, 1.0)):
        middle_m = ((pair + 1) * 160 + 48 - scene.scene_width_px / 2) * 2.0
        ahead_lines = 1057.0 if sign < 0 else -1057.0
        north_m = (1500.0 - np.arange(3000) - 0.5 - ahead_lines) * 2.0
        height = scene.relief.height_at(middle_m, north_m) - scene.relief.base_m
        assert np.ptp(height) > 300.0
        np.testing.assert_allclose(relief[pair], sign * height / 233.0, atol=0.02)


def test_relief_and_level_ground_make_the_whole() -> None:
    plan = StripPlan(ccds=3, lines=2600, relief_m=800.0, seed=6)
    space = space_of(StripWorld(plan))
    relief = relief_px(plan.geometry(), space)
    level = found(plan, level_ground(space.model, space.mean_m))
    for offsets, flat in zip(found(plan, space), level, strict=True):
        whole = flat.dline_px + relief[offsets.pair]
        np.testing.assert_allclose(offsets.dline_px, whole, atol=0.002)


def test_poses_of_a_table_see_as_the_model_itself_does() -> None:
    model = StripWorld(StripPlan(ccds=3, lines=3000, seed=7)).cameras.true
    poses = LinePoses(model, -20.0, 3020.0)
    rng = np.random.default_rng(1)
    col, line = rng.uniform(0.0, 512.0, 50), rng.uniform(0.0, 3000.0, 50)
    ground = model.ground_from_image(2, col, line, 700.0)
    origin, ray = poses.rays(2, col, line)

    ecef = ecef_from_geodetic(*ground.T)
    np.testing.assert_allclose(on_height(origin, ray, 700.0), ecef, atol=0.02)
    back = poses.image(2, ecef, line + 30.0)
    np.testing.assert_allclose(np.stack(back), np.stack([col, line]), atol=0.0005)
