"""What people have built: houses with level or hipped roofs, bridges; their forms in plan and in height."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Floats

Colour = tuple[float, float, float]
_DECK_M, _DECK_HALF_WIDTH_M, _ABUTMENT_M = 30.0, 4.6, 3.0
_DECK_TOP_M, _DECK_THICK_M = 7.0, 1.2
_CONCRETE: Colour = (152, 150, 144)


@dataclass(frozen=True)
class Building:
    """A prism with a rectangular footprint; heights above the ground at its centre.

    height_m: of the eaves; ridge_m: how much higher a hipped roof rises, with one slope on all four sides, 0
    for a level one; open_m: below that height it is open, as a bridge's deck is; 0 for what stands on the
    ground.
    """

    easting_m: float
    northing_m: float
    half_length_m: float
    half_width_m: float
    along_rad: float
    """Direction of the long side, counter-clockwise from grid east."""
    height_m: float
    roof: Colour
    gable: bool
    ridge_m: float = 0.0
    open_m: float = 0.0
    road: bool = False
    """Whether its top is a road's."""

    @property
    def top_m(self) -> float:
        """Of its highest part."""
        return self.height_m + self.ridge_m

    @property
    def axes(self) -> Floats:
        """Unit vectors (2, 2) along the long side and the short side, in easting and northing."""
        c, s = np.cos(self.along_rad), np.sin(self.along_rad)
        return np.array([[c, s], [-s, c]])

    def outline_m(
        self, along: tuple[float, float] = (-1, 1), across: tuple[float, float] = (-1, 1)
    ) -> Floats:
        """The corners (4, 2) of the part between fractions of the half sides."""
        (a, b), (c, d) = along, across
        return self.polygon_m([(a, c), (b, c), (b, d), (a, d)])

    def polygon_m(self, corners: list[tuple[float, float]]) -> Floats:
        """Corners (n, 2) given in fractions of the half length and the half width."""
        uv = np.array(corners) * [self.half_length_m, self.half_width_m]
        return np.asarray(uv @ self.axes + [self.easting_m, self.northing_m])

    def roof_m(self, uv_m: Floats) -> Floats:
        """How high the roof is at places (..., 2) along the long and the short side, from its centre."""
        inside = ([self.half_length_m, self.half_width_m] - np.abs(uv_m)).min(axis=-1)
        return np.asarray(self.height_m + self.ridge_m * inside / self.half_width_m)

    def faces(self) -> Floats:
        """Half-spaces (n, 4) whose intersection it is: `a u + b v + c z <= d`, z above the ground at its
        centre. First the four walls, then what is seen from above, last the underside if it is open."""
        length, width = self.half_length_m, self.half_width_m
        walls = [[1, 0, 0, length], [-1, 0, 0, length], [0, 1, 0, width], [0, -1, 0, width]]
        hip = self.ridge_m / width
        if self.ridge_m:
            roof = [[hip * a, hip * b, 1, self.height_m + hip * d] for a, b, _, d in walls]
        else:
            roof = [[0, 0, 1, self.height_m]]
        return np.array([*walls, *roof, *([[0, 0, -1, -self.open_m]] if self.open_m else [])], dtype=float)


def bridge(line_m: Floats) -> tuple[Building, ...]:
    """The deck in the middle of a road (n, 2), and the abutments at its ends."""
    middle = len(line_m) // 2
    ahead = line_m[middle + 1] - line_m[middle - 1]
    along = float(np.arctan2(ahead[1], ahead[0]))
    to_end = np.array([np.cos(along), np.sin(along)]) * (_DECK_M + _ABUTMENT_M) / 2.0
    parts = []
    for off, length_m, open_m in (
        (-1.0, _ABUTMENT_M, 0.0),
        (1.0, _ABUTMENT_M, 0.0),
        (0.0, _DECK_M, _DECK_TOP_M - _DECK_THICK_M),
    ):
        east, north = (line_m[middle] + off * to_end).tolist()
        parts.append(
            Building(east, north, length_m / 2.0, _DECK_HALF_WIDTH_M, along, _DECK_TOP_M, _CONCRETE, False,
                     open_m=open_m, road=True)
        )  # fmt: skip
    return tuple(parts)
