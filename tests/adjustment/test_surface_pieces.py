"""A surface in pieces is the surface as a whole, and summits stay where even land was taken for granted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from geomosaic.adjustment.ground import surface_pieces
from geomosaic.adjustment.ground.surface_pieces import by_pieces
from geomosaic.adjustment.ground.tie_surface import possible_standings
from geomosaic.adjustment.ground.trial_surface import Heights, Trial, fitted
from geomosaic.projection.ground import GroundSurface

LOW, HIGH = np.array([-430.0, -210.0]), np.array([430.0, 210.0])


def land(at: np.ndarray) -> np.ndarray:
    """Hills of 20 m on a slope of a tenth."""
    return np.asarray(10.0 * np.cos(at[:, 0] / 40.0) * np.cos(at[:, 1] / 55.0) + 0.1 * at[:, 0])


def heights() -> Heights:
    """Points to 3 cm, one in a hundred wrong, with a gap of 120 m where pieces meet."""
    rng = np.random.default_rng(5)
    at = rng.uniform([-400.0, -180.0], [400.0, 180.0], (9000, 2))
    at = at[np.hypot(at[:, 0], at[:, 1]) > 60.0]
    up = land(at) + rng.normal(0.0, 0.03, len(at)) + 20.0 * (rng.uniform(size=len(at)) < 0.01)
    return Heights(np.column_stack([at, up]), np.full(len(at), 0.03), LOW, HIGH, 100.0)


@pytest.mark.parametrize("standing", [(3, 0.0), (6, 0.1)])
def test_pieces_make_the_surface_of_the_whole(
    standing: tuple[int, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where points are, to a tenth of their deviation; in their gap, to a tenth of the surface's error."""
    trial = Trial(heights(), 7.0, 32.0, standing, 12)
    assert trial.nodes == (124, 61)
    made: list[int] = []

    def counted(trials: Sequence[Trial]) -> list[GroundSurface]:
        made.append(len(trials))
        return [fitted(each) for each in trials]

    whole = by_pieces(trial, counted)
    monkeypatch.setattr(surface_pieces, "_SIDE", 50)
    pieces = by_pieces(trial, counted)
    assert made == [1, 15]
    assert pieces.up_m.shape == whole.up_m.shape
    assert (pieces.east_0_m, pieces.north_0_m) == (whole.east_0_m, whole.north_0_m)
    east, north, _ = trial.heights.points_m.T
    apart = np.abs(pieces.up_at(east, north) - whole.up_at(east, north))
    assert np.quantile(apart, 0.99) < 0.003
    gap = np.random.default_rng(1).uniform(-40.0, 40.0, (200, 2))
    apart = np.abs(pieces.up_at(*gap.T) - whole.up_at(*gap.T))
    off = np.abs(whole.up_at(*gap.T) - land(gap))
    assert np.median(apart) < 0.1 * np.median(off)


def test_a_piece_without_points_is_the_trend(monkeypatch: pytest.MonkeyPatch) -> None:
    """A third of the land has no points: the slope goes on there, and nothing is NaN."""
    monkeypatch.setattr(surface_pieces, "_SIDE", 50)
    known = heights()
    west = known.without(known.points_m[:, 0] > -150.0)
    surface = by_pieces(Trial(west, 7.0, 32.0, (3, 0.0), 12), lambda trials: [fitted(t) for t in trials])
    assert np.isfinite(surface.up_m).all()
    assert np.abs(np.diff(surface.up_m, axis=1)).max() < 7.0  # no cliff of a node's width
    assert surface.up_at(400.0, 0.0) == pytest.approx(40.0, abs=25.0)


def test_a_single_summit_is_not_cut_off() -> None:
    """A cone of 60 m on hills of 20 m. A plane or paraboloid that fits the land to 1.25 m would cost it 50 m,
    step by step, since heights that are missed count less and less. Hills are not as even as that."""
    rng = np.random.default_rng(7)
    at = rng.uniform([-400.0, -180.0], [400.0, 180.0], (9000, 2))
    cone = 60.0 * np.exp(-((at[:, 0] - 120.0) ** 2 + (at[:, 1] - 40.0) ** 2) / (2.0 * 25.0**2))
    up = land(at) + cone + rng.normal(0.0, 0.03, len(at))
    its = Heights(np.column_stack([at, up]), np.full(len(at), 0.03), LOW, HIGH, 100.0)
    summit = 60.0 + float(land(np.array([[120.0, 40.0]]))[0])
    for standing in possible_standings(its):
        surface = fitted(Trial(its, 7.0, 32.0, standing, 12))
        assert surface.up_at(120.0, 40.0) == pytest.approx(summit, abs=0.5), standing
    as_it_was = fitted(Trial(its, 7.0, 32.0, (6, 0.0125), 12))
    assert as_it_was.up_at(120.0, 40.0) < summit - 40.0


def test_even_land_may_stay_as_it_was() -> None:
    """Where the low points lie within 0.5 m of a plane, the standings are those given."""
    rng = np.random.default_rng(8)
    at = rng.uniform([-400.0, -180.0], [400.0, 180.0], (4000, 2))
    crowns = 10.0 * (rng.uniform(size=len(at)) < 0.3)
    points_m = np.column_stack([at, 0.1 * at[:, 0] + crowns + rng.normal(0.0, 0.5, len(at))])
    its = Heights(points_m, np.full(len(at), 0.5), LOW, HIGH, 100.0)
    assert possible_standings(its) == [(3, 0.0), (3, 0.0125), (6, 0.1), (6, 0.0125)]
