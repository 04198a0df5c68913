"""Poses corrected by marks: a correction in common, and one of each marked frame.

A correction is a shift of the projection centre and a turn about the camera's axes, 6 numbers in units of
their prior deviations. So one mark in a frame moves it, and three determine it (space resection).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation, exp_turn
from geomosaic.constants import ROUNDS, SLIGHT, sourced, tuned
from geomosaic.estimation.robust import cauchy_weight

MARK_SD_PX = tuned(1.5, "px", "of a mark and a lens; less: marks look wrong; more: wrong marks look right")
_OWN = tuned(0.5, "share of the stated deviations", "of one frame among all; more: nothing is in common")
STEP = sourced(np.finfo(float).eps ** (1 / 3), "deviations", "of central differences", "Press et al., 5.7")
_EQUAL_ROUNDS = tuned(3, "rounds", "before weights are robust; less: all marks of a wrong start are rejected")


@dataclass(frozen=True)
class FrameMarks:
    """The marks of one frame: places_m (m, 3) of its points in the work frame, places_sd_m (m,) in plan,
    image_px (m, 2); pose_sd (6,) as in `OrientedFrames`."""

    pose: Pose
    camera: Camera
    pose_sd: Floats
    places_m: Floats
    places_sd_m: Floats
    image_px: Floats

    @property
    def variance_px2(self) -> Floats:
        """Variances (m,) of marks minus predicted places, but for the pose's errors."""
        away_m = np.linalg.norm(self.places_m - self.pose.position_m, axis=1)
        return np.asarray(MARK_SD_PX**2 + (self.places_sd_m * self.camera.focal_length_px / away_m) ** 2)

    def linearised(self, pose: Pose, sd: Floats) -> tuple[Floats, Floats]:
        """Marks minus predicted places (m, 2) in px, and derivatives of the places (m, 2, 6) by a correction
        in units of sd (6,), those of the middle row. Both are 0 where a point is not seen."""
        off = self.image_px - pose.image_from_ground(self.camera, self.places_m)
        steps = np.concatenate([np.diag(STEP * sd), np.diag(-STEP * sd)])
        in_camera = (self.places_m - pose.position_m - steps[:, None, :3]) @ pose.rotation.matrix
        seen = self.camera.image_from_camera(in_camera @ exp_turn(steps[:, 3:]))
        slopes = np.moveaxis(seen[: len(sd)] - seen[len(sd) :], 0, -1) / (2.0 * STEP)
        lost = ~np.isfinite(off).all(axis=1) | ~np.isfinite(slopes).all(axis=(1, 2))
        off[lost], slopes[lost] = 0.0, 0.0
        return off, slopes


@dataclass(frozen=True)
class CorrectedFrame:
    """A frame's pose by all marks. off_px (m,): how far each of its marks lies from where the other marks
    predict it; deviations (m,): the same over what is expected."""

    pose: Pose
    off_px: Floats
    deviations: Floats


def moved(pose: Pose, correction: Floats) -> Pose:
    """A pose shifted by correction[:3] in m and turned about its camera's axes by correction[3:] in rad."""
    turned = Rotation(pose.rotation.matrix @ exp_turn(correction[None, 3:])[0])
    return replace(pose, position_m=pose.position_m + correction[:3], rotation=turned)


def common_correction(frames: Sequence[FrameMarks]) -> Floats:
    """The correction (6,) in m and rad that all frames share: 0 without marks."""
    if not frames:
        return np.zeros(6)
    sd = np.median([of.pose_sd for of in frames], axis=0)
    return np.asarray(_fitted(frames, sd, _OWN)[0] * sd)


def corrected_frame(frame: FrameMarks) -> CorrectedFrame:
    """A frame whose pose has the common correction, by its own marks."""
    sd = _OWN * frame.pose_sd
    correction, normal, weights = _fitted([frame], sd, 0.0)
    pose = moved(frame.pose, correction * sd)
    off, slopes = frame.linearised(pose, sd)
    leverage = slopes @ np.linalg.inv(normal) @ np.swapaxes(slopes, 1, 2) * weights[:, None, None]
    left_out = np.linalg.solve(np.eye(2) - leverage, off[..., None])[..., 0]
    chi_squared = np.sum(off * left_out, axis=1) / frame.variance_px2
    return CorrectedFrame(pose, np.linalg.norm(left_out, axis=1), np.sqrt(np.maximum(chi_squared, 0.0)))


def _fitted(frames: Sequence[FrameMarks], sd: Floats, own: float) -> tuple[Floats, Floats, Floats]:
    """Correction (6,) in units of sd, its normal matrix (6, 6), and the marks' weights (m,) per px squared.
    own: share of a frame's deviations that its marks scatter by."""
    given = np.concatenate([of.variance_px2 for of in frames])
    correction, normal, weights = np.zeros(6), np.eye(6), np.zeros(0)
    for done in range(ROUNDS):
        found = [of.linearised(moved(of.pose, correction * sd), sd) for of in frames]
        off, slopes = (np.concatenate(parts) for parts in zip(*found, strict=True))
        variance = given + own**2 * np.sum(slopes**2, axis=(1, 2)) / 2.0
        robust = cauchy_weight(np.linalg.norm(off, axis=1) / np.sqrt(variance))
        weights = np.where(done < _EQUAL_ROUNDS, 1.0, robust) / variance
        normal = np.eye(6) + np.einsum("m,mij,mik->jk", weights, slopes, slopes)
        step = np.linalg.solve(normal, np.einsum("m,mij,mi->j", weights, slopes, off) - correction)
        correction = correction + step
        if done > _EQUAL_ROUNDS and np.abs(step).max() < SLIGHT:
            break
    return correction, normal, weights
