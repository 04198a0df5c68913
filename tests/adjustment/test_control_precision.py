"""Control is as precise as its residuals show: a variance component, never below what is stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import Flown, fly

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Adjusted, GroundControl, Settings
from geomosaic.geodesy.local import LocalFrame
from geomosaic.quality.control import control_warnings, precision_warnings
from geomosaic.survey.height_reference import HeightReference

PLAN = np.array(
    [[-15.0, -10.0], [95.0, -10.0], [95.0, 100.0], [-15.0, 100.0], [40.0, 45.0], [40.0, -5.0], [90.0, 45.0],
     [-10.0, 50.0]]
)  # fmt: skip


def surveyed(
    flown: Flown, noise_m: float, *, points: int = 8, stated_m: float = 0.05, at_m: np.ndarray = PLAN
) -> list[GroundControl]:
    out = []
    for k, plan in enumerate(at_m[:points]):
        at = np.append(plan, 0.0)
        seen = tuple(flown.seen(at, 0.5))
        given = at + flown.rng.normal(0.0, noise_m, 3)
        out.append(GroundControl(f"P{k}", given, np.full(3, stated_m), False, seen))
    return out


def solved(flown: Flown, control: list[GroundControl]) -> Adjusted:
    return METHODS["bundle"](replace(flown.block, control=tuple(control)), Settings(model="given"))


def worst(adjusted: Adjusted) -> float:
    """By how many deviations the worst point disagrees, which the verdict asks."""
    return max(float(np.abs(c.residual_m / c.sd_m).max()) for c in adjusted.control)


@pytest.mark.parametrize(
    "seed", [pytest.param(1, marks=pytest.mark.proof), pytest.param(3, marks=pytest.mark.proof), 7]
)
def test_control_of_two_metres_is_weighted_by_that(seed: int) -> None:
    flown = fly(seed, points=300, position_sd_m=np.array([0.5, 0.5, 0.5]))
    control = surveyed(flown, 2.0)
    adjusted = solved(flown, control)
    assert 1.2 < adjusted.figures["control_sd_m.plan"] < 3.2
    assert 0.8 < adjusted.figures["control_sd_m.height"] < 3.8
    (warning,) = precision_warnings(control, adjusted.figures)
    assert "m in plan (stated 0.05 m)" in warning.text
    assert (
        "control-disagrees" not in [w.code for w in control_warnings(adjusted.control)]
        and worst(adjusted) < 5.0
    )
    off = adjusted.poses.positions_m - flown.truth.positions_m
    assert np.all(np.abs(off.mean(axis=0)) < 3.0)
    assert np.all(np.abs(off) < 4.0 * adjusted.poses.positions_sd_m)


@pytest.mark.parametrize("noise_m", [pytest.param(0.05, marks=pytest.mark.proof), 2.0])
def test_a_blunder_among_them_is_named_and_widens_nothing(noise_m: float) -> None:
    flown = fly(5, points=300, position_sd_m=np.array([0.5, 0.5, 0.5]))
    control = surveyed(flown, noise_m)
    plain = solved(flown, control)
    control[3] = replace(control[3], enu_m=control[3].enu_m + [16.0, -12.0, 0.0])
    adjusted = solved(flown, control)
    named = [w.text for w in control_warnings(adjusted.control) if w.code == "control-disagrees"]
    assert len(named) == 1 and "'P3'" in named[0]
    found = adjusted.figures["control_sd_m.plan"]
    assert found == pytest.approx(plain.figures["control_sd_m.plan"], rel=0.5)
    moved = adjusted.poses.positions_m - plain.poses.positions_m
    assert np.abs(moved).max() < (0.2 if noise_m < 1.0 else 2.0)


def test_good_control_is_as_stated_whatever_the_positions() -> None:
    """Positions 8 m off in common: that is not control's error."""
    flown = fly(6, points=300)
    poses = flown.block.poses
    off = replace(poses, positions_m=poses.positions_m + [8.0, -6.0, 9.0])
    control = surveyed(flown, 0.05)
    adjusted = solved(replace(flown, block=replace(flown.block, poses=off)), control)
    assert adjusted.figures["control_sd_m.plan"] < 0.08 and adjusted.figures["control_sd_m.height"] < 0.08
    assert not precision_warnings(control, adjusted.figures)
    away = adjusted.poses.positions_m - flown.truth.positions_m
    assert np.abs(away.mean(axis=0)).max() < 0.4


@pytest.mark.parametrize("seed", [2, pytest.param(4, marks=pytest.mark.proof)])
def test_control_corrects_heights_without_datum_that_are_off_in_common(seed: int) -> None:
    """By 6 m, two of their deviations: left as they are they lean the block, and the focal length makes up."""
    flown = fly(seed, 2, 8, points=500, position_sd_m=np.array([2.0, 2.0, 3.0]))
    true_m = flown.truth.positions_m
    given_m = true_m + [1.5, -2.0, 6.0] + flown.rng.normal(0.0, 0.8, true_m.shape)
    work_frame = LocalFrame(9.0, 48.0, 300.0)
    heights_m = work_frame.geodetic_from_enu(given_m)[:, 2]
    block = replace(
        flown.block,
        poses=replace(flown.block.poses, positions_m=given_m),
        heights=HeightReference(work_frame, heights_m, np.full(len(true_m), 3.0), 46.0),
    )
    one_end = true_m[np.argsort(true_m[:, 1])[:10], :2] + [4.0, 6.0]
    adjusted = solved(replace(flown, block=block), surveyed(flown, 0.03, points=10, at_m=one_end))
    away_m = np.abs((adjusted.poses.positions_m - true_m).mean(axis=0))
    assert away_m[2] < 1.5 and away_m[:2].max() < 0.7, away_m
    assert adjusted.figures["common_height_sd_m"] == 0.0  # the covariance of the poses contains it
    assert adjusted.shared is not None
    k = adjusted.shared.names.index("offset_up_m")
    assert abs(adjusted.shared.found[k] - 6.0) < 3.0 * adjusted.shared.sd[k] < 6.0


def test_precise_positions_keep_their_accuracy_with_coarse_control() -> None:
    """RTK positions of 0.02 m, stated as 0.1 m, with control of 2 m: it shifts nothing, and the map is as sure
    as they are."""
    flown = fly(1, points=300, position_sd_m=np.array([0.02, 0.02, 0.03]))
    poses = replace(flown.block.poses, positions_sd_m=np.full((len(flown.block.poses), 3), 0.1))
    adjusted = solved(replace(flown, block=replace(flown.block, poses=poses)), surveyed(flown, 2.0))
    away_m = adjusted.poses.positions_m - flown.truth.positions_m
    assert np.abs(away_m[:, :2].mean(axis=0)).max() < 0.05
    assert adjusted.poses.positions_sd_m[:, :2].max() < 0.2


def test_four_points_show_no_precision() -> None:
    flown = fly(7, points=300)
    adjusted = solved(flown, surveyed(flown, 2.0, points=4))
    assert not [name for name in adjusted.figures if name.startswith("control_sd_m")]
