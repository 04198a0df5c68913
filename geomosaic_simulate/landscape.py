"""The plan of an endless seeded countryside: parcels, roads, buildings, trees and cars as vectors.

The plane (metres of the map) is cut into cells of CELL_M by a jittered lattice with bent edges. Every
second edge each way is a road; the rest are tracks, hedges or bare borders. Each cell is one parcel
with one land use. All of it follows from the seed and the cell's indices alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import numpy as np

from geomosaic.arrays import Floats
from geomosaic_simulate.buildings import Building, Colour, bridge
from geomosaic_simulate.noise import hashed

Span = tuple[float, float]
Bounds = tuple[float, float, float, float]
CELL_M = 80.0
CROWN = 1.15
"""How much farther than a tree's radius its crown is painted at most."""
COVERS: dict[str, Colour] = {"water": (58, 72, 78), "smooth_forest": (58, 74, 44)}
_EDGE_POINTS = 9
_HIP = 0.7
"""How steep hipped roofs are, m per m: 35 degrees."""

_CROPS: tuple[Colour, ...] = (
    (112, 128, 66), (150, 142, 84), (176, 160, 106), (96, 112, 60), (140, 112, 84), (122, 98, 76),
    (134, 140, 74),
)  # fmt: skip
_MEADOWS: tuple[Colour, ...] = ((104, 122, 66), (118, 128, 76), (92, 110, 62))
_ROOFS: tuple[Colour, ...] = (
    (150, 84, 66), (168, 98, 74), (112, 106, 104), (176, 170, 164), (96, 70, 60), (132, 128, 126),
    (126, 62, 52),
)  # fmt: skip
_CARS: tuple[Colour, ...] = ((225, 225, 228), (40, 42, 46), (150, 152, 156), (150, 34, 30), (44, 66, 120))


@dataclass(frozen=True)
class LandPatch:
    """A piece of land: its outline (n, 2), its colour, and how rough it is at fine and middle scales.

    rows_rad_per_m: the wave vector of crop rows or mowing tracks, (0, 0) for none; rows: their strength.
    """

    outline_m: Floats
    colour: Colour
    fine: float
    middle: float
    rows: float = 0.0
    rows_rad_per_m: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Parcel:
    """All that stands and lies on one cell. Trees: (n, 4) easting, northing, radius (m), tint in [0, 1).

    cover: a key of `COVERS` where the whole cell lies under something without texture.
    """

    patches: tuple[LandPatch, ...]
    trees: Floats
    buildings: tuple[Building, ...]
    cover: str = ""
    outline_m: Floats | None = None


@dataclass(frozen=True)
class Way:
    """A road or track: centre line (n, 2), width, whether it is paved, and cars as (x, y, along, colour)."""

    line_m: Floats
    width_m: float
    paved: bool
    cars: tuple[tuple[float, float, float, Colour], ...] = ()


@dataclass(frozen=True)
class Landscape:
    """The countryside of a seed. `buildings` is a factor on how many villages there are, 0 for none.

    water_share, smooth_forest_share: of all cells, how many lie under water or a canopy without texture.
    hipped: roofs with a ridge rise to it from all four walls, else all are level. bridges: every second road
    that runs north does so over a bridge, see `bridge_on`.
    """

    seed: int
    buildings: float = 1.0
    water_share: float = 0.0
    smooth_forest_share: float = 0.0
    hipped: bool = False
    bridges: bool = False

    def parcels(self, bounds_m: Bounds) -> Iterator[Parcel]:
        """Parcels that may reach into west, south, east, north."""
        for i, j in self._cells(bounds_m):
            yield _parcel(self, i, j)

    def ways(self, bounds_m: Bounds) -> list[Way]:
        """Roads and tracks that may reach into the bounds, tracks first."""
        found = [w for i, j in self._cells(bounds_m) for w in _ways(self, i, j)]
        return sorted(found, key=lambda w: w.paved)

    def buildings_in(self, bounds_m: Bounds) -> list[Building]:
        """Buildings whose centre lies in the bounds."""
        west, south, east, north = bounds_m
        return [
            b
            for parcel in self.parcels(bounds_m)
            for b in parcel.buildings
            if west <= b.easting_m <= east and south <= b.northing_m <= north
        ]

    def bridge_on(self, i: int, j: int) -> tuple[Building, ...]:
        """The deck and the abutments of the bridge in the middle of a cell's western edge, if it has one."""
        if not self.bridges or i % 2 or j % 2:
            return ()
        return bridge(_edge_m(self, i, j, True))

    def cover(self, i: int, j: int) -> str:
        """What covers a cell: a key of `COVERS`, or nothing."""
        number = self.number(i, j, 8)
        if number < self.water_share:
            return "water"
        return "smooth_forest" if number < self.water_share + self.smooth_forest_share else ""

    def trees_in(self, bounds_m: Bounds) -> Floats:
        """Trees near the bounds: (n, 4) easting, northing, radius of the crown at the ground, height."""
        trees = np.concatenate([p.trees for p in self.parcels(bounds_m)])
        radius, tint = trees[:, 2], trees[:, 3]
        return np.column_stack([trees[:, :2], CROWN * radius, radius * (1.4 + tint)])

    def number(self, i: int, j: int, salt: int) -> float:
        """A number in [0, 1) of a cell."""
        return float(hashed(self.seed, 1000 + salt, i, j))

    def numbers(self, i: int, j: int, salt: int, n: int, each: int) -> Floats:
        """Numbers in [0, 1) of a cell, shape (n, each)."""
        base = int(hashed(self.seed, 1000 + salt, i, j) * 2**31)
        return hashed(self.seed, base, np.arange(n)[:, None], np.arange(each)[None, :])

    @staticmethod
    def _cells(bounds_m: Bounds) -> Iterator[tuple[int, int]]:
        west, south, east, north = (int(np.floor(v / CELL_M)) for v in bounds_m)
        for j in range(south - 1, north + 2):
            for i in range(west - 1, east + 2):
                yield i, j

    def patch_m(self, i: int, j: int, u: Floats, v: Floats) -> Floats:
        """Points (..., 2) of the Coons patch between a cell's edges; u eastward, v northward in [0, 1]."""
        south, north = _edge_m(self, i, j, False), _edge_m(self, i, j + 1, False)
        west, east = _edge_m(self, i, j, True), _edge_m(self, i + 1, j, True)
        t = np.linspace(0.0, 1.0, _EDGE_POINTS)

        def on(edge: Floats, at: Floats) -> Floats:
            return np.stack([np.interp(at, t, edge[:, 0]), np.interp(at, t, edge[:, 1])], axis=-1)

        u_, v_ = u[..., None], v[..., None]
        ruled = (1 - v_) * on(south, u) + v_ * on(north, u) + (1 - u_) * on(west, v) + u_ * on(east, v)
        corners = (1 - v_) * ((1 - u_) * south[0] + u_ * south[-1]) + v_ * (
            (1 - u_) * north[0] + u_ * north[-1]
        )
        return np.asarray(ruled - corners)

    def outline_m(self, i: int, j: int, u: Span, v: Span) -> Floats:
        """The outline (n, 2) of a part of a cell."""
        t = np.linspace(0.0, 1.0, _EDGE_POINTS)[:-1]
        us = np.concatenate([u[0] + (u[1] - u[0]) * t, 0 * t + u[1], u[1] - (u[1] - u[0]) * t, 0 * t + u[0]])
        vs = np.concatenate([0 * t + v[0], v[0] + (v[1] - v[0]) * t, 0 * t + v[1], v[1] - (v[1] - v[0]) * t])
        return self.patch_m(i, j, us, vs)


def _node_m(land: Landscape, i: int, j: int) -> Floats:
    """The lattice corner (i, j) after its jitter."""
    jitter = [land.number(i, j, 1) - 0.5, land.number(i, j, 2) - 0.5]
    return (np.array([i, j], dtype=np.float64) + np.multiply(0.42, jitter)) * CELL_M


@lru_cache(maxsize=2048)
def _edge_m(land: Landscape, i: int, j: int, upward: bool) -> Floats:
    """The bent edge (points, 2) from node (i, j) to its eastern or, `upward`, its northern neighbour. Every
    patch of the adjacent cells asks for it."""
    a, b = _node_m(land, i, j), _node_m(land, i + (not upward), j + upward)
    bend = (land.number(i, j, 4 if upward else 3) - 0.5) * 0.28
    t = np.linspace(0.0, 1.0, _EDGE_POINTS)[:, None]
    across = np.array([a[1] - b[1], b[0] - a[0]])
    edge = np.asarray(a + (b - a) * t + across * bend * 2.0 * t * (1.0 - t))
    edge.setflags(write=False)
    return edge


def _pick(colours: tuple[Colour, ...], number: float, shade: float) -> Colour:
    red, green, blue = colours[int(number * len(colours)) % len(colours)]
    factor = 0.85 + 0.3 * shade
    return red * factor, green * factor, blue * factor


def _strips(land: Landscape, i: int, j: int) -> tuple[LandPatch, ...]:
    """Crop fields: the cell cut into one to four strips, each with rows along it."""
    n = 1 + int(land.number(i, j, 10) * 4)
    lengthwise = land.number(i, j, 11) < 0.5
    cuts = np.linspace(0.0, 1.0, n + 1)
    patches = []
    for k, (a, b) in enumerate(pairwise(cuts)):
        r = land.numbers(i, j, 12 + k, 1, 6)[0]
        u, v = ((0.0, 1.0), (a, b)) if lengthwise else ((a, b), (0.0, 1.0))
        outline = land.outline_m(i, j, u, v)
        heading = np.diff(land.patch_m(i, j, np.array([u[0], u[1]]), np.array([v[0], v[1]])), axis=0)[0]
        angle = np.arctan2(heading[1], heading[0]) + (0.6 if lengthwise else -0.6) * 0.4
        k_rad_per_m = 2.0 * np.pi / (0.9 + 2.6 * r[2])
        wave = (float(-np.sin(angle) * k_rad_per_m), float(np.cos(angle) * k_rad_per_m))
        rows = 0.07 * r[3] if r[4] < 0.75 else 0.0
        patches.append(LandPatch(outline, _pick(_CROPS, r[0], r[1]), 0.09 + 0.06 * r[5], 0.09, rows, wave))
    return tuple(patches)


def _trees(
    land: Landscape, i: int, j: int, salt: int, spacing_m: float, share: float, radius_m: float
) -> Floats:
    """Trees on a jittered grid of a cell, of which a share stands."""
    n = max(int(CELL_M / spacing_m), 1)
    r = land.numbers(i, j, salt, n * n, 5)
    v, u = (np.stack(np.divmod(np.arange(n * n), n)) + 0.5 + 0.9 * (r[:, :2].T - 0.5)) / n
    at = land.patch_m(i, j, u, v)
    trees = np.column_stack([at, radius_m * (0.55 + 0.8 * r[:, 2]), r[:, 3]])
    return np.asarray(trees[r[:, 4] < share])


def _village(land: Landscape, i: int, j: int) -> tuple[tuple[LandPatch, ...], tuple[Building, ...]]:
    """Gardens in two rows of three, a building on most."""
    patches, buildings = [], []
    for k in range(6):
        r = land.numbers(i, j, 30 + k, 1, 10)[0]
        u, v = k % 3 / 3.0, k // 3 / 2.0
        colour = _pick(_MEADOWS if r[0] < 0.75 else ((158, 148, 132),), r[0], r[1])
        patches.append(LandPatch(land.outline_m(i, j, (u, u + 1 / 3), (v, v + 0.5)), colour, 0.11, 0.09))
        if r[2] > 0.85:
            continue
        at = land.patch_m(i, j, np.array([u + 1 / 6, u + 1 / 6 + 0.01]), np.array([v + 0.25, v + 0.25]))
        along = float(np.arctan2(*(at[1] - at[0])[::-1]))
        half_length, half_width = 4.5 + 3.5 * r[3], 3.6 + 1.8 * r[4]
        yard = land.patch_m(i, j, np.array([u + 1 / 6]), np.array([0.06 if v == 0 else 0.94]))[0]
        side = (yard - at[0]) / np.linalg.norm(yard - at[0])
        across = np.array([side[1], -side[0]]) * (half_width * 0.6)
        path = np.array([at[0] - across, at[0] + across, yard + across * 0.7, yard - across * 0.7])
        patches.append(LandPatch(path, _pick(((150, 146, 140), (168, 156, 136)), r[5], r[1]), 0.06, 0.05))
        buildings.append(
            Building(float(at[0, 0]), float(at[0, 1]), half_length, half_width, along + 0.2 * (r[6] - 0.5),
                     3.5 + 6.5 * r[7], _pick(_ROOFS, r[8], r[1]), bool(r[9] < 0.7),
                     _HIP * half_width if land.hipped and r[9] < 0.7 else 0.0)
        )  # fmt: skip
    return tuple(patches), tuple(buildings)


@lru_cache(maxsize=512)
def _parcel(land: Landscape, i: int, j: int) -> Parcel:
    """A cell with the bridge on its western edge; no tree stands in that one's way, nor in the eastern's."""
    parcel, west = _fields(land, i, j), land.bridge_on(i, j)
    if not (west or land.bridge_on(i + 1, j)):
        return parcel
    clear = _clear_of(parcel.trees, west + land.bridge_on(i + 1, j))
    return replace(parcel, trees=clear, buildings=parcel.buildings + west)


def _fields(land: Landscape, i: int, j: int) -> Parcel:
    use, shade = land.number(i, j, 5), land.number(i, j, 6)
    whole = land.outline_m(i, j, (0.0, 1.0), (0.0, 1.0))
    if cover := land.cover(i, j):
        return Parcel((), np.empty((0, 4)), (), cover, whole)
    village = 0.3 * land.buildings
    if use < village:
        patches, buildings = _village(land, i, j)
        trees = _trees(land, i, j, 20, 9.0, 0.3, 2.2)
        return Parcel(patches, _clear_of(trees, buildings), buildings)
    use = (use - village) / (1.0 - village)
    if use < 0.22:
        floor = LandPatch(whole, (74, 80, 52), 0.18, 0.12)
        return Parcel((floor,), _trees(land, i, j, 21, 5.0, 0.86, 3.4), ())
    if use < 0.45:
        meadow = LandPatch(whole, _pick(_MEADOWS, land.number(i, j, 7), shade), 0.13, 0.13)
        return Parcel((meadow,), _trees(land, i, j, 22, 13.0, 0.35, 2.8), ())
    if use < 0.53:
        orchard = LandPatch(whole, _pick(_MEADOWS, land.number(i, j, 7), shade), 0.12, 0.10)
        return Parcel((orchard,), _trees(land, i, j, 23, 7.5, 0.85, 2.0), ())
    return Parcel(_strips(land, i, j), _trees(land, i, j, 24, 26.0, 0.15, 2.2), ())


def _clear_of(trees: Floats, buildings: tuple[Building, ...]) -> Floats:
    """The trees whose crowns touch no building."""
    keep = np.ones(len(trees), dtype=bool)
    for b in buildings:
        uv = np.abs((trees[:, :2] - [b.easting_m, b.northing_m]) @ b.axes.T)
        outside = np.maximum(uv - [b.half_length_m, b.half_width_m], 0.0)
        keep &= np.hypot(outside[:, 0], outside[:, 1]) > 1.5 * trees[:, 2]
    return np.asarray(trees[keep])


@lru_cache(maxsize=512)
def _ways(land: Landscape, i: int, j: int) -> tuple[Way, ...]:
    ways = []
    for upward in (False, True):
        line = _edge_m(land, i, j, upward)
        r = land.numbers(i, j, 51 if upward else 50, 4, 4)
        if (i if upward else j) % 2 == 0:
            cars = []
            for share, side, colour, there in r[:3]:
                if there < 0.45:
                    k = min(int(share * (_EDGE_POINTS - 1)), _EDGE_POINTS - 2)
                    step = line[k + 1] - line[k]
                    along = float(np.arctan2(step[1], step[0]))
                    off = np.array([-np.sin(along), np.cos(along)]) * (1.6 if side < 0.5 else -1.6)
                    x, y = (line[k] + line[k + 1]) / 2.0 + off
                    cars.append((float(x), float(y), along, _pick(_CARS, colour, 0.5)))
            ways.append(Way(line, 6.2, True, tuple(cars)))
        elif r[3, 0] < 0.5:
            ways.append(Way(line, 2.6, False))
    return tuple(ways)
