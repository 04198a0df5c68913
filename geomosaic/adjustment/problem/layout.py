"""The unknowns that frames share, by name: the only module that knows an index."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from geomosaic.adjustment.kernels.interior import INTERIOR
from geomosaic.arrays import Bools, Floats


@dataclass(frozen=True)
class Unknowns:
    """Numbers that a term solves for. owner: a camera's name, `platform` or `ground`. names: of the k
    numbers, each ending in its unit. given, sd (k,): prior values and deviations, in px, m, rad or s; 0 for
    known numbers. unit (k,): one of each name's unit in px, m, rad or s. optional: the prior value stays
    where the block does not determine it."""

    name: str
    owner: str
    names: tuple[str, ...]
    given: Floats
    sd: Floats
    unit: Floats
    optional: bool = True


@dataclass(frozen=True)
class UnknownLayout:
    """The shared unknowns (s,) in order: each camera's interior orientation, the ground's level, then what
    meets the frames' poses alone (`platform`)."""

    cameras: tuple[Unknowns, ...]
    ground: Unknowns
    platform: tuple[Unknowns, ...]
    parts: tuple[Unknowns, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "parts", (*self.cameras, self.ground, *self.platform))

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Where the numbers of each part stand."""
        ends = np.cumsum([len(part.names) for part in self.parts])
        return {p.name: slice(int(e) - len(p.names), int(e)) for p, e in zip(self.parts, ends, strict=True)}

    @property
    def size(self) -> int:
        return sum(len(part.names) for part in self.parts)

    @property
    def interior(self) -> slice:
        """All cameras' numbers."""
        return slice(0, self.level)

    @property
    def level(self) -> int:
        """The ground's level."""
        return len(self.cameras) * len(INTERIOR)

    def platform_columns(self, name: str) -> slice | None:
        """Where a part stands among those of the platform; None where nothing solves for it."""
        found, first = self.slices.get(name), self.level + 1
        return None if found is None else slice(found.start - first, found.stop - first)

    @property
    def platform_size(self) -> int:
        return self.size - self.level - 1

    @cached_property
    def given(self) -> Floats:
        return self._joined(part.given for part in self.parts)

    @cached_property
    def sd(self) -> Floats:
        return self._joined(part.sd for part in self.parts)

    @cached_property
    def unit(self) -> Floats:
        return self._joined(part.unit for part in self.parts)

    @cached_property
    def optional(self) -> Bools:
        """Which numbers may keep their prior values."""
        return np.repeat([part.optional for part in self.parts], [len(part.names) for part in self.parts])

    @property
    def names(self) -> list[tuple[str, str]]:
        """Owner and name of each number."""
        return [(part.owner, name) for part in self.parts for name in part.names]

    def of_readouts(self, values: Floats) -> Floats:
        """The cameras' readout times among values (s,), (c,)."""
        return values[self.interior].reshape(len(self.cameras), -1)[:, -1]

    @staticmethod
    def _joined(values: Iterable[Floats]) -> Floats:
        return np.concatenate(list(values)) if values else np.zeros(0)
