"""SIFT keypoints of one frame, spread evenly, in full-frame pixels."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bytes, Floats, Floats32, Ints
from geomosaic.constants import tuned

SIFT_CONTRAST = tuned(0.01, "of full range", "least contrast: more drops soft ground; less takes noise")


@dataclass(frozen=True)
class Features:
    """Keypoints of a frame.

    image_px: (n, 2) col, row in the full frame, corner origin. size_px: (n,) diameters there.
    descriptors: (n, 128) uint8 as SIFT gives them. faint: share of the frame whose contrast was raised.
    """

    image_px: Floats
    size_px: Floats32
    descriptors: Bytes
    faint: float = 0.0

    def __len__(self) -> int:
        return len(self.image_px)


def reduction_for(width_px: int, height_px: int, longest_px: int) -> int:
    """The least of 1, 2, 4, 8 by which a frame must shrink so that no side exceeds longest_px."""
    return next((r for r in (1, 2, 4) if max(width_px, height_px) <= r * longest_px), 8)


def grey(pixels: NDArray[np.generic], valid: Bytes | None, band: int | None = None) -> Bytes:
    """One 8 bit band for matching only, see `stretched`."""
    return stretched(pixels, valid, band)[0]


def stretched(
    pixels: NDArray[np.generic], valid: Bytes | None, band: int | None = None
) -> tuple[Bytes, float | None]:
    """One 8 bit band for matching only: a chosen band, or luma; stretched where the contrast is low. Then
    how many grey levels one of the pixels' own 8 bits has become; None where they have more bits.

    The stretch (0.5 to 99.5 % of the valid pixels onto 0 to 255) is always applied to more than 8 bits. It is
    applied to 8 bits only where that range is less than a third of the scale. This is the logical adaptive
    enhancement of Cheng et al. 2018, which never touches the output.

    Args: pixels (rows, cols, bands). band counts from 1.
    """
    if band is not None or pixels.shape[-1] == 1:
        one = pixels[..., (band or 1) - 1]
    elif pixels.shape[-1] in (3, 4) and pixels.dtype == np.uint8:
        one = cv2.cvtColor(np.ascontiguousarray(pixels[..., :3]), cv2.COLOR_RGB2GRAY)
    else:
        one = pixels[..., :3].mean(axis=-1)
    inside = one[valid > 0] if valid is not None else one.ravel()
    if inside.size == 0:
        return np.zeros(one.shape, np.uint8), 1.0
    low, high = np.percentile(inside[:: max(1, inside.size // 200_000)].astype(np.float32), [0.5, 99.5])
    if pixels.dtype == np.uint8 and high - low >= 85.0:
        return np.ascontiguousarray(one if one.dtype == np.uint8 else np.rint(one).astype(np.uint8)), 1.0
    levels = 255.0 / max(high - low, 1e-6)
    scaled = np.clip(np.rint((one.astype(np.float32) - low) * levels), 0, 255)
    return np.asarray(scaled.astype(np.uint8)), float(levels) if pixels.dtype == np.uint8 else None


def shrunk(image: Bytes, valid: Bytes | None, longest_px: int) -> tuple[Bytes, Bytes | None]:
    """An 8 bit image of which no side is longer, and its valid pixels: those of which all is valid."""
    share = longest_px / max(image.shape)
    if share >= 1.0:
        return image, valid
    rows, cols = (max(1, round(side * share)) for side in image.shape)
    small = np.asarray(cv2.resize(image, (cols, rows), interpolation=cv2.INTER_AREA), np.uint8)
    if valid is None:
        return small, None
    kept = np.asarray(cv2.resize(valid, (cols, rows), interpolation=cv2.INTER_AREA))
    return small, np.where(kept == 255, 255, 0).astype(np.uint8)


def away_from_invalid(valid: Bytes) -> Bytes:
    """Pixels (rows, cols) that have no invalid one within 4 px."""
    return np.asarray(cv2.erode(valid, np.ones((9, 9), np.uint8)), np.uint8)


def coarsest(features: Features, most: int) -> Ints:
    """Numbers of the largest keypoints, as an image of a fraction of the size would have."""
    return np.sort(np.argsort(-features.size_px, kind="stable")[:most])


def sift_features(
    image: Bytes, valid: Bytes | None, pixel_px: tuple[float, float], most: int = 6000
) -> Features:
    """SIFT (Lowe 2004) on an 8 bit image, one pixel of which is pixel_px columns and rows of the frame.

    The strongest are taken cell by cell of a grid of about 24 x 24 cells, so that they cover the frame
    evenly. Keypoints next to invalid pixels are left out.
    """
    mask = None if valid is None else away_from_invalid(valid)
    sift = cv2.SIFT.create(contrastThreshold=SIFT_CONTRAST, edgeThreshold=12, enable_precise_upscale=True)
    found = sift.detect(image, mask)
    if not found:
        return Features(np.zeros((0, 2)), np.zeros(0, np.float32), np.zeros((0, 128), np.uint8))
    at = np.asarray(cv2.KeyPoint.convert(found), np.float64)
    response = np.array([k.response for k in found])
    cell_px = max(image.shape) / 24.0
    columns = int(np.ceil(image.shape[1] / cell_px))
    cell = (at[:, 1] // cell_px).astype(np.int64) * columns + (at[:, 0] // cell_px).astype(np.int64)
    order = np.lexsort((at[:, 0], at[:, 1], -response, cell))
    start = np.searchsorted(cell[order], cell[order], side="left")
    rank = np.arange(order.size) - start
    chosen = order[np.lexsort((cell[order], rank))][:most]
    chosen = np.sort(chosen)
    keypoints, descriptors = sift.compute(image, [found[i] for i in chosen])
    return Features(
        image_px=(np.asarray(cv2.KeyPoint.convert(keypoints), np.float64) + 0.5) * pixel_px,
        size_px=np.array([k.size for k in keypoints], dtype=np.float32) * np.float32(max(pixel_px)),
        descriptors=np.asarray(descriptors).astype(np.uint8).reshape(-1, 128),
    )
