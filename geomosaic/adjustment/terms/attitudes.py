"""Reported attitudes, with the boresight angles between camera and IMU."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from geomosaic.adjustment.problem.estimate import Estimate, Unknowns
from geomosaic.adjustment.terms.frame_components import FrameGroup, common_mean, robust_weights
from geomosaic.adjustment.terms.image_observations import ImageObservations
from geomosaic.adjustment.terms.term import Component, Components, FrameTerm
from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import CAMERA_FROM_BODY, exp_turn, log_turn
from geomosaic.constants import tuned

TILT, YAW, BORESIGHT = "tilt", "yaw", "boresight"
BORESIGHT_SD_RAD = tuned(np.radians(3.0), "rad", "of mounts of small drones; less: boresights are fixed")


@dataclass(frozen=True)
class Attitudes(FrameTerm):
    """Attitudes of f frames, as turns about east, north and up; residuals by component `tilt` and `yaw`. The
    camera's axes are the body's: forward is the image's top, right its right side, down the view. boresight:
    the angles by which the reported attitude is turned against the camera's, about forward, right and down,
    are solved for. parts: frames of each connected part."""

    reported: Poses
    parts: tuple[Ints, ...]
    weight: Floats
    boresight: bool = False

    name: ClassVar[str] = "attitudes"

    def unknowns(self) -> tuple[Unknowns, ...]:
        if not self.boresight:
            return ()
        names = "boresight_roll_deg", "boresight_pitch_deg", "boresight_yaw_deg"
        return (Unknowns(BORESIGHT, "platform", names, np.zeros(3), np.full(3, BORESIGHT_SD_RAD)),)

    def component_names(self) -> tuple[str, ...]:
        return TILT, YAW

    def columns(self, at: Estimate) -> slice:
        return slice(3, 6)

    def miss(self, at: Estimate) -> Floats:
        back = exp_turn(-(CAMERA_FROM_BODY @ at.value(BORESIGHT, 3))[None])[0]
        return log_turn(self.reported.rotations @ back @ np.swapaxes(at.rotations, 1, 2))

    def sd(self, components: Components) -> Floats:
        tilt, yaw = components[TILT], components[YAW]
        sd_rad = self.reported.rotations_sd_rad * [tilt, tilt, yaw]
        return np.asarray(np.where(np.isfinite(sd_rad), sd_rad, np.inf))

    def derivatives(self, at: Estimate) -> tuple[Floats, list[tuple[str, Floats]]]:
        by_pose = np.broadcast_to(np.eye(3, 6, 3), (len(at.rotations), 3, 6))
        return by_pose, [(BORESIGHT, at.rotations @ CAMERA_FROM_BODY)]

    def own_miss(self, at: Estimate, components: Components) -> Floats:
        """Residuals (f, 3) without the heading that the frames of each part have in common."""
        miss, sd = self.miss(at), self.sd(components)
        for part in self.parts:
            miss[part, 2] -= common_mean(miss[part, 2], sd[part, 2])
        return miss

    def components(self, at: Estimate, components: Components, variances: Floats) -> Iterator[Component]:
        share = variances * self.information(components)
        own, sd = self.own_miss(at, components), self.sd(components)
        for name, numbers, common in ((TILT, [0, 1], 0.0), (YAW, [2], 1.0)):
            counted = np.broadcast_to(np.isin(np.arange(3), numbers), own.shape)
            group = FrameGroup(name, counted, sd, self.weight, own, self.parts, common)
            yield group.component(components[name], share)

    def reweighted(self, image: ImageObservations, at: Estimate, components: Components) -> Self:
        own = self.own_miss(at, components) / self.sd(components)
        observed = np.ones(own.shape, dtype=bool)
        return replace(self, weight=robust_weights(own, observed, self.parts, ([0, 1], [2])))

    def without(self, frames: Bools, at: Estimate) -> Self:
        stay, sd_rad = frames[:, None], self.reported.rotations_sd_rad
        reported = replace(
            self.reported,
            rotations=np.where(stay[:, None], at.rotations, self.reported.rotations),
            rotations_sd_rad=np.where(stay, np.minimum(sd_rad, np.pi), sd_rad),
        )
        return replace(self, reported=reported)
