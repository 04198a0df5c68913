"""Sub-pixel offsets of small cells by least squares, and how reliable each is.

The method is Ackermann's (1984, high precision digital image correlation), with shifts alone. The curve that
is refined bends along the lines, so within a cell of some lines nothing but a shift is left. Both images'
fine detail is taken over the ground that both show: a blur over different ground shifts what it leaves. A
cell's residuals are compared to what noise and resampling explain: a cloud, a misread ground or a lost line
does not fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from scipy.ndimage import uniform_filter1d

from geomosaic.arrays import Bools, Floats, Floats32
from geomosaic.ccd.columns import BOX_PX, fine_detail
from geomosaic.ccd.rows import RowPair
from geomosaic.ccd.volumes import halved
from geomosaic.constants import tuned
from geomosaic.estimation.linear import solve_each
from geomosaic.matching.displacement import SMOOTHING_SIGMA_PX

MISFIT_PX = tuned(0.06, "px", "resampling and relief in a cell: less rejects ground; more admits clouds")
_STEPS_PER_PX: Final = cv2.INTER_TAB_SIZE
"""Of cv2.remap's tables, as `_lands` expects."""
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
    gain = float(np.mean(lead[valid])) / max(float(np.mean(trail[valid])), 1e-9) if valid.any() else 1.0
    lead, trail = (_softened(x, valid) for x in (lead, trail * np.float32(np.clip(gain, 0.5, 2.0))))
    return PairImages(lead, trail, valid, pair.nominal_col / scale, scale)


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
    whole = np.rint(at_px * _STEPS_PER_PX) / _STEPS_PER_PX
    w = given.lead.shape[1]
    first = max(0, int(np.ceil(2.0 - float(np.median(whole[0])))))
    last = min(w, int(np.floor(w - 2.0 - float(np.median(whole[0])))))
    cols = (last - first) // _COL_GROUPS * _COL_GROUPS
    if cols <= 0 or knots == 0:
        none = np.zeros((knots, 2, 2))
        return KnotOffsetsMeasured(np.zeros((knots, 2)), none, none, np.zeros(knots), np.ones(knots))
    map_col = (np.arange(first, first + cols)[None, :] + whole[0][:, None]).astype(np.float32)
    map_line = np.repeat((np.arange(n) + whole[1])[:, None], cols, axis=1).astype(np.float32)
    moved = _remap(given.trail, map_col, map_line, cv2.INTER_CUBIC)
    seen = _remap(given.valid.astype(np.float32), map_col, map_line, cv2.INTER_LINEAR) > 0.999
    lead = given.lead[:n, first : first + cols]
    seen &= given.valid[:n, first : first + cols]
    weight = seen.astype(np.float32)
    lead, moved = (fine_detail(image, weight, BOX_PX // s) for image in (lead, moved))
    cells = _cells(lead, moved, weight, (knots, lines, _COL_GROUPS, cols // _COL_GROUPS))
    bent = curve_px[:, : n * s].reshape(2, knots, knot_lines)
    middle = bent[..., (knot_lines - 1) // 2 : knot_lines // 2 + 1].mean(axis=2) - bent.mean(axis=2)
    at = _lands(whole) - known + np.repeat(middle / s, lines, axis=1)
    return _weighed(cells, at, s)


@dataclass(frozen=True)
class _Cells:
    """Centred sums over cells (knots, groups).

    normal: (..., 2, 2) products of the mean image's gradients. right: (..., 2) of these and the difference.
    square: of the difference. shared, whole: power of the gradients that both images have, and of all.
    pixels: seen ones.
    """

    normal: Floats
    right: Floats
    square: Floats
    shared: Floats
    whole: Floats
    pixels: Floats


def _cells(lead: Floats32, moved: Floats32, seen: Floats32, shape: tuple[int, ...]) -> _Cells:
    pixels = _sums(seen, shape)
    difference = lead - moved
    sums = _centred([*_gradients(0.5 * (lead + moved)), difference], seen, shape, pixels)
    apart = _centred(_gradients(0.5 * difference), seen, shape, pixels)
    mean, half = sums[0, 0] + sums[1, 1], apart[0, 0] + apart[1, 1]
    normal, right = np.moveaxis(sums[:2, :2], (0, 1), (2, 3)), np.moveaxis(sums[:2, 2], 0, 2)
    return _Cells(normal, right, sums[2, 2], mean - half, mean + half, pixels)


def _gradients(image: Floats32) -> list[Floats32]:
    return [
        np.asarray(cv2.Sobel(image, cv2.CV_32F, i, 1 - i, ksize=1, scale=0.5), dtype=np.float32)
        for i in (1, 0)
    ]


def _weighed(cells: _Cells, at: Floats, scale: int) -> KnotOffsetsMeasured:
    """Cells to knots. Args: at (2, lines): the shift of each line.

    Noise in the gradients draws a cell's shift towards zero; the share of their power that both images have,
    by some knots together, says how far. What cells scatter about their knots gives the deviations.
    """
    normal, right = cells.normal, cells.right
    knots = len(normal)
    ridge = 1e-3 * np.maximum(np.trace(normal, axis1=2, axis2=3), 1e-12) + 1e-9
    regular = normal + ridge[..., None, None] * np.eye(2)
    shift = np.clip(solve_each(regular, right[..., None])[..., 0], -1.0, 1.0)
    rest = cells.square - 2 * (shift * right).sum(-1) + np.einsum("kgi,kgij,kgj->kg", shift, normal, shift)
    count = np.maximum(cells.pixels, 1.0)
    rest, gradient = np.maximum(rest, 0.0) / count, np.trace(normal, axis1=2, axis2=3) / count
    enough = cells.pixels >= 0.5 * cells.pixels.max(initial=1.0)
    noise = noise_floor(rest[enough])
    expected = noise + MISFIT_PX**2 * gradient
    weight = _weights(rest / np.maximum(expected, 1e-12), _alike(cells, noise))
    weight *= enough & (np.abs(shift).max(-1) < 1.0)
    mean_power = 0.5 * (cells.shared + cells.whole)
    both, all_of = (
        uniform_filter1d((weight * power).sum(axis=1), _ALIKE_KNOTS) for power in (cells.shared, mean_power)
    )
    share = np.clip(both / np.maximum(all_of, 1e-9), 0.0, 1.0)[:, None]
    variance, close = (
        np.maximum(expected + misfit**2 * gradient, 1e-12) for misfit in (_ALIKE_MISFIT_PX, _CLOSE_MISFIT_PX)
    )
    total, near_by = (
        _definite(np.einsum("kg,kgij->kij", weight * share**2 / v, normal)) for v in (variance, close)
    )
    pull = np.einsum("kg,kgi->ki", weight * share / variance, right)
    known = np.trace(total, axis1=1, axis2=2) > 0.0
    mean = np.zeros((knots, 2))
    safe = total[known] + 1e-6 * np.trace(total[known], axis1=1, axis2=2)[:, None, None] * np.eye(2)
    mean[known] = solve_each(safe, pull[known][..., None])[..., 0]
    left = right - share[..., None] * np.einsum("kgij,kj->kgi", normal, mean)
    square = (left * solve_each(regular, left[..., None])[..., 0]).sum(-1) / variance
    scatter = _scatter(square, weight * known[:, None])
    total = total / scatter[:, None, None]
    centre = at.reshape(2, knots, -1).mean(axis=2).T
    good = (weight > 0.5).mean(axis=1)
    return KnotOffsetsMeasured(scale * (centre + mean), total / scale**2, near_by / scale**2, good, scatter)


def _weights(ratio: Floats, alike: Floats) -> Floats:
    """Weights of cells by their misfit and by how far both images show the same."""
    weight = np.where(ratio < _MOST_RATIO, 1.0, (_MOST_RATIO / np.maximum(ratio, 1e-9)) ** 2)
    return weight * (ratio < _HOPELESS_RATIO) * np.clip(2.0 * alike / _ALIKE - 1.0, 0.0, 1.0)


def _alike(cells: _Cells, noise: float) -> Floats:
    """Share (knots, groups) of the gradients' power, over some knots, that both images have or noise makes.

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


def _lands(at: Floats) -> Floats:
    """Where the image that cv2.remap takes from `at` really comes from: the kernel's centre of mass."""
    steps = np.arange(_STEPS_PER_PX, dtype=np.float32) / np.float32(_STEPS_PER_PX)
    ramp = np.arange(16, dtype=np.float32)[None, :]
    centre = cv2.remap(
        ramp,
        steps[None, :] + 8,
        np.zeros((1, len(steps)), np.float32),
        cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REPLICATE,
    )
    off = centre[0].astype(np.float64) - 8.0 - steps
    return np.asarray(at + off[np.rint(at * _STEPS_PER_PX).astype(np.int64) % _STEPS_PER_PX])


def noise_floor(rest: Floats) -> float:
    """Variance of the difference of two images where they agree: the lower tenth of the cells, and more."""
    return 1.15 * float(np.quantile(rest, 0.1)) if rest.size else 1.0


def _centred(fields: list[Floats32], seen: Floats32, shape: tuple[int, ...], facts: Floats) -> Floats:
    fields = [field * seen for field in fields]
    means = [_sums(field, shape) for field in fields]
    count = len(fields)
    out = np.empty((count, count, *facts.shape))
    for i in range(count):
        for j in range(i, count):
            out[i, j] = _sums(fields[i] * fields[j], shape) - means[i] * means[j] / np.maximum(facts, 1.0)
            out[j, i] = out[i, j]
    return out


def _sums(field: Floats32, shape: tuple[int, ...]) -> Floats:
    """Sums over cells (knots, groups)."""
    return np.asarray(field.reshape(shape).sum(axis=1).sum(axis=-1, dtype=np.float64))


def _remap(image: Floats32, cols: Floats32, lines: Floats32, how: int) -> Floats32:
    """cv2.remap, in pieces of less than the 32,767 lines it can address."""
    out = np.empty(cols.shape, dtype=np.float32)
    piece = 8192
    for top in range(0, len(cols), piece):
        part = slice(top, min(top + piece, len(cols)))
        low = int(np.clip(np.floor(lines[part].min()) - 4, 0, len(image) - 1))
        high = int(np.clip(np.ceil(lines[part].max()) + 5, low + 1, len(image)))
        out[part] = cv2.remap(
            image[low:high],
            cols[part],
            lines[part] - np.float32(low),
            how,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=0,
        )
    return out
