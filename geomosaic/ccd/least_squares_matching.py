"""Sub-pixel offsets of small cells by least squares, and how reliable each is.

Ackermann 1984 (high precision digital image correlation), with shifts alone: the curve that is refined bends
along the lines, so that within a cell of some lines nothing else is left. Gradients are means of both
images', which keeps noise from drawing the shift towards zero. A cell's residuals are held
against what noise and resampling explain: a cloud, a misread ground or a lost line does not fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from scipy.ndimage import uniform_filter1d

from geomosaic.ccd.model import Flags, Floats, Images
from geomosaic.ccd.rows import RowPair
from geomosaic.ccd.volumes import halved
from geomosaic.constants import tuned
from geomosaic.estimation.linear import solve_each

_MISFIT_PX = tuned(0.06, "px", "resampling and relief in a cell: less rejects ground; more admits clouds")
_STEPS_PER_PX: Final = cv2.INTER_TAB_SIZE
"""Of cv2.remap's tables, as `_lands` expects."""
_ALIKE_MISFIT_PX = tuned(0.33, "px", "the same, correlated by pixel: less claims too much at high contrast")
_CLOSE_MISFIT_PX = tuned(0.117, "px", "the same for learning: less learns noise; more smooths jitter away")
_MOST_RATIO = tuned(1.8, "1", "misfit of full weight: less loses cells by chance; more admits half clouds")
_HOPELESS_RATIO = tuned(5.0, "1", "misfit of no weight: less loses cells at edges; more lets clouds pull")
_COL_GROUPS = tuned(4, "cells", "across a knot: fewer lose it at a cloud's edge; more lack pixels")
_UNLIKE = tuned(0.2, "1", "gradient correlation of no weight: less lets smooth clouds in; more loses ground")
_ALIKE = tuned(0.4, "1", "gradient correlation of full weight: less lets noise decide; more weakens ground")
_ALIKE_KNOTS = tuned(5, "knots", "window of that correlation, odd: fewer are noisy; more blur clouds' edges")


@dataclass(frozen=True)
class PairImages:
    """A pair made ready: smoothed, without column pattern. scale: pixels of the strips to one of these."""

    lead: Images
    trail: Images
    valid: Flags
    nominal_col: float
    scale: int


@dataclass(frozen=True)
class KnotOffsetsMeasured:
    """Measured against the curve that was given, per knot.

    offset_px: (knots, 2) dcol, dline of the whole, weighted mean of the knot's cells. information:
    (knots, 2, 2) px^-2, zero where nothing was measured. close: (knots, 2, 2) the same, overstated where
    contrast is high, for curves to learn from. fit: (knots,) share of the cells that fit.
    """

    offset_px: Floats
    information: Floats
    close: Floats
    fit: Floats


def pair_images(pair: RowPair, scale: int) -> PairImages:
    """Both strips smoothed to about the sampling; scale 2 halves them."""
    lead, trail, valid = pair.lead, pair.trail, pair.valid
    if scale == 2:
        lead, trail = halved(lead), halved(trail)
        n, w = lead.shape
        valid = np.asarray(valid[: 2 * n, : 2 * w].reshape(n, 2, w, 2).all(axis=(1, 3)))
    gain = float(np.std(lead[valid])) / max(float(np.std(trail[valid])), 1e-9) if valid.any() else 1.0
    lead, trail = (
        np.asarray(cv2.GaussianBlur(x, (0, 0), 0.8), dtype=np.float32)
        for x in (lead, trail * np.float32(np.clip(gain, 0.5, 2.0)))
    )
    return PairImages(lead, trail, valid, pair.nominal_col / scale, scale)


def measure(given: PairImages, curve_px: Floats, known_px: Floats, knot_lines: int) -> KnotOffsetsMeasured:
    """Offsets at every knot, from a curve near them.

    Args: curve_px (2, n) dcol, dline of every line of the strips beyond known_px (n,), the known part of
    dline; n is a whole number of knots, of knot_lines lines each.
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
        return KnotOffsetsMeasured(np.zeros((knots, 2)), none, none, np.zeros(knots))
    map_col = (np.arange(first, first + cols)[None, :] + whole[0][:, None]).astype(np.float32)
    map_line = np.repeat((np.arange(n) + whole[1])[:, None], cols, axis=1).astype(np.float32)
    moved = _remap(given.trail, map_col, map_line, cv2.INTER_CUBIC)
    seen = _remap(given.valid.astype(np.float32), map_col, map_line, cv2.INTER_LINEAR) > 0.999
    lead = given.lead[:n, first : first + cols]
    seen &= given.valid[:n, first : first + cols]
    difference = lead - moved
    shape = (knots, lines, _COL_GROUPS, cols // _COL_GROUPS)
    weight = seen.astype(np.float32)
    facts = _sums(weight, shape)
    sums = _centred([*_gradients(0.5 * (lead + moved)), difference], weight, shape, facts)
    apart = _centred(_gradients(0.5 * difference), weight, shape, facts)
    bent = curve_px[:, : n * s].reshape(2, knots, knot_lines)
    middle = bent[..., (knot_lines - 1) // 2 : knot_lines // 2 + 1].mean(axis=2) - bent.mean(axis=2)
    at = _lands(whole) - known + np.repeat(middle / s, lines, axis=1)
    return _weighed(sums, apart, facts, at, s)


def _gradients(image: Images) -> list[Images]:
    return [
        np.asarray(cv2.Sobel(image, cv2.CV_32F, i, 1 - i, ksize=1, scale=0.5), dtype=np.float32)
        for i in (1, 0)
    ]


def _weighed(sums: Floats, apart: Floats, facts: Floats, at: Floats, scale: int) -> KnotOffsetsMeasured:
    """Cells to knots.

    Args: sums (3, 3, knots, groups): centred products of the mean's gradients and the difference. apart
    (2, 2, knots, groups): products of the half difference's gradients. at (2, lines): the shift of each line.
    """
    knots = facts.shape[0]
    normal = np.moveaxis(sums[:2, :2], (0, 1), (2, 3))
    shared = normal - np.moveaxis(apart, (0, 1), (2, 3))
    alike = _alike(sums, apart)
    right = np.moveaxis(sums[:2, 2], 0, 2)
    enough = facts >= 0.5 * facts.max(initial=1.0)
    ridge = 1e-3 * np.maximum(np.trace(normal, axis1=2, axis2=3), 1e-12)
    shift = solve_each(normal + ridge[..., None, None] * np.eye(2) + 1e-9 * np.eye(2), right[..., None])[
        ..., 0
    ]
    shift = np.clip(shift, -1.0, 1.0)
    rest = np.maximum(
        sums[2, 2] - 2 * (shift * right).sum(-1) + np.einsum("kgi,kgij,kgj->kg", shift, normal, shift), 0.0
    )
    count = np.maximum(facts, 1.0)
    rest, gradient = rest / count, np.trace(normal, axis1=2, axis2=3) / count
    noise = noise_floor(rest[enough])
    expected = noise + _MISFIT_PX**2 * gradient
    ratio = rest / np.maximum(expected, 1e-12)
    weight = np.where(ratio < _MOST_RATIO, 1.0, (_MOST_RATIO / np.maximum(ratio, 1e-9)) ** 2)
    weight *= (ratio < _HOPELESS_RATIO) & enough & (np.abs(shift).max(-1) < 1.0)
    weight *= np.clip((alike - _UNLIKE) / (_ALIKE - _UNLIKE), 0.0, 1.0)
    good = (weight > 0.5).mean(axis=1)
    close = np.einsum(
        "kg,kgij->kij", weight / np.maximum(expected + _CLOSE_MISFIT_PX**2 * gradient, 1e-12), shared
    )
    weight /= np.maximum(expected + _ALIKE_MISFIT_PX**2 * gradient, 1e-12)
    total = _definite(np.einsum("kg,kgij->kij", weight, shared))
    pull = np.einsum("kg,kgij,kgj->ki", weight, shared, shift)
    known = np.trace(total, axis1=1, axis2=2) > 0.0
    mean = np.zeros((knots, 2))
    safe = total[known] + 1e-6 * np.trace(total[known], axis1=1, axis2=2)[:, None, None] * np.eye(2)
    mean[known] = solve_each(safe, pull[known][..., None])[..., 0]
    centre = at.reshape(2, knots, -1).mean(axis=2).T
    return KnotOffsetsMeasured(scale * (centre + mean), total / scale**2, _definite(close) / scale**2, good)


def _alike(sums: Floats, apart: Floats) -> Floats:
    """Correlation (knots, groups) of both images' gradients, over some knots: about 0 where the two show
    different things, however smooth both are."""
    mean, half = sums[0, 0] + sums[1, 1], apart[0, 0] + apart[1, 1]
    both, all_of = (uniform_filter1d(x, _ALIKE_KNOTS, axis=0) for x in (mean - half, mean + half))
    return np.asarray(both / np.maximum(all_of, 1e-9))


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


def _centred(fields: list[Images], seen: Images, shape: tuple[int, ...], facts: Floats) -> Floats:
    fields = [field * seen for field in fields]
    means = [_sums(field, shape) for field in fields]
    count = len(fields)
    out = np.empty((count, count, *facts.shape))
    for i in range(count):
        for j in range(i, count):
            out[i, j] = _sums(fields[i] * fields[j], shape) - means[i] * means[j] / np.maximum(facts, 1.0)
            out[j, i] = out[i, j]
    return out


def _sums(field: Images, shape: tuple[int, ...]) -> Floats:
    """Sums over cells (knots, groups)."""
    return np.asarray(field.reshape(shape).sum(axis=1).sum(axis=-1, dtype=np.float64))


def _remap(image: Images, cols: Images, lines: Images, how: int) -> Images:
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
