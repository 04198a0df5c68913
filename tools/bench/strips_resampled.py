"""Strips of another sampling than the simulator's: overlaps made of one ground, resampled in three ways.

The simulator's ground is a cubic spline, which the matching resamples well. Here the pixels are means of a
finer ground (`box`), points of it without any blur (`points`), or straight lines between pixels (`linear`).
Texture, jitter, noise and bit depth are drawn by the seed. Faint lines are faint in all pairs at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.survey.strips import StripGeometry
from geomosaic_simulate.strip_plan import StripPlan

Floats = NDArray[np.float64]
SAMPLINGS = ("box", "points", "linear")
_FINE = 3
_MARGIN_PX = 48


@dataclass(frozen=True)
class ResampledScene:
    """edges: of each pair both strips' columns; truth: by pair (lines, 2) dcol, dline of the left's lines."""

    geometry: StripGeometry
    edges: list[tuple[NDArray[Any], NDArray[Any]]]
    truth: dict[int, Floats]


@dataclass(frozen=True)
class _Motion:
    """Pointing errors (camera lines, 2), cols and lines; first: the first camera line of them."""

    px: Floats
    first: int

    def at(self, line: Floats) -> Floats:
        grid = np.arange(len(self.px)) + float(self.first)
        return np.stack([np.interp(line, grid, axis) for axis in self.px.T], axis=1)


def resampled_scene(
    seed: int, lines: int, pairs: int, faint_share: float = 0.0, cloud_cover: float = 0.0
) -> ResampledScene:
    """One scene; faint_share of its lines have a contrast of 0.6 to 1.2 %, clouds hide cloud_cover of it."""
    rng = np.random.default_rng([seed, 2611])
    plan = StripPlan(
        seed=seed, lines=lines, ccds=pairs + 1, first_row=1 + seed % 2, bit_depth=int(rng.choice([10, 12]))
    )
    geometry = plan.geometry()
    motion = _motion(rng, lines, geometry)
    faint = _faint(rng, lines, faint_share)
    clouds = _Clouds(rng, cloud_cover) if cloud_cover else None
    noise, sampling = float(rng.uniform(80, 200)), SAMPLINGS[seed % len(SAMPLINGS)]
    edges, truth = [], {}
    for pair in range(pairs):
        own = _own(rng, lines)
        ground = _ground(rng, geometry, lines, sampling, faint)
        sides, true = _looks(geometry, pair, motion, own, lines)
        made = []
        for look in sides:
            light = _sampled(ground, look, sampling)
            if clouds is not None:
                light = clouds.over(light, look, pair, geometry)
            made.append(_counts(rng, light, geometry.bit_depth, noise))
        edges.append((made[0], made[1]))
        truth[pair] = true
    return ResampledScene(geometry, edges, truth)


def _motion(rng: np.random.Generator, lines: int, geometry: StripGeometry) -> _Motion:
    spare = 2 * round(geometry.row_separation_lines)
    time_s = (np.arange(lines + 2 * spare) - spare) / geometry.line_rate_hz
    px = np.outer(time_s, rng.normal(0.0, 2.0, 2))
    for low_hz, high_hz, size_px in ((0.5, 2.0, 1.0), (3.0, 8.0, 0.3), (15.0, 35.0, 0.05)):
        hz = rng.uniform(low_hz, high_hz)
        phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        px += size_px * rng.uniform(0.5, 1.5, 2) * np.sin(2.0 * np.pi * hz * time_s[:, None] + phase)
    return _Motion(px, -spare)


def _own(rng: np.random.Generator, lines: int) -> Floats:
    """A pair's own part (lines, 2) by camera line of the leading strip: mounting, and hills along lines."""
    at = np.arange(lines)
    out = np.tile(rng.normal(0.0, 1.5, 2), (lines, 1))
    for _ in range(3):
        wave = np.sin(2.0 * np.pi * (at / rng.uniform(2500.0, 9000.0) + rng.uniform()))
        out += wave[:, None] * rng.normal(0.0, [0.05, 0.4])
    return out


def _faint(rng: np.random.Generator, lines: int, share: float) -> Floats:
    """Contrast (lines,) of full contrast: faint on stretches that together have the share."""
    if not share:
        return np.ones(lines)
    field = cv2.GaussianBlur(rng.normal(size=(lines, 1)), (1, 0x1001), sigmaX=1.0, sigmaY=500.0)[:, 0]
    inside = 1.0 / (1.0 + np.exp((field - np.quantile(field, share)) / (0.02 * field.std())))
    return np.asarray((rng.uniform(0.05, 0.1)) ** inside)


def _ground(
    rng: np.random.Generator, geometry: StripGeometry, lines: int, sampling: str, faint: Floats
) -> NDArray[np.float32]:
    """Brightness about 1, with a margin on every side; finer by 3 where pixels are means or points."""
    fine = 1 if sampling == "linear" else _FINE
    n, w = (lines + 2 * _MARGIN_PX) * fine, (geometry.read_px + 2 * _MARGIN_PX) * fine
    tone = np.zeros((n, w), dtype=np.float32)
    slope = rng.uniform(0.6, 1.1)
    for scale in (0.6, 1.5, 4.0, 12.0, 40.0):
        step = max(int(scale * fine / 2.0), 1)
        field = rng.standard_normal((n // step + 8, w // step + 8), dtype=np.float32)
        field = cv2.GaussianBlur(field, (0, 0), max(scale * fine / step, 0.6))
        field /= np.float32(field.std())
        field = cv2.resize(field, None, fx=step, fy=step, interpolation=cv2.INTER_CUBIC)[:n, :w]
        tone += np.float32(scale**slope) * field
    tone *= np.float32(0.12) / tone.std()
    per_line = np.interp((np.arange(n) + 0.5) / fine - _MARGIN_PX, np.arange(lines), faint)
    ground = np.float32(1.0) + tone * per_line[:, None].astype(np.float32)
    return np.asarray(cv2.blur(ground, (fine, fine)) if sampling == "box" else ground)


def _looks(
    geometry: StripGeometry, pair: int, motion: _Motion, own: Floats, lines: int
) -> tuple[tuple[Floats, Floats], Floats]:
    """Where the left and the right strip's lines look (lines, 2: col of their first read column, row), and
    the truth. A leading line u looks at row u + a(u), a trailing one v at v - S + a(v) - p(v - S)."""
    apart, side = geometry.row_separation_lines, geometry.side(pair)
    camera = np.arange(lines, dtype=np.float64)

    def leading(line: Floats) -> Floats:
        return motion.at(line) + np.stack([np.zeros_like(line), line], axis=1)

    def trailing(line: Floats) -> Floats:
        part = np.stack([np.interp(line - apart, camera, axis) for axis in own.T], axis=1)
        return leading(line) - part - [0.0, apart]

    left, right = (leading, trailing)[::side]
    seen = left(camera)
    there = camera + side * apart
    for _ in range(30):
        there = there + (seen - right(there))[:, 1]
    true = np.stack([(seen - right(there))[:, 0], there - camera - side * apart], axis=1)
    step = geometry.read_px - geometry.overlap_px
    return (left(camera), right(camera) + np.array([step, 0.0])), true


def _sampled(ground: NDArray[np.float32], look: Floats, sampling: str) -> NDArray[np.float32]:
    fine = 1 if sampling == "linear" else _FINE
    width = ground.shape[1] // fine - 2 * _MARGIN_PX
    cols = look[:, :1] + np.arange(width) + _MARGIN_PX
    rows = np.broadcast_to(look[:, 1:] + _MARGIN_PX, cols.shape)
    return _linear(ground, cols * fine + (fine - 1) / 2.0, rows * fine + (fine - 1) / 2.0)


def _linear(image: NDArray[np.float32], cols: Floats, rows: Floats) -> NDArray[np.float32]:
    """Straight between pixels, without the steps of 1/32 px that OpenCV's tables have."""
    cols, rows = np.clip(cols, 0, image.shape[1] - 1.001), np.clip(rows, 0, image.shape[0] - 1.001)
    c, r = cols.astype(np.int64), rows.astype(np.int64)
    x, y = (cols - c).astype(np.float32), (rows - r).astype(np.float32)
    flat, at, width = image.ravel(), r * image.shape[1] + c, image.shape[1]
    above = flat[at] * (1 - x) + flat[at + 1] * x
    below = flat[at + width] * (1 - x) + flat[at + width + 1] * x
    return np.asarray(above * (1 - y) + below * y)


class _Clouds:
    """A deck that lies some pixels off the ground, by wind and height; mostly brighter than the ground."""

    def __init__(self, rng: np.random.Generator, cover: float) -> None:
        self._off = np.array([rng.normal(0.0, 6.0), -rng.uniform(2.0, 30.0)])
        self._field = cv2.GaussianBlur(rng.standard_normal((4096, 512), dtype=np.float32), (0, 0), 6.0)
        self._threshold = float(np.quantile(self._field, 1.0 - cover))

    def over(
        self, light: NDArray[np.float32], look: Floats, pair: int, geometry: StripGeometry
    ) -> NDArray[np.float32]:
        """The light where the deck lies over it; it is seen twice, `_off` apart."""
        off = 0.5 * self._off * (1.0 if look[0, 1] > -1000.0 else -1.0)
        rows = (look[:, 1:] + off[1]) / 16.0 + 200.0
        cols = (np.arange(light.shape[1]) + look[:, :1] + off[0]) / 16.0 + 40.0 + 56.0 * pair
        thick = _linear(self._field, cols, np.broadcast_to(rows, cols.shape)) - self._threshold
        thick = thick / self._field.std()
        cover = np.clip(0.5 + thick / 0.2, 0.0, 1.0)
        return np.asarray(light + cover * (2.2 + 0.3 * np.tanh(thick) - light), dtype=np.float32)


def _counts(rng: np.random.Generator, light: NDArray[np.float32], bit_depth: int, snr: float) -> NDArray[Any]:
    full = 2.0**bit_depth - 1.0
    mean = 0.35 * full * (1.0 + 0.03 * rng.standard_normal())
    columns = (1.0 + 0.005 * rng.standard_normal(light.shape[1])).astype(np.float32)
    noise = rng.standard_normal(light.shape, dtype=np.float32) * np.sqrt(light) * np.float32(mean / snr)
    return np.rint(np.clip(light * columns * np.float32(mean) + noise, 0.0, full)).astype(np.uint16)
