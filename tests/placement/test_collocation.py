"""Frames without tie points go where the tied ones around them went."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import Flown, fly

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import GroundControl, Settings
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import exp_turn, log_turn
from geomosaic.matching.model import TiePoints
from geomosaic.placement.collocation import moved_with_neighbours
from geomosaic.quality.control import control_warnings

UNTIED = [5, 16]
"""The end of the first line, and a frame in the last."""


def without_ties(flown: Flown) -> TiePoints:
    return TiePoints(tuple(t for t in flown.block.ties.pairs if not {t.left, t.right} & set(UNTIED)))


def control(
    flown: Flown, plan_m: np.ndarray, *, check: bool, only: list[int] | None = None
) -> list[GroundControl]:
    out = []
    for k, at in enumerate(np.column_stack([plan_m, np.zeros(len(plan_m))])):
        seen = [o for o in flown.seen(at, 0.3) if (o[0] in only if only else o[0] not in UNTIED)]
        if seen:
            out.append(GroundControl(f"{k}{check:d}", at, np.full(3, 0.02), check, tuple(seen)))
    return out


def test_untied_frames_follow_a_block_that_control_moves() -> None:
    """Positions are 5 m off in common and 0.3 m each; headings 4 degrees. Control holds the block."""
    flown = fly(4, position_sd_m=np.array([0.3, 0.3, 0.3]), points=500)
    poses = flown.block.poses
    turned = exp_turn(np.tile([0.0, 0.0, np.radians(4.0)], (len(poses), 1))) @ poses.rotations
    off = replace(poses, positions_m=poses.positions_m + [4.0, -3.0, 2.0], rotations=turned)
    corners = np.array([[-15.0, -10.0], [95.0, -10.0], [95.0, 60.0], [-15.0, 60.0], [40.0, 45.0]])
    judges = flown.truth.positions_m[UNTIED, :2] + [2.0, -3.0]
    points = (*control(flown, corners, check=False), *control(flown, judges, check=True, only=UNTIED))
    block = replace(flown.block, poses=off, ties=without_ties(flown), control=points)
    adjusted = METHODS["bundle"](block, Settings(model="given"))
    assert [adjusted.status[i] for i in UNTIED] == ["placed"] * 2
    away = adjusted.poses.positions_m[UNTIED] - flown.truth.positions_m[UNTIED]
    sd = adjusted.poses.positions_sd_m[UNTIED]
    assert np.all(np.abs(away) < 3.0 * sd) and np.all(sd < 1.0)
    turned = log_turn(np.swapaxes(flown.truth.rotations, 1, 2) @ adjusted.poses.rotations)[UNTIED, 2]
    assert np.all(np.abs(turned) < 3.0 * adjusted.poses.rotations_sd_rad[UNTIED, 2])
    assert np.degrees(np.abs(turned)).max() < 3.0
    checks = [c for c in adjusted.control if c.check]
    assert len(checks) == 2
    for c in checks:
        assert np.all(np.abs(c.residual_m) < 3.0 * c.sd_m) and np.hypot(*c.sd_m[:2]) < 3.0
    assert not [w for w in control_warnings(adjusted.control) if w.code == "check-disagrees"]


@pytest.mark.parametrize("kind", [pytest.param("similarity", marks=pytest.mark.proof), "drift", "few"])
def test_the_deviation_of_the_prediction_is_right(kind: str) -> None:
    """Of 40 frames left out one by one, errors are as large as stated."""
    rng = np.random.default_rng(5)
    n = 4 if kind == "few" else 40
    at = np.column_stack([30.0 * (np.arange(n) % 8), 40.0 * (np.arange(n) // 8), np.full(n, 100.0)])
    given = Poses(at, np.tile(np.eye(3), (n, 1, 1)), np.full((n, 3), 1.0), np.radians(np.full((n, 3), 1.0)))
    centred = at[:, :2] - at[:, :2].mean(axis=0)
    truth = at + [3.0, -5.0, 8.0] + rng.normal(0.0, 1.0 if kind == "few" else 0.3, (n, 3))
    if kind == "similarity":
        truth[:, :2] += centred @ np.array([[0.02, 0.05], [-0.05, 0.02]])
    if kind == "drift":
        truth[:, 2] += 10.0 * np.sin(at[:, 1] / 60.0)
    turned = exp_turn(np.radians(rng.normal([1.0, -2.0, 6.0], 0.5, (n, 3))))
    sure = {"positions_sd_m": np.full((n, 3), 0.02), "rotations_sd_rad": np.full((n, 3), 1e-4)}
    found = replace(given, positions_m=truth, rotations=turned, **sure)
    errors, angles = [], []
    for i in range(n):
        alone = np.arange(n) == i
        start = replace(found, positions_m=np.where(alone[:, None], at, truth))
        moved = moved_with_neighbours(given, start, ~alone, alone)
        errors.append((moved.positions_m[i] - truth[i]) / moved.positions_sd_m[i])
        angles.append(log_turn((moved.rotations[i].T @ turned[i])[None])[0] / moved.rotations_sd_rad[i])
        assert np.array_equal(moved.positions_m[~alone], truth[~alone])
    low = 0.3 if kind == "few" else 0.75
    for values in (errors, angles):
        assert low < np.sqrt(np.mean(np.square(values))) < 1.3
    if kind == "few":
        assert np.abs(np.array(errors)).max() < 3.0


def test_without_tied_frames_nothing_moves() -> None:
    flown = fly(6, 1, 4)
    poses, none = flown.block.poses, np.zeros(4, dtype=bool)
    assert moved_with_neighbours(poses, poses, none, ~none) is poses
