"""Rotation and drift of each frame while its rows are read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from geomosaic.adjustment.problem.estimate import Estimate
from geomosaic.adjustment.terms.image_observations import IMAGE
from geomosaic.adjustment.terms.term import Component, Components, FrameTerm
from geomosaic.arrays import Bools, Floats
from geomosaic.constants import SLIGHT, sourced, tuned

RATE_SD_RAD_PER_S = sourced(0.3, "rad/s", "of each function; more: they take up poses", "a Sequoia: 0.26")
GUST_M_PER_S = tuned(0.5, "m/s", "error of a velocity; 0: chance differences set readout and scale")
_SHOWN = tuned(0.1, "of the image deviation", "more: hundreds of points a frame show what is left out")
IMAGE_AXES: Floats = tuned(np.array([1.0, 1.0, 1e-3]), "of a rate's deviation", "its last axis is fixed")
DRIFTS = "drift across the view", "drift along the view"


@dataclass(frozen=True)
class RollingShutterRotation(FrameTerm):
    """Rotation and drift of f frames about and along their camera's axes while rows are read are near
    0. rotation_sd_rad (f, t, 3), drift_sd (f, 3): first deviations, of drifts over the flying height. Each
    function of the row, drifts across the view and drifts along it have variance components. common: a part
    of the rotation may be common to all frames, so that it does not shrink. most_rotation: limit of its
    components. focal_length_px: by it, deviations shrink no further than the images show. The numbers of
    frames with deviations of 0, whose rows are read at once, are known."""

    rotation_sd_rad: Floats
    drift_sd: Floats
    focal_length_px: float
    common: bool
    most_rotation: float

    name: ClassVar[str] = "rolling shutter rotation"

    @property
    def weight(self) -> Floats:  # type: ignore[override]
        return np.ones((len(self.drift_sd), 1))

    @property
    def terms(self) -> int:
        return int(self.rotation_sd_rad.shape[1])

    @property
    def _read_by_row(self) -> Bools:
        """Frames (f,) with rows read one after the other."""
        return np.asarray(self.drift_sd.any(axis=1))

    def without_vanished(self, components: Components) -> RollingShutterRotation:
        """Without the last functions of the row whose components have shrunk to what images do not show."""
        unseen = 2.0 * self._least(components)
        shown = [
            k + 1
            for k in range(self.terms)
            if self.common or components[f"rotation term {k + 1}"] > unseen[k]
        ]
        return replace(self, rotation_sd_rad=self.rotation_sd_rad[:, : max(shown, default=1)])

    def _least(self, components: Components) -> Floats:
        """Lower limits of the components: half of what the images show at the frames' rims."""
        sd = np.column_stack(
            [self.rotation_sd_rad.max(axis=2), self.drift_sd[:, :2].max(axis=1), self.drift_sd[:, 2]]
        )
        sd = np.median(sd[self._read_by_row], axis=0)
        rim_px = np.maximum(self.focal_length_px * sd, np.finfo(np.float64).tiny)
        least = np.asarray(np.minimum(0.5 * _SHOWN * components[IMAGE] / rim_px, 1.0))
        if self.common:
            least[: self.terms] = 1.0
        return least

    def component_names(self) -> tuple[str, ...]:
        return (*(f"rotation term {k + 1}" for k in range(self.terms)), *DRIFTS)

    def columns(self, at: Estimate) -> slice:
        return slice(6, 6 + 3 * self.terms + 3)

    def miss(self, at: Estimate) -> Floats:
        return -at.while_read

    def sd(self, components: Components) -> Floats:
        *of_rotation, along, up = (components[name] for name in self.component_names())
        rotation_sd = self.rotation_sd_rad * np.reshape(of_rotation, (-1, 1))
        sd = np.column_stack([rotation_sd.reshape(len(rotation_sd), -1), self.drift_sd * [along, along, up]])
        return np.where(self._read_by_row[:, None], sd, SLIGHT)

    def derivatives(self, at: Estimate) -> tuple[None, list[tuple[str, Floats]]]:
        return None, []

    def components(self, at: Estimate, components: Components, variances: Floats) -> Iterator[Component]:
        """By the residuals of all frames without their median, which belongs to the readout or the lens."""
        read = self._read_by_row
        own = at.while_read - np.median(at.while_read[read], axis=0)
        sd, terms = self.sd(components), self.terms
        of = np.append(np.repeat(np.arange(terms), 3), terms + np.array([0, 0, 1]))
        redundancy = 1.0 - variances / sd**2
        least = self._least(components)
        most = [self.most_rotation] * terms + [1.0] * 2
        for k, name in enumerate(self.component_names()):
            factor, its = components[name], sd * np.outer(read, of == k)
            of_term = (its > 2.0 * IMAGE_AXES.min() * its.max(axis=1, keepdims=True)).astype(float)
            r = float((of_term * redundancy).sum()) - (its.max(axis=0) > 0.0).sum()
            squares = float((of_term * (own / sd) ** 2).sum())
            present = Component(name, factor, of_term, -own, squares, r, 0.0, least[k], most[k])
            yield present.estimated(lambda scatter, _: scatter)
