"""Reported positions of the projection centres, with lever arm, delay and an offset in common."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from geomosaic.adjustment.problem.estimate import Estimate, Unknowns
from geomosaic.adjustment.terms.frame_components import (
    FrameGroup,
    common_similarity,
    common_slope,
    robust_weights,
)
from geomosaic.adjustment.terms.image_observations import ImageObservations
from geomosaic.adjustment.terms.term import Component, Components, FrameTerm
from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import CAMERA_FROM_BODY
from geomosaic.constants import tuned

HORIZONTAL, VERTICAL = "horizontal", "vertical"
LEVER_ARM, DELAY, OFFSET = "lever arm", "GNSS delay", "common offset"
ANYWHERE_M = tuned(1e3, "m", "deviation of what is not known; more: the equations lose their digits")
LEVER_ARM_SD_M = tuned(0.5, "m", "lever arms of small drones; less: one that is asked for is held")
DELAY_SD_S = tuned(1.0, "s", "by which positions are late; less: one that is asked for is held")


@dataclass(frozen=True)
class GnssPositions(FrameTerm):
    """Positions of f frames; residuals by component `horizontal` and `vertical`. reported: positions,
    deviations (inf where unknown) and velocities. assumed (f,): frames whose position is an assumption, which
    tells nothing about the others' deviations. parts: frames of each connected part. lever_arm (forward,
    right, down), delay: solved for. offset_sd_m (3,): of a common offset of all positions, zeros for none."""

    reported: Poses
    assumed: Bools
    parts: tuple[Ints, ...]
    weight: Floats
    lever_arm: bool = False
    delay: bool = False
    offset_sd_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    name: ClassVar[str] = "GNSS positions"

    def unknowns(self) -> tuple[Unknowns, ...]:
        out, zero = [], np.zeros(3)
        if self.lever_arm:
            names = "lever_arm_forward_m", "lever_arm_right_m", "lever_arm_down_m"
            out.append(Unknowns(LEVER_ARM, "platform", names, zero, np.full(3, LEVER_ARM_SD_M)))
        if self.delay:
            out.append(Unknowns(DELAY, "platform", ("gps_lag_s",), zero[:1], np.full(1, DELAY_SD_S)))
        if any(self.offset_sd_m):
            names = "offset_east_m", "offset_north_m", "offset_up_m"
            out.append(Unknowns(OFFSET, "positions", names, zero, np.array(self.offset_sd_m), optional=False))
        return tuple(out)

    def component_names(self) -> tuple[str, ...]:
        return HORIZONTAL, VERTICAL

    def columns(self, at: Estimate) -> slice:
        return slice(0, 3)

    def miss(self, at: Estimate) -> Floats:
        lever = CAMERA_FROM_BODY @ at.value(LEVER_ARM, 3)
        computed = at.positions_m + at.rotations @ lever + at.value(OFFSET, 3)
        if self.reported.velocities_m_per_s is not None:
            computed = computed - at.value(DELAY, 1) * self.reported.velocities_m_per_s
        return np.asarray(self.reported.positions_m - computed)

    def sd(self, components: Components) -> Floats:
        plan, height = components[HORIZONTAL], components[VERTICAL]
        sd_m = self.reported.positions_sd_m * [plan, plan, height]
        return np.asarray(np.where(np.isfinite(sd_m), sd_m, np.inf))

    def derivatives(self, at: Estimate) -> tuple[Floats, list[tuple[str, Floats]]]:
        f = len(at.rotations)
        lever = at.rotations @ (CAMERA_FROM_BODY @ at.value(LEVER_ARM, 3))
        by_pose = np.broadcast_to(np.eye(3, 6), (f, 3, 6)).copy()
        by_pose[:, :, 3:] = -np.cross(np.eye(3), lever[:, None, :])
        shared = [(LEVER_ARM, at.rotations @ CAMERA_FROM_BODY)]
        if self.reported.velocities_m_per_s is not None:
            shared.append((DELAY, -self.reported.velocities_m_per_s[:, :, None]))
        shared.append((OFFSET, np.broadcast_to(np.eye(3), (f, 3, 3))))
        return by_pose, shared

    def own_miss(self, at: Estimate, components: Components) -> tuple[Floats, int]:
        """Residuals (f, 3) without what the frames of each part have in common (a similarity of the plane, a
        height that may slope), 0 of assumed positions; and in how many parts the height slopes."""
        miss, sd = self.miss(at), self.sd(components)
        out, slopes = miss.copy(), 0
        for part in self.parts:
            frames = part[~self.assumed[part]]
            if not len(frames):
                continue
            plan = at.positions_m[frames, :2]
            out[frames, :2] -= common_similarity(plan, miss[frames, :2], sd[frames, :2])
            tilt_sd_rad = float(np.median(self.reported.rotations_sd_rad[frames, :2]))
            common = common_slope(plan, miss[frames, 2], sd[frames, 2], tilt_sd_rad)
            slopes += bool(np.ptp(common))
            out[frames, 2] -= common
        return np.where(self.assumed[:, None], 0.0, out), slopes

    def components(self, at: Estimate, components: Components, variances: Floats) -> Iterator[Component]:
        (own, slopes), observed = self.own_miss(at, components), ~self.assumed[:, None]
        share, sd = variances[:, self.columns(at)] * self.information(components), self.sd(components)
        # in common: a similarity in plan, a level; of parts that slope two numbers more
        for name, numbers, common in ((HORIZONTAL, [0, 1], 4.0), (VERTICAL, [2], 1.0)):
            counted = np.isin(np.arange(3), numbers) & observed
            more = 2.0 * slopes if name == VERTICAL else 0.0
            group = FrameGroup(name, counted, sd, self.weight, own, self.parts, common, more)
            yield group.component(components[name], share, variances.shape[1], 0)

    def reweighted(self, image: ImageObservations, at: Estimate, components: Components) -> Self:
        own = self.own_miss(at, components)[0] / self.sd(components)
        observed = np.broadcast_to(~self.assumed[:, None], own.shape)
        return replace(self, weight=robust_weights(own, observed, self.parts, ([0, 1], [2])))

    def without(self, frames: Bools, at: Estimate) -> Self:
        stay, sd_m = frames[:, None], self.reported.positions_sd_m
        reported = replace(
            self.reported,
            positions_m=np.where(stay, at.positions_m, self.reported.positions_m),
            positions_sd_m=np.where(stay, np.minimum(sd_m, ANYWHERE_M), sd_m),
        )
        return replace(self, reported=reported)
