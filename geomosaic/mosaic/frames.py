"""Decoded frames in bounded memory. The windows' plan is known, so what is needed last goes first."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.survey.model import Frame
from geomosaic.survey.pixels import read_pixels

Floats32 = NDArray[np.float32]
_DISTANCE_BYTES = np.dtype(np.float32).itemsize
_FULLY_VALID = (".jpg", ".jpeg")


@dataclass(frozen=True)
class Decoded:
    """A frame's pixels (rows, cols, bands), and per pixel the distance in px to the nearest one whose
    resampling would touch an invalid pixel, or None where all are valid."""

    pixels: NDArray[Any]
    mask_distance_px: Floats32 | None


def may_be_masked(frame: Frame) -> bool:
    """False where the format has no invalid pixels; else only decoding shows."""
    jpeg = frame.path.lower().endswith(_FULLY_VALID)
    return not jpeg or frame.valid_mask is not None or frame.nodata is not None


def decode(frame: Frame, kernel_radius_px: int) -> Decoded:
    """One frame off the disk, ready to be resampled."""
    pixels, mask = read_pixels(frame)
    if mask is None or mask.all():
        return Decoded(pixels, None)
    reach = np.ones((2 * kernel_radius_px + 1, 2 * kernel_radius_px + 1), dtype=np.uint8)
    safe = cv2.erode((mask != 0).astype(np.uint8), reach)
    distance = cv2.distanceTransform(safe, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return Decoded(pixels, np.asarray(distance, dtype=np.float32))


def decoded_bytes(frame: Frame) -> int:
    """What a decoded frame takes, its mask's distances included if it may have some."""
    per_pixel = frame.bands * np.dtype(frame.dtype).itemsize
    per_pixel += _DISTANCE_BYTES if may_be_masked(frame) else 0
    return frame.width_px * frame.height_px * per_pixel


class DecodedFrames:
    """Hands out frames step by step of a plan known beforehand, decoding each as rarely as memory allows.

    `plan[n]` lists the frames step n needs. When memory runs short the frame needed farthest in the future
    is forgotten (Belady 1966, the best any cache can do); one never needed again goes at once. A step's own
    frames are kept even if they are larger than the budget together.
    """

    def __init__(
        self,
        plan: Sequence[Sequence[int]],
        sizes_bytes: Mapping[int, int],
        memory_bytes: int,
        pool: Executor,
        decode: Callable[[int], Decoded],
    ) -> None:
        self.decodes = 0
        self._plan, self._sizes, self._memory, self._pool, self._decode = (
            plan,
            sizes_bytes,
            memory_bytes,
            pool,
            decode,
        )
        self._uses: dict[int, deque[int]] = {}
        for step, frames in enumerate(plan):
            for frame in frames:
                self._uses.setdefault(frame, deque()).append(step)
        self._kept: dict[int, Future[Decoded]] = {}

    def for_step(self, step: int) -> dict[int, Future[Decoded]]:
        """The step's frames; to be called once for each step, in order."""
        needed = self._plan[step]
        given = {}
        self._make_room(0, needed)
        for frame in needed:
            if frame not in self._kept:
                self._make_room(self._sizes[frame], needed)
                self._kept[frame] = self._pool.submit(self._decode, frame)
                self.decodes += 1
            given[frame] = self._kept[frame]
        for frame in needed:
            self._uses[frame].popleft()
            if not self._uses[frame]:
                del self._kept[frame]
        return given

    def _make_room(self, size_bytes: int, needed: Sequence[int]) -> None:
        while sum(self._sizes[f] for f in self._kept) + size_bytes > self._memory:
            spare = [f for f in self._kept if f not in needed]
            if not spare:
                return
            del self._kept[max(spare, key=lambda f: (self._uses[f][0], f))]
