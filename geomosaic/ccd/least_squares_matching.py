"""Sub-pixel offsets of small cells by least squares, and how reliable each is.

The method is Ackermann's (1984, high precision digital image correlation), with shifts alone. The curve that
is refined bends along the lines, so within a cell of some lines nothing but a shift is left. Both images'
fine detail is taken over the ground that both show: a blur over different ground shifts what it leaves. Each
octave of resolution counts by what it knows: gradients that both images have, over noise. So faint ground is
matched by its coarse forms: the matched filter of Knapp and Carter (1976), octave by octave. A cell's
residuals are compared to what noise and resampling explain: a cloud, a misread ground or a lost line does not
fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement

import cv2
import numpy as np
from scipy.ndimage import uniform_filter1d

from geomosaic.arrays import Bools, Floats, Floats32
from geomosaic.ccd.columns import BOX_PX, fine_detail
from geomosaic.ccd.remapping import STEPS_PER_PX, lands, remap
from geomosaic.ccd.rows import RowPair
from geomosaic.ccd.volumes import halved
from geomosaic.constants import tuned
from geomosaic.estimation.linear import solve_each
from geomosaic.matching.displacement import SMOOTHING_SIGMA_PX

MISFIT_PX = tuned(0.06, "px", "resampling and relief in a cell: less rejects ground; more admits clouds")
_ALIKE_MISFIT_PX = tuned(0.33, "px", "the same, correlated by pixel: less claims too much at high contrast")
_CLOSE_MISFIT_PX = tuned(0.117, "px", "the same for learning: less learns noise; more smooths jitter away")
_MOST_RATIO = tuned(1.8, "1", "misfit of full weight: less loses cells by chance; more admits half clouds")
_HOPELESS_RATIO = tuned(5.0, "1", "misfit of no weight: less loses cells at edges; more lets clouds pull")
_COL_GROUPS = tuned(4, "cells", "across a knot: fewer lose it at a cloud's edge; more lack pixels")
_ALIKE = tuned(0.4, "1", "gradient correlation of full weight, none at half: less lets smooth clouds in")
NEARBY_KNOTS = tuned(31, "knots", "of one scatter and contrast, odd: fewer are chance; more blur contrast")
_ALIKE_KNOTS = tuned(5, "knots", "window of that correlation, odd: fewer are noisy; more blur clouds' edges")


@dataclass(frozen=True)
class PairImages:
    """A pair made ready: smoothed, without column pattern. scale: pixels of the strips to one of these."""

    lead: Floats32
    trail: Floats32
    valid: Bools
    nominal_col: float
    scale: int


@dataclass(frozen=True)
class KnotOffsetsMeasured:
    """Measured against the curve that was given, per knot.

    offset_px: (knots, 2) dcol, dline of the whole, weighted mean of the knot's cells. information:
    (knots, 2, 2) px^-2, zero where nothing was measured. close: (knots, 2, 2) the same, overstated where
    contrast is high, for curves to learn from. fit: (knots,) share of the cells that fit. scatter: (knots,)
    variance factor of the cells about their knots, in information already.
    """

    offset_px: Floats
    information: Floats
    close: Floats
    fit: Floats
    scatter: Floats


def pair_images(pair: RowPair, scale: int) -> PairImages:
    """Both strips smoothed to about the sampling; scale 2 halves them."""
    lead, trail, valid = pair.lead, pair.trail, pair.valid
    if scale == 2:
        lead, trail = halved(lead), halved(trail)
        n, w = lead.shape
        valid = np.asarray(valid[: 2 * n, : 2 * w].reshape(n, 2, w, 2).all(axis=(1, 3)))
    return PairImages(_softened(lead, valid), _softened(trail, valid), valid, pair.nominal_col / scale, scale)


def _softened(image: Floats32, valid: Bools) -> Floats32:
    """The image blurred; what is not valid is in no other pixel's blur."""
    soft: Floats32 = np.asarray(cv2.GaussianBlur(image * valid, (0, 0), SMOOTHING_SIGMA_PX), dtype=np.float32)
    if not valid.all():
        soft /= np.maximum(cv2.GaussianBlur(valid.astype(np.float32), (0, 0), SMOOTHING_SIGMA_PX), 1e-3)
    return soft


def measure(given: PairImages, curve_px: Floats, known_px: Floats, knot_lines: int) -> KnotOffsetsMeasured:
    """Offsets at every knot, from a curve near them.

    Args: curve_px (2, n) dcol, dline of every line of the strips beyond known_px (n,), the known part of
    dline. n is a whole number of knots, of knot_lines lines each.
    """
    s = given.scale
    lines = knot_lines // s
    n = min(curve_px.shape[1] // s, len(given.lead)) // lines * lines
    knots = n // lines
    known = np.stack([np.zeros_like(known_px), known_px])[:, : n * s].reshape(2, n, s).mean(axis=2) / s
    known[0] += given.nominal_col
    at_px = curve_px[:, : n * s].reshape(2, n, s).mean(axis=2) / s + known
    whole = np.rint(at_px * STEPS_PER_PX) / STEPS_PER_PX
    w = given.lead.shape[1]
    first = max(0, int(np.ceil(2.0 - float(np.median(whole[0])))))
    last = min(w, int(np.floor(w - 2.0 - float(np.median(whole[0])))))
    cols = (last - first) // _COL_GROUPS * _COL_GROUPS
    if cols <= 0 or knots == 0:
        none = np.zeros((knots, 2, 2))
        return KnotOffsetsMeasured(np.zeros((knots, 2)), none, none, np.zeros(knots), np.ones(knots))
    map_col = (np.arange(first, first + cols)[None, :] + whole[0][:, None]).astype(np.float32)
    map_line = np.repeat((np.arange(n) + whole[1])[:, None], cols, axis=1).astype(np.float32)
    moved = remap(given.trail, map_col, map_line, cv2.INTER_CUBIC)
    seen = remap(given.valid.astype(np.float32), map_col, map_line, cv2.INTER_LINEAR) > 0.999
    seen &= given.valid[:n, first : first + cols]
    edges = np.arange(knots + 1) * float(lines)
    cells = _octaves(given.lead[:n, first : first + cols], moved, seen, edges, s)
    bent = curve_px[:, : n * s].reshape(2, knots, knot_lines)
    middle = bent[..., (knot_lines - 1) // 2 : knot_lines // 2 + 1].mean(axis=2) - bent.mean(axis=2)
    at = lands(whole) - known + np.repeat(middle / s, lines, axis=1)
    return _weighed(cells, s * at.reshape(2, knots, -1).mean(axis=2).T)


def seen_near(information: Floats, sd_px: float) -> Bools:
    """Knots (knots,) that the images show to sd_px with no prior: all pairs over some knots together.

    Args: information (pairs, knots, 2) px^-2 of dcol and dline; what is alike by chance has a little.
    """
    together = _ALIKE_KNOTS * uniform_filter1d(information.sum(axis=0), _ALIKE_KNOTS, axis=0)
    return np.asarray(together.min(axis=1) >= sd_px**-2)


@dataclass(frozen=True)
class _Cells:
    """Sums over cells (knots, octaves, groups), in pixels of the octave.

    normal: (..., 2, 2) products of the mean image's gradients. right: (..., 2) of these and the difference.
    square: of the difference. shared, whole: power of the gradients that both images have, and of all.
    pixels: seen ones. unit_px: (octaves, 1) pixels of the strips to one of the octave's.
    """

    normal: Floats
    right: Floats
    square: Floats
    shared: Floats
    whole: Floats
    pixels: Floats
    unit_px: Floats


def _octaves(lead: Floats32, moved: Floats32, seen: Bools, edges: Floats, unit_px: int) -> _Cells:
    """Cells of the images and of their halves, as long as the blur is wider than a pixel. edges (knots + 1,):
    lines where knots begin."""
    found, units = [], []
    while lead.shape[1] >= _COL_GROUPS and BOX_PX // unit_px > 1:
        weight = seen.astype(np.float32)
        box = BOX_PX // unit_px // 2 * 2 + 1
        fine, other = (fine_detail(image, weight, box) for image in (lead, moved))
        found.append(_sums_of(fine, other, weight, edges))
        units.append([float(unit_px)])
        unit_px, edges, (n, w) = 2 * unit_px, edges / 2, np.array(lead.shape) // 2
        seen = np.asarray(seen[: 2 * n, : 2 * w].reshape(n, 2, w, 2).all(axis=(1, 3)))
        lead, moved = (_softened(halved(image), seen) for image in (lead, moved))
    cc, cl, cd, ll, ld, d, apart, pixels = np.stack(found, axis=2)
    normal = np.moveaxis(np.array([[cc, cl], [cl, ll]]), (0, 1), (3, 4))
    return _Cells(
        normal, np.stack([cd, ld], axis=3), d, cc + ll - apart, cc + ll + apart, pixels, np.array(units)
    )


def _sums_of(lead: Floats32, moved: Floats32, weight: Floats32, edges: Floats) -> Floats:
    """Sums over cells (8, knots, groups): products of the mean's gradients by columns and lines and the
    difference, power of half the difference's gradients, seen pixels."""
    half = np.float32(0.5)
    fields = [*_gradients(half * (lead + moved)), lead - moved]
    sums = [_sums(one * other * weight, edges) for one, other in combinations_with_replacement(fields, 2)]
    by_col, by_line = _gradients(half * fields[2])
    power = by_col * by_col + by_line * by_line
    return np.stack([*sums, _sums(power * weight, edges), _sums(weight, edges)])


def _gradients(image: Floats32) -> list[Floats32]:
    return [
        np.asarray(cv2.Sobel(image, cv2.CV_32F, i, 1 - i, ksize=1, scale=0.5), dtype=np.float32)
        for i in (1, 0)
    ]


def _weighed(cells: _Cells, centre_px: Floats) -> KnotOffsetsMeasured:
    """Cells to knots. Args: centre_px (knots, 2): the shift that cells were measured about.

    Noise in the gradients draws a cell's shift towards zero; the share of their power that both images have,
    by some knots together, says how far. What cells scatter about their knots gives the deviations.
    """
    weight, share, expected, gradient = _judged(cells)
    slope = share / cells.unit_px
    variance, close = (
        np.maximum(expected + misfit**2 * gradient, 1e-12) for misfit in (_ALIKE_MISFIT_PX, _CLOSE_MISFIT_PX)
    )
    each, near_by = (
        _definite(np.einsum("kog,kogij->kgij", weight * slope**2 / v, cells.normal))
        for v in (variance, close)
    )
    pull = np.einsum("kog,kogi->kgi", weight * slope / variance, cells.right)
    pull *= (np.trace(each, axis1=2, axis2=3) > 0.0)[..., None]
    total = each.sum(axis=1)
    known = np.trace(total, axis1=1, axis2=2) > 0.0
    mean = np.zeros(centre_px.shape)
    mean[known] = solve_each(_firm(total[known], 1e-6), pull[known].sum(axis=1)[..., None])[..., 0]
    left = pull - np.einsum("kgij,kj->kgi", each, mean)
    square = (left * solve_each(_firm(each, 1e-3), left[..., None])[..., 0]).sum(-1)
    scatter = _scatter(square, (np.trace(each, axis1=2, axis2=3) > 0.0).astype(np.float64))
    good = (weight > 0.5).mean(axis=(1, 2))
    total = total / scatter[:, None, None]
    return KnotOffsetsMeasured(centre_px + mean, total, near_by.sum(axis=1), good, scatter)


def _judged(cells: _Cells) -> tuple[Floats, Floats, Floats, Floats]:
    """Of cells (knots, octaves, groups): weight, share of common gradients (of all groups), expected
    variance of the difference, mean square gradient."""
    normal, right = cells.normal, cells.right
    shift = np.clip(solve_each(_firm(normal, 1e-3), right[..., None])[..., 0], -1.0, 1.0)
    bowl = np.einsum("...i,...ij,...j->...", shift, normal, shift)
    left = np.maximum(cells.square - 2 * (shift * right).sum(-1) + bowl, 0.0)
    rest, gradient = (x / np.maximum(cells.pixels, 1.0) for x in (left, np.trace(normal, axis1=3, axis2=4)))
    enough = cells.pixels >= 0.5 * cells.pixels.max(axis=(0, 2), initial=1.0, keepdims=True)
    noise = _noise(left, cells.pixels)
    expected = noise + MISFIT_PX**2 * gradient
    weight = _weights(rest / np.maximum(expected, 1e-12), _alike(cells, noise))
    weight *= enough & (np.abs(shift).max(-1) < 1.0)
    weight = np.minimum.accumulate(weight, axis=1)  # what differs in detail is a cloud in coarse forms too
    both, all_of = (_near_by(weight * power) for power in (cells.shared, 0.5 * (cells.shared + cells.whole)))
    share = np.clip(both / np.maximum(all_of, 1e-9), 0.0, 1.0)
    return weight, share[..., None], expected, gradient


def _near_by(cells: Floats) -> Floats:
    """Sums (knots, octaves) over the groups of some knots."""
    return np.asarray(uniform_filter1d(cells.sum(axis=2), _ALIKE_KNOTS, axis=0))


def _firm(matrices: Floats, by: float) -> Floats:
    """Matrices (..., 2, 2) with a share of their trace added, so that they can be solved."""
    ridge = by * np.maximum(np.trace(matrices, axis1=-2, axis2=-1), 1e-12) + 1e-9
    return np.asarray(matrices + ridge[..., None, None] * np.eye(2))


def _weights(ratio: Floats, alike: Floats) -> Floats:
    """Weights of cells by their misfit and by how far both images show the same."""
    weight = np.where(ratio < _MOST_RATIO, 1.0, (_MOST_RATIO / np.maximum(ratio, 1e-9)) ** 2)
    return weight * (ratio < _HOPELESS_RATIO) * np.clip(2.0 * alike / _ALIKE - 1.0, 0.0, 1.0)


def _alike(cells: _Cells, noise: Floats) -> Floats:
    """Share (knots, octaves, groups) of the gradients' power, over some knots, that both have or noise makes.

    About 0 where the two show different things, however smooth both are. noise: variance of the difference.
    """
    by_noise = 0.5 * (1.0 - np.exp(-(SMOOTHING_SIGMA_PX**-2))) * noise * cells.pixels
    same, whole = (
        uniform_filter1d(power, _ALIKE_KNOTS, axis=0) for power in (cells.shared + by_noise, cells.whole)
    )
    return np.asarray(same / np.maximum(whole, 1e-9))


def _scatter(square: Floats, weight: Floats) -> Floats:
    """Variance factor (knots,), at least 1, of cells about their knots, over nearby knots.

    Args: square (knots, groups): of residuals in deviations, two numbers each.
    """
    freedom = 2.0 * np.maximum((weight > 0.0).sum(axis=1) - 1, 0)
    total, number = (uniform_filter1d(x, NEARBY_KNOTS) for x in ((weight * square).sum(axis=1), freedom))
    return np.asarray(np.maximum(total / np.maximum(number, 1e-9), 1.0))


def _definite(matrix: Floats) -> Floats:
    """Zero where not positive definite: where noise outweighs what both images share."""
    a, b, c = matrix[..., 0, 0], matrix[..., 1, 1], matrix[..., 0, 1]
    return matrix * ((a > 0) & (a * b - c * c > 1e-3 * a * b))[..., None, None]


def _noise(square: Floats, pixels: Floats) -> Floats:
    """Variance (octaves, 1) of the difference where images agree: the lower tenth of knots, and more."""
    total, count = _near_by(square), _near_by(pixels)
    seen = count >= 0.5 * count.max(axis=0, initial=1.0)
    rest = [mine[good] for mine, good in zip((total / np.maximum(count, 1.0)).T, seen.T, strict=True)]
    return np.array([[1.15 * float(np.quantile(mine, 0.1)) if mine.size else 1.0] for mine in rest])


def _sums(field: Floats32, edges: Floats) -> Floats:
    """Sums over cells (knots, groups); a line that lies in two knots counts in both by its parts."""
    groups = field[:, : field.shape[1] // _COL_GROUPS * _COL_GROUPS].reshape(len(field), _COL_GROUPS, -1)
    total = np.zeros((len(field) + 1, _COL_GROUPS))
    np.cumsum(groups.sum(axis=2), axis=0, dtype=np.float64, out=total[1:])
    low = np.minimum(edges.astype(np.intp), len(field) - 1)
    part = np.minimum(edges - low, 1.0)[:, None]
    return np.diff((1.0 - part) * total[low] + part * total[low + 1], axis=0)
