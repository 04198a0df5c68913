"""Blocks of which nothing says where down is: cameras that look ahead, seen as land that slopes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import fly

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Adjusted, Block, Settings
from geomosaic.survey.accuracy import ATTITUDE, POSITION


def sloping(rise: float):
    """Land that rises northwards by so much, from 45 m before the block's middle on."""
    return lambda east, north: rise * (north - 45.0) + 0.0 * east


def unobserved(block: Block, sd_tilt_deg: float = ATTITUDE["none"].sd_tilt_deg) -> Block:
    """All frames 100 m above one place, at deviations that say that nobody observed it."""
    n = len(block.names)
    sd_deg = [sd_tilt_deg, sd_tilt_deg, ATTITUDE["none"].sd_yaw_deg]
    poses = replace(
        block.poses,
        positions_m=np.tile([0.0, 0.0, 100.0], (n, 1)),
        positions_sd_m=np.full((n, 3), POSITION["none"].sd_horizontal_m),
        rotations_sd_rad=np.tile(np.radians(sd_deg), (n, 1)),
        velocities_m_per_s=None,
    )
    return replace(block, poses=poses)


def against(adjusted: Adjusted, truth_m: np.ndarray) -> tuple[np.ndarray, float]:
    """True direction of what is up in the result, and RMS of its centres after a similarity, in m (Horn 1987)."""
    own, true = (p - p.mean(axis=0) for p in (adjusted.poses.positions_m, truth_m))
    u, s, vt = np.linalg.svd(true.T @ own)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = u * sign @ vt
    miss_m = (s * sign).sum() / (own**2).sum() * own @ turn.T - true
    return turn @ [0.0, 0.0, 1.0], float(np.sqrt((miss_m**2).sum(axis=1).mean()))


@pytest.mark.parametrize(("seed", "rise"), [(1, 0.5), (2, 0.7)])
def test_land_that_is_steeper_than_assumed_tilts_explain_is_level(seed: int, rise: float) -> None:
    """To the block it is the same whether land rises by 27 or 35 degrees or cameras look ahead by as much."""
    flown = fly(seed, relief=sloping(rise), points=1500)
    adjusted = METHODS["bundle"](unobserved(flown.block), Settings())
    up, miss_m = against(adjusted, flown.truth.positions_m)
    assert np.degrees(np.arccos(up @ np.array([0.0, -rise, 1.0]) / np.hypot(rise, 1.0))) < 0.5
    assert miss_m < 0.15
    assert adjusted.ground.kind == "flat"
    text = next(w.text for w in adjusted.warnings if w.code == "ground-levelled")
    said = float(text.partition("look ")[2].partition("°")[0])
    assert said == pytest.approx(np.degrees(np.arctan(rise)), abs=2.0)


def test_hillsides_and_observed_tilts_stay(seed: int = 4) -> None:
    """Land that rises by 11 degrees; and by 27 where tilts are known to 3 degrees."""
    for rise, block in (
        (0.2, unobserved(fly(seed, relief=sloping(0.2), points=1500).block)),
        (0.5, unobserved(fly(seed, relief=sloping(0.5), points=1500).block, 3.0)),
    ):
        adjusted = METHODS["bundle"](block, Settings())
        assert "ground-levelled" not in {w.code for w in adjusted.warnings}
        east, north = np.array([40.0, 40.0]), np.array([20.0, 70.0])
        assert np.ptp(adjusted.ground.up_at(east, north)) == pytest.approx(50.0 * rise, rel=0.3)
