"""How well the offsets lay neighbouring strips on one another, seen in the strips, without any truth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from geomosaic.arrays import Bools, Floats, Ints64
from geomosaic.ccd.columns import flattened
from geomosaic.ccd.image_registration import PATCH_LINES
from geomosaic.ccd.model import (
    BRIDGED,
    LABELS,
    LOCKING_SD_PX,
    MEASURED,
    PairOffsets,
    Progress,
    StripOffsets,
)
from geomosaic.ccd.overlaps import PIECE_LINES, Strips
from geomosaic.ccd.parallel import each
from geomosaic.constants import tuned
from geomosaic.matching.displacement import VALID_SHARE, Displacements, PatchMatching, measure_displacements
from geomosaic.matching.least_squares_matching import MaskedImage
from geomosaic.quality.strip_figures import (
    LIMIT_PX,
    StripFigures,
    common_lines,
    label_shares,
    segment_rms,
    strip_figures,
)
from geomosaic.quality.strip_resampling import resampled_onto

_PATCH_PX = tuned(28, "px", "three fit an overlap of 96 px: smaller match by chance; larger leave few")
_LEAST_PATCH_PX = tuned(12, "px", "in narrow overlaps: smaller match by chance; larger leave them unchecked")
BLOCK_LINES: Final = PATCH_LINES
"""Of one residual."""
_MARGIN_LINES: Final = 2 * BLOCK_LINES
"""Around a piece."""
_SEARCH_PX: Final = _PATCH_PX // 2
_AGREE_PX: Final = 0.5 * LIMIT_PX
"""Between patches: half of the limit."""
_LEAST_AGREEING = tuned(0.75, "share", "of a block's patches: less mixes clouds in; 1 fails by one patch")


@dataclass(frozen=True)
class PairQuality:
    """What is left between the two strips of a pair, block of 64 lines by block.

    residual_px: (blocks, 2) dcol, dline: where the right strip has the ground minus where the offsets say, so
    that offsets + residual would be right. It is NaN where it can't be measured. sd_px: (blocks,) one
    standard deviation of it. counts: (blocks,) lines of the block that are labelled measured and whose ground
    both strips have; the others don't count. other_px: (blocks, 2) the residual of lines that aren't labelled
    measured, which may be the clouds' own motion. segments_px: root mean square of each segment's lines that
    count, NaN where there are none. share_of_labels: of the lines whose ground both strips have, in the order
    of `ccd.model.LABELS`.
    """

    pair: int
    lines: int
    residual_px: Floats
    sd_px: Floats
    counts: Floats
    other_px: Floats
    segments_px: Floats
    share_of_labels: tuple[float, float, float]

    @property
    def centre_lines(self) -> Floats:
        """Middles of the blocks, corner origin."""
        first = np.arange(len(self.counts)) * float(BLOCK_LINES)
        return np.asarray((first + np.minimum(first + BLOCK_LINES, self.lines)) / 2.0)


@dataclass(frozen=True)
class StripQuality:
    """The check of a scene. figures: over the lines labelled measured, where a residual could be measured.

    Of a method that looks at no image, and so measures nothing, the bridged lines count instead.
    lines: whose ground both strips have. unmeasured_lines: that count, but have nothing to check them by (too
    little texture, or clouds and ground mixed). other_lines: that don't count. others: figures of those of
    them where something could be measured; they decide nothing, since it may be clouds.
    """

    pairs: tuple[PairQuality, ...]
    figures: StripFigures
    lines: int
    unmeasured_lines: int
    other_lines: int
    others: StripFigures = strip_figures([])  # noqa: RUF009

    @property
    def misplaced(self) -> bool | None:
        """Whether any segment is above the limit of 1 px; None where no segment is known."""
        return self.figures.misplaced


def misplacement(strips: Strips, offsets: StripOffsets, progress: Progress) -> StripQuality:
    """What the offsets leave between the strips, measured independently of how they were found.

    The right strip is resampled onto the left one along the offsets. Patches of 28 px, in narrow overlaps of
    12 px and more, are matched by correlation within 14 px and then by least squares
    (`quality.displacement`).
    A block's residual is the mean of its patches, if three quarters agree within half a pixel: where they
    don't, clouds and ground are adjacent. Patches of clouds alone do agree, on the clouds' own motion. So
    only lines labelled measured count (bridged ones, where no line of the scene is measured). A residual
    above 1 px must be seen by three quarters of all the block's patches, not of the measurable ones alone.
    """
    pairs, errors, other_errors = [], [], []
    seen_lines = unmeasured = other = 0
    label = MEASURED if any((p.label == MEASURED).any() for p in offsets.pairs) else BRIDGED
    for pair, parts in zip(offsets.pairs, _pieces(strips, offsets, label, progress), strict=True):
        lines = strips.lines(pair.pair)
        residual, sd, elsewhere = (np.concatenate(v) for v in zip(*parts, strict=True))
        residual = confirmed(residual)
        seen = common_lines(strips.geometry, pair.pair, pair.dline_px)
        own = seen & (pair.label == label)
        error = np.where(own[:, None], by_line(residual, lines), np.nan)
        known = np.isfinite(error[:, 0])
        starts = np.arange(0, lines, BLOCK_LINES)
        counts = np.add.reduceat(own.astype(np.float64), starts)
        labels = label_shares(pair.label[seen])
        segments = segment_rms(error)
        pairs.append(PairQuality(pair.pair, lines, residual, sd, counts, elsewhere, segments, labels))
        errors.append(error)
        other_errors.append(np.where((seen & ~own)[:, None], by_line(elsewhere, lines), np.nan))
        seen_lines += int(seen.sum())
        unmeasured += int((own & ~known).sum())
        other += int((seen & ~own).sum())
    figures, others = strip_figures(errors), strip_figures(other_errors)
    return StripQuality(tuple(pairs), figures, seen_lines, unmeasured, other, others)


def confirmed(residual_px: Floats) -> Floats:
    """Residuals (blocks, 2) without those above the limit that neither neighbour shares to half a pixel.

    Offsets that are wrong are so over many lines; a block that stands alone saw the edge of a cloud.
    """
    beyond = np.full((1, 2), np.nan)
    steps = np.hypot(*np.diff(np.concatenate([beyond, residual_px, beyond]), axis=0).T)
    alone = ~((steps[:-1] <= _AGREE_PX) | (steps[1:] <= _AGREE_PX))
    far = np.hypot(*residual_px.T) > LIMIT_PX
    return np.where((alone & far)[:, None], np.nan, residual_px)


def by_line(residual_px: Floats, lines: int) -> Floats:
    """(lines, 2) residuals (blocks, 2), straight between the blocks' middles; NaN in blocks without."""
    out = np.full((lines, 2), np.nan)
    known = np.isfinite(residual_px).all(axis=1)
    if not known.any():
        return out
    middle = (np.arange(len(residual_px)) + 0.5) * BLOCK_LINES
    at = np.arange(lines) + 0.5
    inside = np.repeat(known, BLOCK_LINES)[:lines]
    for axis in (0, 1):
        out[inside, axis] = np.interp(at[inside], middle[known], residual_px[known, axis])
    return out


def quality_metrics(quality: StripQuality) -> dict[str, object]:
    """Plain numbers for run.json; None for what isn't known."""
    f, n = quality.figures, max(quality.lines, 1)
    numbers = {
        "rms_px": f.rms_px, "p95_px": f.p95_px, "worst_line_px": f.worst_line_px,
        "worst_segment_px": f.worst_segment_px, "share_above_1px": f.share_above,
    }  # fmt: skip
    shares = np.array([p.share_of_labels for p in quality.pairs]).reshape(-1, len(LABELS))
    common = np.isfinite(shares).all(axis=1)
    weight = np.array([p.lines for p in quality.pairs], dtype=np.float64)[common]
    mean = np.average(shares[common], axis=0, weights=weight) if len(weight) else np.full(len(LABELS), np.nan)
    return {
        "misplaced": quality.misplaced,
        "lines": quality.lines,
        "lines_checked": f.lines,
        **{key: _plain(value) for key, value in numbers.items()},
        "others_share_above_1px": _plain(quality.others.share_above),
        "share_unmeasurable": round(quality.unmeasured_lines / n, 6),
        **{f"share_{label}": _plain(float(value)) for label, value in zip(LABELS, mean, strict=True)},
        "pairs": [
            {"pair": p.pair, "worst_segment_px": _plain(float(np.nanmax(p.segments_px, initial=-1.0)))}
            for p in quality.pairs
        ],
    }


def _plain(value: float) -> float | None:
    return round(value, 6) if np.isfinite(value) and value >= 0.0 else None


def _pieces(
    strips: Strips, offsets: StripOffsets, label: int, progress: Progress
) -> list[list[tuple[Floats, Floats, Floats]]]:
    """Of each pair what its pieces show."""
    lines = [strips.lines(pair.pair) for pair in offsets.pairs]
    found: list[list[tuple[Floats, Floats, Floats]]] = [[] for _ in lines]
    for start in range(0, max(lines, default=0), PIECE_LINES):
        stop = start + PIECE_LINES
        here = [k for k, of_pair in enumerate(lines) if of_pair > start]

        def shown(k: int, start: int = start, stop: int = stop) -> tuple[Floats, Floats, Floats]:
            return _piece(strips, offsets.pairs[k], label, start, min(stop, lines[k]))

        for k, part in zip(here, each(shown, here), strict=True):
            found[k].append(part)
        progress(sum(min(stop, of_pair) for of_pair in lines), sum(lines))
    return found


def _piece(
    strips: Strips, pair: PairOffsets, label: int, start: int, stop: int
) -> tuple[Floats, Floats, Floats]:
    """Residuals (blocks, 2), their deviations (blocks,), residuals of lines that don't count."""
    first, last = start - _MARGIN_LINES, stop + _MARGIN_LINES
    g, overlap = strips.geometry, strips.overlap(pair.pair, first, last)
    lines = np.arange(first, last)
    at = np.clip(lines, 0, len(pair.dline_px) - 1)
    dcol, dline = pair.dcol_px[at], pair.dline_px[at]
    nominal = g.read_px - g.overlap_px
    left, right = (flattened(x.astype(np.float32), overlap.valid) for x in (overlap.left, overlap.right))
    whole = overlap.side * g.row_separation_lines
    shown, shown_valid = resampled_onto(
        right, overlap.valid, dcol - nominal, dline + whole - round(whole), nominal
    )
    inside = (lines >= start) & (lines < stop)
    wide = ((0, 0), (0, nominal))
    left, left_valid = np.pad(left, wide), np.pad(overlap.valid & inside[:, None], wide)
    blocks = -(-(stop - start) // BLOCK_LINES)
    corners, patch_px = _corners(np.maximum(nominal - dcol, 0.0), g.read_px, blocks)
    if not len(corners) or not left_valid.any():
        return np.full((blocks, 2), np.nan), np.full(blocks, np.nan), np.full((blocks, 2), np.nan)
    found = measure_displacements(
        MaskedImage(shown, shown_valid),
        MaskedImage(left, left_valid),
        corners,
        PatchMatching(patch_px, _SEARCH_PX),
    )
    counts = inside & (pair.label[at] == label)
    own, sd = _of_blocks(found, corners, left_valid & counts[:, None], blocks, patch_px)
    other, _ = _of_blocks(found, corners, left_valid & (inside & ~counts)[:, None], blocks, patch_px)
    return own, sd, other


def _corners(begin_px: Floats, end_px: int, blocks: int) -> tuple[Ints64, int]:
    """First row and col of the patches, in the columns that both strips have, and the patches' side."""
    tops = _MARGIN_LINES + np.arange(blocks) * BLOCK_LINES
    begins = [math.ceil(begin_px[top : top + BLOCK_LINES].max(initial=0.0)) + 2 for top in tops]
    size = _PATCH_PX
    if end_px - min(begins, default=0) < size:
        size = max(end_px - max(begins), _LEAST_PATCH_PX)
    pitch, out = BLOCK_LINES // (BLOCK_LINES // size), []
    for top, begin in zip(tops, begins, strict=True):
        many = max((end_px - begin) // size, 0)
        spare = (end_px - begin - many * size) // 2
        for row in range(top + (pitch - size) // 2, top + BLOCK_LINES - size + 1, pitch):
            out += [(row, begin + spare + size * k) for k in range(many)]
    return np.array(out, dtype=np.int64).reshape(-1, 2), size


def _of_blocks(
    found: Displacements, corners: Ints64, asked: Bools, blocks: int, size: int
) -> tuple[Floats, Floats]:
    """Weighted means of the patches, in the lines asked for, that agree with their block's middle one."""
    share = np.array([asked[r : r + size, c : c + size].mean() for r, c in corners])
    home = corners[share >= VALID_SHARE]
    patches = np.bincount((home[:, 0] - _MARGIN_LINES) // BLOCK_LINES, minlength=blocks)
    places = np.rint(found.centres_px[:, ::-1] - size / 2).astype(np.int64)
    among = np.isin(places @ [1 << 20, 1], home @ [1 << 20, 1])
    residual, sd = np.full((blocks, 2), np.nan), np.full(blocks, np.nan)
    block = ((found.centres_px[:, 1] - _MARGIN_LINES) // BLOCK_LINES).astype(np.int64)
    for b in np.unique(block):
        of_block = (block == b) & among
        if not of_block.any():
            continue
        shift, own_sd = found.displacement_px[of_block], np.maximum(found.sd_px[of_block], LOCKING_SD_PX)
        off = np.abs(shift - np.median(shift, axis=0)).max(axis=1)
        agree = off <= np.maximum(_AGREE_PX, 3.0 * own_sd)
        if agree.sum() == 1 or agree.sum() < _LEAST_AGREEING * agree.size:
            continue
        weight = own_sd[agree] ** -2
        mean = weight @ shift[agree] / weight.sum()
        if np.hypot(*mean) > LIMIT_PX and agree.sum() < _LEAST_AGREEING * patches[b]:
            continue
        residual[b] = mean
        sd[b] = weight.sum() ** -0.5
    return residual, sd
