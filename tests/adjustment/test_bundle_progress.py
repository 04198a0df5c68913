"""How far the adjustment of one block has come."""

from __future__ import annotations

import pytest
from adjustment_blocks import fly

from geomosaic.adjustment.model import Settings
from geomosaic.adjustment.procedure.bundle_method import PROCEDURE, pose_block
from geomosaic.errors import CancelledError
from geomosaic.spread import AtOnce


class Watched(AtOnce):
    """Keeps what is shown, and stops the work at a step."""

    def __init__(self, stop_at: str = "") -> None:
        self.shown: list[tuple[int, int, str]] = []
        self._stop_at = stop_at

    def progress(self, done: int, total: int, text: str = "") -> None:
        self.shown.append((done, total, text))
        if text == self._stop_at:
            raise CancelledError


def test_each_step_is_shown_when_it_begins() -> None:
    watched = Watched()
    pose_block(fly(1).block, Settings(), watched)
    steps = [(k, len(PROCEDURE), f"{name}, step") for k, name in enumerate(PROCEDURE)]
    assert watched.shown[-len(steps) :] == steps
    assert watched.shown[-len(steps) - 1] == (0, len(steps), "first solution, step")


def test_an_adjustment_can_be_stopped_between_its_steps() -> None:
    watched = Watched(stop_at="all tie points, step")
    with pytest.raises(CancelledError):
        pose_block(fly(1).block, Settings(), watched)
    assert watched.shown[-1][2] == "all tie points, step"
