"""Ground with known truth: the landscape's image and in any window, from the seed alone.

The image lives in the map CRS on a grid of square pixels aligned to its origin: world column
`floor(easting / pixel)`, world row `floor(-northing / pixel)`, rows downward. It is made in blocks of
BLOCK_PX, so that a window is the same however it is asked for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bytes, Floats, Floats32
from geomosaic_simulate.buildings import Building, Colour
from geomosaic_simulate.landscape import COVERS, CROWN, Landscape
from geomosaic_simulate.noise import fractal_noise

BLOCK_PX = 512
TILE_MARGIN_PX = 2
_PAD_PX = 8
_SHIFT = 6
_SUN = np.array([0.62, -0.78])
"""Where shadows fall on the map (east, north); their length is 0.8 of the height."""
_SHADOW_PER_M = 0.8


@dataclass(frozen=True)
class GroundImage:
    """The image of a landscape at one pixel size."""

    landscape: Landscape
    pixel_m: float

    def block(self, block_col: int, block_row: int) -> Bytes:
        """One block (BLOCK_PX, BLOCK_PX, 3), RGB; its first pixel is world (BLOCK_PX * block_col, ...)."""
        return self.tile(block_col, block_row)[TILE_MARGIN_PX:-TILE_MARGIN_PX, TILE_MARGIN_PX:-TILE_MARGIN_PX]

    def tile(self, block_col: int, block_row: int) -> Bytes:
        """A block with TILE_MARGIN_PX more on every side."""
        return _Painter(self, block_col * BLOCK_PX - _PAD_PX, block_row * BLOCK_PX - _PAD_PX).image()

    def window(self, col: int, row: int, shape: tuple[int, int]) -> Bytes:
        """Pixels (rows, cols, 3) of a window of world columns and rows."""
        out = np.empty((*shape, 3), dtype=np.uint8)
        for block_row in range(row // BLOCK_PX, (row + shape[0] - 1) // BLOCK_PX + 1):
            for block_col in range(col // BLOCK_PX, (col + shape[1] - 1) // BLOCK_PX + 1):
                top, left = block_row * BLOCK_PX - row, block_col * BLOCK_PX - col
                y_0, x_0 = max(top, 0), max(left, 0)
                y_1, x_1 = min(top + BLOCK_PX, shape[0]), min(left + BLOCK_PX, shape[1])
                block = self.block(block_col, block_row)
                out[y_0:y_1, x_0:x_1] = block[y_0 - top : y_1 - top, x_0 - left : x_1 - left]
        return out


def cover_mask(
    land: Landscape, cover: str, west_m: float, north_m: float, pixel_m: float, shape: tuple[int, ...]
) -> Bytes:
    """How much of each pixel of a window lies under a cover, 0 to 255; roads and tracks run over it.

    Args: west_m, north_m: the window's outer corner; shape: its rows and cols.
    """
    mask = np.zeros(shape[:2], dtype=np.uint8)
    bounds = (west_m, north_m - shape[0] * pixel_m, west_m + shape[1] * pixel_m, north_m)
    under = [p.outline_m for p in land.parcels(bounds) if p.cover == cover and p.outline_m is not None]
    over = [_ribbon(w.line_m, w.width_m + (2.4 if w.paved else 0.0)) for w in land.ways(bounds)]
    for outlines, value in ((under, 255), (over if under else [], 0)):
        for outline in outlines:
            fill_polygon(mask, outline, west_m, north_m, pixel_m, (value, value, value))
    return mask


def fill_polygon(
    image: Bytes, outline_m: Floats, west_m: float, north_m: float, pixel_m: float, paint: Colour
) -> None:
    """Paint a polygon (n, 2) of the map into a window of pixels, its edges smooth (in place)."""
    px = (outline_m - [west_m, north_m]) / [pixel_m, -pixel_m] - 0.5
    points = np.round(px * 2**_SHIFT).astype(np.int32)
    cv2.fillPoly(image, [points], paint, lineType=cv2.LINE_AA, shift=_SHIFT)


class _Painter:
    """Paints one padded block: land, roads, shadows, cars, trees, buildings, from below to above."""

    def __init__(self, ground: GroundImage, col: int, row: int) -> None:
        self.land, self.pixel_m, self.col, self.row = ground.landscape, ground.pixel_m, col, row
        self.size = BLOCK_PX + 2 * _PAD_PX
        self.west_m, self.north_m = col * self.pixel_m, -row * self.pixel_m
        reach = 20.0
        side = self.size * self.pixel_m
        bounds = (
            self.west_m - reach,
            self.north_m - side - reach,
            self.west_m + side + reach,
            self.north_m + reach,
        )
        self.parcels = list(self.land.parcels(bounds))
        self.ways = self.land.ways(bounds)
        self.buildings = [b for p in self.parcels for b in p.buildings]
        self.trees = self._near(np.concatenate([p.trees for p in self.parcels]))
        noise = self._noise
        self.fine, self.middle = noise(1, (1, 2, 4, 8)), noise(2, (16, 32, 64))
        self.coarse, self.hue = noise(3, (128, 256, 512)), noise(4, (16, 64, 256))

    def image(self) -> Bytes:
        image = self._land()
        image = self._shaded(image)
        image = self._cars(image)
        image = self._crowns(image)
        image = self._roofs(image)
        inner = slice(_PAD_PX - TILE_MARGIN_PX, _PAD_PX + BLOCK_PX + TILE_MARGIN_PX)
        return np.ascontiguousarray(np.clip(image[inner, inner] + 0.5, 0.0, 255.0).astype(np.uint8))

    def _noise(self, salt: int, spacings_px: tuple[int, ...]) -> Floats32:
        return fractal_noise(self.land.seed, salt, self.col, self.row, (self.size, self.size), spacings_px)

    def _near(self, trees: Floats) -> Floats:
        xy = self._px(trees[:, :2])
        reach = (2.0 * trees[:, 2:3] + _SHADOW_PER_M * 3.0 * trees[:, 2:3]) / self.pixel_m
        near = ((xy > -reach) & (xy < self.size + reach)).all(axis=1)
        return np.asarray(trees[near])

    def _px(self, map_m: Floats) -> Floats:
        """Block columns and rows (corner origin) of eastings and northings (..., 2)."""
        return np.asarray((map_m - [self.west_m, self.north_m]) * [1.0 / self.pixel_m, -1.0 / self.pixel_m])

    def _fill(self, image: NDArray[Any], outline_m: Floats, value: Colour, smooth: bool = True) -> None:
        """Fill a polygon; OpenCV's pixel origin is the centre of the first pixel, hence the half."""
        points = np.round((self._px(outline_m) - 0.5) * 2**_SHIFT)
        limit = 2.0**30
        points = np.clip(points, -limit, limit).astype(np.int32)
        line = cv2.LINE_AA if smooth and image.dtype == np.uint8 else cv2.LINE_8
        cv2.fillPoly(image, [points], value, lineType=line, shift=_SHIFT)

    def _land(self) -> Floats32:
        """Colours of parcels and ways, roughened by noise and rows."""
        colour = np.full((self.size, self.size, 3), (110, 118, 74), dtype=np.uint8)
        rough = np.full((self.size, self.size, 3), (0.12, 0.1, 0.0), dtype=np.float32)
        wave = np.zeros((self.size, self.size, 3), dtype=np.float32)
        for parcel in self.parcels:
            for p in parcel.patches:
                self._fill(colour, p.outline_m, p.colour)
                self._fill(rough, p.outline_m, (p.fine, p.middle, p.rows), smooth=False)
                if p.rows:
                    along, up = p.rows_rad_per_m
                    start_rad = (along * self.west_m + up * self.north_m) % (2.0 * np.pi)
                    self._fill(wave, p.outline_m, (along, up, start_rad), smooth=False)
        for w in self.ways:
            verge = _ribbon(w.line_m, w.width_m + (2.4 if w.paved else 0.0))
            self._fill(colour, verge, (128, 124, 100) if w.paved else (158, 146, 122))
            self._fill(rough, verge, (0.13, 0.1, 0.0), smooth=False)
        for w in self.ways:
            if w.paved:
                self._fill(colour, _ribbon(w.line_m, w.width_m), (118, 117, 118))
                self._fill(rough, _ribbon(w.line_m, w.width_m), (0.06, 0.06, 0.0), smooth=False)
        for w in self.ways:
            if w.paved:
                for dash in _dashes(w.line_m):
                    self._fill(colour, dash, (205, 204, 198))
        tone = 1.0 + rough[..., 0] * self.fine + rough[..., 1] * self.middle + 0.05 * self.coarse
        if wave.any():
            metres = (np.arange(self.size, dtype=np.float32) + 0.5) * self.pixel_m
            phase = wave[..., 0] * metres - wave[..., 1] * metres[:, None] + wave[..., 2]
            phase += 1.5 * self.coarse
            tone += rough[..., 2] * (1.0 + 0.6 * self.middle) * np.sin(phase)
        image = colour.astype(np.float32) * tone[..., None]
        image += self.hue[..., None] * np.array([5.0, 1.0, -3.0], dtype=np.float32)
        for cover in sorted({p.cover for p in self.parcels if p.cover}):
            paint = np.array(COVERS[cover], dtype=np.float32)
            mask = cover_mask(self.land, cover, self.west_m, self.north_m, self.pixel_m, image.shape[:2])
            image += (mask / np.float32(255.0))[..., None] * (paint - image)
        return np.asarray(image, dtype=np.float32)

    def _shaded(self, image: Floats32) -> Floats32:
        """The shadows that trees, cars and buildings throw on the ground."""
        shadow = np.zeros((self.size, self.size), dtype=np.uint8)
        for east, north, radius, tint in self.trees:
            height = radius * (1.4 + tint)
            centre = self._px(np.array([east, north]) + _SUN * _SHADOW_PER_M * height) - 0.5
            at = np.round(centre * 2**_SHIFT).astype(int)
            cv2.circle(shadow, (int(at[0]), int(at[1])), int(radius / self.pixel_m * 2**_SHIFT), 255, -1,
                       cv2.LINE_AA, _SHIFT)  # fmt: skip
        for b in self.buildings:
            base = b.outline_m()
            both = np.concatenate([base, base + _SUN * _SHADOW_PER_M * b.height_m]).astype(np.float64)
            origin = both.mean(axis=0)
            hull = cv2.convexHull((both - origin).astype(np.float32))[:, 0] + origin
            self._fill(shadow, np.asarray(hull), (255, 255, 255))
        ragged = shadow.astype(np.float32) / 255.0
        ragged *= np.clip(0.92 + 0.1 * self.middle, 0.6, 1.0)
        for w in self.ways:
            for x, y, along, _ in w.cars:
                box = box_m(x + 0.4, y - 0.5, along, 2.2, 0.95)
                part, cover = self._cover(box)
                ragged[part] = np.maximum(ragged[part], cover)
        ragged = np.asarray(cv2.GaussianBlur(ragged, (0, 0), 0.8), dtype=np.float32)
        return np.asarray(image * (1.0 - ragged[..., None] * np.array([0.62, 0.58, 0.48], dtype=np.float32)))

    def _crowns(self, image: Floats32) -> Floats32:
        """Tree crowns: domes with ragged leafy surfaces, lit from the sun's side."""
        if not len(self.trees):
            return image
        height = np.full((self.size, self.size), -1.0, dtype=np.float32)
        tints = np.zeros((self.size, self.size), dtype=np.float32)
        for (x, y), (radius, tint) in zip(self._px(self.trees[:, :2]), self.trees[:, 2:], strict=True):
            r = radius / self.pixel_m * CROWN
            x_0, x_1 = max(int(x - r), 0), min(int(x + r) + 2, self.size)
            y_0, y_1 = max(int(y - r), 0), min(int(y + r) + 2, self.size)
            if x_0 >= x_1 or y_0 >= y_1:
                continue
            d_sq = (np.arange(x_0, x_1) + 0.5 - x) ** 2 + ((np.arange(y_0, y_1) + 0.5 - y) ** 2)[:, None]
            dome = (radius * (1.0 - d_sq / r**2)).astype(np.float32)
            part, tint_part = height[y_0:y_1, x_0:x_1], tints[y_0:y_1, x_0:x_1]
            tint_part[dome > part] = tint
            np.maximum(part, dome, out=part)
        leaf = 0.35 * self.fine * min(1.0, 0.5 + 0.05 / self.pixel_m) + 0.35 * self._noise(5, (4, 8, 16))
        ragged = height + 0.7 * leaf
        cover = np.clip((ragged - 0.15) * 2.5, 0.0, 1.0)
        slope = cv2.Sobel(height + 0.5 * leaf, cv2.CV_32F, 1, 0, scale=0.125) * _SUN[0] - (
            cv2.Sobel(height + 0.5 * leaf, cv2.CV_32F, 0, 1, scale=0.125) * _SUN[1]
        )
        light = np.clip(0.86 - 0.24 * slope / self.pixel_m**0.5 + 0.12 * leaf, 0.3, 1.7)
        light *= np.clip(0.55 + 0.35 * height, 0.5, 1.0)
        green = np.stack([74 + 40 * tints, 96 + 26 * tints, 52 + 12 * tints], axis=-1)
        return np.asarray(image + cover[..., None] * (green * light[..., None] - image), dtype=np.float32)

    def _cars(self, image: Floats32) -> Floats32:
        for w in self.ways:
            for x, y, along, paint in w.cars:
                image = self._over(image, box_m(x, y, along, 2.2, 0.9), paint, 0.03)
                image = self._over(image, box_m(x, y, along, 1.1, 0.75), (46, 50, 56), 0.03)
                image = self._over(image, box_m(x, y, along, 0.75, 0.72), paint, 0.03)
        return image

    def _roofs(self, image: Floats32) -> Floats32:
        """Gable roofs with a light and a dark side and rows of tiles; flat roofs with an edge and boxes."""
        for b in self.buildings:
            if b.road:
                image = self._deck(image, b)
            elif b.ridge_m:
                image = self._hips(image, b)
            elif b.gable:
                for side, across in ((1.0, (0.0, 1.0)), (-1.0, (-1.0, 0.0))):
                    facing = float(b.axes[1] @ _SUN) * side
                    lit = 1.0 - 0.2 * facing
                    image = self._over(image, b.outline_m((-1, 1), across), _times(b.roof, lit), 0.07)
                    for k in range(1, 8):
                        at = side * k / 8.0
                        image = self._over(image, b.outline_m((-1, 1), (at - 0.02, at + 0.02)),
                                           _times(b.roof, lit * 0.84), 0.05)  # fmt: skip
                image = self._over(image, b.outline_m((-1, 1), (-0.03, 0.03)), _times(b.roof, 1.25), 0.05)
                image = self._over(image, b.outline_m((0.3, 0.42), (0.15, 0.35)), (88, 66, 58), 0.1)
            else:
                image = self._over(image, b.outline_m(), _times(b.roof, 1.1), 0.05)
                image = self._over(image, b.outline_m((-0.93, 0.93), (-0.9, 0.9)), _times(b.roof, 0.92), 0.07)
                image = self._over(image, b.outline_m((-0.6, -0.3), (-0.4, 0.1)), (196, 198, 200), 0.05)
                image = self._over(image, b.outline_m((0.2, 0.35), (0.2, 0.5)), (92, 94, 98), 0.05)
        return image

    def _hips(self, image: Floats32, b: Building) -> Floats32:
        """Four faces of a hipped roof, each as light as it faces the sun, rows of tiles on the long ones."""
        end = 1.0 - b.half_width_m / b.half_length_m
        for side in (1.0, -1.0):
            long_side = [(-1.0, side), (1.0, side), (end, 0.0), (-end, 0.0)]
            short_side = [(side, -1.0), (side, 1.0), (side * end, 0.0)]
            for corners, axis in ((long_side, 1), (short_side, 0)):
                lit = 1.0 - 0.2 * float(b.axes[axis] @ _SUN) * side
                image = self._over(image, b.polygon_m(corners), _times(b.roof, lit), 0.1)
            lit = 0.84 * (1.0 - 0.2 * float(b.axes[1] @ _SUN) * side)
            for k in range(1, 8):
                reach, at = end + (1.0 - end) * k / 8.0, side * k / 8.0
                row = b.outline_m((-reach, reach), (at - 0.02, at + 0.02))
                image = self._over(image, row, _times(b.roof, lit), 0.05)
        return self._over(image, b.outline_m((-end, end), (-0.03, 0.03)), _times(b.roof, 1.25), 0.05)

    def _deck(self, image: Floats32, b: Building) -> Floats32:
        """A road between parapets."""
        image = self._over(image, b.outline_m(), b.roof, 0.05)
        image = self._over(image, b.outline_m(across=(-0.9, 0.9)), (118, 117, 118), 0.08)
        ends = np.arange(-b.half_length_m + 2.0, b.half_length_m - 2.0, 7.0)
        for at in ends / b.half_length_m:
            dash = b.outline_m((at, at + 3.0 / b.half_length_m), (-0.016, 0.016))
            image = self._over(image, dash, (205, 204, 198), 0.03)
        return image

    def _over(self, image: Floats32, outline_m: Floats, paint: Colour, rough: float) -> Floats32:
        """Lay a roughened polygon over the image, touching only the part it covers."""
        part, cover = self._cover(outline_m)
        tone = 1.0 + rough * self.fine[part] + 0.6 * rough * self.middle[part]
        image[part] += cover[..., None] * (np.array(paint, dtype=np.float32) * tone[..., None] - image[part])
        return image

    def _cover(self, outline_m: Floats) -> tuple[tuple[slice, slice], Floats32]:
        """The part of the block around a polygon, and how much of each pixel there it covers."""
        xy = self._px(outline_m)
        x_0, y_0 = (int(v) for v in np.clip(np.floor(xy.min(axis=0)) - 1, 0, self.size))
        x_1, y_1 = (int(v) for v in np.clip(np.ceil(xy.max(axis=0)) + 2, 0, self.size))
        mask = np.zeros((max(y_1 - y_0, 0), max(x_1 - x_0, 0)), dtype=np.uint8)
        if mask.size:
            points = np.round((xy - [x_0, y_0] - 0.5) * 2**_SHIFT).astype(np.int32)
            cv2.fillPoly(mask, [points], (255, 255, 255), lineType=cv2.LINE_AA, shift=_SHIFT)
        return np.s_[y_0 : max(y_0, y_1), x_0 : max(x_0, x_1)], mask.astype(np.float32) / np.float32(255.0)


def _times(colour: Colour, factor: float) -> Colour:
    return colour[0] * factor, colour[1] * factor, colour[2] * factor


def box_m(x: float, y: float, along: float, half_length: float, half_width: float) -> Floats:
    """The corners (4, 2) of a rectangle about a point, its long side along an angle from grid east (rad)."""
    return Building(x, y, half_length, half_width, along, 0.0, (0, 0, 0), False).outline_m()


def _ribbon(line_m: Floats, width_m: float) -> Floats:
    """The outline of a line with a width, its ends rounded out by half the width."""
    step = np.gradient(line_m, axis=0)
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    left = np.column_stack([-step[:, 1], step[:, 0]]) * (width_m / 2.0)
    turn = np.linspace(np.pi / 2.0, -np.pi / 2.0, 9)[:, None]

    def cap(at: Floats, ahead: Floats) -> Floats:
        side = np.array([-ahead[1], ahead[0]])
        return np.asarray(at + (np.cos(turn) * ahead + np.sin(turn) * side) * (width_m / 2.0))

    return np.concatenate(
        [line_m + left, cap(line_m[-1], step[-1]), (line_m - left)[::-1], cap(line_m[0], -step[0])]
    )


def _dashes(line_m: Floats) -> list[Floats]:
    """A dashed centre line: 3 m painted, 4 m not, 0.15 m wide."""
    steps = np.linalg.norm(np.diff(line_m, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    at: Callable[[float], Floats] = lambda s: np.array([np.interp(s, along, line_m[:, k]) for k in (0, 1)])  # noqa: E731
    starts = np.arange(6.0, along[-1] - 9.0, 7.0)
    return [_bar(at(float(s)), at(float(s) + 3.0), 0.15) for s in starts]


def _bar(a: Floats, b: Floats, width_m: float) -> Floats:
    ahead = (b - a) / np.linalg.norm(b - a)
    side = np.array([-ahead[1], ahead[0]]) * (width_m / 2.0)
    return np.array([a + side, b + side, b - side, a - side])
