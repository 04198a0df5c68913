"""Dense normalised correlation pair by pair, and a smooth curve or one mean (two methods).

`image_registration` is what the jitter correction of HiRISE does (hijitreg and slither of USGS ISIS; Mattson
et al. 2009): patches along the overlap are correlated, doubtful ones dropped, and a smooth curve is drawn
through the rest. `mean_offset` is how HiRISE's CCDs are put together without it: hijitreg's average offsets
of each pair, for all its lines.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.interpolate import make_smoothing_spline
from scipy.ndimage import median_filter

from geomosaic.arrays import Bools, Bytes, Floats
from geomosaic.ccd.columns import BOX_PX, flattened
from geomosaic.ccd.model import (
    BRIDGED,
    LOCKING_SD_PX,
    MEASURED,
    UNRELIABLE,
    CcdSettings,
    Overlap,
    PairOffsets,
    Progress,
)
from geomosaic.ccd.overlaps import PIECE_LINES, Strips
from geomosaic.ccd.sift_chains import ABNORMAL_PX, LEAST_POINTS, NEAR_PX, bridging_sd, pieces
from geomosaic.ccd.volumes import within_overlap
from geomosaic.constants import tuned
from geomosaic.matching.displacement import LEAST_CORRELATION
from geomosaic.survey.strips import StripGeometry

PATCH_LINES = tuned(64, "lines", "patch height: lower fails at low contrast; higher blurs TH-1's jitter")


def image_registration(strips: Strips, settings: CcdSettings, progress: Progress) -> tuple[PairOffsets, ...]:
    """A smoothing spline through the peaks of the correlation of patches of 64 lines."""
    found = _all_patches(strips, settings, progress)
    return tuple(_curve(pair, strips.lines(pair), patches_of) for pair, patches_of in found.items())


def mean_offset(strips: Strips, settings: CcdSettings, progress: Progress) -> tuple[PairOffsets, ...]:
    """One offset for each pair: the mean of the peaks of the correlation of patches of 64 lines.

    The standard deviation is that of a patch about the mean: the motion within the scene is not corrected.
    """
    found = _all_patches(strips, settings, progress)
    return tuple(_mean(pair, strips.lines(pair), patches_of) for pair, patches_of in found.items())


def _all_patches(strips: Strips, settings: CcdSettings, progress: Progress) -> dict[int, Floats]:
    """The patches (p, 4) of every pair, as `patches` returns them."""
    found: dict[int, list[Floats]] = {pair: [] for pair in strips.pairs}
    settings = within_overlap(settings, strips.geometry.overlap_px)
    spare = settings.search_lines_px + 3 * (BOX_PX // 2)
    for done, (pair, first, stop, total) in enumerate(pieces(strips, PIECE_LINES)):
        overlap = strips.overlap(pair, first - spare, stop + spare)
        found[pair].append(patches(overlap, strips.geometry, settings, spare))
        progress(done + 1, total)
    return {pair: np.concatenate([np.zeros((0, 4)), *parts]) for pair, parts in found.items()}


def patches(overlap: Overlap, geometry: StripGeometry, settings: CcdSettings, spare: int) -> Floats:
    """The patches of an overlap, but for `spare` lines at either end: middle line, dcol, dline, correlation.

    Returns: (p, 4). Patches whose peak is at the edge of the search, or that have a line without any
    valid pixel, have correlation 0.
    """
    reach_c, reach_l = settings.search_cols_px, settings.search_lines_px
    left, right = (
        cv2.GaussianBlur(flattened(image.astype(np.float32), overlap.valid), (0, 0), 0.7)
        for image in (overlap.left, overlap.right)
    )
    shift, width = geometry.overlap_px - geometry.read_px, left.shape[1]
    begin, end = max(0, reach_c - shift), min(width, width - reach_c - shift)
    apart = overlap.side * geometry.row_separation_lines
    last = len(left) - spare - PATCH_LINES
    tops = np.unique(np.append(np.arange(spare, last, PATCH_LINES), max(last, spare)))
    out = np.zeros((len(tops), 4))
    out[:, 0] = overlap.first_line + tops + (PATCH_LINES - 1) / 2
    if end - begin < 8:
        return out
    for patch, top in zip(out, tops, strict=True):
        if not overlap.valid[top : top + PATCH_LINES].any(axis=1).all():
            continue
        lines = slice(top - reach_l, top + PATCH_LINES + reach_l)
        window = right[lines, begin + shift - reach_c : end + shift + reach_c]
        pattern = left[top : top + PATCH_LINES, begin:end]
        found = cv2.matchTemplate(window, pattern, cv2.TM_CCOEFF_NORMED).astype(np.float64)
        line, col = np.unravel_index(int(np.argmax(found)), found.shape)
        if 0 < line < found.shape[0] - 1 and 0 < col < found.shape[1] - 1:
            patch[1] = col - reach_c + _vertex(found[line, col - 1 : col + 2])
            patch[2] = line - reach_l + _vertex(found[line - 1 : line + 2, col]) + round(apart) - apart
            patch[3] = found[line, col]
    return out


def _curve(pair: int, lines: int, found: Floats) -> PairOffsets:
    """The standard deviation is that of a patch: what the curve smooths is not counted on."""
    good = _plausible(found)
    if good.sum() < LEAST_POINTS:
        return PairOffsets.unknown(pair, lines)
    at, offset, r = found[good, 0], found[good, 1:3], found[good, 3]
    t = np.arange(lines, dtype=np.float64)
    curves, deviations = [], []
    for axis in (0, 1):
        spline = make_smoothing_spline(at, offset[:, axis], w=r**2)
        curves.append(np.asarray(spline(np.clip(t, at[0], at[-1]))))
        deviations.append(bridging_sd(t, at, offset[:, axis], np.full(lines, LOCKING_SD_PX), PATCH_LINES))
    label = _labels(lines, found[:, 0], good)
    return PairOffsets(pair, curves[0], curves[1], deviations[0], deviations[1], label)


def _mean(pair: int, lines: int, found: Floats) -> PairOffsets:
    good = _plausible(found)
    if good.sum() < LEAST_POINTS:
        return PairOffsets.unknown(pair, lines)
    offset = found[good, 1:3]
    mean, sd = offset.mean(axis=0), offset.std(axis=0, ddof=1)
    near = good & (np.hypot(*(found[:, 1:3] - mean).T) <= NEAR_PX)
    dcol, dline, sd_col, sd_line = (np.full(lines, value) for value in (*mean, *sd))
    return PairOffsets(pair, dcol, dline, sd_col, sd_line, _labels(lines, found[:, 0], near))


def _plausible(found: Floats) -> Bools:
    """Patches (p,) that correlate and lie near the middle of the seven about them."""
    good = found[:, 3] >= LEAST_CORRELATION
    if good.any():
        offset = found[good, 1:3]
        usual = median_filter(offset, size=(7, 1), mode="nearest")
        good[good] = np.abs(offset - usual).max(axis=1) <= ABNORMAL_PX
    return np.asarray(good)


def _labels(lines: int, centre: Floats, measured: Bools) -> Bytes:
    """Lines of patches are measured or bridged, the others unreliable."""
    label = np.full(lines, UNRELIABLE, dtype=np.uint8)
    for middle, own in zip(centre, measured, strict=True):
        first = round(middle - (PATCH_LINES - 1) / 2)
        label[first : first + PATCH_LINES] = MEASURED if own else BRIDGED
    return label


def _vertex(three: Floats) -> float:
    """Where the parabola through three neighbouring values is highest, from the middle one."""
    a, b, c = (float(value) for value in three)
    bend = a - 2 * b + c
    return 0.5 * (a - c) / bend if bend < 0 else 0.0
