"""What is said of a run's progress where no terminal is: how much is done, and the time left."""

from __future__ import annotations

import io

import pytest

from geomosaic.cli import progress


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time, to be set."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_lines_say_the_time_left_of_these_items(clock: list[float]) -> None:
    """Ten that were there from before took no time; 20 of the others took 40 s, 70 are left."""
    said = io.StringIO()
    lines = progress.ProgressLines(said)
    lines.stage_started(5, 18, "Match frames")
    lines.progress(10, 100, "pairs")
    clock[0] += 40.0
    lines.progress(30, 100, "pairs")
    clock[0] += 20.0
    lines.progress(0, 50, "tie points")
    clock[0] += 5.0
    lines.progress(10, 50, "tie points")
    clock[0] += 5.0
    lines.progress(20, 50, "tie points")
    assert said.getvalue().splitlines() == [
        "[6/18] Match frames: pairs 30 of 100, 3 min left",
        "[6/18] Match frames: tie points 0 of 50",
        "[6/18] Match frames: tie points 20 of 50, 15 s left",
    ]


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.2, "1 s"), (89.5, "90 s"), (91.0, "2 min"), (5399.0, "90 min"), (9000.0, "2.5 h")],
)
def test_times_are_rounded_up(seconds: float, words: str) -> None:
    assert progress._duration(seconds) == words
