"""Some neighbouring frames of a block, and solutions that pass between them and the whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from adjustment_blocks import estimate_of, fly

from geomosaic.adjustment.model import Settings
from geomosaic.adjustment.procedure.block_part import (
    neighbours,
    part_of_block,
    part_of_solution,
    part_of_tracks,
    solution_of_whole,
)
from geomosaic.adjustment.procedure.block_problem import block_problem
from geomosaic.adjustment.solver.solution import Start
from geomosaic.adjustment.terms.term import Components
from geomosaic.matching.tracks import join_tracks


def test_neighbours_are_tied_to_one_another_and_allowed() -> None:
    block = fly(1, 2, 5).block
    allowed = np.arange(10) != 3
    chosen = neighbours(block, allowed, 4)
    assert len(chosen) == 4 and 3 not in chosen and (np.diff(chosen) > 0).all()
    pairs = part_of_block(block, chosen).ties.frames
    assert {i for pair in pairs for i in pair} == set(range(4))
    assert len(neighbours(block, np.zeros(10, dtype=bool), 4)) == 0


def test_a_part_has_the_tracks_that_two_of_its_frames_see() -> None:
    block = fly(1, 2, 5).block
    frames = neighbours(block, np.ones(10, dtype=bool), 4)
    tracks = join_tracks(block.ties)
    part, kept = part_of_tracks(tracks, frames)
    assert part.points == kept.sum() < tracks.points
    assert (part.lengths >= 2).all() and set(part.frame) == set(range(4))
    whole, all_kept = part_of_tracks(tracks, np.arange(10))
    assert all_kept.all() and (whole.image_px == tracks.image_px).all()


def test_a_solution_of_a_part_becomes_one_of_the_whole() -> None:
    """Frames beyond the part follow its median move; shared unknowns pass by name."""
    block = fly(1, 2, 5).block
    one, two = block.cameras[0], replace(block.cameras[0], name="other", focal_length_px=900.0)
    block = replace(block, cameras=(one, *(two, one) * 4, two))
    frames = np.array([1, 2, 5, 6])
    problem = block_problem(block, Settings(), join_tracks(block.ties), np.zeros((5, 3)))
    at = estimate_of(problem, block.poses)
    fixed = np.zeros(at.layout.size, dtype=bool)
    fixed[1] = True
    whole = Start(block.poses, block.lenses, at, Components(), fixed, None)
    part = part_of_block(block, frames)
    begun = part_of_solution(whole, frames, np.zeros((3, 3)))
    layout = block_problem(part, Settings(), join_tracks(part.ties), np.zeros((3, 3))).layout
    assert [u.owner for u in layout.cameras] == ["other", one.name]
    values, still_fixed = begun.shared_in(layout)
    assert values[0] == 900.0 and np.flatnonzero(still_fixed).tolist() == [len(layout.cameras[0].names) + 1]
    moved = replace(begun.poses, positions_m=begun.poses.positions_m + [1.0, 0.0, 2.0])
    rotation_terms = replace(
        begun.estimate, rotation_terms_rad=np.full((4, 2, 3), 0.1), drift=np.ones((4, 3))
    )
    found = solution_of_whole(replace(begun, poses=moved, estimate=rotation_terms), whole, frames)
    assert found.cameras == block.lenses and np.array_equal(found.fixed, fixed)
    assert np.allclose(found.poses.positions_m - block.poses.positions_m, [1.0, 0.0, 2.0])
    turned = found.estimate.rotation_terms_rad.any(axis=(1, 2))
    assert np.array_equal(np.flatnonzero(turned), frames)
    assert len(found.points_m) == 5
