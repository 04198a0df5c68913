"""Image coordinates of tie and control points: the collinearity equations, Student's distribution."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from geomosaic.adjustment.kernels.collinearity import (
    Projections,
    Rows,
    image_from_ground,
    kinds_of,
    of_each,
    project_by_levers,
    readout_of,
)
from geomosaic.adjustment.kernels.interior import READOUT
from geomosaic.adjustment.kernels.normal_equations import Linearised, Normals, build_normals
from geomosaic.adjustment.kernels.observation_groups import AT_ONCE, Sightings
from geomosaic.adjustment.kernels.pose_jacobian import Levers
from geomosaic.adjustment.problem.estimate import Estimate
from geomosaic.adjustment.terms.term import MEASURED_SD_PX, Components
from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import MEDIAN_LENGTH, ROUNDS, tuned
from geomosaic.estimation.robust import INFORMATION, median_of_known, student_cost, student_weight
from geomosaic.matching.tracks import Tracks

BEHIND = tuned(1e6, "deviations", "of an image behind its camera: farther off than any in front of it")
_LEAST_SIGMA_PX = tuned(0.02, "px", "less: exact (simulated) tie points weigh without bound")
IMAGE, CONTROL_IMAGE = "image", "control image"


@dataclass(frozen=True)
class ImageObservations:
    """m image coordinates of p points in f frames. camera_of (f,): of each frame, its place among cameras.
    reported: velocities and turns of the platform. control (p,): points measured by hand, with a deviation of
    their own. rolling: a camera may read its rows one after the other. left_out (f,): frames whose images do
    not count. local (p,): see `local_factors`. design_effect: how many of the tie points' coordinates count
    as one."""

    tracks: Tracks
    camera_of: Ints
    cameras: tuple[Camera, ...]
    reported: Poses
    control: Bools
    rolling: bool
    left_out: Bools
    local: Floats
    design_effect: float = 1.0

    def of(self, which: Ints) -> Self:
        """Some of the observations, of the same points."""
        its = self.tracks
        return replace(self, tracks=Tracks(its.frame[which], its.point[which], its.image_px[which]))

    @cached_property
    def by_hand(self) -> Bools:
        """Which observations are of control points, (m,)."""
        return np.asarray(self.control[self.tracks.point])

    @cached_property
    def used(self) -> Bools:
        """Which observations count, (m,): those of frames that are not left out."""
        return np.asarray(~self.left_out[self.tracks.frame])

    @cached_property
    def as_many(self) -> Floats:
        """How many observations count as one, (m,)."""
        return np.where(self.by_hand, 1.0, self.design_effect)

    @cached_property
    def shown(self) -> Floats:
        """The share of an error's square that residuals show along the directions in which they do, (m,). A
        point takes three of the two numbers that each of its k images gives (Baarda 1968, section 4).
        Residuals of a point in two images have one direction, with half of the square in it."""
        return np.where(self.by_hand, 1.0, 1.0 - 1.5 / np.maximum(self.views[self.tracks.point], 3))

    @cached_property
    def views(self) -> Ints:
        """How many observations of each point count, (p,)."""
        return np.bincount(self.tracks.point, self.used, self.tracks.points).astype(np.intp)

    @property
    def longest_side_px(self) -> float:
        """Of all cameras' images: no image deviation is larger."""
        return float(max(max(c.width_px, c.height_px) for c in self.cameras))

    def frame_share(self) -> Floats:
        """Each frame's share of the observations, (f,)."""
        counts = np.bincount(self.tracks.frame, minlength=len(self.camera_of))
        return counts / max(len(self.tracks.frame), 1)

    def sd_px(self, components: Components) -> Floats:
        """Present deviation of each observation, (m,)."""
        of_ties = components[IMAGE] * self.local[self.tracks.point]
        return np.where(self.by_hand, components[CONTROL_IMAGE], of_ties)

    def computed_px(self, at: Estimate) -> Floats:
        """Image coordinates of the points while the measured rows are read, (m, 2); NaN behind the camera."""
        kept = at.memo.get(id(self.tracks))
        if kept is not None and kept[0] is self.tracks:
            return kept[1]
        parts = np.array_split(np.arange(len(self.tracks.frame)), max(len(self.tracks.frame) // AT_ONCE, 1))
        out = np.concatenate([image_from_ground(self.of(i).projections(at)) for i in parts])
        at.memo[id(self.tracks)] = self.tracks, out
        return out

    def lengths_px(self, at: Estimate) -> Floats:
        """Lengths of the residuals, (m,); NaN behind the camera."""
        away = self.tracks.image_px - self.computed_px(at)
        return np.asarray(np.hypot(away[:, 0], away[:, 1]))

    def standardised(self, at: Estimate, components: Components) -> Floats:
        """Residual lengths over their deviations, (m,); NaN behind the camera."""
        return np.asarray(self.lengths_px(at) / (self.sd_px(components) * np.sqrt(self.shown)))

    def cost(self, at: Estimate, components: Components) -> float:
        """Twice the negative logarithm of their likelihood."""
        length = self.standardised(at, components)
        cost = self.shown * student_cost(np.where(np.isfinite(length), length, BEHIND)) / self.as_many
        return float(cost[self.used].sum())

    def linearised(self, at: Estimate, components: Components) -> Linearised:
        """What `build_normals` asks for, weighted with the expected information (Fisher's scoring)."""
        sd_px, computed = self.sd_px(components), self.computed_px(at)

        def of(which: Ints) -> tuple[Floats, Floats, Levers, Floats, Floats]:
            some = self.of(which)
            image, levers, by_interior, by_point = project_by_levers(
                some.projections_in_own_rows(at, computed[which])
            )
            residual, sd = some.tracks.image_px.T - image, sd_px[which]
            counts = np.isfinite(residual).all(axis=0) & self.used[which]
            length = np.linalg.norm(residual, axis=0) / (sd * np.sqrt(self.shown[which]))
            weight = np.where(counts, student_weight(length) / sd**2 / self.as_many[which], 0.0)
            residual /= INFORMATION
            for a in (residual, levers.arms_m, levers.shares, by_interior, by_point):
                a[..., ~counts] = 0.0
            return residual, weight, levers, by_interior, by_point

        return of

    def normals(self, at: Estimate, components: Components) -> Normals:
        """The normal equations of the observations."""
        key = len(at.positions_m), len(at.points_m)
        if key not in self.tracks.memo:
            self.tracks.memo[key] = Sightings.of(self.tracks.frame, self.tracks.point, *key)
        counts = (*at.interior.shape, at.layout.platform_size)
        linearised = self.linearised(at, components)
        return build_normals(
            self.tracks.memo[key], self.camera_of, counts, linearised, at.rotation_terms_rad.shape[1]
        )

    def projections(self, at: Estimate, rows_px: Floats | None = None) -> Projections:
        """The points in the frames that see them; rolling shutters at rows_px (m,), or the measured rows."""
        frame = self.tracks.frame
        camera = self.camera_of[frame]
        interior, kinds = of_each(at.interior, camera), kinds_of(self.cameras)
        kind = None if kinds is None else kinds[camera]
        points_m = at.points_m[self.tracks.point]
        if not self._reads_rows(at):
            rotations = of_each(at.rotations, frame)
            return Projections(at.positions_m[frame], rotations, interior, points_m, None, kind)
        measured = self.tracks.image_px[:, 1] if rows_px is None else rows_px
        rows = Rows(frame, measured, self._heights_px[camera], interior[:, READOUT])
        motion = (at.rotation_terms_rad, at.drift) if at.rotation_terms_rad.shape[1] else (None, None)
        read = readout_of(self.reported, at.rotations, rows, *motion)
        return Projections(at.positions_m[frame], read.rotations, interior, points_m, read, kind)

    def projections_in_own_rows(self, at: Estimate, computed_px: Floats) -> Projections:
        """The same with rolling shutters at the points' own rows, see `Readout`; computed_px (m, 2)."""
        if not self._reads_rows(at):
            return self.projections(at)
        rows = np.clip(computed_px[:, 1], 0.0, self._heights_px[self.camera_of[self.tracks.frame]])
        return self.projections(at, np.where(np.isnan(rows), self.tracks.image_px[:, 1], rows))

    @cached_property
    def _heights_px(self) -> Floats:
        return np.array([c.height_px for c in self.cameras])

    def _reads_rows(self, at: Estimate) -> bool:
        moving = self.reported.velocities_m_per_s is not None or self.reported.turns is not None
        return self.rolling and (moving or bool(at.rotation_terms_rad.shape[1]))

    def first_components(self, at: Estimate) -> dict[str, float]:
        """Image deviations by the present median residuals."""
        length = self.lengths_px(at)
        return {
            name: float(np.clip(median_of_known(length[which]), MEASURED_SD_PX, self.longest_side_px))
            for name, which in ((IMAGE, self.used & ~self.by_hand), (CONTROL_IMAGE, self.used & self.by_hand))
        }

    def components(self, at: Estimate, components: Components, unknowns: float) -> dict[str, float]:
        """Image deviations by the residuals; unknowns: how many the tie points determine."""
        length, out = self.lengths_px(at), {}
        tied = ~self.by_hand & self.used
        if tied.any():
            shown = self.shown[tied]
            error_px = length[tied] / np.sqrt(shown) / self.local[self.tracks.point[tied]]
            redundancy = max(2.0 * int(tied.sum()) - unknowns, 1.0)
            sigma_px = _scale_px(error_px, shown, redundancy, components[IMAGE])
            out[IMAGE] = float(np.clip(sigma_px, _LEAST_SIGMA_PX, self.longest_side_px))
        control_px = median_of_known(length[self.by_hand & self.used]) / MEDIAN_LENGTH
        out[CONTROL_IMAGE] = float(np.clip(control_px, MEASURED_SD_PX, self.longest_side_px))
        return out


def _scale_px(error_px: Floats, shown: Floats, redundancy: float, first_px: float) -> float:
    """The scale of Student's distribution of errors with this redundancy; NaN count as beyond all."""
    error_px, scale_px = np.nan_to_num(error_px, nan=BEHIND * first_px), first_px
    for _ in range(ROUNDS):
        error = error_px / scale_px
        squares = float((shown * student_weight(error) * error**2).sum()) / INFORMATION
        if not squares:
            break
        scale_px *= float(np.sqrt(squares / redundancy))
    return scale_px
