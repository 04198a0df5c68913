"""What every term of the adjustment offers: one physical statement about the unknowns."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from geomosaic.adjustment.kernels.normal_equations import Normals
from geomosaic.adjustment.problem.estimate import Estimate, Unknowns
from geomosaic.arrays import Bools, Floats
from geomosaic.constants import tuned
from geomosaic.estimation.robust import LEAST_REDUNDANCY

if TYPE_CHECKING:
    from geomosaic.adjustment.terms.image_observations import ImageObservations

MEASURED_SD_PX = tuned(0.5, "px", "of a point measured by hand in an image: half a pixel")


@dataclass(frozen=True)
class Components:
    """Variance components by name: image deviations in px, and factors of all other stated deviations."""

    values: Mapping[str, float] = field(default_factory=dict)

    def __getitem__(self, name: str) -> float:
        return self.values.get(name, MEASURED_SD_PX if name.endswith("image") else 1.0)

    def also(self, values: Mapping[str, float]) -> Components:
        """With other values of some."""
        return Components({**self.values, **values})


@dataclass(frozen=True)
class Component:
    """A variance component of a term by its residuals. factor: of the deviations. counted (f, k): weight with
    which each number that the term observes takes part; miss (f, k): residual of each; squares, redundancy:
    of all.
    follows: by how much the factor's logarithm follows that of the residuals' scatter, 0 where it stays as it
    is. least, most: limits of the factor."""

    name: str
    factor: float
    counted: Floats
    miss: Floats
    squares: float
    redundancy: float
    follows: float
    least: float
    most: float

    def estimated(self, factor_of: Callable[[float, float], float]) -> Component:
        """With the factor by the residuals (Foerstner 1979). factor_of: from the scatter and its redundancy,
        the factor that is taken."""
        if self.redundancy < LEAST_REDUNDANCY:
            return replace(self, factor=float(np.clip(self.factor, self.least, self.most)))
        scatter = self.factor * float(np.sqrt(self.squares / self.redundancy))
        a_little = 1.0 + float(np.sqrt(np.finfo(np.float64).eps))
        found, above = (factor_of(f, self.redundancy) for f in (scatter, a_little * scatter))
        inside = self.least < found < self.most
        follows = float(np.log(above / found) / np.log(a_little)) if inside else 0.0
        return replace(self, factor=float(np.clip(found, self.least, self.most)), follows=follows)


class Term(ABC):
    """One physical statement. Terms are immutable; `reweighted` returns another one."""

    name: ClassVar[str]

    def unknowns(self) -> tuple[Unknowns, ...]:
        """Shared unknowns that the term solves for."""
        return ()

    def component_names(self) -> tuple[str, ...]:
        """Of the variance components that start at 1."""
        return ()

    @abstractmethod
    def cost(self, at: Estimate, components: Components) -> float:
        """The term's share of the minimised sum of weighted squares."""

    @abstractmethod
    def add_to(self, normals: Normals, at: Estimate, components: Components) -> Normals:
        """The normal equations with the term's observations."""

    def reweighted(self, image: ImageObservations, at: Estimate, components: Components) -> Self:
        """The term with robust weights by its present residuals."""
        return self

    def without(self, frames: Bools, at: Estimate) -> Self:
        """The term for frames (f,) whose images are left out, so that they stay where they are."""
        return self


class FrameTerm(Term):
    """Observes numbers of each frame: k of its d unknowns, with weights (f, k) between 0 and 1."""

    weight: Floats

    @abstractmethod
    def columns(self, at: Estimate) -> slice:
        """Which of the frames' unknowns are observed."""

    @abstractmethod
    def miss(self, at: Estimate) -> Floats:
        """Observed minus computed, (f, k)."""

    @abstractmethod
    def sd(self, components: Components) -> Floats:
        """Present deviations, (f, k); inf where nothing was observed."""

    @abstractmethod
    def derivatives(self, at: Estimate) -> tuple[Floats | None, list[tuple[str, Floats]]]:
        """Derivatives of the computed numbers by the first six unknowns of a pose (f, k, 6), None where they
        are the unknowns themselves. Then those by shared unknowns, (f, k, q), each with the name of their
        part."""

    @abstractmethod
    def components(self, at: Estimate, components: Components, variances: Floats) -> Iterator[Component]:
        """Variance components by the residuals; variances (f, k): of the computed numbers."""

    def information(self, components: Components) -> Floats:
        """Weights over variances, (f, k)."""
        return np.asarray(self.weight / self.sd(components) ** 2)

    def cost(self, at: Estimate, components: Components) -> float:
        return float((self.weight * (self.miss(at) / self.sd(components)) ** 2).sum())

    def add_to(self, normals: Normals, at: Estimate, components: Components) -> Normals:
        by_pose, shared = self.derivatives(at)
        information, miss = self.information(components), self.miss(at)
        if by_pose is None:
            numbers = np.arange(normals.pose.shape[1])[self.columns(at)]
            normals.pose[:, numbers, numbers] += information
            normals.pose_side[:, numbers] += information * miss
            return normals
        back = np.swapaxes(by_pose, 1, 2)
        weighted = information[:, :, None]
        normals.pose[:, :6, :6] += back @ (weighted * by_pose)
        normals.pose_side[:, :6] += (back @ (weighted * miss[:, :, None]))[:, :, 0]
        placed = [(at.layout.platform_columns(name), by) for name, by in shared]
        asked = [(columns, by) for columns, by in placed if columns is not None]
        for columns, by in asked:
            normals.pose_mounting[:, :6, columns] += back @ (weighted * by)
            normals.mounting_side[columns] += np.einsum("fai,fa->i", by, information * miss)
            for others, other in asked:
                normals.mounting[columns, others] += np.einsum("fai,faj->ij", by, weighted * other)
        return normals
