"""What stages tell of the rounds of an adjustment."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest
from adjustment_blocks import fly

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Settings
from geomosaic.camera.rotation import about_x
from geomosaic.stages import reporting


@pytest.mark.parametrize("method", ["none", "error_sharing"])
def test_pairs_that_see_no_ground_together_have_no_misalignment(
    method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One frame looks up: its pairs' tie points lie nowhere. Found by `make fuzz`, seed 922, case 1355."""
    block = fly(1, points=600).block
    rotations = block.poses.rotations.copy()
    rotations[4] = about_x(3.0) @ rotations[4]
    block = replace(block, poses=replace(block.poses, rotations=rotations))
    monkeypatch.setattr(reporting, "is_local", lambda _: True)
    context: Any = MagicMock()
    survey: Any = SimpleNamespace(map_crs="", work_frame=None, left_out=(), frames=())
    adjusted = METHODS[method](block, Settings(), context)
    reporting.record_adjusted(context, survey, block, adjusted, method)
    reported = context.recorder.offsets.call_args.args[2]
    names = {name for left, right, *_ in reported for name in (left, right)}
    assert names == set(block.names) - {block.names[4]}
    assert len(reported) == sum(4 not in pair for pair in block.ties.frames)
