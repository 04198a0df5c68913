"""Least-squares matching of patches: sub-pixel shift with gain and offset, many patches at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.fft import rfft2
from scipy.ndimage import spline_filter

from geomosaic.arrays import Bools, Floats, Floats32, Ints64
from geomosaic.constants import ROUNDS, TOGETHER, tuned
from geomosaic.estimation.linear import eigen_each, pseudo_inverse

_CONVERGED_PX = tuned(0.002, "px", "step that ends it, a tenth of the accuracy: more shows; less is slow")
_REACH_PX = tuned(2.0, "px", "from the starting pixel: less loses offset patches; more finds other texture")
_MARGIN_PX: Final = int(_REACH_PX) + 2
"""Of the spline past the edge, with its two nodes."""
LEAST_GAIN = tuned(0.05, "1", "contrast ratio of a lost patch; bounds steps: more loses haze and shade")

_SLOPE = np.array([[-0.5, 0.0, 0.5]], dtype=np.float32)


@dataclass(frozen=True)
class MaskedImage:
    """A single-band image (rows, cols), float32, and which of its pixels are valid."""

    pixels: Floats32
    valid: Bools


@dataclass(frozen=True)
class Match:
    """shift (n, 2) rows and cols, sd_px (n,) of the worse axis, correlation (n,), converged (n,)."""

    shift: Floats
    sd_px: Floats
    correlation: Floats
    converged: Bools


@dataclass(frozen=True)
class _Basis:
    """What patches are cut from: the image's spline coefficients, padded, and the reference's two gradients
    and itself. image_safe, reference_safe: 1 where all pixels nearby are valid in the image and in the
    reference, else 0."""

    coefficients: Floats32
    bases: tuple[Floats32, Floats32, Floats32]
    image_safe: Floats32
    reference_safe: Floats32


@dataclass(frozen=True)
class _Regression:
    """Of n patches: design (n, 4, pixels), weight (n, pixels), inverse normal matrices (n, 4, 4)."""

    design: Floats32
    weight: Floats32
    inverse: Floats


def refine(
    image: MaskedImage,
    reference: MaskedImage,
    corners: Ints64,
    shifts: Ints64,
    patch_px: int,
) -> Match:
    """Sub-pixel shifts from whole-pixel ones.

    With T the reference and I the image, `I(x + d) = a T(x) + b`. About a shift d0 the image is regressed on
    T's two gradients, T and 1 (Gruen 1985, without the affine terms). The gradient's coefficients over T's
    are d0 - d. The image is read between its pixels by a cubic B-spline, which for one shift a patch is
    separable. The normal matrix is the patch's own and stays.

    The stated deviation is the sandwich `N^-1 (G' C G) N^-1`, G the gradients and C the covariance of the
    residuals, which are correlated from pixel to pixel. G' C G is summed in the frequency domain.

    Args: corners (n, 2) first row and col in the reference, shifts (n, 2) rows and cols.
    """
    spline = spline_filter(image.pixels, order=3, output=np.float32, mode="mirror")
    basis = _Basis(
        np.pad(spline, _MARGIN_PX, "reflect"),
        (_filtered(reference.pixels, _SLOPE.T), _filtered(reference.pixels, _SLOPE), reference.pixels),
        _eroded(image.valid),
        _eroded(reference.valid),
    )
    parts = [
        _refine_some(basis, corners[i : i + TOGETHER], shifts[i : i + TOGETHER], patch_px)
        for i in range(0, len(corners), TOGETHER)
    ]
    if not parts:
        return Match(np.empty((0, 2)), np.empty(0), np.empty(0), np.empty(0, dtype=bool))
    return Match(
        np.concatenate([p.shift for p in parts]),
        np.concatenate([p.sd_px for p in parts]),
        np.concatenate([p.correlation for p in parts]),
        np.concatenate([p.converged for p in parts]),
    )


def _filtered(image: Floats32, kernel: Floats32) -> Floats32:
    return np.asarray(cv2.filter2D(image, cv2.CV_32F, kernel, borderType=cv2.BORDER_REPLICATE), np.float32)


def _eroded(valid: Bools) -> Floats32:
    """1 where all pixels within 3 are valid, else 0."""
    near = np.ones((7, 7), np.uint8)
    inner = cv2.erode(valid.astype(np.uint8), near, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(inner, dtype=np.float32)


def _refine_some(basis: _Basis, corners: Ints64, shifts: Ints64, patch_px: int) -> Match:
    weight = _patches(basis.reference_safe, corners, patch_px)
    weight = weight * _patches(basis.image_safe, corners + shifts, patch_px)
    weight = weight.reshape(len(corners), -1).astype(np.float32)
    count = weight.sum(axis=1)
    enough = count > 0.5 * patch_px**2
    design = np.stack(
        [_patches(b, corners, patch_px).reshape(len(corners), -1) for b in basis.bases]
        + [np.ones_like(weight)],
        axis=1,
    )
    mean = (design[:, 2] * weight).sum(axis=1) / np.maximum(count, 1.0)
    design[:, 2] -= mean[:, None]
    weighted = design * weight[:, None]
    normal = np.einsum("nik,njk->nij", weighted, design, optimize=True).astype(np.float64)
    inverse = pseudo_inverse(normal, symmetric=True)
    shift = shifts.astype(np.float64)
    converged = np.zeros(len(corners), dtype=bool)
    active = enough & (normal[:, 2, 2] > 1e-3 * np.maximum(count, 1.0))
    answer = np.zeros((len(corners), 4))
    warped = np.zeros_like(weight)
    for _ in range(ROUNDS):
        at = np.flatnonzero(active)
        if not at.size:
            break
        seen = _shifted(basis.coefficients, corners[at], shift[at], patch_px).reshape(at.size, -1)
        right = np.einsum("nik,nk->ni", weighted[at], seen, optimize=True)
        answer[at] = np.einsum("nij,nj->ni", inverse[at], right)
        warped[at] = seen
        gain = answer[at, 2]
        step = np.clip(answer[at, :2] / np.maximum(gain, LEAST_GAIN)[:, None], -1.0, 1.0)
        shift[at] -= step
        done = np.abs(step).max(axis=1) < _CONVERGED_PX
        lost = (gain <= LEAST_GAIN) | (np.abs(shift[at] - shifts[at]).max(axis=1) > _REACH_PX)
        converged[at[done & ~lost]] = True
        active[at[done | lost]] = False
    sd, correlation = _assessed(_Regression(design, weight, inverse), answer, warped, patch_px)
    sd[~converged] = np.inf
    return Match(shift, sd, correlation, converged)


def _assessed(of: _Regression, answer: Floats, warped: Floats32, patch_px: int) -> tuple[Floats, Floats]:
    """Deviation in pixels and correlation of each patch, by the coefficients (n, 4) that were found."""
    design, weight, inverse = of.design, of.weight, of.inverse
    count = np.maximum(weight.sum(axis=1, dtype=np.float64), 8.0)
    fitted = np.einsum("ni,nik->nk", answer.astype(np.float32), design, optimize=True)
    residual = ((warped - fitted) * weight).reshape(-1, patch_px, patch_px)
    slopes = (design[:, :2] * weight[:, None]).reshape(-1, 2, patch_px, patch_px)
    spectrum = rfft2(slopes)
    power = np.abs(rfft2(residual)) ** 2
    power[:, :, 1 : (patch_px + 1) // 2] *= 2.0
    middle = np.einsum("nirc,njrc,nrc->nij", spectrum, spectrum.conj(), power, optimize=True).real
    middle /= (patch_px**2 * (count - 4.0))[:, None, None]
    covariance = inverse[:, :2, :2] @ middle @ inverse[:, :2, :2]
    worst = eigen_each(covariance)[0][:, 1]
    sd = np.sqrt(np.maximum(worst, 0.0)) / np.maximum(np.abs(answer[:, 2]), 1e-6)
    about = warped - ((warped * weight).sum(axis=1) / count)[:, None]
    spread = np.sqrt(
        (design[:, 2] ** 2 * weight).sum(axis=1, dtype=np.float64)
        * (about**2 * weight).sum(axis=1, dtype=np.float64)
    )
    correlation = (design[:, 2] * about * weight).sum(axis=1) / np.maximum(spread, 1e-12)
    return sd, correlation.astype(np.float64)


def _patches(image: NDArray[np.generic], corners: Ints64, size_px: int) -> Floats32:
    """Copies of square windows, (n, size_px, size_px), clamped to the image."""
    windows = sliding_window_view(image, (size_px, size_px))
    r = np.clip(corners[:, 0], 0, windows.shape[0] - 1)
    c = np.clip(corners[:, 1], 0, windows.shape[1] - 1)
    return windows[r, c].astype(np.float32)


def _shifted(coefficients: Floats32, corners: Ints64, shift: Floats, patch_px: int) -> Floats32:
    """The image's patches at shifted places, by the separable cubic B-spline (padded coefficients)."""
    whole = np.floor(shift).astype(np.int64)
    wide = _patches(coefficients, corners + whole + (_MARGIN_PX - 1), patch_px + 3)
    rows, cols = (bspline_weights(shift[:, k] - whole[:, k]) for k in (0, 1))
    down = rows[:, 0, None, None] * wide[:, :patch_px]
    for k in range(1, 4):
        down += rows[:, k, None, None] * wide[:, k : k + patch_px]
    across = cols[:, 0, None, None] * down[:, :, :patch_px]
    for k in range(1, 4):
        across += cols[:, k, None, None] * down[:, :, k : k + patch_px]
    return np.asarray(across)


def bspline_weights(t: Floats) -> Floats32:
    """Cubic B-spline weights of the four nodes around a fraction t (n,) in [0, 1], shape (n, 4)."""
    u = 1.0 - t
    w = [u**3, 3 * t**3 - 6 * t**2 + 4, 3 * u**3 - 6 * u**2 + 4, t**3]
    return (np.stack(w, axis=-1) / 6.0).astype(np.float32)
