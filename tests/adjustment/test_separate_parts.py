"""A survey in two parts without ties between them: each is adjusted, and each may lie at its own level."""

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import Flown, fly, hills, level
from test_control import surveyed

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Adjusted, Block, Settings
from geomosaic.camera.exterior import Poses
from geomosaic.matching.model import TiePoints
from geomosaic.quality.figures import best_similarity

LOST = (3, 4, 5, 6)


def parted(flown: Flown) -> tuple[Block, Poses, np.ndarray]:
    """Three lines of ten without their middle frames; their truth; the part of each frame."""
    kept = [i for i in range(30) if i % 10 not in LOST]
    number = {i: k for k, i in enumerate(kept)}
    ties = tuple(
        replace(t, left=number[t.left], right=number[t.right])
        for t in flown.block.ties.pairs
        if t.left in number and t.right in number
    )
    part = np.array([int(i % 10 > LOST[0]) for i in kept])
    assert all(part[t.left] == part[t.right] for t in ties)

    def of(p: Poses) -> Poses:
        return Poses(
            *(getattr(p, f)[kept] for f in ("positions_m", "rotations", "positions_sd_m", "rotations_sd_rad"))
        )

    block = replace(
        flown.block,
        names=tuple(flown.block.names[i] for i in kept),
        cameras=flown.block.cameras[: len(kept)],
        poses=of(flown.block.poses),
        ties=TiePoints(ties),
        sequence=tuple(range(len(kept))),
        lines=tuple(flown.block.lines[i] for i in kept),
    )
    return block, of(flown.truth), part


def shape_errors_m(adjusted: Adjusted, truth: Poses, frames: np.ndarray) -> np.ndarray:
    at, found = truth.positions_m[frames, :2], adjusted.poses.positions_m[frames, :2]
    return best_similarity(at, found - at)[1]


@pytest.mark.parametrize("seed", [1, pytest.param(4, marks=pytest.mark.proof)])
def test_flat_ground_stays_flat_at_two_levels(seed: int) -> None:
    """Heights are off by 2 m a frame, so the parts' levels differ by about 1 m: 0.5 to 1 px of relief, were
    they one surface."""
    block, truth, part = parted(fly(seed, lines=3, per_line=10, noise_px=0.1, points=1600, relief=level))
    adjusted = METHODS["bundle"](block, Settings(model="given"))
    assert adjusted.ground.kind == "flat"
    assert set(adjusted.status) == {"tied"}
    for k in (0, 1):
        frames = part == k
        assert np.sqrt(np.mean(shape_errors_m(adjusted, truth, frames) ** 2)) < 0.3
        shift = (adjusted.poses.positions_m - truth.positions_m)[frames, :2].mean(axis=0)
        given = (block.poses.positions_m - truth.positions_m)[frames, :2].mean(axis=0)
        assert shift == pytest.approx(given, abs=0.5), "each part lies where its own positions say"


def test_relief_is_still_seen() -> None:
    block, _, _ = parted(fly(2, lines=3, per_line=10, noise_px=0.1, points=1600, relief=hills))
    assert METHODS["bundle"](block, Settings(model="given")).ground.kind == "tie_surface"


def test_parts_without_positions_lie_on_their_own_control() -> None:
    """Five points in one part, three in the other: one similarity would put the second 80 m off."""
    flown = fly(1, 3, 10, points=1500)
    block, truth, part = parted(flown)
    number = {name: k for k, name in enumerate(block.names)}
    places = [(-5.0, 5.0), (85.0, 0.0), (40.0, 20.0), (-5.0, 35.0), (85.0, 40.0)]
    control = tuple(
        replace(c, observations=seen)
        for c in surveyed(
            flown, np.array([*places, (-5.0, 135.0), (85.0, 140.0), (40.0, 160.0)]), noise_px=0.3
        )
        if (
            seen := tuple(
                (number[n], x, y) for i, x, y in c.observations if (n := flown.block.names[i]) in number
            )
        )
    )
    poses = replace(
        block.poses,
        positions_m=np.tile([40.0, 40.0, 100.0], (len(part), 1)),
        positions_sd_m=np.full((len(part), 3), 1e5),
        rotations_sd_rad=np.tile([0.17, 0.17, np.pi], (len(part), 1)),
    )
    adjusted = METHODS["bundle"](replace(block, poses=poses, control=control), Settings(model="given"))
    off_m = np.linalg.norm(adjusted.poses.positions_m - truth.positions_m, axis=1)
    assert off_m.max() < 3.0
