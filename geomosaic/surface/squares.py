"""Squares of a tile's cells side by side, and what the frames that are asked in each show there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bools, Bytes, Floats32, Ints
from geomosaic.surface.plane_sweep import SWEPT_AT_ONCE, Block, PlaneSweep
from geomosaic.surface.visibility import Asked

SquareView = tuple[Bytes, Bools | None]
_NOBODY: Final = -1


@dataclass(frozen=True)
class SweptPictures:
    """A sweep and its frames' grey pictures."""

    sweep: PlaneSweep
    pictures: Sequence[Bytes]


class Squares:
    """n squares, each with a rim on every side that lies within the tile."""

    def __init__(
        self,
        sweep: PlaneSweep,
        pictures: Sequence[Bytes],
        asked: Asked,
        rim: int,
        size: tuple[int, int] | None = None,
    ) -> None:
        """asked: blocks of cells, and the frames that are asked there; those of one frame are left out.
        pictures: grey, of the sweep's frames. size: rows and cols of each with its rims, else those of the
        largest."""
        self._sweep, self._pictures, self._rim = sweep, pictures, rim
        self._asked = [(at, frames) for at, frames in asked if len(frames) > 1]
        shape = sweep.base_m.shape
        self._size = size or self._largest(shape)
        self._at = [self._widened(at, shape) for at, _ in self._asked]
        """Where each lies in the tile, rim and all."""

    def _largest(self, shape: tuple[int, ...]) -> tuple[int, int]:
        rows, cols = (
            min(max((at[k].stop - at[k].start for at, _ in self._asked), default=0) + 2 * self._rim, n)
            for k, n in enumerate(shape)
        )
        return rows, cols

    def _widened(self, at: Block, shape: tuple[int, ...]) -> Block:
        first = [
            max(min(s.start - self._rim, n - k), 0) for s, n, k in zip(at, shape, self._size, strict=True)
        ]
        rows, cols = (slice(f, f + k) for f, k in zip(first, self._size, strict=True))
        return rows, cols

    def __len__(self) -> int:
        return len(self._asked)

    def some(self, points: int) -> Iterator[Squares]:
        """A few at a time, of whose cells so many points each are looked at."""
        count = max(SWEPT_AT_ONCE // max(points * self._size[0] * self._size[1], 1), 1)
        for first in range(0, len(self), count):
            asked = self._asked[first : first + count]
            yield Squares(self._sweep, self._pictures, asked, self._rim, self._size)

    def cut(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values (..., rows, cols) of a tile's cells, (n, ..., rows, cols) of the squares'."""
        return np.stack([values[..., *at] for at in self._at])

    def put(self, values: NDArray[Any], out: NDArray[Any]) -> None:
        """Values (n, rows, cols) of the squares, without rims, to their places among the tile's cells."""
        for (at, _), wide, own in zip(self._asked, self._at, values, strict=True):
            rows, cols = (slice(s.start - w.start, s.stop - w.start) for s, w in zip(at, wide, strict=True))
            out[at] = own[rows, cols]

    @cached_property
    def _frames(self) -> Ints:
        """(frames, n): whom each square asks first, second and so on."""
        most = max((len(frames) for _, frames in self._asked), default=0)
        return np.array(
            [[*frames, *[_NOBODY] * (most - len(frames))] for _, frames in self._asked], dtype=np.intp
        ).T

    @cached_property
    def _terms(self) -> Floats32:
        """Of each asked frame (frames, 2, 3, n, rows, cols): see `PlaneSweep.terms`."""
        found = np.zeros((*self._frames.shape[:1], 2, 3, len(self), *self._size), dtype=np.float32)
        for rank, frames in enumerate(self._frames):
            for k, (frame, at) in enumerate(zip(frames.tolist(), self._at, strict=True)):
                if frame != _NOBODY:
                    found[rank, :, :, k] = self._sweep.terms(frame)[..., *at]
        return found

    def shown(
        self, height_m: Floats32, hidden_below_m: Mapping[int, Floats32], by: int = 1
    ) -> list[SquareView]:
        """Grey levels of each asked frame at heights over the base (n, heights, rows, cols), and where it
        sees the points. These are `by` times as dense each way as the cells. Where it sees is None if it sees
        all of them.

        hidden_below_m (rows, cols of the tile), by frame: see `hidden_below`.
        """
        bent = self._sweep.bent(height_m)
        found = []
        for frames, terms in zip(self._frames, self._terms, strict=True):
            col, row = (_place(one, bent, by) for one in terms)
            grey = np.zeros(height_m.shape, dtype=np.uint8)
            sees: Bools | None = None
            for frame in np.unique(frames).tolist():
                of = np.flatnonzero(frames == frame)
                alone = len(of) == len(frames)
                seen: Bools | bool | None = False
                if frame != _NOBODY:
                    places = (col, row) if alone else (col[of], row[of])
                    grey[of], seen = self._shown(frame, *places)
                    low_m = hidden_below_m.get(frame)
                    if low_m is not None:
                        seen = _and(seen, self._unhidden(low_m, of, height_m, by))
                if seen is not None:
                    sees = np.ones(height_m.shape, dtype=np.bool_) if sees is None else sees
                    sees[of] = seen
            found.append((grey, sees))
        return found

    def _shown(self, frame: int, col: Floats32, row: Floats32) -> tuple[Bytes, Bools | None]:
        picture = self._pictures[frame]
        flat = col.reshape(-1, col.shape[-1]), row.reshape(-1, row.shape[-1])
        grey = cv2.remap(picture, *flat, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(grey, dtype=np.uint8).reshape(col.shape), _inside(col, row, picture.shape)

    def _unhidden(self, low_m: Floats32, of: Ints, height_m: Floats32, by: int) -> Bools | None:
        low = np.stack([low_m[self._at[k]] for k in of])
        if low.max() <= height_m.min():
            return None
        if by > 1:
            low = low.repeat(by, axis=1).repeat(by, axis=2)
        return np.asarray(height_m[of] >= low[:, None])


def by_first(shown: Sequence[SquareView]) -> tuple[Bytes, list[SquareView]]:
    """What the first frame that sees a place shows there; and what each shows, and where it sees a place and
    is not the first itself. One that is the first everywhere is left out."""
    (first, sees), *others = shown
    if sees is None:
        return first, others
    first, lacking = first.copy(), ~sees
    found: list[SquareView] = [(first, np.zeros_like(sees))]
    for grey, sees in others:
        own = lacking if sees is None else lacking & sees
        np.copyto(first, grey, where=own)
        found.append((grey, ~own if sees is None else sees & ~own))
        lacking = lacking & ~own
    return first, found


def dense(values: NDArray[Any], by: int, interpolation: int) -> NDArray[Any]:
    """Values (..., rows, cols) by times as dense each way; squares lie one below the other, and are mixed at
    their rims, which nobody looks at."""
    *more, rows, cols = values.shape
    flat = values.reshape(-1, cols)
    found = cv2.resize(flat, (by * cols, by * len(flat)), interpolation=interpolation)
    return np.asarray(found).reshape(*more, by * rows, by * cols)


def _place(terms: Floats32, bent: Floats32, by: int) -> Floats32:
    """Cols or rows in a picture (n, heights, rows, cols); terms: as `PlaneSweep.terms`."""
    constant, linear, square = terms if by == 1 else dense(terms, by, cv2.INTER_LINEAR)
    place = bent * square[:, None]
    place += linear[:, None]
    place *= bent
    place += constant[:, None]
    return np.asarray(place)


def _and(one: Bools | None, other: Bools | None) -> Bools | None:
    if one is None or other is None:
        return one if other is None else other
    return np.asarray(one & other)


def _inside(col: Floats32, row: Floats32, shape: tuple[int, ...]) -> Bools | None:
    """Which places lie in a picture; None where all do."""
    down, across = shape
    if col.min() >= 0.0 and col.max() <= across - 1.0 and row.min() >= 0.0 and row.max() <= down - 1.0:
        return None
    return np.asarray((col >= 0.0) & (col <= across - 1.0) & (row >= 0.0) & (row <= down - 1.0))
