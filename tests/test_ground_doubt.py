"""How far the ground's deviations may move a mosaic, in figures worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geomosaic.camera.exterior import Poses
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.mosaic.model import OutputGrid
from geomosaic.mosaic.ownership import Ownership
from geomosaic.projection.ground import GroundSurface
from geomosaic.quality.ground_doubt import Land, LandDoubt, land_doubt, places_of

HOME = LocalFrame(9.0, 48.0, 400.0)
AT_M = MapProjection("EPSG:32632").map_from_geodetic(9.0, 48.0)
FRAMES = Poses(np.array([[0.0, 0.0, 50.0], [500.0, 0.0, 50.0]]), *[np.zeros((2, 3))] * 3)
SURE = GroundSurface("tie_surface", -100.0, -100.0, 50.0, np.zeros((5, 5)), np.full((5, 5), 0.4))


def owned(owner: np.ndarray) -> Ownership:
    """Cells of 1 m, ten pixels, with the work frame's origin in the middle."""
    rows, cols = owner.shape
    west, north = float(AT_M[0]) - cols / 2.0, float(AT_M[1]) + rows / 2.0
    grid = OutputGrid("EPSG:32632", west, north, 0.1, 10 * cols, 10 * rows)
    return Ownership(grid, np.array([True, True]), 10, owner.astype(np.int32))


def doubt(owner: np.ndarray, ground: GroundSurface, known: GroundSurface | None = None) -> LandDoubt:
    return land_doubt(Land(owned(owner), FRAMES, HOME, ground, known or ground), 3.0)


def test_a_place_leans_by_the_angle_of_the_frame_that_gives_it() -> None:
    """30 m beside the point below a frame 50 m up, and 470 m beside that of the other."""
    owner = np.zeros((61, 61))
    owner[30, 60] = owner[10, 30] = 1
    at_m, tangent = places_of(owned(owner), FRAMES, HOME, SURE)
    assert at_m[1] == pytest.approx([30.0, 0.0, 0.0], abs=0.6)
    assert tangent == pytest.approx([20.0 / 50.0, 30.0 / 50.0], rel=2e-3)
    _, tangent = places_of(owned(np.where(owner > 0, 2, 0)), FRAMES, HOME, SURE)
    assert tangent[1] == pytest.approx(470.0 / 50.0, rel=2e-3)


def test_of_equal_places_99_in_100_lie_within_2_58_deviations() -> None:
    owner = np.zeros((61, 61))
    owner[30, 60] = 1
    assert doubt(owner, SURE).ground_px == pytest.approx(2.5758 * 2.4, rel=2e-3)


def test_a_hundredth_of_bad_land_is_passed_over_and_a_twentieth_is_not() -> None:
    rough = replace(SURE, sd_m=np.where(np.arange(5)[:, None] >= 4, 50.0, 0.0) + np.full((5, 5), 0.01))
    owner = np.ones((200, 200))
    assert doubt(owner[1:], rough).ground_px > 10.0
    assert doubt(owner, SURE).ground_px < 20.0
    owner[:50] = 0
    assert doubt(owner, rough).ground_px < 1.0


def test_what_stands_unsurely_is_told_apart_from_the_ground() -> None:
    """30 m beside the point below a frame 50 m up, 1 m of height is 0.6 m, 6 px: of such places 62 % lie off by
    more than 3 px; the ground through tie points is known to 0.4 m."""
    owner = np.zeros((61, 61))
    owner[30, 60] = 1
    woods = replace(SURE, kind="dense", sd_m=np.full((5, 5), 1.0))
    found = doubt(owner, woods, SURE)
    assert found.ground_px == pytest.approx(2.5758 * 2.4, rel=2e-3)
    assert found.surface_share == pytest.approx(0.6171, abs=2e-3)
    assert np.isnan(doubt(owner, SURE).surface_share)


def test_what_was_matched_surely_beyond_tie_points_is_known() -> None:
    owner = np.zeros((61, 61))
    owner[30, 60] = 1
    sharp = replace(SURE, kind="dense", sd_m=np.full((5, 5), 0.1))
    found = doubt(owner, sharp, SURE)
    assert found.ground_px == pytest.approx(2.5758 * 0.6, rel=2e-3)
    assert found.surface_share < 1e-5


def test_a_surface_that_strays_about_the_ground_is_off_by_as_much() -> None:
    """0.3 m over a ground known to 0.05 m, by a matching that knows it to 0.4 m: 1.8 px, 0.3 and 2.4."""
    owner = np.zeros((61, 61))
    owner[30, 60] = 1
    known = replace(SURE, sd_m=np.full((5, 5), 0.05))
    strayed = replace(SURE, kind="dense", up_m=np.full((5, 5), 0.3))
    found = doubt(owner, strayed, known)
    assert found.ground_px == pytest.approx(1.8 + 2.3263 * 0.3, rel=1e-2)
    assert found.surface_share == pytest.approx(0.2113, abs=5e-3)
    roof = replace(strayed, up_m=np.full((5, 5), 6.0))
    assert doubt(owner, roof, known).ground_px == pytest.approx(2.5758 * 0.3, rel=0.2)


def test_what_a_surface_raises_without_being_sure_may_be_ground() -> None:
    """1 m, seen 49 m below: 6.12 px, over a ground known to 0.31 px, by a matching that knows it to 0.5 m: one
    time in 22 nothing stands there, and 22 % of these lie farther off than 0.77 deviations; to 0.25 m: in
    16,000."""
    owner = np.zeros((61, 61))
    owner[30, 60] = 1
    known = replace(SURE, sd_m=np.full((5, 5), 0.05))
    raised = replace(SURE, kind="dense", up_m=np.full((5, 5), 1.0), sd_m=np.full((5, 5), 0.5))
    beyond_px = (6.0 + 0.3 * 0.773) * 50.0 / 49.0
    assert doubt(owner, raised, known).ground_px == pytest.approx(beyond_px, rel=5e-3)
    sure = replace(raised, sd_m=np.full((5, 5), 0.25))
    assert doubt(owner, sure, known).ground_px == pytest.approx(2.5758 * 0.3 * 50.0 / 49.0, rel=1e-2)


def test_what_is_not_known_is_not_told() -> None:
    owner = np.ones((10, 10))
    given = replace(SURE, sd_m=None)
    assert np.isnan(doubt(owner, given).ground_px)
    assert np.isnan(doubt(0.0 * owner, SURE).ground_px)
    on_given = doubt(owner, replace(SURE, kind="terrain"), given)
    assert np.isnan(on_given.ground_px) and on_given.surface_share < 0.01


def test_land_is_judged_by_what_is_asked_of_it() -> None:
    """Ground unknown by 1 m, seen up to 30 degrees aslant at 0.1 m a pixel, may be off by 3 px, not by 30."""
    owner = np.ones((61, 61))
    unsure = replace(SURE, sd_m=np.ones_like(SURE.up_m))
    land = Land(owned(owner), FRAMES, HOME, unsure, unsure)
    assert land_doubt(land, 3.0).ground_share > 0.1 > 0.01 > land_doubt(land, 30.0).ground_share
