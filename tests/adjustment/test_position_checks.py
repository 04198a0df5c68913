"""Positions that images contradict: exchanged columns, lost signs, rows of other frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import fly
from numpy.typing import NDArray

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Settings
from geomosaic.adjustment.procedure.position_checks import shift_and_scale
from geomosaic.quality.warned import WARNED

Floats = NDArray[np.float64]


def codes(given: Floats, found: Floats | None = None) -> list[str]:
    """Warnings of a flight of 18 frames with positions given (18, 3) against the true ones, or those found."""
    poses = fly(2).block.poses
    truth = replace(poses, positions_m=fly(2).truth.positions_m if found is None else found)
    block = replace(fly(2).block, poses=replace(poses, positions_m=given))
    return [w.code for w in shift_and_scale(block, truth, np.arange(len(poses)))]


@pytest.mark.parametrize("mirror", [[-1.0, 1.0], [1.0, -1.0], "exchanged"])
def test_mirrored_positions_are_named(mirror: list[float] | str) -> None:
    """A sign lost; or degrees exchanged at 48 degrees north and 11 east."""
    given = fly(2).block.poses.positions_m.copy()
    given[:, :2] = given[:, [1, 0]] * [0.98, 1.50] if mirror == "exchanged" else given[:, :2] * mirror
    assert codes(given) == ["positions-mirrored"]


def test_positions_of_other_frames_are_named() -> None:
    given = fly(2).block.poses.positions_m
    assert codes(given[np.random.default_rng(3).permutation(len(given))]) == ["positions-contradicted"]


@pytest.mark.parametrize("step", [1, -1])
def test_positions_of_the_next_frame_are_named(step: int) -> None:
    """A log that begins one exposure early or late, of lines flown there and back; the last row is the
    first's."""
    poses = fly(2, position_sd_m=np.array([1.5, 1.5, 2.0])).block.poses
    back = [*range(6), *range(11, 5, -1), *range(12, 18)]
    truth = replace(poses, positions_m=fly(2).truth.positions_m[back])
    given = replace(poses, positions_m=np.roll(poses.positions_m[back], step, axis=0))
    (named,) = shift_and_scale(replace(fly(2).block, poses=given), truth, np.arange(len(poses)))
    assert named.code == "positions-out-of-step"
    assert f"that of the one {'before' if step > 0 else 'after'}" in named.text


def test_positions_that_agree_turned_scaled_or_with_blunders_are_not() -> None:
    given = fly(2).block.poses.positions_m
    turned = np.column_stack([given[:, 1], -given[:, 0], given[:, 2]])
    assert not {"positions-mirrored", "positions-contradicted"} & {
        *codes(turned),
        *codes(given * [3.0, 3.0, 1.0]),
    }
    blunders = given.copy()
    blunders[[2, 9, 11]] += [[3e4, 0.0, 0.0], [0.0, 900.0, 0.0], [-80.0, 80.0, 0.0]]
    assert codes(blunders) == codes(given) == []


def test_a_line_has_no_mirror_image() -> None:
    """Its frames may bend by the images, to either side."""
    along = np.column_stack([np.linspace(0.0, 500.0, 18), np.zeros(18), np.full(18, 100.0)])
    bent = along + [[0.0, 8.0 * np.sin(k / 17.0 * np.pi), 0.0] for k in range(18)]
    assert codes(along, bent) == []
    assert "positions-mirrored" not in codes(bent * [1.0, -1.0, 1.0], bent)


def test_the_adjustment_of_a_mirrored_flight_says_so() -> None:
    flown = fly(2)
    poses = flown.block.poses
    mirrored = replace(poses, positions_m=poses.positions_m * [-1.0, 1.0, 1.0])
    adjusted = METHODS["bundle"](replace(flown.block, poses=mirrored), Settings())
    named = {w.code for w in adjusted.warnings}
    assert "positions-mirrored" in named and not {"scale-doubtful", "position-wrong"} & named
    assert WARNED["positions-mirrored"][0] == "bad"
