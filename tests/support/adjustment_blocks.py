"""Blocks of frames with known truth and stated noise, without images, for the tests of the bundle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from geomosaic.adjustment.kernels.interior import INTERIOR, interior_of
from geomosaic.adjustment.model import Block
from geomosaic.adjustment.problem.estimate import Estimate, UnknownLayout, Unknowns
from geomosaic.adjustment.solver.problem import BlockProblem
from geomosaic.adjustment.terms.attitudes import Attitudes
from geomosaic.adjustment.terms.gnss_positions import GnssPositions
from geomosaic.adjustment.terms.rolling_shutter_rotation import RollingShutterRotation
from geomosaic.adjustment.terms.terrain import level_unknown
from geomosaic.camera.exterior import Poses, Turns
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation, about_x, about_z, exp_turn
from geomosaic.matching.model import TiePair, TiePoints
from geomosaic.projection.ground import GroundSurface

POSITION_SD_M = np.array([1.5, 1.5, 2.0])
TURN_SD_RAD = np.radians([0.3, 0.3, 1.0])


@dataclass(frozen=True)
class Flown:
    """A block with noise and the poses it was flown with."""

    block: Block
    truth: Poses
    rng: np.random.Generator

    def seen(self, ground_m: np.ndarray, noise_px: float = 0.0) -> list[tuple[int, float, float]]:
        """Frame, col and row of every image of a ground point (3,), with noise."""
        out = []
        for i, camera in enumerate(self.block.cameras):
            col, row = self.truth[i].image_from_ground(camera, ground_m) + self.rng.normal(0, noise_px, 2)
            if 0.0 < col < camera.width_px and 0.0 < row < camera.height_px:
                out.append((i, float(col), float(row)))
        return out


def level(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Land at zero."""
    return np.zeros(np.broadcast(east, north).shape)


def hills(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Hills of 15 m, a seventh of the flying height."""
    return 7.5 * np.sin(east / 23.0 + 0.4) * np.cos(north / 31.0)


def fly(
    seed: int,
    lines: int = 3,
    per_line: int = 6,
    *,
    noise_px: float = 0.3,
    points: int = 900,
    relief=level,  # type: ignore[no-untyped-def]
    ground: GroundSurface | None = None,
    position_sd_m: np.ndarray = POSITION_SD_M,
    there_and_back: bool = False,
    crossed: bool = False,
    readout_s: float = 0.0,
    rate_sd_rad_per_s: float = 0.0,
    shaking_hz: float = 0.0,
    swaying_px: float = 0.0,
    gusts_px: float = 0.0,
    unreported_m_per_s: np.ndarray | float = 0.0,
    lens: Camera | None = None,
    aslant_deg: Mapping[int, float] | None = None,
    low_m: Mapping[int, float] | None = None,
) -> Flown:
    """At 15 m/s, each second line back or, crossed, west, if asked; all north otherwise, and apart from that as nobody
    tells. While they are read, frames turn at a
    rate of their own, or shake; some look forward by so many degrees, some fly only so high. What stands on every second square of 20 m sways in the wind; gusts move all land, alike from neighbour to neighbour. Nadir frames of 800 x 600 px at 100 m (0.1 m a pixel), 70 % forward and 50 % side overlap."""
    rng = np.random.default_rng(seed)
    n = lines * per_line
    camera = lens or Camera("plain", 800, 600, 1000.0, 402.0, 297.0, k1=-0.02, readout_s=readout_s)
    back = (np.arange(n) // per_line % 2 == 1) & there_and_back
    heading = np.pi * back + np.pi / 2.0 * ((np.arange(n) // per_line % 2 == 1) & crossed)
    velocities = 15.0 * np.column_stack([-np.sin(heading), np.cos(heading), np.zeros(n)])
    at = np.array([[40.0 * (i // per_line), 18.0 * (i % per_line), 100.0] for i in range(n)])
    for i, up in (low_m or {}).items():
        at[i, 2] = up
    truth = Poses(
        at + rng.normal(0, [1.0, 1.0, 0.5], (n, 3)),
        about_z(heading)
        @ Rotation.from_yaw_pitch_roll(*rng.normal(0, np.radians([2.0, 1.0, 1.0]), (n, 3)).T).matrix,
        np.zeros((n, 3)),
        np.zeros((n, 3)),
        velocities,
    )
    truth = replace(truth, velocities_m_per_s=velocities + unreported_m_per_s)
    for i, degrees in (aslant_deg or {}).items():
        truth.rotations[i] = truth.rotations[i] @ about_x(np.radians(degrees))
    if rate_sd_rad_per_s:
        rates = np.random.default_rng(seed + 1).normal(0.0, rate_sd_rad_per_s, (n, 1, 3))
        after_s = np.linspace(-0.5, 0.5, 41)[:, None] * readout_s
        phase, round_s = np.random.default_rng(seed + 2).uniform(0, 6.3, (n, 1, 3)), 6.283 * shaking_hz
        shaking = (np.cos(phase) - np.cos(round_s * after_s + phase)) / max(round_s, 1e-9)
        truth = replace(truth, turns=Turns(readout_s, rates * (shaking if shaking_hz else after_s)))
    margin_m = np.array([35.0, 25.0]) * (1.25 * camera.width_px / camera.focal_length_px) ** 2
    low, high = at[:, :2].min(axis=0) - margin_m, at[:, :2].max(axis=0) + margin_m
    plan = rng.uniform(low, high, (points, 2))
    land = np.column_stack([plan, relief(*plan.T)])
    seen = [truth[i].image_from_ground(camera, land) for i in range(n)]
    inside = [
        np.all((px > 5.0) & (px < [camera.width_px - 5.0, camera.height_px - 5.0]), axis=1) for px in seen
    ]
    measured = [px + rng.normal(0, noise_px, px.shape) for px in seen]
    sways = np.floor(plan / 20.0).sum(axis=1) % 2.0 == 0.0
    for i, px in enumerate(measured):
        wind = np.random.default_rng([seed, i])
        px[sways] += wind.normal(0.0, swaying_px, px[sways].shape)
        if gusts_px:
            waves, phases = wind.normal(0.0, 0.2, (12, 2)), wind.uniform(0.0, 6.3, 12)
            px += gusts_px / np.sqrt(6.0) * np.sin(plan @ waves.T + phases) @ wind.normal(0.0, 1.0, (12, 2))
    ties = []
    for i in range(n):
        for j in range(i + 1, n):
            both = np.flatnonzero(inside[i] & inside[j])
            if len(both) >= 12:
                number = both.astype(np.int32)
                ties.append(TiePair(i, j, measured[i][both], measured[j][both], number, number))
    poses = Poses(
        truth.positions_m + rng.normal(0, position_sd_m, (n, 3)),
        exp_turn(rng.normal(0, TURN_SD_RAD, (n, 3))) @ truth.rotations,
        np.tile(position_sd_m, (n, 1)),
        np.tile(TURN_SD_RAD, (n, 1)),
        velocities,
    )
    flat = GroundSurface("flat", 0.0, 0.0, 1.0, np.zeros((1, 1)))
    block = Block(
        tuple(f"{i:03d}.jpg" for i in range(n)), (camera,) * n, poses, ground or flat, TiePoints(tuple(ties)),
        tuple(range(n)), tuple(i // per_line for i in range(n)), 0.1,
    )  # fmt: skip
    return Flown(block, truth, rng)


def camera_unknowns(camera: Camera, sd: np.ndarray) -> Unknowns:
    """A camera's numbers with prior deviations (9,)."""
    return Unknowns(camera.name, camera.name, INTERIOR, interior_of(camera), sd)


def layout_of(cameras: tuple[Camera, ...], interior_sd: np.ndarray) -> UnknownLayout:
    """The shared unknowns of cameras with prior deviations (c, 9), and the ground's level."""
    parts = [camera_unknowns(c, sd) for c, sd in zip(cameras, interior_sd, strict=True)]
    return UnknownLayout(tuple(parts), level_unknown(1.0), ())


def frame_terms(reported: Poses) -> tuple[GnssPositions, Attitudes]:
    """Positions with lever arm, delay and offset, and attitudes with boresight, of one connected part."""
    n, parts = len(reported), (np.arange(len(reported)),)
    one, assumed = np.ones((n, 3)), np.zeros(n, dtype=bool)
    asked = {"lever_arm": True, "delay": True, "offset_sd_m": (1.0, 1.5, 3.0)}
    return (
        GnssPositions(reported, assumed, parts, one, **asked),
        Attitudes(reported, parts, one, boresight=True),
    )


def estimate_of(problem: BlockProblem, poses: Poses) -> Estimate:
    """Poses with the prior values of all other unknowns."""
    layout, frames = problem.layout, len(poses)
    terms = next((t.terms for t in problem.frames if isinstance(t, RollingShutterRotation)), 0)
    while_read = np.zeros((frames, terms, 3)), np.zeros((frames, 3))
    at = poses.positions_m, poses.rotations, problem.points.given_m
    return Estimate(layout, *at, layout.given, *while_read)
