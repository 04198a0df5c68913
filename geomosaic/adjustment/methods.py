"""The adjustment methods by name. Each is a function of a block and the shared settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import numpy as np

from geomosaic.adjustment.model import Adjusted, Block, Round, Settings
from geomosaic.adjustment.paper import offsets
from geomosaic.adjustment.paper.misalignment import OffsetNet, offset_net
from geomosaic.adjustment.paper.offsets import chain, least_squares
from geomosaic.adjustment.procedure.bundle_method import pose_block
from geomosaic.adjustment.procedure.outcome import outcome
from geomosaic.arrays import Floats
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import about_z
from geomosaic.spread import Spread


class Method(Protocol):
    """Returns the adjusted block. spread: runs work in parallel; None for this process alone."""

    def __call__(self, block: Block, settings: Settings, spread: Spread | None = None) -> Adjusted: ...


def _shifting(solve: Callable[[OffsetNet, Block, Settings], offsets.Moves]) -> Method:
    """A method that shifts frames over the map."""

    def method(block: Block, settings: Settings, spread: Spread | None = None) -> Adjusted:
        moves, rounds = solve(offset_net(block), block, settings)
        return outcome(block, _shifted(block.poses, moves), rounds)

    return method


def _shifted(poses: Poses, moves: Floats) -> Poses:
    return replace(poses, positions_m=poses.positions_m + np.column_stack([moves, np.zeros(len(moves))]))


def _chain(block: Block, settings: Settings, spread: Spread | None = None) -> Adjusted:
    """A similarity of the ground plane is a turn about the vertical, a shift, and a change of height."""
    net, poses = offset_net(block), block.poses
    turn, shift = chain(net, block.sequence)
    east_m, north_m, up_m = poses.positions_m.T
    to = turn * (east_m + 1j * north_m) + shift
    ground_m = block.ground.up_at(east_m, north_m)
    positions_m = np.column_stack([to.real, to.imag, ground_m + np.abs(turn) * (up_m - ground_m)])
    moved = replace(poses, positions_m=positions_m, rotations=about_z(np.angle(turn)) @ poses.rotations)
    moves = (positions_m - poses.positions_m)[:, :2]
    return outcome(block, moved, (Round(net.misalignments_m(np.zeros_like(moves)), moves),))


def _least_squares(block: Block, settings: Settings, spread: Spread | None = None) -> Adjusted:
    net, sd_up_m = offset_net(block), block.poses.positions_sd_m[:, 2]
    moves, sd_m = least_squares(net, *_deviations_m(block, net))
    moved = replace(_shifted(block.poses, moves), positions_sd_m=np.column_stack([sd_m, sd_m, sd_up_m]))
    return outcome(block, moved, offsets.rounds_of(net, moves))


def _deviations_m(block: Block, net: OffsetNet) -> tuple[Floats, Floats]:
    """Standard deviations of the offset model in metres: of each frame's ground (n,) and of each pair (m,). A
    frame's follows from its position and from height times tilt. A pair's follows from yaw and height errors
    half a base away from either nadir point, and is at least half a ground pixel."""
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
    "none": _shifting(lambda net, block, settings: offsets.error_sharing(net, np.inf, 1)),
    "chain": _chain,
    "layered": _shifting(lambda net, block, settings: offsets.layered(net, block.sequence)),
    "base_frame": _shifting(lambda net, block, settings: offsets.base_frame(net, block.sequence)),
    "error_sharing": _shifting(
        lambda net, block, settings: offsets.error_sharing(
            net, settings.epsilon_px * block.ground_pixel_m, settings.max_rounds
        )
    ),
    "least_squares": _least_squares,
    "bundle": pose_block,
}
