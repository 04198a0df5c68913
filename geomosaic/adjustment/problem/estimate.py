"""The unknowns that frames share, by name and index, and values of all unknowns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from geomosaic.adjustment.kernels.interior import INTERIOR, READOUT
from geomosaic.arrays import Bools, Floats
from geomosaic.camera.rotation import exp_turn
from geomosaic.estimation.linear import pseudo_inverse


@dataclass(frozen=True)
class Unknowns:
    """Numbers that a term solves for. owner: a camera's name, `platform` or `ground`. names: of the k
    numbers, each ending in its unit. given, sd (k,): prior values and deviations, in px, m, rad or s; 0 for
    known numbers. optional: the prior value stays where the block does not determine it."""

    name: str
    owner: str
    names: tuple[str, ...]
    given: Floats
    sd: Floats
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
        return np.concatenate([part.given for part in self.parts])

    @cached_property
    def sd(self) -> Floats:
        return np.concatenate([part.sd for part in self.parts])

    @property
    def unit(self) -> Floats:
        """One of each name's unit in px, m, rad or s, (s,)."""
        return np.array([np.radians(1.0) if name.endswith("_deg") else 1.0 for _, name in self.names])

    @cached_property
    def optional(self) -> Bools:
        """Which numbers may keep their prior values."""
        return np.repeat([part.optional for part in self.parts], [len(part.names) for part in self.parts])

    @property
    def names(self) -> list[tuple[str, str]]:
        """Owner and name of each number."""
        return [(part.owner, name) for part in self.parts for name in part.names]

    def begun_from(self, known: Mapping[str, tuple[Floats, Bools]]) -> tuple[Floats, Bools]:
        """Values (s,) to begin with, and which are fixed: those of another solution by the name of the part.

        A part that it does not have, or has with another number of unknowns, begins at its prior values. By
        now a flight may hang together in other parts, each with an error of its headings.
        """
        values, fixed = self.given.copy(), np.zeros(self.size, dtype=bool)
        for name, its in self.slices.items():
            if name in known and len(known[name][0]) == its.stop - its.start:
                values[its], fixed[its] = known[name]
        return values, fixed

    def of_readouts(self, values: Floats) -> Floats:
        """The cameras' readout times among values (s,), (c,)."""
        return values[self.interior].reshape(len(self.cameras), -1)[:, -1]


class Step(NamedTuple):
    """Corrections of poses (f, d), points (p, 3) and shared unknowns (s,)."""

    pose: Floats
    points: Floats
    shared: Floats

    def towards(self, other: Step, share: float) -> Step:
        """This step and a share of what leads to another."""
        return Step(*(here + share * (there - here) for here, there in zip(self, other, strict=True)))


@dataclass(frozen=True)
class Estimate:
    """Values of the unknowns in the work frame: positions_m (f, 3), rotations (f, 3, 3), points_m (p, 3).
    rotation_terms_rad (f, t, 3): factors of the t functions of the row for the rotation while it is read;
    drift (f, 3): movement along the camera's axes meanwhile besides the velocity, over the depth; t is 0
    where all rows are read at once. shared (s,): in the order of the layout. memo: derived quantities,
    computed once."""

    layout: UnknownLayout
    positions_m: Floats
    rotations: Floats
    points_m: Floats
    shared: Floats
    rotation_terms_rad: Floats
    drift: Floats
    memo: dict[int, tuple[object, Floats]] = field(init=False, default_factory=dict, compare=False)

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "memo": {}}

    @property
    def interior(self) -> Floats:
        """Each camera's numbers in the order of INTERIOR, (c, 9)."""
        return self.shared[self.layout.interior].reshape(len(self.layout.cameras), -1)

    @property
    def level_m(self) -> float:
        """The ground's level above the surface as given."""
        return float(self.shared[self.layout.level])

    def value(self, name: str, size: int) -> Floats:
        """A part of the shared unknowns, (size,); zeros where nothing solves for it."""
        found = self.layout.slices.get(name)
        return np.zeros(size) if found is None else self.shared[found]

    @property
    def while_read(self) -> Floats:
        """Rotation terms and drift in one row a frame, (f, 3 t + 3), or (f, 0)."""
        frames, terms = self.rotation_terms_rad.shape[:2]
        if not terms:
            return np.zeros((frames, 0))
        return np.column_stack([self.rotation_terms_rad.reshape(frames, -1), self.drift])

    def stepped(self, step: Step, share: float = 1.0) -> Estimate:
        """The estimate after a share of a step. The turn and scale that all movements have in common are
        applied last, as a similarity. A similarity leaves the images unchanged however large it is; the
        products of added corrections would change them."""
        pose, point, shared = (share * part for part in step)
        frames = len(self.positions_m)
        if not len(point):
            middle, shift = self.positions_m.mean(axis=0), pose[:, :3].mean(axis=0)
        else:
            middle, shift = self.points_m.mean(axis=0), point.mean(axis=0)
        away = np.concatenate([self.positions_m, self.points_m]) - middle
        move = np.concatenate([pose[:, :3], point]) - shift
        turn, scale = _turn_and_scale(away[frames:], move[frames:]) if len(point) else (np.zeros(3), 0.0)
        turned = exp_turn(turn[None])[0]
        away += move - np.cross(turn, away) - scale * away
        places = (1.0 + scale) * away @ turned.T + middle + shift
        shared = shared.copy()
        readouts = shared[self.layout.interior].reshape(len(self.layout.cameras), -1)[:, READOUT]
        in_step = scale * self.interior[:, READOUT]
        readouts += np.where(readouts == 0.0, 0.0, scale * (readouts - in_step))
        rotation_terms, drift = self.rotation_terms_rad, self.drift
        if rotation_terms.shape[1]:
            rotation_terms, drift = (
                rotation_terms + pose[:, 6:-3].reshape(rotation_terms.shape),
                drift + pose[:, -3:],
            )
        return replace(
            self,
            positions_m=places[:frames],
            rotations=turned @ exp_turn(pose[:, 3:6] - turn) @ self.rotations,
            points_m=places[frames:],
            shared=self.shared + shared,
            rotation_terms_rad=rotation_terms,
            drift=drift,
        )


def _turn_and_scale(away: Floats, move: Floats) -> tuple[Floats, float]:
    """Turn (3,) in rad and scale that movements (n, 3) of points have in common; far points count little."""
    square = (away**2).sum(axis=1)
    weight = 1.0 / np.maximum(square + np.median(square), 1e-300)
    weighted = away * weight[:, None]
    inertia = float(weight @ square) * np.eye(3) - weighted.T @ away
    turn = pseudo_inverse(inertia, symmetric=True) @ np.cross(weighted, move).sum(axis=0)
    return turn, float((weighted * move).sum()) / max(float(weight @ square), 1e-300)
