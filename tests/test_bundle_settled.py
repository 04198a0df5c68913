"""What keeps a block from its end: points that wander alone, and components that follow what was believed."""

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import fly, hills

from geomosaic.adjustment.model import Settings
from geomosaic.adjustment.problem.bundle_model import Factors, Priors, State
from geomosaic.adjustment.problem.priors import priors_of
from geomosaic.adjustment.problem.tracks import Tracks, join_tracks
from geomosaic.adjustment.procedure.block_solution import points_on_ground
from geomosaic.adjustment.solver.bundle_equations import cost_of, normals_of
from geomosaic.adjustment.solver.normal_equations import reduce_normals
from geomosaic.adjustment.solver.single_points import settled_points, wandering
from geomosaic.adjustment.solver.variance_component_newton import ahead
from geomosaic.adjustment.terms.collinearity import interior_of
from geomosaic.adjustment.terms.mounting import MOUNTING

FACTORS = Factors(image_px=0.3)


def at_truth(points: int, blunders: int) -> tuple[Tracks, np.ndarray, Priors, State]:
    """A block at its true poses, its points on the ground below; some tracks have one image 4 px off."""
    flown = fly(5, relief=hills, points=points)
    block, tracks = flown.block, join_tracks(flown.block.ties)
    image_px = tracks.image_px.copy()
    wrong = np.searchsorted(tracks.point, np.flatnonzero(tracks.lengths > 2)[:blunders])
    image_px[wrong, 0] += 4.0
    ground, tracks = points_on_ground(
        flown.truth, block.cameras, block.ground, Tracks(tracks.frame, tracks.point, image_px)
    )
    priors = priors_of(block, Settings(), block.lenses, ground)
    interior = np.stack([interior_of(c) for c in block.lenses])
    at = flown.truth.positions_m, flown.truth.rotations, interior, ground, np.zeros(len(MOUNTING))
    return tracks, block.lens_of, replace(priors, terrain=None), State(*at)


def test_points_go_where_their_images_want_them_while_all_others_stand() -> None:
    """Cost falls, and of slopes nothing is left; also where an image contradicts the others."""
    tracks, camera_of, priors, state = at_truth(400, 40)
    which = np.arange(0, tracks.points, 2)
    settled = state
    for _ in range(3):
        settled = settled_points(tracks, camera_of, priors, settled, FACTORS, which)
    assert cost_of(tracks, camera_of, priors, settled, FACTORS) < cost_of(
        tracks, camera_of, priors, state, FACTORS
    )
    assert settled.points[1::2] == pytest.approx(state.points[1::2], abs=0.0)
    assert settled.positions is state.positions
    reduced = reduce_normals(normals_of(tracks, camera_of, priors, settled, FACTORS))
    side = reduced.normals.point_side
    off = np.sqrt(np.einsum("pi,pij,pj->p", side, reduced.points_inverse, side))
    assert np.quantile(off[which], 0.99) < 0.02
    assert np.median(off[1::2]) > 1.0


def test_who_wanders_are_the_farthest_of_a_large_block_alone() -> None:
    tracks, camera_of, priors, state = at_truth(4000, 10)
    everyone = np.arange(tracks.points)
    for _ in range(3):
        state = settled_points(tracks, camera_of, priors, state, FACTORS, everyone)
    thrown = np.array([7, 500, 2900])
    points = state.points.copy()
    points[thrown] += [0.5, 0.3, 4.0]
    reduced = reduce_normals(normals_of(tracks, camera_of, priors, replace(state, points=points), FACTORS))
    assert set(thrown) <= set(wandering(reduced).tolist())
    assert len(wandering(reduced)) < 0.04 * tracks.points
    tracks, camera_of, priors, state = at_truth(400, 10)
    assert not len(wandering(reduce_normals(normals_of(tracks, camera_of, priors, state, FACTORS))))


def test_a_component_that_follows_what_was_believed_goes_its_whole_way() -> None:
    """Found by a rule that halves what is missing to 2.4, it is there at once, not in five rounds."""
    before, end = Factors(tilt=1.0), 2.4
    found = replace(before, tilt=float(np.exp(0.5 * np.log(end))))
    followed = np.zeros((4, 4))
    followed[2, 2] = 0.5
    *_, priors, _ = at_truth(400, 0)
    sent, change = ahead(before, found, followed, priors)
    assert sent.tilt == pytest.approx(end)
    assert change == pytest.approx(np.log(end))
    assert (sent.horizontal, sent.vertical, sent.yaw) == (1.0, 1.0, 1.0)


@pytest.mark.parametrize("following", [1.2, 0.99])
def test_no_component_goes_back_or_beyond_bounds(following: float) -> None:
    before, found = Factors(tilt=1.0), Factors(tilt=1.3)
    followed = np.zeros((4, 4))
    followed[2, 2] = following
    *_, priors, _ = at_truth(400, 0)
    sent, _ = ahead(before, found, followed, priors)
    assert 1.0 < sent.tilt <= 1.3**4 + 1e-9
