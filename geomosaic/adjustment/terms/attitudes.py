"""Reported attitudes, with what headings are off by in common and the boresight of camera and IMU."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from geomosaic.adjustment.problem.estimate import Estimate, Unknowns
from geomosaic.adjustment.terms.frame_components import FrameGroup, common_mean, robust_weights
from geomosaic.adjustment.terms.image_observations import ImageObservations
from geomosaic.adjustment.terms.term import Component, Components, FrameTerm
from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import CAMERA_FROM_BODY, about_z, exp_turn, log_turn
from geomosaic.constants import tuned
from geomosaic.placement.prior import heading_assumed, tilt_assumed

TILT, YAW, BORESIGHT, HEADINGS = "tilt", "yaw", "boresight", "headings"
BORESIGHT_SD_RAD = tuned(np.radians(3.0), "rad", "of mounts of small drones; less: boresights are fixed")


@dataclass(frozen=True)
class Attitudes(FrameTerm):
    """Attitudes of f frames, as turns about east, north and up; residuals by component `tilt` and `yaw`. The
    camera's axes are the body's: forward is the image's top, right its right side, down the view. boresight:
    the angles by which the reported attitude is turned against the camera's, about forward, right and down,
    are solved for. parts: frames of each connected part. group (f,): numbers from 0 on of frames whose
    headings may be off in common, as one compass is, or -1; groups_sd_rad (g,): by how much."""

    reported: Poses
    parts: tuple[Ints, ...]
    weight: Floats
    boresight: bool = False
    group: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    groups_sd_rad: Floats = field(default_factory=lambda: np.zeros(0))

    name: ClassVar[str] = "attitudes"

    def unknowns(self) -> tuple[Unknowns, ...]:
        if self.boresight:  # its third angle is what all headings are off by
            names = "boresight_roll_deg", "boresight_pitch_deg", "boresight_yaw_deg"
            return (Unknowns(BORESIGHT, "platform", names, np.zeros(3), np.full(3, BORESIGHT_SD_RAD)),)
        if not (g := len(self.groups_sd_rad)):
            return ()
        each = tuple(f"heading_error{f'_{k + 1}' if g > 1 else ''}_deg" for k in range(g))
        return (Unknowns(HEADINGS, "attitudes", each, np.zeros(g), self.groups_sd_rad, optional=False),)

    def _of_group(self) -> Floats:
        """Which group each frame belongs to, as ones, (f, g)."""
        g = len(self.groups_sd_rad)
        return np.vstack([np.eye(g), np.zeros(g)])[self.group] if g else np.zeros((len(self.weight), 0))

    def _computed(self, at: Estimate) -> Floats:
        """Attitudes (f, 3, 3) as they would be reported without error."""
        boresight = exp_turn((CAMERA_FROM_BODY @ at.value(BORESIGHT, 3))[None])[0]
        return np.asarray(self._turned_in_common(at) @ at.rotations @ boresight)

    def _turned_in_common(self, at: Estimate) -> Floats:
        """Turns (f, 3, 3) about up by what reported headings are off by in common."""
        return about_z(-self._of_group() @ at.value(HEADINGS, len(self.groups_sd_rad)))

    def component_names(self) -> tuple[str, ...]:
        return TILT, YAW

    def columns(self, at: Estimate) -> slice:
        return slice(3, 6)

    def miss(self, at: Estimate) -> Floats:
        """Turns about east and north once the heading is turned back, and the heading's about up. In one
        rotation vector a heading far off would count as tilts, and tilts as heading."""
        off = self.reported.rotations @ np.swapaxes(self._computed(at), 1, 2)
        heading = np.arctan2(off[:, 1, 0] - off[:, 0, 1], off[:, 0, 0] + off[:, 1, 1])
        return np.column_stack([log_turn(about_z(-heading) @ off)[:, :2], heading])

    def sd(self, components: Components) -> Floats:
        tilt, yaw = components[TILT], components[YAW]
        sd_rad = self.reported.rotations_sd_rad * [tilt, tilt, yaw]
        return np.asarray(np.where(np.isfinite(sd_rad), sd_rad, np.inf))

    def derivatives(self, at: Estimate) -> tuple[Floats, list[tuple[str, Floats]]]:
        turned = self._turned_in_common(at)
        by_pose = turned @ np.eye(3, 6, 3)
        shared = [(BORESIGHT, turned @ at.rotations @ CAMERA_FROM_BODY)]
        if len(self.groups_sd_rad):
            shared.append((HEADINGS, self._of_group()[:, None] * np.array([0.0, 0.0, -1.0])[:, None]))
        return by_pose, shared

    def own_miss(self, at: Estimate, components: Components) -> Floats:
        """Residuals (f, 3) without the heading that the frames of each part have in common."""
        miss, sd = self.miss(at), self.sd(components)
        for part in self.parts:
            mean = np.angle(np.exp(1j * miss[part, 2]).sum())
            apart = np.angle(np.exp(1j * (miss[part, 2] - mean)))
            miss[part, 2] = apart - common_mean(apart, sd[part, 2])
        return miss

    def _informative(self) -> Bools:
        """Which numbers (f, 3) tell about the deviations: assumptions tell nothing about observed ones."""
        assumed = np.column_stack([tilt_assumed(self.reported)] * 2 + [heading_assumed(self.reported)])
        return np.asarray(~assumed | assumed.all(axis=0))

    def components(self, at: Estimate, components: Components, variances: Floats) -> Iterator[Component]:
        share = variances * self.information(components)
        own, sd, informative = self.own_miss(at, components), self.sd(components), self._informative()
        for name, numbers, common in ((TILT, [0, 1], 0.0), (YAW, [2], 1.0)):
            counted = np.isin(np.arange(3), numbers) & informative
            group = FrameGroup(name, counted, sd, self.weight, own, self.parts, common)
            yield group.component(components[name], share)

    def reweighted(self, image: ImageObservations, at: Estimate, components: Components) -> Self:
        own = self.own_miss(at, components) / self.sd(components)
        weight = robust_weights(own, self._informative(), self.parts, ([0, 1], [2]))
        return replace(self, weight=weight)

    def without(self, frames: Bools, at: Estimate) -> Self:
        stay, sd_rad = frames[:, None], self.reported.rotations_sd_rad
        reported = replace(
            self.reported,
            rotations=np.where(stay[:, None], self._computed(at), self.reported.rotations),
            rotations_sd_rad=np.where(stay, np.minimum(sd_rad, np.pi), sd_rad),
        )
        return replace(self, reported=reported)
