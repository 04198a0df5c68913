"""A block as the solver takes it: image observations, terms, and the layout of what frames share."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from geomosaic.adjustment.kernels.normal_equations import Normals
from geomosaic.adjustment.problem.estimate import Estimate, UnknownLayout, Unknowns
from geomosaic.adjustment.terms.image_observations import ImageObservations
from geomosaic.adjustment.terms.point_coordinates import PointCoordinates
from geomosaic.adjustment.terms.term import Components, FrameTerm, Term
from geomosaic.adjustment.terms.terrain import Terrain, level_unknown
from geomosaic.arrays import Bools, Floats
from geomosaic.camera.interior import Camera
from geomosaic.constants import tuned
from geomosaic.matching.tracks import Tracks

KNOWN = tuned(1e-6, "px, rad, m or s, or share of a deviation", "of known numbers; 0: not solvable")


@dataclass(frozen=True)
class BlockProblem:
    """What is minimised: the cost of the image observations, of each term, and of the shared unknowns'
    priors. interior: each camera's unknowns. points: prior coordinates. frames: observations of the poses.
    terrain: a surface under the tie points. fixed (s,): shared unknowns that keep their prior values.
    clearance_m (f,): the least distance of each frame's points."""

    image: ImageObservations
    interior: tuple[Unknowns, ...]
    points: PointCoordinates
    frames: tuple[FrameTerm, ...]
    terrain: Terrain | None
    fixed: Bools | None = None
    clearance_m: Floats | None = None

    @property
    def layout(self) -> UnknownLayout:
        """Of the shared unknowns."""
        level = level_unknown(1.0 if self.terrain is None else self.terrain.level_sd_m)
        return UnknownLayout(self.interior, level, tuple(u for term in self.frames for u in term.unknowns()))

    @property
    def tracks(self) -> Tracks:
        return self.image.tracks

    @property
    def cameras(self) -> tuple[Camera, ...]:
        return self.image.cameras

    @property
    def terms(self) -> Iterator[Term]:
        """All but the image observations."""
        yield self.points
        yield from self.frames
        if self.terrain is not None:
            yield self.terrain

    def cost(self, at: Estimate, components: Components) -> float:
        """The sum that is minimised."""
        total = self.image.cost(at, components) + sum(t.cost(at, components) for t in self.terms)
        off = (at.layout.given - at.shared) / self.shared_sd(at.layout)
        return total + float((off**2).sum())

    def normals(self, at: Estimate, components: Components) -> Normals:
        """The normal equations of all observations and priors."""
        n = self.image.normals(at, components)
        for term in self.terms:
            n = term.add_to(n, at, components)
        layout = at.layout
        weight = 1.0 / self.shared_sd(layout) ** 2
        pull = weight * (layout.given - at.shared)
        c, k = n.interior_side.shape
        i, platform = np.arange(k), slice(layout.level + 1, None)
        n.interior[:, i, i] += weight[layout.interior].reshape(c, k)
        n.interior_side[:] += pull[layout.interior].reshape(c, k)
        i = np.arange(layout.platform_size)
        n.mounting[i, i] += weight[platform]
        n.mounting_side[:] += pull[platform]
        return replace(
            n,
            level=n.level + float(weight[layout.level]),
            level_side=n.level_side + float(pull[layout.level]),
        )

    def known(self, layout: UnknownLayout) -> Bools:
        """Which shared unknowns are known or fixed, (s,)."""
        return np.asarray((layout.sd == 0.0) if self.fixed is None else (layout.sd == 0.0) | self.fixed)

    def shared_sd(self, layout: UnknownLayout) -> Floats:
        """Prior deviations of the shared unknowns, (s,): next to nothing for known or fixed ones."""
        sd = layout.sd
        return np.where(self.known(layout), KNOWN * np.where(sd == 0.0, 1.0, sd), sd)

    def reweighted(self, at: Estimate, components: Components) -> BlockProblem:
        """With robust weights of the terms by their present residuals."""
        return replace(
            self,
            points=self.points.reweighted(self.image, at, components),
            frames=tuple(term.reweighted(self.image, at, components) for term in self.frames),
        )

    def without(self, frames: Bools, at: Estimate) -> BlockProblem:
        """Without the images of some frames (f,), which stay where they are."""
        if not frames.any():
            return self
        image = replace(self.image, left_out=frames)
        return replace(self, image=image, frames=tuple(term.without(frames, at) for term in self.frames))
