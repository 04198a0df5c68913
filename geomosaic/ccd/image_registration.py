"""Dense normalised correlation and a smooth curve, pair by pair (method `image_registration`).

What the jitter correction of HiRISE does (hijitreg and slither of USGS ISIS; Mattson et al. 2009): patches
along the overlap are correlated, doubtful ones dropped, and a smooth curve is drawn through the rest.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.interpolate import make_smoothing_spline
from scipy.ndimage import median_filter

from geomosaic.ccd.model import BRIDGED, MEASURED, UNRELIABLE, Floats, Overlap, PairOffsets, Settings
from geomosaic.ccd.volumes import flattened
from geomosaic.survey.strips import StripGeometry

_LEAST_CORRELATION = 0.4
_ODD_PX = 1.5
_PATCH_LINES = 64


def image_registration(
    overlaps: Sequence[Overlap], geometry: StripGeometry, settings: Settings
) -> tuple[PairOffsets, ...]:
    """A smoothing spline through the peaks of the correlation of patches of 64 lines."""
    return tuple(_of_pair(overlap, geometry, settings) for overlap in overlaps)


def _of_pair(overlap: Overlap, geometry: StripGeometry, settings: Settings) -> PairOffsets:
    n = len(overlap.left)
    centre, offset, r = _patches(overlap, geometry, settings)
    good = r >= _LEAST_CORRELATION
    if good.sum() >= 5:
        usual = median_filter(offset[good], size=(7, 1), mode="nearest")
        good[good] = np.abs(offset[good] - usual).max(axis=1) <= _ODD_PX
    whole = overlap.side * geometry.row_separation_lines
    seen = overlap.valid.any(axis=1)
    if good.sum() < 5:
        zero, far = np.zeros(n), np.full(n, 10.0)
        return PairOffsets(overlap.pair, zero, zero, far, far, np.full(n, UNRELIABLE, dtype=np.uint8))
    t = np.clip(np.arange(n, dtype=np.float64), centre[good][0], centre[good][-1])
    curves, deviations = [], []
    for axis in (0, 1):
        spline = make_smoothing_spline(centre[good], offset[good, axis], w=r[good] ** 2)
        curves.append(np.asarray(spline(t)))
        rest = offset[good, axis] - spline(centre[good])
        deviations.append(np.full(n, 1.4826 * float(np.median(np.abs(rest)))))
    nearest = np.clip((np.arange(n) // _PATCH_LINES), 0, len(good) - 1)
    label = np.where(seen, np.where(good[nearest], MEASURED, BRIDGED), UNRELIABLE).astype(np.uint8)
    return PairOffsets(
        overlap.pair, curves[0], curves[1] + round(whole) - whole, deviations[0], deviations[1], label
    )


def _patches(overlap: Overlap, geometry: StripGeometry, settings: Settings) -> tuple[Floats, Floats, Floats]:
    """Centre lines (p,), offsets (p, 2) and correlations (p,) of the patches; 0 where there is none."""
    reach_c, reach_l = settings.search_cols_px, settings.search_lines_px
    left, right = (
        cv2.GaussianBlur(flattened(image.astype(np.float32), overlap.valid), (0, 0), 0.7)
        for image in (overlap.left, overlap.right)
    )
    right = cv2.copyMakeBorder(right, reach_l, reach_l, 0, 0, cv2.BORDER_CONSTANT, value=0.0)
    shift, w = geometry.overlap_px - geometry.read_px, left.shape[1]
    begin, end = max(0, reach_c - shift), min(w, w - reach_c - shift)
    patches = len(left) // _PATCH_LINES
    centre = np.arange(patches) * float(_PATCH_LINES) + (_PATCH_LINES - 1) / 2
    offset, best = np.zeros((patches, 2)), np.zeros(patches)
    if end - begin < 8:
        return centre, offset, best
    for p in range(patches):
        top = p * _PATCH_LINES
        if not overlap.valid[top : top + _PATCH_LINES].any(axis=1).all():
            continue
        window = right[
            top : top + _PATCH_LINES + 2 * reach_l, begin + shift - reach_c : end + shift + reach_c
        ]
        found = cv2.matchTemplate(window, left[top : top + _PATCH_LINES, begin:end], cv2.TM_CCOEFF_NORMED)
        line, col = np.unravel_index(int(np.argmax(found)), found.shape)
        if 0 < line < found.shape[0] - 1 and 0 < col < found.shape[1] - 1:
            best[p] = float(found[line, col])
            offset[p] = (
                col - reach_c + _vertex(found[line, col - 1 : col + 2]),
                line - reach_l + _vertex(found[line - 1 : line + 2, col]),
            )
    return centre, offset, best


def _vertex(three: Floats) -> float:
    """Where the parabola through three neighbouring values is highest, from the middle one."""
    a, b, c = (float(value) for value in three)
    bend = a - 2 * b + c
    return 0.5 * (a - c) / bend if bend < 0 else 0.0
