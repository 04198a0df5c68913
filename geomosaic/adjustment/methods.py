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
from geomosaic.adjustment.procedure.outcome import outcome
from geomosaic.camera.rotation import about_z
from geomosaic.spread import Spread

Floats = NDArray[np.float64]


def _slid(block: Block, moves: Floats, rounds: tuple[Round, ...], sd_m: Floats | None = None) -> Adjusted:
    poses = block.poses
    positions = poses.positions_m + np.column_stack([moves, np.zeros(len(moves))])
    sd = poses.positions_sd_m
    if sd_m is not None:
        sd = np.column_stack([sd_m, sd_m, sd[:, 2]])
    return outcome(block, replace(poses, positions_m=positions, positions_sd_m=sd), rounds)


def _none(block: Block, settings: Settings) -> Adjusted:
    return _slid(block, *offsets.none(offset_net(block)))


def _error_sharing(block: Block, settings: Settings) -> Adjusted:
    epsilon_m = settings.epsilon_px * block.ground_pixel_m
    return _slid(block, *offsets.error_sharing(offset_net(block), epsilon_m, settings.max_rounds))


def _base_frame(block: Block, settings: Settings) -> Adjusted:
    return _slid(block, *offsets.base_frame(offset_net(block), block.sequence))


def _layered(block: Block, settings: Settings) -> Adjusted:
    return _slid(block, *offsets.layered(offset_net(block), block.sequence))


def _chain(block: Block, settings: Settings) -> Adjusted:
    """A similarity of the ground plane is a turn about the vertical, a shift, and a change of height."""
    net = offset_net(block)
    turn, shift = chain(net, block.sequence)
    poses = block.poses
    z = poses.positions_m[:, 0] + 1j * poses.positions_m[:, 1]
    moved = turn * z + shift
    ground_up = block.ground.up_at(poses.positions_m[:, 0], poses.positions_m[:, 1])
    up = ground_up + np.abs(turn) * (poses.positions_m[:, 2] - ground_up)
    laid = replace(
        poses,
        positions_m=np.column_stack([moved.real, moved.imag, up]),
        rotations=about_z(np.angle(turn)) @ poses.rotations,
    )
    still = np.zeros((net.n, 2))
    moves = np.column_stack([(moved - z).real, (moved - z).imag])
    return outcome(block, laid, (Round(net.misalignments_m(still), moves),))


def _least_squares(block: Block, settings: Settings) -> Adjusted:
    net = offset_net(block)
    prior_sd_m, pair_sd_m = offset_deviations_m(block, net)
    moves, sd_m = least_squares(net, prior_sd_m, pair_sd_m)
    still = np.zeros_like(moves)
    rounds = (Round(net.misalignments_m(still), moves), Round(net.misalignments_m(moves), still))
    return _slid(block, moves, rounds, sd_m)


def offset_deviations_m(block: Block, net: OffsetNet) -> tuple[Floats, Floats]:
    """Standard deviations of the offset model: of each frame's POS (n,), of each pair (m,).

    A frame's ground is off by its position and by height times tilt. A pair's mean disagreement
    differs from a pure offset by what yaw and height errors do at the overlap, half a base away from
    either nadir point; never less than half a ground pixel.
    """
    poses = block.poses
    height = poses.positions_m[:, 2] - block.ground.up_at(poses.positions_m[:, 0], poses.positions_m[:, 1])
    horizontal = poses.positions_sd_m[:, :2].mean(axis=1)
    tilt = np.minimum(poses.rotations_sd_rad[:, :2].mean(axis=1), 0.5)
    prior = np.hypot(horizontal, height * tilt)
    a, b = net.pairs.T
    half_base = np.linalg.norm(poses.positions_m[a, :2] - poses.positions_m[b, :2], axis=1) / 2.0
    per_metre = np.hypot(np.minimum(poses.rotations_sd_rad[:, 2], 1.0), poses.positions_sd_m[:, 2] / height)
    pair = half_base * np.hypot(per_metre[a], per_metre[b])
    return prior, np.maximum(pair, 0.5 * block.ground_pixel_m)


class Method(Protocol):
    """spread: who makes what can be made side by side; None for this process alone."""

    def __call__(self, block: Block, settings: Settings, spread: Spread | None = None) -> Adjusted: ...


def _in_one(method: Callable[[Block, Settings], Adjusted]) -> Method:
    """A method that makes nothing side by side."""
    return lambda block, settings, spread=None: method(block, settings)


METHODS: dict[str, Method] = {
    "none": _in_one(_none),
    "chain": _in_one(_chain),
    "layered": _in_one(_layered),
    "base_frame": _in_one(_base_frame),
    "error_sharing": _in_one(_error_sharing),
    "least_squares": _in_one(_least_squares),
    "bundle": pose_block,
}
