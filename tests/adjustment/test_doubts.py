"""What an adjusted block says against what it was given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from adjustment_blocks import fly

from geomosaic.adjustment.procedure.blunder_detection import contradicted_frames, wrong_tags
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import exp_turn


def _moved(poses: Poses, frame: int, east_m: float, tilt_deg: float) -> Poses:
    positions, rotations = poses.positions_m.copy(), poses.rotations.copy()
    positions[frame, 0] += east_m
    rotations[frame] = exp_turn(np.radians([[tilt_deg, 0.0, 0.0]]))[0] @ rotations[frame]
    return replace(poses, positions_m=positions, rotations=rotations)


def test_a_frame_that_looks_aside_far_from_its_position_is_left_out() -> None:
    block = fly(1).block
    name = block.names[4]
    for east_m, tilt_deg, strayed in ((200.0, 31.0, [4]), (200.0, 5.0, []), (3.0, 31.0, [])):
        poses = _moved(block.poses, 4, east_m, tilt_deg)
        found = contradicted_frames(block, poses, np.ones(len(poses)))
        assert list(found) == strayed, (east_m, tilt_deg)
        lies = [w.frame for w in wrong_tags(block, poses, found) if w.code == "position-wrong"]
        assert lies == ([name] if east_m > 100.0 and not strayed else [])
        for warning in found.values():
            assert warning.code == "frame-oblique" and warning.frame == name
            assert "200 m from its own position" in warning.text


def test_a_survey_that_looks_aside_keeps_its_frames() -> None:
    block = fly(1).block
    aside = exp_turn(np.radians(np.tile([45.0, 0.0, 0.0], (len(block.names), 1))))
    poses = _moved(replace(block.poses, rotations=aside @ block.poses.rotations), 4, 200.0, 31.0)
    assert contradicted_frames(block, poses, np.ones(len(poses))) == {}


def test_a_position_is_judged_by_how_positions_were_found_to_scatter() -> None:
    """A position is 25 m off where 5 m is the default of the source, and the others agree to 1 m. It is wrong
    if its own place is known. By what is stated it might be right."""
    block = fly(1).block
    given = replace(block.poses, positions_sd_m=np.full((len(block.poses), 3), 5.0))
    for scatter, own_m, named in ((1.0, 0.2, []), (0.3, 0.2, [block.names[4]]), (0.3, 4.5, [])):
        found = _moved(block.poses, 4, 25.0, 0.0)
        found = replace(found, positions_sd_m=np.full((len(found), 3), own_m))
        said = wrong_tags(replace(block, poses=given), found, scatter=scatter)
        assert [w.frame for w in said if w.code == "position-wrong"] == named, (scatter, own_m)
