"""Reported positions of the projection centres, with lever arm, delay and an offset of each flight."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
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
LEVER_ARM, DELAY, OFFSET = "lever arm", "GNSS delay", "offset of a flight"
ANYWHERE_M = tuned(1e3, "m", "deviation of what is not known; more: the equations lose their digits")
LEVER_ARM_SD_M = tuned(0.5, "m", "lever arms of small drones; less: a requested one is fixed")
DELAY_SD_S = tuned(1.0, "s", "by which positions are late; less: a requested one is fixed")


@dataclass(frozen=True)
class GnssPositions(FrameTerm):
    """Positions of f frames; residuals by component `horizontal` and `vertical`. reported: positions,
    deviations (inf where unknown) and velocities. assumed (f,): frames whose position is an assumption, which
    tells nothing about the others' deviations. parts: frames of each connected part. lever_arm (forward,
    right, down), delay: solved for. offset_sd_m (3,): of an offset that the positions of each flight have in
    common, zeros for none; flight (f,): numbers from 0 on, empty for one flight."""

    reported: Poses
    assumed: Bools
    parts: tuple[Ints, ...]
    weight: Floats
    lever_arm: bool = False
    delay: bool = False
    offset_sd_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    flight: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.intp))

    name: ClassVar[str] = "GNSS positions"

    def unknowns(self) -> tuple[Unknowns, ...]:
        out, zero = [], np.zeros(3)
        if self.lever_arm:
            names = "lever_arm_forward_m", "lever_arm_right_m", "lever_arm_down_m"
            out.append(Unknowns(LEVER_ARM, "platform", names, zero, np.full(3, LEVER_ARM_SD_M)))
        if self.delay:
            out.append(Unknowns(DELAY, "platform", ("gps_lag_s",), zero[:1], np.full(1, DELAY_SD_S)))
        if any(self.offset_sd_m):
            k = self.flights
            which = [f"_{flight + 1}" for flight in range(k)] if k > 1 else [""]
            axes = tuple(f"offset_{axis}{flight}_m" for flight in which for axis in ("east", "north", "up"))
            sd_m = np.tile(self.offset_sd_m, k)
            out.append(Unknowns(OFFSET, "positions", axes, np.zeros(3 * k), sd_m, optional=False))
        return tuple(out)

    @property
    def flights(self) -> int:
        """How many there are."""
        return int(self.flight.max(initial=0)) + 1

    def _offset_m(self, at: Estimate) -> Floats:
        """Of each frame, (f, 3), or of all, (1, 3)."""
        of_flights = at.value(OFFSET, 3 * self.flights).reshape(-1, 3)
        return of_flights[self.flight] if self.flights > 1 else of_flights

    def component_names(self) -> tuple[str, ...]:
        return HORIZONTAL, VERTICAL

    def columns(self, at: Estimate) -> slice:
        return slice(0, 3)

    def miss(self, at: Estimate) -> Floats:
        return np.asarray(self.reported.positions_m - self._computed_m(at))

    def _computed_m(self, at: Estimate) -> Floats:
        """Positions (f, 3) as they would be reported without error."""
        lever = CAMERA_FROM_BODY @ at.value(LEVER_ARM, 3)
        computed = at.positions_m + at.rotations @ lever + self._offset_m(at)
        if self.reported.velocities_m_per_s is not None:
            computed = computed - at.value(DELAY, 1) * self.reported.velocities_m_per_s
        return np.asarray(computed)

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
        mine = np.eye(self.flights)[self.flight] if self.flights > 1 else np.ones((f, 1))
        shared.append((OFFSET, np.einsum("fk,ij->fikj", mine, np.eye(3)).reshape(f, 3, -1)))
        return by_pose, shared

    def own_miss(self, at: Estimate, components: Components) -> tuple[Floats, int]:
        """Residuals (f, 3) without what the frames of each part have in common, and the number of parts whose
        height slopes. In common are a similarity of the plane and a height that may slope. Residuals of
        assumed positions are 0."""
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
        share, sd = variances * self.information(components), self.sd(components)
        own_offsets = (self.flights - 1.0) * (np.array(self.offset_sd_m) > 0.0)
        # in common: a similarity in plan, a level; of parts that slope two numbers more; offsets but one
        for name, numbers, common in ((HORIZONTAL, [0, 1], 4.0), (VERTICAL, [2], 1.0)):
            counted = np.isin(np.arange(3), numbers) & observed
            more = (2.0 * slopes if name == VERTICAL else 0.0) + float(own_offsets[numbers].sum())
            group = FrameGroup(name, counted, sd, self.weight, own, self.parts, common, more)
            yield group.component(components[name], share)

    def reweighted(self, image: ImageObservations, at: Estimate, components: Components) -> Self:
        own = self.own_miss(at, components)[0] / self.sd(components)
        observed = np.broadcast_to(~self.assumed[:, None], own.shape)
        return replace(self, weight=robust_weights(own, observed, self.parts, ([0, 1], [2])))

    def without(self, frames: Bools, at: Estimate) -> Self:
        stay, sd_m = frames[:, None], self.reported.positions_sd_m
        reported = replace(
            self.reported,
            positions_m=np.where(stay, self._computed_m(at), self.reported.positions_m),
            positions_sd_m=np.where(stay, np.minimum(sd_m, ANYWHERE_M), sd_m),
        )
        return replace(self, reported=reported)
