"""What two frames show at full resolution where their tie points disagree most."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomosaic.arrays import Bytes, Floats
from geomosaic.constants import tuned
from geomosaic.recording.file.thumbnail import thumbnail

SIDE_PX: Final = 400  # of a chip's half: less hides what the ground is; 20 chips take 2 MB
_WORST = tuned(0.2, "share", "of a pair's tie points: chips are cut where most of the worst lie")


@dataclass(frozen=True)
class Cut:
    """Where to cut. corner_px: col and row of the square's corner in the frame; quarters: by how many times
    90 degrees anticlockwise what was cut is turned."""

    corner_px: tuple[int, int]
    quarters: int = 0

    def places(self, image_px: Floats, side_px: int = SIDE_PX) -> Floats:
        """Where points (n, 2) of the frame are in what was cut."""
        x, y = (image_px - self.corner_px).T
        for _ in range(self.quarters % 4):
            x, y = y, side_px - x
        return np.column_stack([x, y])

    def pixels(self, frame: NDArray[Any], side_px: int = SIDE_PX) -> NDArray[Any]:
        """(side_px, side_px, bands) of a frame's pixels; black beyond its edge."""
        col, row = self.corner_px
        out = np.zeros((side_px, side_px, frame.shape[2]), dtype=frame.dtype)
        seen = frame[max(row, 0) : max(row + side_px, 0), max(col, 0) : max(col + side_px, 0)]
        top, left = max(-row, 0), max(-col, 0)
        out[top : top + seen.shape[0], left : left + seen.shape[1]] = seen
        return np.ascontiguousarray(np.rot90(out, self.quarters % 4))


@dataclass(frozen=True)
class Chip:
    """Two halves side by side, and the tie points in both.

    left_xy, right_xy (n, 2): places in the whole image. residual_m (n, 2): east and north. weight (n,): the
    solve's, NaN for those that took no part.
    """

    jpeg: bytes
    side_px: int
    left_corner_px: tuple[int, int]
    right_corner_px: tuple[int, int]
    right_quarters: int
    left_xy: Floats
    right_xy: Floats
    residual_m: Floats
    weight: Floats


def cuts(left_px: Floats, right_px: Floats, residual_m: Floats) -> tuple[Cut, Cut]:
    """Where to cut in both frames: about the tie point (n, 2 each) that has most of the worst near it. The
    right cut is turned by quarters, as the tie points of both show it."""
    length = np.nan_to_num(np.hypot(*residual_m.T), nan=np.inf)
    worst = np.argsort(-length, kind="stable")[: max(1, int(np.ceil(_WORST * len(length))))]
    away = np.abs(left_px[worst, None] - left_px[None, worst]).max(axis=2)
    middle = worst[int(np.argmax((away < SIDE_PX / 2).sum(axis=1)))]
    a, b = left_px - left_px.mean(axis=0), right_px - right_px.mean(axis=0)
    angle = np.angle(np.sum((b[:, 0] + 1j * b[:, 1]) * (a[:, 0] - 1j * a[:, 1])))
    quarters = int(np.round(angle / (np.pi / 2))) % 4
    corners = [tuple(int(v) for v in np.round(px[middle] - SIDE_PX / 2)) for px in (left_px, right_px)]
    return Cut((corners[0][0], corners[0][1])), Cut((corners[1][0], corners[1][1]), quarters)


def shown(image: NDArray[Any]) -> Bytes:
    """Pixels (rows, cols, bands) as three bands of eight bits, blue first, as `thumbnail` would show them."""
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image[..., 2::-1] if image.shape[2] > 2 else image[..., [0, 0, 0]])
    small = cv2.imdecode(
        np.frombuffer(thumbnail(image, max(image.shape[:2]), 100), np.uint8), cv2.IMREAD_COLOR
    )
    return np.asarray(small, dtype=np.uint8)


def chip(
    halves: tuple[Bytes, Bytes],
    where: tuple[Cut, Cut],
    points_px: tuple[Floats, Floats],
    residual_m: Floats,
    weight: ArrayLike,
) -> Chip:
    """Args: halves: as `Cut.pixels` and `shown` give them; points_px: all tie points (n, 2) of a pair in the
    left and the right frame, of which those are kept that lie in both halves."""
    done, jpeg = cv2.imencode(".jpg", np.concatenate(halves, axis=1), [cv2.IMWRITE_JPEG_QUALITY, 85])
    assert done
    left, right = (cut.places(px) for cut, px in zip(where, points_px, strict=True))
    inside = ((left >= 0) & (left < SIDE_PX) & (right >= 0) & (right < SIDE_PX)).all(axis=1)
    return Chip(
        jpeg.tobytes(),
        SIDE_PX,
        where[0].corner_px,
        where[1].corner_px,
        where[1].quarters,
        left[inside],
        right[inside] + [SIDE_PX, 0],
        residual_m[inside],
        np.asarray(weight, dtype=np.float64)[inside],
    )
