"""A drawing in map metres, and what is drawn on it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np

from geomosaic.arrays import Bytes, Floats

Colour = tuple[int, int, int]
PAPER: Final[Colour] = (255, 255, 255)
INK: Final[Colour] = (50, 50, 50)
RED: Final[Colour] = (40, 40, 220)
GOOD: Final[Colour] = (90, 170, 40)
_MARGIN_PX: Final = 60
_LINE_PX: Final = 20
_TIP_PX: Final = 14
_LETTERS: Final = (cv2.FONT_HERSHEY_SIMPLEX, 0.45)
_FARTHEST: Final = 30.0
"""Extents of the middle nine tenths that is drawn: farther points lie beyond the edge."""


class Canvas:
    """White, east to the right and north up, all of `at_m` (n, 2) in it. Colours are blue, green, red."""

    def __init__(self, at_m: Floats, width_px: int) -> None:
        seen = at_m[np.isfinite(at_m).all(axis=1)]
        seen = seen if len(seen) else np.zeros((1, 2))
        middle = np.median(seen, axis=0)
        reach = np.maximum(np.quantile(np.abs(seen - middle), 0.9, axis=0), 0.5) * _FARTHEST
        seen = np.clip(seen, middle - reach, middle + reach)
        low, high = seen.min(axis=0), seen.max(axis=0)
        span = np.maximum(high - low, 1e-3)
        inner = width_px - 2 * _MARGIN_PX
        self._px_per_m = float(min(inner / span[0], inner / span[1]))
        size = np.maximum(span * self._px_per_m, 60.0) + 2 * _MARGIN_PX
        self._low, self._height = low, float(size[1])
        self.image: Bytes = np.full((int(size[1]), max(int(size[0]), 700), 3), 255, dtype=np.uint8)

    def _at(self, m: Floats) -> tuple[int, int] | None:
        """Where a point (2,) is drawn; None for one that lies nowhere near."""
        if not np.isfinite(m).all():
            return None
        x, y = (m - self._low) * self._px_per_m + _MARGIN_PX
        x, y = np.clip([x, self._height - y], -20_000, 20_000)
        return round(float(x)), round(float(y))

    def ring(self, ring_m: Floats, colour: Colour) -> None:
        """A closed outline (k, 2)."""
        points = [p for p in map(self._at, ring_m) if p is not None]
        if len(points) > 2:
            cv2.polylines(self.image, [np.array(points, np.int32)], True, colour, 1, cv2.LINE_AA)

    def line(self, ends_m: Floats, colour: Colour, dashed: bool = False) -> None:
        """A line between two points (2, 2)."""
        a, b = self._at(ends_m[0]), self._at(ends_m[1])
        if a is None or b is None:
            return
        if not dashed:
            cv2.line(self.image, a, b, colour, 2, cv2.LINE_AA)
            return
        for k in range(0, 20, 2):
            (x, y), (dx, dy) = a, (b[0] - a[0], b[1] - a[1])
            p, q = ((x + dx * n // 20, y + dy * n // 20) for n in (k, k + 1))
            cv2.line(self.image, p, q, colour, 1, cv2.LINE_AA)

    def arrow(self, start_m: Floats, end_m: Floats, colour: Colour) -> None:
        """An arrow, if it can be seen."""
        a, b = self._at(start_m), self._at(end_m)
        if a is None or b is None:
            return
        length = float(np.hypot(a[0] - b[0], a[1] - b[1]))
        if length >= 4.0:
            cv2.arrowedLine(self.image, a, b, colour, 2, cv2.LINE_AA, tipLength=min(0.3, _TIP_PX / length))

    def dot(self, at_m: Floats, colour: Colour, small: bool = False) -> None:
        at = self._at(at_m)
        if at is not None:
            cv2.circle(self.image, at, 1 if small else 4, colour, -1, cv2.LINE_AA)

    def label(self, at_m: Floats, words: str, colour: Colour) -> None:
        """Words next to a point, on white: to its right, or to its left where there is no room."""
        at = self._at(at_m)
        if at is not None:
            (wide, _), _ = cv2.getTextSize(words, *_LETTERS, 1)
            right = at[0] + 8
            x = right if right + wide <= self.image.shape[1] else max(at[0] - 8 - wide, 0)
            write(self.image, words, (x, at[1] - 8), colour)

    def finished(self, foot: Sequence[str]) -> Bytes:
        """The drawing with a scale bar and lines of words below."""
        longest_m = 200.0 / self._px_per_m
        step = 10.0 ** np.floor(np.log10(longest_m))
        bar_m = float(max(k * step for k in (1, 2, 5) if k * step <= longest_m))
        band = np.full((_LINE_PX * (len(foot) + 2), self.image.shape[1], 3), 255, dtype=np.uint8)
        for k, words in enumerate(foot):
            write(band, words, (10, _LINE_PX * (k + 1)), INK)
        y = _LINE_PX * (len(foot) + 1)
        cv2.line(band, (10, y), (10 + round(bar_m * self._px_per_m), y), INK, 3)
        write(band, f"{bar_m:g} m", (20 + round(bar_m * self._px_per_m), y + 4), INK)
        return np.concatenate([self.image, band])


def png_of(image: Bytes) -> bytes:
    return bytes(cv2.imencode(".png", image)[1].tobytes())


def write(image: Bytes, words: str, at: tuple[int, int], colour: Colour) -> None:
    """Letters that the drawing knows (ASCII) on a white rim; others as question marks."""
    text = "".join(c if " " <= c <= "~" else "?" for c in words)
    for shade, thick in ((PAPER, 4), (colour, 1)):
        cv2.putText(image, text, at, *_LETTERS, shade, thick, cv2.LINE_AA)
