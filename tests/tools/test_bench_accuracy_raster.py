"""Normalised errors of the accuracy raster: of a true raster 1, with the scatter that few surveys leave."""

from __future__ import annotations

import numpy as np
import pytest

from geomosaic.adjustment.ground_places import GroundPlaces
from tools.bench.bench_accuracy_raster_judge import Errors, freedoms, judged, missed, table, together

AT_M = np.random.default_rng(1).uniform(-50.0, 50.0, (900, 2))


def survey(seed: int, stated: float = 1.0) -> Errors:
    """Places of a block that shifts, turns and grows by chance, and states its deviations times a factor."""
    rng, count = np.random.default_rng(seed), len(AT_M)
    turn, growth = rng.normal(0.0, 0.02, 2)
    shift = rng.normal(0.0, 0.5, 2)
    plan_m = shift + growth * AT_M + turn * AT_M[:, ::-1] * [-1.0, 1.0]
    plan_sd_m = np.hypot(0.5, 0.02 * np.linalg.norm(AT_M, axis=1))
    up_m, level = np.full(count, rng.normal(0.0, 0.3)), np.full(count, np.nan)
    source = np.where(AT_M[:, 0] > 20.0, 4, 1)
    up_sd_m = np.where(source == 4, level, 0.3)
    return Errors(source, AT_M, plan_m, up_m, stated * plan_sd_m, stated * up_sd_m, (4.0, 1.0))


def rows_of(surveys: int, stated: float = 1.0) -> list[dict]:
    return [row for seed in range(surveys) for row in judged("a", "GNSS", seed, survey(seed, stated))]


def test_a_true_raster_is_1_within_its_scatter_and_one_survey_may_be_far_from_it() -> None:
    rows = rows_of(300)
    tie, beyond = (row for row in together(rows) if row["positions"] == "all")
    assert (tie["class"], beyond["class"], tie["surveys"]) == ("tie surface", "extrapolated", 300)
    for row in (tie, beyond):
        assert row["plan"] == pytest.approx(1.0, abs=3.0 * row["plan_scatter"]) and row["plan_scatter"] < 0.04
    assert tie["up"] == pytest.approx(1.0, abs=3.0 * tie["up_scatter"]) and beyond["up"] is None
    ones = np.array([row["plan"] for row in rows if row["class"] == "tie surface"])
    assert np.mean((ones < 0.8) | (ones > 1.25)) > 0.3
    assert max(row["local_rms_m"] for row in rows) < 1e-9
    assert not missed([tie, beyond])


def test_deviations_stated_half_as_large_as_they_are_miss() -> None:
    wrong = missed(together(rows_of(60, stated=0.5)))
    assert len(wrong) == 3 and wrong[0].startswith("tie surface, horizontal: ")


def test_errors_that_all_places_share_are_one_and_independent_ones_as_many_as_there_are() -> None:
    at_m = np.zeros((20, 3))
    shared = np.kron(np.ones((20, 20)), np.diag([1.0, 4.0, 9.0]))
    assert freedoms(GroundPlaces(at_m, shared)) == pytest.approx((2.0, 1.0))
    assert freedoms(GroundPlaces(at_m, np.eye(60))) == pytest.approx((40.0, 20.0))
    assert freedoms(None) == (1.0, 1.0)


def test_the_table_leaves_columns_out_that_nothing_fills() -> None:
    lines = table(rows_of(1)).splitlines()
    assert "surveys" not in lines[0] and lines[2].startswith("| a 0 | GNSS | tie surface |")
    assert {line.count("|") for line in lines} == {lines[0].count("|")}
