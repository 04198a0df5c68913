"""What a frame's pose does to the points it sees, by what these do themselves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.estimation.linear import multiply_each


@dataclass(frozen=True)
class Levers:
    """Derivatives by poses from those by points: an image depends on where a point lies from the pose alone.
    arms_m (3, n): from projection centres to points, in the work frame. terms (t, n): functions of the row
    for the rotation; shares (1, n): of the image's height times the depth, for the drift; axes (3, 3, n): of
    the cameras. The last three are empty where all rows are read at once."""

    arms_m: Floats
    terms: Floats
    shares: Floats
    axes: Floats

    @classmethod
    def rigid(cls, arms_m: Floats) -> Levers:
        """Where all rows are read at once."""
        none = np.zeros((0, arms_m.shape[-1]))
        return cls(arms_m, none, none, np.zeros((3, 3, 0)))

    def of(self, span: slice) -> Levers:
        """Some of them."""
        return Levers(*(a[..., span] for a in (self.arms_m, self.terms, self.shares, self.axes)))

    @property
    def numbers(self) -> int:
        """Of a pose: place and turn, and what a frame does while its rows are read, d."""
        return 6 + 3 * (len(self.terms) + len(self.shares))

    def by_pose(self, by_point: Floats, out: Floats | None = None) -> Floats:
        """Derivatives (..., d, n) by position, turn, rotation terms and drift, from those by the point (...,
        3, n)."""
        if out is None:
            out = np.empty((*by_point.shape[:-2], self.numbers, by_point.shape[-1]))
        np.negative(by_point, out=out[..., :3, :])
        turn = out[..., 3:6, :]
        for axis in range(3):
            one, two = (axis + 1) % 3, (axis + 2) % 3
            np.multiply(by_point[..., one, :], self.arms_m[two], out=turn[..., axis, :])
            turn[..., axis, :] -= by_point[..., two, :] * self.arms_m[one]
        if len(self.terms):
            about_axes = _along(self.axes, turn)
            for k, term in enumerate(self.terms):
                np.multiply(about_axes, term, out=out[..., 6 + 3 * k : 9 + 3 * k, :])
        for share in self.shares:
            np.multiply(_along(self.axes, by_point), -share, out=out[..., -3:, :])
        return out

    def as_points_m(self, step: Floats) -> Floats:
        """Moves of the points (3, n) to first order that images take for steps of the poses (d, n)."""
        turn = step[3:6]
        if len(self.terms):
            term_rotation = sum(term * step[6 + 3 * k : 9 + 3 * k] for k, term in enumerate(self.terms))
            turn = turn + multiply_each(self.axes, np.asarray(term_rotation))
        x, y, z = self.arms_m
        a, b, c = turn
        moved = np.stack([y * c - z * b, z * a - x * c, x * b - y * a]) - step[:3]
        for share in self.shares:
            moved -= multiply_each(self.axes, share * step[-3:])
        return np.asarray(moved)


def _along(axes: Floats, rows: Floats) -> Floats:
    """Derivatives (..., 3, n) by the work frame's axes as those by other axes (3, 3, n)."""
    return np.stack([sum(rows[..., i, :] * axes[i, j] for i in range(3)) for j in range(3)], axis=-2)
