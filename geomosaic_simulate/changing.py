"""What is different in every frame: the glitter of water, cars under way, crowns in the wind."""

from __future__ import annotations

import cv2
import numpy as np

from geomosaic.arrays import Bytes, Floats
from geomosaic_simulate.buildings import Colour
from geomosaic_simulate.landscape import Bounds, Landscape
from geomosaic_simulate.noise import hashed
from geomosaic_simulate.terrain import box_m, cover_mask, fill_polygon

_PAINTS: tuple[Colour, ...] = ((225, 225, 228), (40, 42, 46), (150, 34, 30), (44, 66, 120), (196, 180, 60))
_LANE_M = 1.6
_GLITTER = 9.0
SWAY_REACH = 1.6


def glitter(
    window: Bytes, west_m: float, north_m: float, pixel_m: float, land: Landscape, rng: np.random.Generator
) -> None:
    """Let the water of a window (rows, cols, 3) shine otherwise than in any other frame (in place)."""
    water = cover_mask(land, "water", west_m, north_m, pixel_m, window.shape)
    if not water.any():
        return
    rows, cols = water.shape
    shine = np.zeros((rows, cols), dtype=np.float32)
    for spacing_px in (3, 12, 200):
        coarse = rng.standard_normal((rows // spacing_px + 2, cols // spacing_px + 2), dtype=np.float32)
        shine += cv2.resize(coarse, (cols, rows), interpolation=cv2.INTER_CUBIC)
    on = water > 0
    change = (_GLITTER / np.sqrt(3.0) * shine[on] * (water[on] / np.float32(255.0)))[:, None]
    window[on] = np.clip(np.round(window[on] + change), 0, 255).astype(np.uint8)


def cars_at(land: Landscape, per_road: float, time_s: float, bounds_m: Bounds) -> Floats:
    """Cars under way in the bounds: (n, 4) easting, northing, direction from grid east (rad), colour.

    `per_road` cars on average on each 80 m of paved road, at 8 to 18 m/s; at the end of its piece of road
    a car starts again.
    """
    found = []
    west, south, east, north = bounds_m
    for way in land.ways(bounds_m) if per_road > 0.0 else []:
        if not way.paved:
            continue
        place = [round(float(v) * 10.0) for v in way.line_m[4]]
        steps = np.linalg.norm(np.diff(way.line_m, axis=0), axis=1)
        at = np.concatenate([[0.0], np.cumsum(steps)])
        count = int(per_road + float(hashed(land.seed, 7000, *place)))
        for k in range(count):
            start, speed, back, colour = (
                float(hashed(land.seed, 7001 + 4 * k + m, *place)) for m in range(4)
            )
            way_m = (start * at[-1] + (8.0 + 10.0 * speed) * (time_s % 86400.0)) % at[-1]
            if back < 0.5:
                way_m = at[-1] - way_m
            i = min(int(np.searchsorted(at, way_m, side="right")) - 1, len(steps) - 1)
            ahead = (way.line_m[i + 1] - way.line_m[i]) / steps[i]
            ahead_of_car = ahead if back >= 0.5 else -ahead
            right = np.array([ahead_of_car[1], -ahead_of_car[0]])
            x, y = way.line_m[i] + ahead * (way_m - at[i]) + right * _LANE_M
            if west <= x <= east and south <= y <= north:
                found.append((x, y, np.arctan2(ahead_of_car[1], ahead_of_car[0]), colour))
    return np.array(found).reshape(-1, 4)


def paint_cars(window: Bytes, cars: Floats, west_m: float, north_m: float, pixel_m: float) -> None:
    """Paint cars of `cars_at` into a window (rows, cols, 3) (in place)."""
    for x, y, along, colour in cars:
        paint = _PAINTS[int(colour * len(_PAINTS))]
        for length, width, value in ((2.2, 0.9, paint), (1.1, 0.75, (46, 50, 56)), (0.75, 0.72, paint)):
            fill_polygon(window, box_m(x, y, along, length, width), west_m, north_m, pixel_m, value)


def changes_at(land: Landscape, count: int, side_m: float, bounds_m: Bounds) -> Floats:
    """Squares painted on the ground in the bounds, well apart: (count, 4) west, south, east, north."""
    west, south, east, north = bounds_m
    columns = max(1, int(np.ceil(np.sqrt(count))))
    rows = max(1, -(-count // columns))
    found = []
    for k in range(count):
        across, along = (float(hashed(land.seed, 7100 + m, k)) for m in range(2))
        x = west + (east - west) * (k % columns + 0.2 + 0.6 * across) / columns
        y = south + (north - south) * (k // columns + 0.2 + 0.6 * along) / rows
        found.append((x - side_m / 2.0, y - side_m / 2.0, x + side_m / 2.0, y + side_m / 2.0))
    return np.array(found).reshape(-1, 4)


def paint_changes(window: Bytes, changes: Floats, west_m: float, north_m: float, pixel_m: float) -> None:
    """Paint squares of `changes_at` into a window (rows, cols, 3) (in place): white on dark ground, black on
    bright."""
    for west, south, east, north in changes:
        rows = slice(*(max(0, round((north_m - y) / pixel_m)) for y in (north, south)))
        cols = slice(*(max(0, round((x - west_m) / pixel_m)) for x in (west, east)))
        if window[rows, cols].size:
            bright = float(window[rows, cols].mean())
            window[rows, cols] = _PAINTS[0] if bright < 128.0 else _PAINTS[1]


def gusts(trees: Floats, wind_m: float, rng: np.random.Generator) -> Floats:
    """How far the wind bends each crown in one frame (n, 2) east and north, sd wind_m: a gust and its own."""
    common, own = rng.standard_normal(2), rng.standard_normal((len(trees), 2))
    return np.asarray(wind_m * (0.6 * common + 0.8 * own))


def sway(
    window: Bytes, west_m: float, north_m: float, pixel_m: float, trees: Floats, bent_m: Floats
) -> Bytes:
    """A window (rows, cols, 3) whose crowns are moved by bent_m (n, 2): most in their middle, at
    SWAY_REACH of their radius not at all.

    Args: trees: (n, 4) as `Landscape.trees_in`.
    """
    rows, cols = window.shape[:2]
    moved = np.zeros((rows, cols, 2), dtype=np.float32)
    for (east, north, radius, _), bent in zip(trees, bent_m, strict=True):
        reach = SWAY_REACH * radius / pixel_m
        x, y = (east - west_m) / pixel_m - 0.5, (north_m - north) / pixel_m - 0.5
        x_0, x_1 = max(int(x - reach), 0), min(int(x + reach) + 2, cols)
        y_0, y_1 = max(int(y - reach), 0), min(int(y + reach) + 2, rows)
        if x_0 < x_1 and y_0 < y_1:
            off_sq = ((np.arange(x_0, x_1) - x) ** 2 + ((np.arange(y_0, y_1) - y) ** 2)[:, None]) / reach**2
            weight = np.maximum(1.0 - off_sq, 0.0) ** 2
            moved[y_0:y_1, x_0:x_1] += weight[..., None] * (bent / [pixel_m, -pixel_m])
    x_map, y_map = np.meshgrid(np.arange(cols, dtype=np.float32), np.arange(rows, dtype=np.float32))
    return np.asarray(
        cv2.remap(
            window, x_map - moved[..., 0], y_map - moved[..., 1], cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REPLICATE,
        )
    )  # fmt: skip
