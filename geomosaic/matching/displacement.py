"""How far apart two aligned images show the same ground: correlation on patches, coarse to fine."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from geomosaic.arrays import Bools, Floats, Floats32, Ints64
from geomosaic.constants import tuned
from geomosaic.matching.least_squares_matching import MaskedImage, refine

_FINE_RADIUS_PX = tuned(3, "px", "search on finer levels: less loses patches; more finds other peaks")
LEAST_CORRELATION = tuned(0.3, "1", "of a guiding coarse patch: less guides by chance; more loses jumps")
VALID_SHARE = tuned(0.9, "share", "of a patch: less correlates filled pixels; 1 loses patches at edges")
SMOOTHING_SIGMA_PX = tuned(0.8, "px", "Gaussian before matching: less locks to pixels; more loses texture")


@dataclass(frozen=True)
class Displacements:
    """Where the image under test shows the ground minus where the reference shows it.

    centres_px: (n, 2) col and row of the patches' centres in the reference, corner origin.
    displacement_px: (n, 2) col and row. sd_px: (n,) one standard deviation of the worse axis, from the
    residuals of the least-squares match. correlation: (n,) coefficient once matched.
    asked: how many patches had valid pixels in both images; those not among the n were rejected.
    """

    centres_px: Floats
    displacement_px: Floats
    sd_px: Floats
    correlation: Floats
    asked: int


def patch_corners(shape: tuple[int, int], patch_px: int, step_px: int) -> Ints64:
    """First row and col of every whole patch of a regular grid, shape (n, 2)."""
    rows = np.arange(0, shape[0] - patch_px + 1, step_px)
    cols = np.arange(0, shape[1] - patch_px + 1, step_px)
    return np.stack(np.meshgrid(rows, cols, indexing="ij"), axis=-1).reshape(-1, 2)


@dataclass(frozen=True)
class PatchMatching:
    """How patches are matched.

    patch_px: side of a patch. search_px: how far from its own place one is looked for. min_correlation: least
    coefficient once matched. max_sd_px: most standard deviation of the worse axis.
    """

    patch_px: int = 64
    search_px: int = 128
    min_correlation: float = 0.5
    max_sd_px: float = 0.3


def measure_displacements(
    image: MaskedImage,
    reference: MaskedImage,
    corners: Ints64,
    how: PatchMatching = PatchMatching(),
) -> Displacements:
    """Displacement of each patch of the reference in the image.

    Both are of one shape and on one grid. Normalised correlation finds each patch within search_px on a
    pyramid. At each finer level the neighbours' coarse displacements are tried and the best is kept, so that
    a jump (a seam) doesn't stop it. Least-squares matching (shift, gain and offset; Gruen 1985) makes it
    sub-pixel: errors stay below 0.02 px on natural texture. Patches without texture (stated deviation above
    max_sd_px) are rejected. So are those with a weak peak (correlation below min_correlation), and those that
    run away from their peak.

    Args: corners (n, 2) first row and col of the patches in the reference (`patch_corners`).
    """
    patch_px, search_px = how.patch_px, how.search_px
    levels = _pyramid(image, reference, how)
    top = len(levels) - 1
    found_at: Floats = np.empty((0, 2))
    found: Floats = np.empty((0, 2))
    for k in range(top, -1, -1):
        level = levels[k]
        here = corners if k == 0 else patch_corners(level.reference.pixels.shape, patch_px, patch_px // 2)
        here = here[_valid_share(level.reference.valid, here, patch_px) >= (VALID_SHARE if k == 0 else 0.5)]
        centres = (here + patch_px / 2.0) * 2**k
        radius = int(np.ceil(search_px / 2**k)) if k == top else _FINE_RADIUS_PX
        guesses = _guesses(centres, found_at, found, 2**k)
        shifts, peaks = _search(level, here, guesses, patch_px, radius)
        if k > 0:
            good = peaks >= LEAST_CORRELATION
            found_at = np.asarray(centres[good], dtype=np.float64)
            found = np.asarray(shifts[good] * 2.0**k, dtype=np.float64)
    asked = _asked(levels[0], here, shifts, patch_px)
    hopeful = (peaks >= 0.6 * how.min_correlation) & asked
    match = refine(_smoothed(image), _smoothed(reference), here[hopeful], shifts[hopeful], patch_px)
    good = (match.correlation >= how.min_correlation) & (match.sd_px <= how.max_sd_px) & match.converged
    return Displacements(
        np.asarray((here[hopeful][good] + patch_px / 2.0)[:, ::-1], dtype=np.float64),
        match.shift[good][:, ::-1],
        match.sd_px[good],
        match.correlation[good],
        int(asked.sum()),
    )


def _smoothed(image: MaskedImage) -> MaskedImage:
    """Less aliasing and noise, so that the match doesn't lock to whole pixels."""
    pixels = np.asarray(cv2.GaussianBlur(image.pixels, (0, 0), SMOOTHING_SIGMA_PX), dtype=np.float32)
    return MaskedImage(pixels, image.valid)


@dataclass(frozen=True)
class _MatchLevel:
    image: MaskedImage
    reference: MaskedImage


def _pyramid(image: MaskedImage, reference: MaskedImage, how: PatchMatching) -> list[_MatchLevel]:
    """Halvings until the search is a quarter of a patch, while two patches still fit."""
    levels = [_MatchLevel(image, reference)]
    while (
        how.search_px / 2 ** (len(levels) - 1) > how.patch_px / 4
        and min(levels[-1].image.pixels.shape) >= 3 * how.patch_px
        and len(levels) < 8
    ):
        last = levels[-1]
        levels.append(_MatchLevel(_halved(last.image), _halved(last.reference)))
    return levels


def _halved(image: MaskedImage) -> MaskedImage:
    """Mean of the valid pixels of each 2 x 2; an odd last row or col is left out."""
    rows, cols = (n // 2 * 2 for n in image.pixels.shape)
    weight = image.valid[:rows, :cols].astype(np.float32)
    size = (cols // 2, rows // 2)
    share = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    total = cv2.resize(image.pixels[:rows, :cols] * weight, size, interpolation=cv2.INTER_AREA)
    return MaskedImage(np.asarray(total / np.maximum(share, 1e-6), dtype=np.float32), share >= 0.5)


def _valid_share(valid: Bools, corners: Ints64, patch_px: int) -> Floats:
    """Share of valid pixels in each patch; 0 where it leaves the image."""
    total = cv2.integral(valid.astype(np.uint8))
    r, c = corners[:, 0], corners[:, 1]
    inside = (r >= 0) & (c >= 0) & (r + patch_px <= valid.shape[0]) & (c + patch_px <= valid.shape[1])
    r, c = np.where(inside, r, 0), np.where(inside, c, 0)
    s = total[r + patch_px, c + patch_px] - total[r, c + patch_px] - total[r + patch_px, c] + total[r, c]
    return np.where(inside, s / patch_px**2, 0.0)


def _asked(level: _MatchLevel, corners: Ints64, shifts: Ints64, patch_px: int) -> Bools:
    """Patches that could have been measured: valid in the image where they are or where they went."""
    at_home = _valid_share(level.image.valid, corners, patch_px)
    moved = _valid_share(level.image.valid, corners + shifts, patch_px)
    return np.asarray(np.minimum(at_home, moved) >= VALID_SHARE)


def _guesses(centres: Floats, found_at: Floats, found: Floats, scale: int) -> list[Ints64]:
    """For each patch the different displacements (level pixels) of the four nearest coarse patches."""
    if not len(found_at) or not len(centres):
        return [np.zeros((1, 2), dtype=np.int64)] * len(centres)
    near = cKDTree(found_at).query(centres, k=min(4, len(found_at)))[1].reshape(len(centres), -1)
    candidates = np.rint(found[near] / scale).astype(np.int64)
    out = []
    for these in candidates:
        kept: list[Ints64] = []
        for guess in these:
            if all(np.abs(guess - k).max() > 1 for k in kept):
                kept.append(guess)
        out.append(np.array(kept))
    return out


def _search(
    level: _MatchLevel,
    corners: Ints64,
    guesses: list[Ints64],
    patch_px: int,
    radius_px: int,
) -> tuple[Ints64, Floats]:
    """Whole-pixel displacement (row, col) and correlation of each patch; -1 where nothing was found."""
    shifts = np.zeros((len(corners), 2), dtype=np.int64)
    peaks = np.full(len(corners), -1.0)
    image, reference = level.image, level.reference
    height, width = image.pixels.shape
    for i, (row, col) in enumerate(corners):
        here = slice(row, row + patch_px), slice(col, col + patch_px)
        template = _filled(reference.pixels[here], reference.valid[here])
        if template is None:
            continue
        for guess in guesses[i]:
            r0, c0 = max(0, row + guess[0] - radius_px), max(0, col + guess[1] - radius_px)
            r1 = min(height, row + guess[0] + radius_px + patch_px)
            c1 = min(width, col + guess[1] + radius_px + patch_px)
            if r1 - r0 < patch_px or c1 - c0 < patch_px:
                continue
            region = _filled(image.pixels[r0:r1, c0:c1], image.valid[r0:r1, c0:c1])
            if region is None:
                continue
            scores = cv2.matchTemplate(region, template, cv2.TM_CCOEFF_NORMED)
            peak = np.unravel_index(int(np.argmax(scores)), scores.shape)
            if np.isfinite(scores[peak]) and scores[peak] > peaks[i]:
                peaks[i] = scores[peak]
                shifts[i] = r0 + peak[0] - row, c0 + peak[1] - col
    return shifts, peaks


def _filled(part: Floats32, valid: Bools) -> Floats32 | None:
    """The part with its invalid pixels at the mean of the others; None if flat or mostly invalid."""
    mask = valid.view(np.uint8)
    seen = cv2.countNonZero(mask)
    if seen < valid.size:
        if seen < 0.3 * valid.size:
            return None
        part = np.where(valid, part, np.float32(cv2.mean(part, mask)[0]))
    least, most, _, _ = cv2.minMaxLoc(part)
    return part if most - least > 1e-3 else None
