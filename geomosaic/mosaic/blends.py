"""How frames pass into each other at seams.

A blend takes, for k frames over one window of h x w pixels and as much around it as its reach asks for,

    pictures: k arrays (h, w, bands), float32; what a frame doesn't show is anything finite;
    inside (k, h, w): 0 where the frame has no valid pixel, rising to 1 over half the reach from its edge and
        from its invalid pixels inwards;
    label (h, w): the frame (from 0) that gives each pixel, -1 where none does;
    reach_px: how wide the transition is;

and gives the mosaic (h, w, bands), float32; anything where no frame has a valid pixel. Pixels farther from
the window's edge than `halo_px` of the reach are the same whatever else a window holds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

Floats32 = NDArray[np.float32]
Labels = NDArray[np.int32]
_LEVELS: Final = 4
"""Differences of colour are spread over 2^4 px and more either side, detail over a pixel or two (Burt and
Adelson 1983, ACM Transactions on Graphics 2)."""
_STEP_PX: Final = 1 << _LEVELS


@dataclass(frozen=True)
class Blend:
    """A way to blend, and how much around a window it looks at: halo_px of a reach in px."""

    mosaic: Callable[[Sequence[Floats32], Floats32, Labels, float], Floats32]
    halo_px: Callable[[float], int]


def hard(pictures: Sequence[Floats32], inside: Floats32, label: Labels, reach_px: float) -> Floats32:
    """Every pixel is one frame's."""
    out = np.zeros_like(pictures[0])
    for k, picture in enumerate(pictures):
        np.copyto(out, picture, where=(label == k)[..., None])
    return out


def feather(pictures: Sequence[Floats32], inside: Floats32, label: Labels, reach_px: float) -> Floats32:
    """Straight from one frame to the other over the reach, and to nothing where a frame ends."""
    side = 2 * round(reach_px / 2.0) + 1
    total, weights = np.zeros_like(pictures[0]), np.zeros(label.shape, dtype=np.float32)
    for k, picture in enumerate(pictures):
        mine = (label == k).astype(np.float32)
        weight = cv2.blur(mine, (side, side), borderType=cv2.BORDER_REPLICATE) * inside[k]
        weight += mine * np.float32(1e-4)
        total += picture * weight[..., None]
        weights += weight
    np.divide(total, weights[..., None], out=total, where=weights[..., None] > 0.0)
    return total


def multi_band(pictures: Sequence[Floats32], inside: Floats32, label: Labels, reach_px: float) -> Floats32:
    """Each band of frequencies over its own wavelength: no step of brightness, and nothing doubled.

    What a frame doesn't show is taken from the mosaic, so that it pulls nothing towards black.
    """
    plain = hard(pictures, inside, label, reach_px)
    _fill(plain, label >= 0)
    height, width, bands = plain.shape
    whole = _STEP_PX * -(-height // _STEP_PX), _STEP_PX * -(-width // _STEP_PX)
    sums = [np.zeros((whole[0] >> n, whole[1] >> n, bands), dtype=np.float32) for n in range(_LEVELS + 1)]
    weights = [np.zeros(s.shape[:2], dtype=np.float32) for s in sums]
    plain = _padded(plain, whole)
    for k, picture in enumerate(pictures):
        at = _reached(label == k, whole)
        if at is None:
            continue
        full = at[0], at[1]
        mask = _padded((label == k).astype(np.float32), whole)[full]
        shown = _padded(inside[k] > 0.0, whole)[full][..., None]
        own = np.where(shown, _padded(picture, whole)[full], plain[full])
        for n in range(_LEVELS + 1):
            here = tuple(slice(s.start >> n, s.stop >> n) for s in at)
            if n < _LEVELS:
                smaller = cv2.pyrDown(own)
                detail = own - cv2.pyrUp(smaller, dstsize=own.shape[1::-1]).reshape(own.shape)
            else:
                smaller, detail = own, own
            sums[n][here] += detail.reshape(*own.shape) * mask[..., None]
            weights[n][here] += mask
            if n < _LEVELS:
                own = smaller.reshape(*smaller.shape[:2], bands)
                mask = cv2.pyrDown(mask)
    out = np.zeros_like(sums[-1])
    for total, weight in zip(reversed(sums), reversed(weights), strict=True):
        if out.shape != total.shape:
            out = cv2.pyrUp(out, dstsize=total.shape[1::-1]).reshape(total.shape)
        out += total / np.maximum(weight, np.float32(1e-12))[..., None]
    return out[:height, :width]


def _reached(mine: NDArray[np.bool_], whole: tuple[int, int]) -> tuple[slice, slice] | None:
    """Whole steps about the pixels of a frame, as far as its weights reach at the coarsest level."""
    rows, cols = np.flatnonzero(mine.any(axis=1)), np.flatnonzero(mine.any(axis=0))
    if not rows.size:
        return None
    reach = 4 * _STEP_PX
    return (
        slice(
            max(rows[0] // _STEP_PX * _STEP_PX - reach, 0),
            min(rows[-1] // _STEP_PX * _STEP_PX + reach + _STEP_PX, whole[0]),
        ),
        slice(
            max(cols[0] // _STEP_PX * _STEP_PX - reach, 0),
            min(cols[-1] // _STEP_PX * _STEP_PX + reach + _STEP_PX, whole[1]),
        ),
    )


def _padded(a: NDArray[Any], whole: tuple[int, int]) -> NDArray[Any]:
    more = [(0, whole[0] - a.shape[0]), (0, whole[1] - a.shape[1])] + [(0, 0)] * (a.ndim - 2)
    return np.pad(a, more, mode="edge") if any(m[1] for m in more) else a


def _fill(picture: Floats32, valid: NDArray[np.bool_]) -> None:
    """Puts into what isn't valid the nearest that is."""
    if valid.all() or not valid.any():
        return
    _, nearest = cv2.distanceTransformWithLabels(
        (~valid).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    value = np.zeros((nearest.max() + 1, picture.shape[-1]), dtype=np.float32)
    value[nearest[valid]] = picture[valid]
    picture[~valid] = value[nearest[~valid]]


BLENDS: dict[str, Blend] = {
    "multi_band": Blend(multi_band, lambda reach_px: 4 * _STEP_PX),
    "feather": Blend(feather, lambda reach_px: _STEP_PX * -(-(round(reach_px / 2.0) + 1) // _STEP_PX)),
    "hard": Blend(hard, lambda reach_px: 0),
}
