"""The columns' own response: what of it can be determined from the image, and images without it."""

from __future__ import annotations

import cv2
import numpy as np

from geomosaic.arrays import Bools, Floats32
from geomosaic.constants import tuned

BOX_PX = tuned(17, "px", "three boxes make a Gaussian of 8.5 px: smaller removes detail that matching needs")


def column_gains(image: Floats32, valid: Bools) -> Floats32:
    """Each column's response against the columns about it (w,): the middle of the ratios over all lines.

    Args: image, valid (n, w). Lines that aren't valid throughout are left out; 1 where there are none.
    """
    lines = np.flatnonzero(valid.all(axis=1))
    if not lines.size:
        return np.ones(image.shape[1], dtype=np.float32)
    some = image[lines[:: max(1, lines.size // 2048)]].astype(np.float32)
    around = cv2.GaussianBlur(some, (0, 0), sigmaX=6.0, sigmaY=1e-3, borderType=cv2.BORDER_REFLECT)
    gains = np.median((some + 1.0) / (around + 1.0), axis=0)
    return np.asarray(np.clip(gains, 0.5, 2.0), dtype=np.float32)


def flattened(image: Floats32, valid: Bools) -> Floats32:
    """Fine detail without column pattern: what a blurred image (about 8 px) leaves of it.

    What is bright for a while, a cloud, leaves no mark on the ground before and after it.

    Args: image, valid (n, w). Returns: (n, w), 0 where not valid.
    """
    weight = valid.astype(np.float32)
    return np.asarray(fine_detail(even_columns(image, valid), weight) * weight)


def even_columns(image: Floats32, valid: Bools) -> Floats32:
    """An image (n, w) without its columns' own response: their mean share of the lines' brightness.

    Lines count by the inverse of their variance, as faint ground shows the response best. Lines that are not
    valid throughout are left out.
    """
    share = image[valid.all(axis=1)] + np.float32(1.0)
    if not len(share):
        return image
    share /= share.mean(axis=1, keepdims=True)
    weight = 1.0 / np.maximum(share.var(axis=1), np.finfo(np.float32).eps)
    response = np.clip((weight / weight.sum()) @ share, 0.5, 2.0)
    return np.asarray(image / response, dtype=np.float32)


def fine_detail(image: Floats32, weight: Floats32, box_px: int = BOX_PX) -> Floats32:
    """What a blurred image leaves of an image (n, w); pixels of weight (n, w) 0 are not in the blur."""
    blurred = _blurred(image * weight, box_px)
    if not weight.all():
        blurred /= np.maximum(_blurred(weight, box_px), 1e-3)
    return np.asarray(image - blurred, dtype=np.float32)


def _blurred(image: Floats32, box_px: int) -> Floats32:
    """Three boxes in place of a Gaussian."""
    for _ in range(3):
        image = np.asarray(cv2.blur(image, (box_px, box_px)), dtype=np.float32)
    return image
