"""What of a matched surface is smoothed before frames are projected onto it."""

from __future__ import annotations

import time

import numpy as np
import pytest

from geomosaic.composition.ortho_surface import ortho_surface
from geomosaic.projection.ground import GroundSurface

SPACING_M = 0.25
N = 240


def town_and_woods() -> GroundSurface:
    """A level place of 60 m x 60 m with a house of 10 m x 8 m, 6 m high, whose edges aren't sure over a
    metre. In the north is a wood, 20 m deep, of crowns that were matched anywhere between 2 m and 14 m."""
    rng = np.random.default_rng(3)
    up, sd = np.zeros((N, N)), np.full((N, N), 0.05)
    up[40:72, 60:100] = 6.0
    sd[38:74, 58:102] = 2.0
    sd[42:70, 62:98] = 0.05
    up[160:] = rng.uniform(2.0, 14.0, (N - 160, N))
    sd[160:] = 3.0
    return GroundSurface("dense", 0.0, 0.0, SPACING_M, up, sd)


def test_woods_are_smoothed_and_what_is_sure_stays_to_the_last_bit() -> None:
    ground = town_and_woods()
    found = ortho_surface(ground)
    np.testing.assert_array_equal(found.up_m[:155], ground.up_m[:155])
    step = np.abs(np.diff(found.up_m[155:], axis=0)).max(), np.abs(np.diff(found.up_m[160:], axis=1)).max()
    assert max(step) < 4.0 * SPACING_M, "they can be drawn without a fold"
    assert np.abs(np.diff(ground.up_m[160:], axis=1)).max() > 11.0
    assert np.median(found.up_m[190:]) == pytest.approx(8.0, abs=1.0), "and are as high as they were"
    assert found.kind == ground.kind and found.sd_m is ground.sd_m


def test_a_surface_that_is_sure_or_says_nothing_is_itself() -> None:
    ground = town_and_woods()
    plain = GroundSurface("dense", 0.0, 0.0, SPACING_M, ground.up_m)
    assert ortho_surface(plain) is plain
    sure = GroundSurface("dense", 0.0, 0.0, SPACING_M, ground.up_m, np.full((N, N), 0.1))
    assert ortho_surface(sure) is sure


def test_what_is_narrower_than_2_5_m_stays_in_little_time() -> None:
    """Cells of 1 cm: a strip of 2 m stays; one of 7 m is smoothed, with a hole of 2 m x 0.2 m in it. By an
    ellipse of 251 cells that takes 20 s."""
    n = 1300
    up = np.random.default_rng(3).uniform(0.0, 1.0, (n, n))
    sd = np.zeros((n, n))
    sd[20:220] = sd[300:1000] = 1.0
    sd[640:660, 300:500] = 0.0
    began = time.process_time()
    found = ortho_surface(GroundSurface("dense", 0.0, 0.0, 0.01, up, sd))
    assert time.process_time() - began < 6.0
    changed = found.up_m != up
    assert not changed[:300].any() and not changed[1000:].any()
    assert changed[302:998].mean() > 0.999
