"""Least-squares matching of small windows between frames: where another image shows what one image shows.

Keypoints are places to a fraction of their own size; windows about them, compared in the pixels,
agree several times better. `least_squares_matching` compares whole mosaics by shifts alone; frames are turned
against each other, scaled and seen aslant, so that a window's shape has to be found with its place.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from geomosaic.arrays import Bools, Bytes, Floats, Floats32
from geomosaic.constants import ROUNDS, TOGETHER, tuned
from geomosaic.estimation.linear import inverse_each
from geomosaic.matching.least_squares_matching import LEAST_GAIN

_HALF_PX = tuned(10, "px", "half a window: 7 agrees a sixth worse; 14 takes twice as long, bends on relief")
_BLUR_PX = tuned(0.6, "px", "smoothing of both images: 0 matches noise; 1 agrees a sixth less well")
_CONVERGED_PX = tuned(0.03, "px", "step that ends it, a third of the accuracy: less takes rounds; more shows")
_FARTHEST_PX = tuned(4.0, "px", "from the keypoint, an axis: less loses coarse ones; more finds other ground")
_LEAST_LIKENESS = tuned(0.8, "correlation", "right ones have 0.96, leaves 0.85: less admits wrong ones")
_STIFF = tuned(
    40.0, "grey levels", "noise by deviation of stretch: less lets windows run off; more binds roofs"
)
_NEAR_SHARE = tuned(0.7, "half sides", "Gaussian weight: less wastes pixels; more blurs the place")
_SIDE: Final = 2 * _HALF_PX + 1
TEMPLATE_PX: Final = _SIDE + 2
"""A window with the pixels about it, for its slopes."""
_ALONG = np.arange(-_HALF_PX, _HALF_PX + 1, dtype=np.float32)
_COL, _ROW = (axis.ravel() for axis in np.meshgrid(_ALONG, _ALONG))
_NEAR = np.exp(-0.5 * (_COL**2 + _ROW**2) / (_NEAR_SHARE * _HALF_PX) ** 2).astype(np.float32)


@dataclass(frozen=True)
class Found:
    """image_px (n, 2) where the image shows the templates' middles; sure (n,) whether it shows them."""

    image_px: Floats
    sure: Bools


def templates(image: Bytes, at_px: Floats) -> Bytes:
    """Windows (n, TEMPLATE_PX, TEMPLATE_PX) about places (n, 2) of an image, corner origin."""
    along = np.arange(TEMPLATE_PX, dtype=np.float32) - np.float32(TEMPLATE_PX // 2)
    col, row = (axis.ravel() for axis in np.meshgrid(along, along))
    smooth = _smooth(image)
    out = np.empty((len(at_px), TEMPLATE_PX, TEMPLATE_PX), np.uint8)
    for first in range(0, len(at_px), TOGETHER):
        at = at_px[first : first + TOGETHER].astype(np.float32) - np.float32(0.5)
        read = _read(smooth, at[:, :1] + col, at[:, 1:] + row)
        out[first : first + TOGETHER] = np.rint(read).reshape(-1, TEMPLATE_PX, TEMPLATE_PX)
    return out


def find(windows: Bytes, image: Bytes, near_px: Floats, shapes: Floats) -> Found:
    """Where an image shows windows of other images, from about where they lie.

    Affine least-squares matching with gain and offset (Gruen 1985) by inverse composition (Baker and Matthews
    2004, section 3.2): derivatives are the template's and stay. A prior holds the affine part to the
    shapes given.

    Args: windows as `templates` gives them; near_px (n, 2) corner origin; shapes (n, 2, 2): columns and rows
        of the image over those of each window.
    """
    smooth = _smooth(image)
    parts = [
        _find_some(windows[i : i + TOGETHER], smooth, near_px[i : i + TOGETHER], shapes[i : i + TOGETHER])
        for i in range(0, len(windows), TOGETHER)
    ]
    if not parts:
        return Found(np.zeros((0, 2)), np.zeros(0, np.bool_))
    return Found(np.concatenate([p.image_px for p in parts]), np.concatenate([p.sure for p in parts]))


def _find_some(windows: Bytes, smooth: Floats32, near_px: Floats, shapes: Floats) -> Found:
    slopes, weighted, inverse = _derivatives(windows.astype(np.float32))
    own = slopes[:, 6]
    power = (own * own) @ _NEAR
    n = len(windows)
    at, shape = near_px.astype(np.float64), shapes.astype(np.float64)
    sure = np.zeros(n, np.bool_)
    left = np.arange(n)
    for _ in range(ROUNDS):
        turn = shape[left].astype(np.float32)
        middle = (at[left] - 0.5).astype(np.float32)
        seen = _read(
            smooth,
            middle[:, :1] + turn[:, 0, :1] * _COL + turn[:, 0, 1:] * _ROW,
            middle[:, 1:] + turn[:, 1, :1] * _COL + turn[:, 1, 1:] * _ROW,
        )
        seen -= ((seen @ _NEAR) / _NEAR.sum())[:, None]
        right = (weighted[left] @ seen[:, :, None])[:, :, 0]
        answer = (inverse[left] @ right[:, :, None])[:, :, 0]
        gain = answer[:, 6]
        likeness = right[:, 6] / np.sqrt(np.maximum((seen * seen) @ _NEAR * power[left], 1e-9))
        step = (answer[:, :6] / np.maximum(gain, LEAST_GAIN)[:, None]).astype(np.float64)
        moved = np.clip(step[:, :2], -1.0, 1.0)
        back = np.eye(2) - step[:, 2:].reshape(-1, 2, 2) / _HALF_PX
        at[left] -= (shape[left] @ moved[:, :, None])[:, :, 0]
        shape[left] = shape[left] @ back
        lost = (gain < LEAST_GAIN) | (np.abs(at[left] - near_px[left]).max(axis=1) > _FARTHEST_PX)
        converged = np.abs(moved).max(axis=1) < _CONVERGED_PX
        sure[left] = converged & ~lost & (likeness >= _LEAST_LIKENESS)
        left = left[~(converged | lost)]
        if not len(left):
            break
    return Found(at, sure)


def _derivatives(windows: Floats32) -> tuple[Floats32, Floats32, Floats32]:
    """Derivatives of each window (n, 7, pixels) by place, shape and gain, less their means, which an offset
    takes. Then the same times the weights of pixels, and the inverse normal matrices (n, 7, 7)."""
    n, inner = len(windows), slice(1, -1)
    out = np.empty((n, 7, _SIDE * _SIDE), np.float32)
    across = (windows[:, inner, 2:] - windows[:, inner, :-2]).reshape(n, -1) * np.float32(0.5)
    down = (windows[:, 2:, inner] - windows[:, :-2, inner]).reshape(n, -1) * np.float32(0.5)
    out[:, 0], out[:, 1] = across, down
    for k, slope in ((2, across), (4, down)):
        out[:, k] = slope * (_COL / _HALF_PX)
        out[:, k + 1] = slope * (_ROW / _HALF_PX)
    out[:, 6] = windows[:, inner, inner].reshape(n, -1)
    out -= ((out @ _NEAR) / _NEAR.sum())[:, :, None]
    weighted = out * _NEAR
    normal = (weighted @ out.transpose(0, 2, 1)).astype(np.float64)
    prior_weight = np.array([0.0, 0.0, *[(_STIFF / _HALF_PX) ** 2] * 4, 0.0]) + 1e-6
    normal[:, range(7), range(7)] += prior_weight
    return out, weighted, inverse_each(normal).astype(np.float32)


def _smooth(image: Bytes) -> Floats32:
    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), _BLUR_PX), np.float32)


def _read(smooth: Floats32, col: Floats32, row: Floats32) -> Floats32:
    """Between pixels, centre origin."""
    return np.asarray(cv2.remap(smooth, col, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT))
