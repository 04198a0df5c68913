"""One window of a mosaic, whatever shows its ground: every source resampled once, blended along seams."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bools, Floats32, Ints32
from geomosaic.composition.blends import STEP_PX, Blend, Piece

_DEPTHS: Final = {"uint8": cv2.CV_8U, "uint16": cv2.CV_16U, "int16": cv2.CV_16S, "float32": cv2.CV_32F}
DTYPES: Final = tuple(_DEPTHS)
"""Of pixels that can be resampled."""


@dataclass(frozen=True)
class Window:
    """A part of the output grid: its first col and row, width and height."""

    col: int
    row: int
    width: int
    height: int

    def grown(self, px: int) -> Window:
        """With so many pixels more on every side, past the grid's edge as well, and in whole steps."""
        width, height = (STEP_PX * -(-n // STEP_PX) + 2 * px for n in (self.width, self.height))
        return Window(self.col - px, self.row - px, width, height)

    def within(self, other: Window) -> tuple[slice, slice]:
        """Its rows and cols in another window that holds it."""
        row, col = self.row - other.row, self.col - other.col
        return slice(row, row + self.height), slice(col, col + self.width)

    def part(self, rows: slice, cols: slice) -> Window:
        """Some of its rows and cols."""
        return Window(
            self.col + cols.start, self.row + rows.start, cols.stop - cols.start, rows.stop - rows.start
        )


@dataclass(frozen=True)
class SourcePixels:
    """Part of a window as one source shows it.

    pixels (h, w, bands): finite anywhere. margin_px (h, w): how far inside the source's valid pixels each one
    lies, in pixels of the mosaic; not above 0 where it isn't valid. None where all are valid and far inside.
    """

    pixels: NDArray[Any]
    margin_px: Floats32 | None


class Source(Protocol):
    """What shows ground and may give the mosaic's pixels: a frame, a CCD strip.

    number: from 0, of all of the mosaic's. `material` is what a source has to be given to show its part: a
    frame's pixels on the grid, lines.
    """

    @property
    def number(self) -> int: ...

    def share(self, window: Window, rows: slice, cols: slice) -> Floats32:
        """How far pixels of part of a window belong to it, broadcasting to (h, w): the largest share gives a
        pixel, of those that are valid there."""

    def shown(self, window: Window, rows: slice, cols: slice, material: Any) -> SourcePixels:
        """Part of a window."""


@dataclass(frozen=True)
class SourcePart:
    """The part of a step's surroundings that a source is asked for."""

    source: Source
    rows: slice
    cols: slice


@dataclass(frozen=True)
class CompositionStep:
    """A window, it in whole steps and as much around it as its seams need, how wide their transition is, and
    the sources' parts in that."""

    window: Window
    around: Window
    reach_px: float
    parts: tuple[SourcePart, ...]


@dataclass(frozen=True)
class Manner:
    """What all windows of a mosaic have in common: its blend, bands and type, and the highest value where
    that is less than the type holds."""

    blend: Blend
    bands: int
    dtype: str
    highest: int | None = None

    def as_type(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Pixels of the mosaic's type."""
        return as_type(pixels, self.dtype, self.highest)


def as_type(pixels: NDArray[Any], dtype: str, highest: int | None = None) -> NDArray[Any]:
    """Pixels (h, w, bands) of a type: rounded (halves to even), cut to what it holds."""
    if pixels.dtype == dtype:
        return pixels
    flat = np.ascontiguousarray(pixels).reshape(len(pixels), -1)
    out = np.asarray(cv2.addWeighted(flat, 1.0, flat, 0.0, 0.0, dtype=_DEPTHS[dtype]))
    if highest is not None:
        np.minimum(out, highest, out=out)
    return out.reshape(pixels.shape)


def scaled(pixels: NDArray[Any], by: Floats32, dtype: str) -> NDArray[Any]:
    """Pixels (h, w, bands) times what is as large, rounded and cut as by `as_type`."""
    of, factors = (np.ascontiguousarray(a).reshape(len(pixels), -1) for a in (pixels, by))
    return np.asarray(cv2.multiply(of, factors, dtype=_DEPTHS[dtype])).reshape(pixels.shape)


@dataclass(frozen=True)
class Composed:
    """A finished window.

    pixels (h, w, bands): 0 where not valid (h, w). label (h, w): the place in `numbers` of the source that
    gives a pixel, -1 where none does. gave: the numbers of the sources that gave pixels. wanted (h, w): what
    of the window was asked for, None for all of it.
    """

    window: Window
    pixels: NDArray[Any]
    valid: Bools
    label: NDArray[np.int16]
    numbers: tuple[int, ...]
    gave: tuple[int, ...]
    wanted: Bools | None = None

    def cut(self, wanted: Bools) -> Composed:
        """Without the pixels that were not asked for."""
        label = np.where(wanted, self.label, np.int16(-1))
        gave = tuple(n for n in self.gave if (label == self.numbers.index(n)).any())
        pixels = np.where(wanted[..., None], self.pixels, self.pixels.dtype.type(0))
        return Composed(self.window, pixels, self.valid & wanted, label, self.numbers, gave, wanted)

    def source(self, dtype: Any = np.int32, at: Any = np.s_[:, :]) -> NDArray[Any]:
        """Of pixels (default: all), the source's number plus 1, 0 where there is none."""
        number = np.array([*self.numbers, -1], dtype=np.int64) + 1
        return np.asarray(np.take(number.astype(dtype), self.label[at], mode="wrap"))

    def cells(self, step_px: int) -> tuple[Ints32, Bools | None]:
        """Of the middle of each cell of n x n pixels the source, as `source` says it, and whether it was
        asked for, None for all of them."""
        rows, cols = (
            np.minimum(np.arange(0, size, step_px) + step_px // 2, size - 1) for size in self.label.shape
        )
        at = np.ix_(rows, cols)
        return self.source(at=at), None if self.wanted is None else self.wanted[at]


def compose_window(manner: Manner, step: CompositionStep, materials: Mapping[int, Any]) -> Composed:
    """All the window's pixels; those no source shows are 0 and not valid."""
    window, around = step.window, step.around
    numbers = tuple(p.source.number for p in step.parts)
    pixels = np.zeros((window.height, window.width, manner.bands), dtype=manner.dtype)
    if not step.parts:
        shape = window.height, window.width
        return Composed(window, pixels, np.zeros(shape, bool), np.full(shape, -1, np.int16), (), ())
    shown = [p.source.shown(around, p.rows, p.cols, materials[p.source.number]) for p in step.parts]
    whole = step.around == window and shown[0].pixels.shape == pixels.shape
    if len(shown) == 1 and shown[0].margin_px is None and whole:
        every = np.ones(pixels.shape[:2], dtype=bool)
        return Composed(window, manner.as_type(shown[0].pixels), every, every - np.int16(1), numbers, numbers)
    label = _label(step, shown)
    inner = window.within(around)
    gave = []
    for k, (part, what) in enumerate(zip(step.parts, shown, strict=True)):
        here, there = _overlap(part, inner)
        mask = label[inner][there] == k
        if mask.any():
            gave.append(numbers[k])
            cv2.copyTo(manner.as_type(what.pixels[here]), mask.view(np.uint8), pixels[there])
    if len(step.parts) > 1:
        _blend(manner, step, shown, label, pixels)
    label = label[inner]
    return Composed(window, pixels, label >= 0, label, numbers, tuple(sorted(gave)))


def _label(step: CompositionStep, shown: Sequence[SourcePixels]) -> NDArray[np.int16]:
    """The part that gives each pixel of the surroundings, -1 where none does."""
    shape = step.around.height, step.around.width
    label, best = np.full(shape, -1, np.int16), np.full(shape, -np.inf, np.float32)
    for k, (part, what) in enumerate(zip(step.parts, shown, strict=True)):
        at = part.rows, part.cols
        mine = np.ones(what.pixels.shape[:2], bool) if what.margin_px is None else what.margin_px > 0.0
        if len(step.parts) > 1:
            share = np.broadcast_to(part.source.share(step.around, *at), mine.shape)
            mine &= share > best[at]
            np.copyto(best[at], share, where=mine)
        np.copyto(label[at], np.int16(k), where=mine)
    return label


def _overlap(part: SourcePart, inner: tuple[slice, slice]) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """What of a part lies in the window: counted from the part's first pixel, and from the window's."""
    here, there = [], []
    for own, all_ in zip((part.rows, part.cols), inner, strict=True):
        first, last = max(own.start, all_.start), max(min(own.stop, all_.stop), own.start, all_.start)
        here.append(slice(first - own.start, last - own.start))
        there.append(slice(first - all_.start, last - all_.start))
    return (here[0], here[1]), (there[0], there[1])


def _blend(
    manner: Manner,
    step: CompositionStep,
    shown: Sequence[SourcePixels],
    label: NDArray[np.int16],
    pixels: NDArray[Any],
) -> None:
    """Blends what lies near seams: a box about the steps in whose reach more than one source gives pixels."""
    mixed = _mixed(label, len(shown), manner.blend.halo_px(step.reach_px))
    inner = step.window.within(step.around)
    wanted = np.repeat(np.repeat(mixed, STEP_PX, axis=0), STEP_PX, axis=1)
    wanted = wanted[: label.shape[0], : label.shape[1]] & (label >= 0)
    if not wanted[inner].any():
        return
    rows, cols = (np.flatnonzero(mixed.any(axis=a)) * STEP_PX for a in (1, 0))
    box = slice(int(rows[0]), int(rows[-1]) + STEP_PX), slice(int(cols[0]), int(cols[-1]) + STEP_PX)
    half = np.float32(max(step.reach_px / 2.0, 1e-6))
    pieces = []
    for k, (part, what) in enumerate(zip(step.parts, shown, strict=True)):
        here, there = _overlap(part, box if (label[box] == k).any() else (slice(0, 0), slice(0, 0)))
        pieces.append(
            Piece(
                *there,
                np.ascontiguousarray(what.pixels[here], dtype=np.float32),
                _inside(what, here, half),
            )
        )
    total = manner.as_type(manner.blend.mosaic(pieces, label[box], step.reach_px))
    (top, left), (row, col) = ((s.start for s in box), (s.start for s in inner))
    first, left_first = max(top, row), max(left, col)
    last, right = min(box[0].stop, inner[0].stop), min(box[1].stop, inner[1].stop)
    cv2.copyTo(
        np.ascontiguousarray(total[first - top : last - top, left_first - left : right - left]),
        wanted[first:last, left_first:right].view(np.uint8),
        pixels[first - row : last - row, left_first - col : right - col],
    )


def _inside(what: SourcePixels, here: tuple[slice, slice], half_px: np.float32) -> Floats32:
    if what.margin_px is None:
        return np.ones([s.stop - s.start for s in here], dtype=np.float32)
    return np.asarray(np.clip(what.margin_px[here] / half_px, 0.0, 1.0))


def _mixed(label: NDArray[np.int16], parts: int, halo_px: int) -> Bools:
    """Steps of STEP_PX within whose reach more than one part gives pixels."""
    side = 2 * (halo_px // STEP_PX) + 1
    down, across = (n // STEP_PX for n in label.shape)
    count = np.zeros((down, across), dtype=np.int16)
    for k in range(parts):
        eights = (label == k).view(np.uint64).reshape(down, STEP_PX, -1)  # pixels side by side
        rows = np.bitwise_or.reduce(eights, axis=1).view(np.uint8)
        mine = rows.reshape(down, across, STEP_PX).any(axis=2)
        count += cv2.dilate(mine.view(np.uint8), np.ones((side, side), np.uint8))
    return np.asarray(count > 1)
