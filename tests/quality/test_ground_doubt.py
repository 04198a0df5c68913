"""How far the ground's deviations may move a mosaic, in figures worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geomosaic.camera.exterior import Poses
from geomosaic.composition.model import OutputGrid
from geomosaic.composition.ownership import Ownership
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import MapProjection
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


def land(owner: np.ndarray, ground: GroundSurface, known: GroundSurface | None = None) -> Land:
    return Land(owned(owner), FRAMES, HOME, ground, known or ground)


def doubt(owner: np.ndarray, ground: GroundSurface, known: GroundSurface | None = None) -> LandDoubt:
    return land_doubt(land(owner, ground, known), 3.0)


def test_a_place_leans_by_the_angle_of_the_frame_that_gives_it() -> None:
    """30 m off the point below a frame 50 m up, and 470 m off that of the other."""
    owner = np.zeros((61, 61))
    owner[30, 60] = owner[10, 30] = 1
    at_m, tangent, _ = places_of(land(owner, SURE))
    assert at_m[1] == pytest.approx([30.0, 0.0, 0.0], abs=0.6)
    assert tangent == pytest.approx([20.0 / 50.0, 30.0 / 50.0], rel=2e-3)
    _, tangent, _ = places_of(land(np.where(owner > 0, 2, 0), SURE))
    assert tangent[1] == pytest.approx(470.0 / 50.0, rel=2e-3)


def test_a_place_known_to_2_4_px_lies_off_by_3_px_one_time_in_five() -> None:
    owner = np.zeros((61, 61))
    owner[30, 60] = 1
    found = doubt(owner, SURE)
    assert found.ground_share == pytest.approx(0.2113, rel=5e-3) and found.rim_share == 0.0


def test_unknown_land_amid_known_land_is_no_rim() -> None:
    """Nodes 50 m apart: one is known to 100 m where no tie point is, in the middle or at the edge."""
    owner, known = np.ones((200, 200)), np.full((5, 5), 0.01)
    middle, edge = known.copy(), known.copy()
    middle[2, 2] = edge[2, 4] = 100.0
    amid, rim = (doubt(owner, replace(SURE, sd_m=sd_m)) for sd_m in (middle, edge))
    assert amid.ground_share > 0.1 and amid.rim_share == 0.0
    assert rim.rim_share > 0.05 and rim.ground_share < 0.02


def test_what_stands_unsurely_is_distinguished_from_the_ground() -> None:
    """30 m off the point below a frame 50 m up, 1 m of height is 0.6 m, 6 px. Of such places 62 % lie off by
    more than 3 px; the ground through tie points is known to 0.4 m."""
    owner = np.zeros((61, 61))
    owner[30, 60] = 1
    woods = replace(SURE, kind="dense", sd_m=np.full((5, 5), 1.0))
    found = doubt(owner, woods, SURE)
    assert found.ground_share == pytest.approx(0.2113, rel=5e-3)
    assert found.surface_share == pytest.approx(0.6171, abs=2e-3)
    assert np.isnan(doubt(owner, SURE).surface_share)


def test_what_was_matched_surely_beyond_tie_points_is_known() -> None:
    owner = np.zeros((61, 61))
    owner[30, 60] = 1
    sharp = replace(SURE, kind="dense", sd_m=np.full((5, 5), 0.1))
    found = doubt(owner, sharp, SURE)
    assert found.ground_share == pytest.approx(5.7e-7, rel=0.1)
    assert found.surface_share < 1e-5


def test_a_surface_that_strays_about_the_ground_is_off_by_as_much() -> None:
    """0.3 m over a ground known to 0.05 m, by a matching that knows it to 0.4 m, seen from 49.7 m above:
    1.81 px, 0.302 and 2.4."""
    owner = np.zeros((61, 61))
    owner[30, 60] = 1
    known = replace(SURE, sd_m=np.full((5, 5), 0.05))
    strayed = replace(SURE, kind="dense", up_m=np.full((5, 5), 0.3))
    found = doubt(owner, strayed, known)
    assert found.ground_share == pytest.approx(4.1e-5, rel=0.05)
    assert found.surface_share == pytest.approx(0.2113, abs=5e-3)
    roof = replace(strayed, up_m=np.full((5, 5), 6.0))
    assert doubt(owner, roof, known).ground_share < 1e-9


def test_what_a_surface_raises_without_being_sure_may_be_ground() -> None:
    """A matching raises land by 1 m, seen 49 m below: 6.12 px, over a ground known to 0.31 px. If it knows
    the height to 0.5 m, nothing stands there one time in 22. If it knows it to 0.25 m, that is one time in
    16,000."""
    owner = np.zeros((61, 61))
    owner[30, 60] = 1
    known = replace(SURE, sd_m=np.full((5, 5), 0.05))
    raised = replace(SURE, kind="dense", up_m=np.full((5, 5), 1.0), sd_m=np.full((5, 5), 0.5))
    assert doubt(owner, raised, known).ground_share == pytest.approx(0.0455, rel=1e-2)
    sure = replace(raised, sd_m=np.full((5, 5), 0.25))
    assert doubt(owner, sure, known).ground_share == pytest.approx(6.3e-5, rel=2e-2)


def test_what_is_not_known_is_not_reported() -> None:
    owner = np.ones((10, 10))
    given = replace(SURE, sd_m=None)
    assert np.isnan(doubt(owner, given).ground_share)
    assert np.isnan(doubt(0.0 * owner, SURE).ground_share)
    on_given = doubt(owner, replace(SURE, kind="terrain"), given)
    assert np.isnan(on_given.ground_share) and on_given.surface_share < 0.01


def test_land_is_judged_by_what_is_asked_of_it() -> None:
    """Ground unknown by 1 m, seen up to 30 degrees aslant at 0.1 m a pixel, may be off by 3 px, not by 30."""
    owner = np.ones((61, 61))
    unsure = replace(SURE, sd_m=np.ones_like(SURE.up_m))
    its = land(owner, unsure)
    assert land_doubt(its, 3.0).ground_share > 0.1 > 0.01 > land_doubt(its, 30.0).ground_share
