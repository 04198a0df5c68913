"""Correlation volumes: how well each block of lines of a pair matches at every whole shift."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from geomosaic.arrays import Floats, Floats32
from geomosaic.ccd.model import CcdSettings
from geomosaic.ccd.rows import RowPair
from geomosaic.constants import tuned

BLOCK_LINES = tuned(32, "lines", "of joint evidence: fewer fail at low contrast; more include clouds")
_PIXELS_PER_FACT = tuned(24.0, "px", "that are one fact: fewer saturate fair matches; more mute low contrast")


_LEAST_COLS = tuned(8, "half px", "compared at any shift: fewer match by chance; more narrow the search")


def within_overlap(settings: CcdSettings, overlap_px: int) -> CcdSettings:
    """The settings with as wide a search across as leaves enough columns of the overlap to compare."""
    widest_px = 2 * max((overlap_px // 2 - _LEAST_COLS) // 2, 0)
    return replace(settings, search_cols_px=min(settings.search_cols_px, widest_px))


def halved(image: Floats32) -> Floats32:
    """Means of 2 x 2 pixels (n // 2, w // 2)."""
    n, w = image.shape[0] // 2, image.shape[1] // 2
    return np.asarray(cv2.resize(image[: 2 * n, : 2 * w], (w, n), interpolation=cv2.INTER_AREA))


def volume(pair: RowPair, blocks: int, settings: CcdSettings) -> Floats:
    """Evidence for every shift, block by block of 32 lines (Lewis 1995 for the normalised correlation).

    Computed at half the images' resolution, band-passed. The evidence is the log likelihood ratio -n/2 log(1
    - r^2) of a correlation r over n independent facts against none at all (Kay 1998, section 7). Correlations
    count as 0.99 at most.

    The pair's nominal column and known lines are shift 0 here.

    Returns: (blocks, 2 search_lines_px // 2 + 1, 2 search_cols_px // 2 + 1); shift 0 in the middle.
    """
    reach_l, reach_c = settings.search_lines_px // 2, settings.search_cols_px // 2
    lead, trail = (_band_passed(halved(image)) for image in pair.detail())
    shift = pair.nominal_col // 2
    w = lead.shape[1]
    begin, end = max(0, reach_c - shift), min(w, w - reach_c - shift)
    out = np.zeros((blocks, 2 * reach_l + 1, 2 * reach_c + 1))
    if end - begin < _LEAST_COLS:
        return out
    half = BLOCK_LINES // 2
    moved = np.rint(pair.known_px[: blocks * BLOCK_LINES].reshape(blocks, -1).mean(axis=1) / 2).astype(int)
    spare = reach_l + int(np.abs(moved).max(initial=0))
    trail = np.pad(trail, ((spare, spare), (0, 0)))
    facts = half * (end - begin) / _PIXELS_PER_FACT
    for block in range(blocks):
        pattern = lead[block * half : (block + 1) * half, begin:end]
        if pattern.std() < 1e-6:
            continue
        top = block * half + spare - reach_l + moved[block]
        window = trail[top : top + half + 2 * reach_l, begin + shift - reach_c : end + shift + reach_c]
        r = cv2.matchTemplate(window, pattern, cv2.TM_CCOEFF_NORMED).astype(np.float64)
        r = np.clip(np.nan_to_num(r), 0.0, 0.99)
        out[block] = -0.5 * facts * np.log1p(-(r**2))
    return out


def _band_passed(image: Floats32) -> Floats32:
    """Fine detail in units of its own local deviation: a cloud's edge weighs no more than a field."""
    fine = cv2.GaussianBlur(image, (0, 0), 0.7)
    fine = fine - cv2.GaussianBlur(image, (0, 0), 2.5)
    power = cv2.GaussianBlur(fine * fine, (0, 0), 4.0)
    return np.asarray(fine / np.sqrt(power + 1e-2 * float(np.median(power)) + 1e-12), dtype=np.float32)
