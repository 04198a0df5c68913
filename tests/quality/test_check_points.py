"""Check points: the map's shift and scatter, and blunders found against the other points."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import fly

from geomosaic.adjustment.model import ControlResidual, GroundControl
from geomosaic.adjustment.procedure.control_points import control_residuals
from geomosaic.estimation.robust import blunders
from geomosaic.quality.check_points import check_points
from geomosaic.quality.control import control_blunders, control_warnings
from geomosaic.survey.accuracy import POSITION

STATED_M = 1.21
SURVEYED_M = np.full(3, 0.02)
SHIFT_M = np.array([0.8, 1.8, -0.3])


def points(count: int, off_m: dict[int, list[float]] | None = None, **how: object) -> list[ControlResidual]:
    """Check points that a map shifted by 2 m leaves, with 0.02 m of scatter, and blunders (e, n, u)."""
    noise = np.random.default_rng(count).normal(0.0, 0.02, (count, 3))
    sd_m, check = np.full(3, how.get("sd_m", STATED_M)), not how.get("control")
    residual_m = [SHIFT_M + noise[k] + (off_m or {}).get(k, 0.0) for k in range(count)]
    return [ControlResidual(f"P{k}", check, 4, off, sd_m, SURVEYED_M) for k, off in enumerate(residual_m)]


def test_figures_by_hand() -> None:
    """East 1, 3, 2: mean 2, root mean square about it sqrt(2/3), about 0 sqrt(14/3)."""
    east, north, up = [1.0, 3.0, 2.0], [-1.0, -1.0, -1.0], [0.1, 0.1, 4.0]
    sd_m = [np.ones(3), np.ones(3), np.array([1.0, 1.0, POSITION["none"].sd_vertical_m])]
    residual_m = np.array([east, north, up]).T
    some = [ControlResidual("abc"[k], True, 2, residual_m[k], sd_m[k], SURVEYED_M) for k in range(3)]
    control = ControlResidual("control", False, 2, np.full(3, 9.0), np.ones(3), SURVEYED_M)
    found = check_points([*some, control])
    assert found is not None and (found.count, found.blunders) == (3, ())
    assert found.mean_shift_m == pytest.approx([2.0, -1.0, 0.1]), "c has no surveyed height"
    assert found.scatter_m == pytest.approx([(2.0 / 3.0) ** 0.5, 0.0, 0.0])
    assert found.rmse_m == pytest.approx([(14.0 / 3.0) ** 0.5, 1.0, 0.1])
    assert check_points([]) is None
    (plan,) = [p for p in some if p.name == "c"]
    alone = check_points([plan])
    assert alone is not None and np.isnan(alone.rmse_m[2]) and not control_warnings([plan] * 6)


def test_a_common_shift_of_two_metres_is_accuracy_not_a_fault() -> None:
    """28 points surveyed to the millimetre, marked without error, on a map whose frames lie 2 m off."""
    flown = fly(0)
    plan = flown.rng.uniform([-15.0, -10.0], [95.0, 100.0], (28, 2))
    surveyed_m = np.column_stack([plan, np.zeros(28)])
    control = tuple(
        GroundControl(f"RTK-{k}", at, np.full(3, 0.02), True, tuple(flown.seen(at)))
        for k, at in enumerate(surveyed_m)
    )
    poses = replace(
        flown.truth,
        positions_m=flown.truth.positions_m - SHIFT_M,
        positions_sd_m=np.full((18, 3), STATED_M),
    )
    block = replace(flown.block, poses=poses, control=tuple(c for c in control if len(c.observations) > 1))
    residuals = control_residuals(block, poses)
    assert len(residuals) > 20 and control_warnings(residuals) == []
    found = check_points(residuals)
    assert found is not None and found.count == len(residuals) and found.blunders == ()
    assert found.mean_shift_m == pytest.approx(SHIFT_M, abs=1e-3)
    assert found.scatter_m == pytest.approx(np.zeros(3), abs=1e-3)
    assert found.rmse_m == pytest.approx(np.abs(SHIFT_M), abs=1e-3)


def test_one_shift_beyond_three_deviations_is_one_line() -> None:
    (warning,) = control_warnings(points(28, sd_m=0.3))
    assert warning.code == "check-shifted" and "28 check points" in warning.text
    assert "+0.80 east, +1.80 north, -0.30 up" in warning.text and "6.0 of its stated" in warning.text
    (warning,) = control_warnings(points(28, sd_m=0.3, control=True))
    assert warning.code == "control-shifted"


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_one_blunder_among_twelve_is_named_and_only_it(axis: int) -> None:
    """5 m, with a shift of 2 m: less than five of the stated deviations, and 250 of the scatter."""
    five_m = [5.0 * (k == axis) for k in range(3)]
    some = points(12, {7: five_m})
    (warning,) = control_warnings(some)
    assert warning.code == "check-disagrees"
    said = re.fullmatch(r"check point 'P7' lies (\S+) m .* other 11 check points put it .*", warning.text)
    assert said is not None and float(said[1]) == pytest.approx(5.0, abs=0.06)
    found, plain = check_points(some), check_points([p for p in some if p.name != "P7"])
    assert found is not None and plain is not None and (found.count, found.blunders) == (11, ("P7",))
    assert np.array_equal(found.mean_shift_m, plain.mean_shift_m)
    assert np.array_equal(found.scatter_m, plain.scatter_m)


def test_two_blunders_do_not_hide_each_other() -> None:
    some = points(12, {2: [5.0, 0.0, 0.0], 9: [5.2, 0.0, 0.0]})
    assert np.flatnonzero(control_blunders(some)).tolist() == [2, 9]
    texts = [w.text for w in control_warnings(some)]
    assert len(texts) == 2 and "'P2'" in texts[0] and "'P9'" in texts[1]


def test_an_error_that_all_positions_share_hides_no_blunder() -> None:
    """2 m off eleven others that scatter by 0.3 m, on a map that is as a whole off by 1.4 m at one
    deviation."""
    rng = np.random.default_rng(6)
    residual_m = rng.normal(0.0, 0.3, (12, 3)) + [1.0, -1.0, 0.5]
    residual_m[4, 1] = 1.0
    sd_m, shared_m = np.full(3, np.hypot(1.4, 0.3)), np.full(3, 1.4)
    some = [
        ControlResidual(f"P{k}", True, 3, off, sd_m, SURVEYED_M, shared_m) for k, off in enumerate(residual_m)
    ]
    assert np.flatnonzero(control_blunders(some)).tolist() == [4]
    assert not control_blunders([replace(p, common_sd_m=np.zeros(3)) for p in some]).any()


def test_of_four_points_none_is_named() -> None:
    """The fifth shows which of them is wrong."""
    four = points(4, {1: [5.0, 0.0, 0.0]}, sd_m=1.0)
    found = check_points(four)
    assert found is not None and (found.count, found.blunders) == (4, ())
    (warning,) = control_warnings(four)
    assert warning.text.startswith("1 of 4 check points disagree") and "fewer than 5" in warning.text
    assert not any(f"P{k}" in warning.text for k in range(4))
    assert "'P1' lies" in control_warnings(points(5, {1: [5.0, 0.0, 0.0]}, sd_m=1.0))[0].text


def test_many_equal_warnings_are_one_line() -> None:
    """Points ten times less precise than stated: none is a blunder, all that disagree are counted."""
    noise = np.random.default_rng(4).normal(0.0, 1.0, (28, 3))
    some = [ControlResidual(f"P{k}", True, 3, n, np.full(3, 0.1), SURVEYED_M) for k, n in enumerate(noise)]
    (warning,) = control_warnings(some)
    off = noise - noise.mean(axis=0)
    far = [f"P{k}" for k in np.flatnonzero((np.abs(off) > 0.5).any(axis=1))]
    assert warning.code == "check-disagrees" and len(far) > 20
    assert warning.text.startswith(
        f"{len(far)} of 28 check points ({', '.join(far[:3])} and {len(far) - 3} more)"
    )


@pytest.mark.parametrize(
    ("count", "common_m", "own_m"), [(5, 0.0, 1.2), (12, 0.0, 1.2), (28, 0.0, 1.2), (12, 1.2, 0.15)]
)
def test_good_points_are_seldom_called_blunders(count: int, common_m: float, own_m: float) -> None:
    """At most in one of a hundred sets, whether all points share the error or each has its own."""
    rng, sd = np.random.default_rng(count), np.full(count, np.hypot(common_m, own_m))
    sets = [rng.normal(0.0, common_m) + rng.normal(0.0, own_m, count) for _ in range(1000)]
    assert np.mean([blunders(values, sd).any() for values in sets]) < 0.01


def test_a_difference_below_its_own_deviation_is_no_blunder() -> None:
    """Points that agree to 1 mm and one 3 cm off, each surveyed to 2 cm."""
    values = np.append(np.random.default_rng(1).normal(0.0, 0.001, 11), 0.03)
    assert not blunders(values, np.full(12, 0.02)).any()
    assert np.flatnonzero(blunders(values * 2.0, np.full(12, 0.02))).tolist() == [11]
