"""The adjustment methods by name. Each is a function of a block and the shared settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import Adjusted, Block, Round, Settings
from geomosaic.adjustment.paper import offsets
from geomosaic.adjustment.paper.chain import chain
from geomosaic.adjustment.paper.least_squares import least_squares
from geomosaic.adjustment.paper.misalignment import OffsetNet, offset_net
from geomosaic.adjustment.procedure.bundle_method import pose_block
from geomosaic.adjustment.procedure.outcome import settled
from geomosaic.camera.rotation import about_z
from geomosaic.spread import Spread

Floats = NDArray[np.float64]


class Method(Protocol):
    """Returns the adjusted block. spread: runs work in parallel; None for this process alone."""

    def __call__(self, block: Block, settings: Settings, spread: Spread | None = None) -> Adjusted: ...


def _in_process(solve: Callable[[Block, OffsetNet, Settings], Adjusted]) -> Method:
    return lambda block, settings, spread=None: solve(block, offset_net(block), settings)


def _shifted(block: Block, moved: offsets.Moves, sd_m: Floats | None = None) -> Adjusted:
    """The block after moves in plan; sd_m (n,): their deviations per axis, where the method has them."""
    (moves, rounds), sd = moved, block.poses.positions_sd_m
    positions_m = block.poses.positions_m + np.column_stack([moves, np.zeros(len(moves))])
    sd = sd if sd_m is None else np.column_stack([sd_m, sd_m, sd[:, 2]])
    return settled(block, replace(block.poses, positions_m=positions_m, positions_sd_m=sd), rounds)


def _none(block: Block, net: OffsetNet, _: Settings) -> Adjusted:
    return _shifted(block, offsets.none(net))


def _error_sharing(block: Block, net: OffsetNet, settings: Settings) -> Adjusted:
    epsilon_m = settings.epsilon_px * block.ground_pixel_m
    return _shifted(block, offsets.error_sharing(net, epsilon_m, settings.max_rounds))


def _base_frame(block: Block, net: OffsetNet, _: Settings) -> Adjusted:
    return _shifted(block, offsets.base_frame(net, block.sequence))


def _layered(block: Block, net: OffsetNet, _: Settings) -> Adjusted:
    return _shifted(block, offsets.layered(net, block.sequence))


def _chain(block: Block, net: OffsetNet, _: Settings) -> Adjusted:
    """A similarity of the ground plane is a turn about the vertical, a shift, and a change of height."""
    turn, shift = chain(net, block.sequence)
    poses = block.poses
    east_m, north_m, up_m = poses.positions_m.T
    move = turn * (east_m + 1j * north_m) + shift
    ground_m = block.ground.up_at(east_m, north_m)
    up_m = ground_m + np.abs(turn) * (up_m - ground_m)
    moved = replace(
        poses,
        positions_m=np.column_stack([move.real, move.imag, up_m]),
        rotations=about_z(np.angle(turn)) @ poses.rotations,
    )
    moves = (moved.positions_m - poses.positions_m)[:, :2]
    return settled(block, moved, (Round(net.misalignments_m(np.zeros((net.n, 2))), moves),))


def _least_squares(block: Block, net: OffsetNet, _: Settings) -> Adjusted:
    moves, sd_m = least_squares(net, *_deviations_m(block, net))
    return _shifted(block, (moves, offsets.rounds_of(net, moves)), sd_m)


def _deviations_m(block: Block, net: OffsetNet) -> tuple[Floats, Floats]:
    """Standard deviations of the offset model in metres: of each frame's ground (n,), of each pair (m,).

    A frame's ground is off by its position and by height times tilt. A pair differs from a pure offset by
    yaw and height errors half a base away from either nadir point; at least by half a ground pixel.
    """
    poses = block.poses
    height = poses.positions_m[:, 2] - block.ground.up_at(poses.positions_m[:, 0], poses.positions_m[:, 1])
    tilt = np.minimum(poses.rotations_sd_rad[:, :2].mean(axis=1), 0.5)
    frame = np.hypot(poses.positions_sd_m[:, :2].mean(axis=1), height * tilt)
    a, b = net.pairs.T
    half_base = np.linalg.norm(poses.positions_m[a, :2] - poses.positions_m[b, :2], axis=1) / 2.0
    per_metre = np.hypot(np.minimum(poses.rotations_sd_rad[:, 2], 1.0), poses.positions_sd_m[:, 2] / height)
    pair = half_base * np.hypot(per_metre[a], per_metre[b])
    return frame, np.maximum(pair, 0.5 * block.ground_pixel_m)


METHODS: dict[str, Method] = {
    "none": _in_process(_none),
    "chain": _in_process(_chain),
    "layered": _in_process(_layered),
    "base_frame": _in_process(_base_frame),
    "error_sharing": _in_process(_error_sharing),
    "least_squares": _in_process(_least_squares),
    "bundle": pose_block,
}
