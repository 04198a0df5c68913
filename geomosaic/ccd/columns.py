"""The columns' own response: what of it can be determined from the image, and images without it."""

from __future__ import annotations

import cv2
import numpy as np

from geomosaic.arrays import Bools, Floats32, Ints
from geomosaic.constants import tuned

BOX_PX = tuned(17, "px", "three boxes make a Gaussian of 8.5 px: smaller removes detail that matching needs")


def column_gains(image: Floats32, valid: Bools) -> Floats32:
    """Each column's response against the columns about it (w,): the middle of the ratios over all lines.

    Args: image, valid (n, w). Lines that aren't valid throughout are left out, but for columns that hardly
    ever are; 1 where there are none.
    """
    out, (lines, columns) = np.ones(image.shape[1], dtype=np.float32), _mostly_valid(valid)
    if not lines.size:
        return out
    some = image[lines[:: max(1, lines.size // 2048)]][:, columns].astype(np.float32)
    around = cv2.GaussianBlur(some, (0, 0), sigmaX=6.0, sigmaY=1e-3, borderType=cv2.BORDER_REFLECT)
    out[columns] = np.clip(np.median((some + 1.0) / (around + 1.0), axis=0), 0.5, 2.0)
    return out


def _mostly_valid(valid: Bools) -> tuple[Ints, Ints]:
    """Columns of valid (n, w) that are valid in most lines of the best column; lines in which all these are.
    A stuck column would leave no line."""
    share = valid.mean(axis=0)
    columns = np.flatnonzero((share > 0.0) & (share > 0.5 * share.max(initial=0.0)))
    lines = np.flatnonzero(valid[:, columns].all(axis=1)) if columns.size else columns
    return lines, columns


def flattened(image: Floats32, valid: Bools) -> Floats32:
    """Fine detail without column pattern: what a blurred image (about 8 px) leaves of it.

    What is bright for a while, a cloud, leaves no mark on the ground before and after it.

    Args: image, valid (n, w). Returns: (n, w), 0 where not valid.
    """
    weight = valid.astype(np.float32)
    return np.asarray(fine_detail(even_columns(image, valid), weight) * weight)


def even_columns(image: Floats32, valid: Bools) -> Floats32:
    """An image (n, w) without its columns' own response: their mean share of the lines' brightness.

    Lines count by the inverse of their variance, as faint ground shows the response best. Lines and columns
    as in `column_gains`.
    """
    lines, columns = _mostly_valid(valid)
    if not lines.size:
        return image
    share = image[lines][:, columns] + np.float32(1.0)
    share /= share.mean(axis=1, keepdims=True)
    weight = 1.0 / np.maximum(share.var(axis=1), np.finfo(np.float32).eps)
    response = np.ones(image.shape[1], dtype=np.float32)
    response[columns] = np.clip((weight / weight.sum()) @ share, 0.5, 2.0)
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
