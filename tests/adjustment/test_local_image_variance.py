"""Places whose tie points are less sure than others."""

from __future__ import annotations

import numpy as np
import pytest
from adjustment_blocks import fly
from test_chosen_model import _bent_m

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Settings
from geomosaic.adjustment.solver import steps
from geomosaic.adjustment.solver.variance_components import local_factors
from geomosaic.matching.tracks import Tracks


def residuals(views: np.ndarray, sd_px: np.ndarray, seed: int) -> tuple[Tracks, np.ndarray]:
    """Of points seen so often, as their own place in the images leaves them: 2 k - 3 normal numbers each."""
    rng = np.random.default_rng(seed)
    point = np.repeat(np.arange(len(views)), views)
    left = np.array([rng.chisquare(2 * k - 3) for k in views]) * sd_px**2
    length = np.sqrt(left / views)[point]
    return Tracks(np.zeros(len(point), np.intp), point, np.zeros((len(point), 2))), length


@pytest.mark.parametrize("sd_px", [0.1, 3.0])
def test_where_all_places_are_alike_all_points_count_alike(sd_px: float) -> None:
    rng = np.random.default_rng(1)
    points_m, views = rng.uniform(0.0, 100.0, (2000, 3)), rng.integers(2, 8, 2000)
    tracks, length = residuals(views, np.full(2000, sd_px), 2)
    found = local_factors(tracks, points_m, length, np.ones(len(length), bool))
    assert np.abs(np.log(found)).max() < 0.12


def test_crowns_in_the_wind_are_distinguished_from_still_ground() -> None:
    rng = np.random.default_rng(3)
    points_m, views = rng.uniform(0.0, 100.0, (4000, 3)), rng.integers(2, 8, 4000)
    crowns = np.floor(points_m[:, :2] / 25.0).sum(axis=1) % 2.0 == 0.0
    tracks, length = residuals(views, np.where(crowns, 1.2, 0.15), 4)
    found = local_factors(tracks, points_m, length, np.ones(len(length), bool))
    assert np.median(found[crowns]) / np.median(found[~crowns]) == pytest.approx(8.0, rel=0.1)
    sure = found < np.sqrt(found.min() * found.max())
    assert (sure == ~crowns).mean() > 0.9


def test_blunders_flung_to_one_place_are_no_noise_of_it() -> None:
    """Forty points a thousand kilometres off, with residuals of ten million pixels: the place is no land whose
    observations are good to that."""
    rng = np.random.default_rng(7)
    points_m, views = rng.uniform(0.0, 100.0, (2000, 3)), np.full(2000, 3)
    points_m[:40] += 1e6
    tracks, length = residuals(views, np.full(2000, 0.3), 8)
    length[:120] = 1e7
    found = local_factors(tracks, points_m, length, np.ones(len(length), bool))
    assert found[:40].max() < 60.0
    assert (length[:120] / found[tracks.point[:120]]).min() > 1e5, "blunders by their deviations"
    assert np.abs(np.log(found[40:])).max() < 0.8


def test_what_is_unknown_counts_as_ever() -> None:
    """Points that nobody sees, or that have no say; and blocks too small to tell places apart."""
    rng = np.random.default_rng(5)
    points_m, views = rng.uniform(0.0, 100.0, (300, 3)), np.full(300, 3)
    tracks, length = residuals(views, np.where(np.arange(300) < 150, 0.1, 2.0), 6)
    none = local_factors(tracks, points_m, length, np.zeros(len(length), bool))
    assert none.tolist() == [1.0] * 300
    length[:3] = np.nan
    assert local_factors(tracks, points_m, length, np.ones(len(length), bool))[0] == 1.0
    few = tracks.point < 50
    small = Tracks(tracks.frame[few], tracks.point[few], tracks.image_px[few])
    assert (
        local_factors(small, points_m[:50], length[few], np.ones(int(few.sum()), bool)).tolist() == [1.0] * 50
    )


@pytest.mark.proof
def test_still_ground_holds_a_block_of_which_half_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Good to 0.1 px next to 1.5 px: taken alike, all count as if they were good to 0.3 px."""
    flights = [fly(seed, 3, 5, points=2500, noise_px=0.1, swaying_px=1.5) for seed in (31, 32)]

    def bent_m() -> float:
        off = [
            _bent_m(
                METHODS["bundle"](f.block, Settings(model="given")).poses.positions_m, f.truth.positions_m
            )
            for f in flights
        ]
        return float(np.sqrt(np.mean(np.square(off))))

    distinguished = bent_m()
    monkeypatch.setattr(steps, "local_factors", lambda tracks, points_m, *_: np.ones(len(points_m)))
    assert distinguished < 0.75 * bent_m()
