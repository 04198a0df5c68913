"""What `inspect` says beyond the run's own accusations: frames that stand against their line."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from adjustment_blocks import fly

from geomosaic.adjustment.model import Adjusted
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import about_z
from geomosaic.placement.model import Placement
from geomosaic.recording.inspect.solved import Solved
from geomosaic.recording.inspect.worst import _against_their_lines


def _headed(poses: Poses, by_deg: dict[int, float]) -> Poses:
    rotations = poses.rotations.copy()
    for i, deg in by_deg.items():
        rotations[i] = about_z(np.radians(deg)) @ rotations[i]
    return replace(poses, rotations=rotations)


@pytest.mark.parametrize(
    ("given_deg", "found_deg", "tags"),
    [
        ({}, {}, {}),
        ({8: 180.0}, {8: 180.0}, {8: "its tags say so, too"}),
        ({8: 100.0}, {8: 180.0}, {}),  # its tag is wrong, too: that has an explanation
        ({6: 100.0, 7: 70.0, 8: 180.0}, {8: 180.0}, {8: "its tags say so, too"}),  # images count, not tags
        ({8: 180.0, 9: 180.0}, {8: 180.0, 9: 180.0}, {}),  # two of six: the line itself goes both ways
        ({8: 140.0}, {8: 140.0}, {}),  # no half turn to the adjustment either
        (dict.fromkeys(range(6, 12), 180.0), dict.fromkeys(range(6, 12), 180.0), {}),  # flown backward
    ],
)
def test_a_frame_that_stands_on_its_head_in_its_line_is_named(
    given_deg: dict[int, float], found_deg: dict[int, float], tags: dict[int, str]
) -> None:
    flown = fly(1)
    n = len(flown.block.names)
    prior = Placement(_headed(flown.block.poses, given_deg), tuple(range(n)), (0,) * n, (), 0.1, "rigorous")
    nothing: Any = None
    poses = _headed(flown.truth, found_deg)
    adjusted = Adjusted(poses, flown.block.cameras, ("tied",) * n, (), (), nothing)
    survey: Any = SimpleNamespace(frames=[SimpleNamespace(name=name) for name in flown.block.names])
    named = {f.frames[0]: f.text for f in _against_their_lines(Solved(survey, prior, None, None, adjusted))}
    assert set(named) == {flown.block.names[i] for i in tags}
    for i, words in tags.items():
        assert words in named[flown.block.names[i]]
    assert not [*_against_their_lines(Solved(survey, prior, None, None, adjusted), named)], "named already"
