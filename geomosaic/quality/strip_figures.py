"""What the offsets of strips are judged by: figures of errors line by line; the paper's limit is 1 px.

A scene with a misplacement above 1 px is unusable, and the share of such scenes is the misplacement rate
(Cheng et al. 2018, Spacecraft Recovery & Remote Sensing 39(2), 84-92, table 1).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from geomosaic.arrays import Bools, Floats
from geomosaic.ccd.model import LABELS, MEASURED, CcdSettings, StripOffsets
from geomosaic.ccd.volumes import BLOCK_LINES
from geomosaic.constants import sourced
from geomosaic.quality.figures import interval_of
from geomosaic.survey.strips import StripGeometry

SEGMENT_LINES: Final = CcdSettings.segment_lines
"""Of one RMS."""
LIMIT_PX = sourced(1.0, "px", "misplacement of a bad scene", "Cheng et al. 2018, SRRS 39(2), table 1")


@dataclass(frozen=True)
class StripFigures:
    """What errors (dcol, dline) say, by their lengths; NaN where no line is known.

    lines: those that count. rms_px, p95_px, worst_line_px: over them. worst_segment_px: the largest root
    mean square of a segment. share_above: lines above the limit. misplaced: a segment is above it; None where
    no segment is known.
    """

    lines: int
    rms_px: float
    p95_px: float
    worst_line_px: float
    worst_segment_px: float
    share_above: float
    misplaced: bool | None


@dataclass(frozen=True)
class SceneErrors:
    """Errors against the truth, over all lines whose ground both strips have.

    measured_above: lines labelled measured and above the limit. measured_worst_px: the worst labelled so.
    coverage: share of the true offsets inside the stated 90 % intervals, dcol and dline.
    share_of_labels: by `LABELS`.
    """

    figures: StripFigures
    measured_above: int
    measured_worst_px: float
    coverage: tuple[float, float]
    share_of_labels: tuple[float, float, float]


@dataclass(frozen=True)
class MisplacementRate:
    """Of a set of scenes: how many are misplaced; low, high: Wilson's 95 % interval of the rate.

    scenes: of which it is known. unknown: the others, which the rate leaves out; NaN where none is known.
    """

    scenes: int
    misplaced: int
    rate: float
    low: float
    high: float
    unknown: int


def strip_figures(errors_px: Sequence[Floats]) -> StripFigures:
    """Figures of errors (n, 2) of each pair's lines, NaN where a line doesn't count."""
    length = np.concatenate([np.hypot(*e.T) for e in errors_px] or [np.empty(0)])
    length = length[np.isfinite(length)]
    worst = max((float(s) for e in errors_px for s in segment_rms(e) if np.isfinite(s)), default=np.nan)
    if not length.size:
        return StripFigures(0, np.nan, np.nan, np.nan, np.nan, np.nan, None)
    return StripFigures(
        int(length.size),
        float(np.sqrt((length**2).mean())),
        float(np.quantile(length, 0.95)),
        float(length.max()),
        worst,
        float((length > LIMIT_PX).mean()),
        worst > LIMIT_PX if np.isfinite(worst) else None,
    )


def segment_rms(errors_px: Floats) -> Floats:
    """Root mean square length of each segment's errors (n, 2); NaN where fewer than 32 lines are known."""
    square = (errors_px**2).sum(axis=1)
    known = np.isfinite(square)
    starts = np.arange(0, len(square), SEGMENT_LINES)
    if not starts.size:
        return np.empty(0)
    count = np.add.reduceat(known.astype(np.float64), starts)
    total = np.add.reduceat(np.where(known, square, 0.0), starts)
    return np.asarray(np.sqrt(np.where(count >= BLOCK_LINES, total, np.nan) / np.maximum(count, 1.0)))


def scene_errors(offsets: StripOffsets, truth: Mapping[int, Floats], geometry: StripGeometry) -> SceneErrors:
    """Offsets against the truth (n, 2) dcol, dline of each pair's lines."""
    errors, inside, labels, measured = [], [], [], []
    for pair in offsets.pairs:
        true = truth[pair.pair]
        seen = common_lines(geometry, pair.pair, true[:, 1])
        found = np.stack([pair.dcol_px, pair.dline_px], axis=1)
        error = np.where(seen[:, None], found - true, np.nan)
        sd = np.stack([pair.sd_col_px, pair.sd_line_px], axis=1)
        errors.append(error)
        inside.append((np.abs(error) <= interval_of(0.9) * sd)[seen])
        labels.append(pair.label[seen])
        measured.append(np.hypot(*error.T)[seen & (pair.label == MEASURED)])
    within, label = np.concatenate(inside), np.concatenate(labels)
    length = np.concatenate(measured)
    return SceneErrors(
        strip_figures(errors),
        int((length > LIMIT_PX).sum()),
        float(length.max(initial=0.0)),
        (float(within[:, 0].mean()), float(within[:, 1].mean())) if len(within) else (np.nan, np.nan),
        label_shares(label),
    )


def common_lines(geometry: StripGeometry, pair: int, dline_px: Floats) -> Bools:
    """(n,) which of the left strip's lines have their ground in the right strip too."""
    middle = np.arange(len(dline_px)) + 0.5
    there = middle + geometry.side(pair) * geometry.row_separation_lines + dline_px
    return np.asarray((there > 0.0) & (there < geometry.lines[pair + 1]))


def label_shares(label: np.ndarray) -> tuple[float, float, float]:
    """Shares of the labels, in the order of `LABELS`; NaN of no lines."""
    count = np.bincount(label, minlength=len(LABELS)) / (len(label) or np.nan)
    return float(count[0]), float(count[1]), float(count[2])


def misplacement_rate(misplaced: Sequence[bool | None]) -> MisplacementRate:
    """The share of misplaced scenes among those of which it is known (not None), as in the paper's table
    1."""
    known = [scene for scene in misplaced if scene is not None]
    n, k, unknown = len(known), sum(known), len(misplaced) - len(known)
    if n == 0:
        return MisplacementRate(0, 0, np.nan, np.nan, np.nan, unknown)
    z = interval_of(0.95)
    middle = (k + z * z / 2) / (n + z * z)
    half = z / (n + z * z) * float(np.sqrt(k * (n - k) / n + z * z / 4))
    return MisplacementRate(n, k, k / n, max(middle - half, 0.0), min(middle + half, 1.0), unknown)
