"""A large surface made piece by piece, so that its time grows with its area alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from geomosaic.adjustment.ground.trial_surface import Trial, even_ground
from geomosaic.arrays import Floats
from geomosaic.constants import tuned
from geomosaic.projection.ground import GroundSurface

_SIDE = tuned(200, "nodes", "of a piece's side; more: a band's time grows with its cube; fewer: overlaps")
_OVERLAP = tuned(1.0, "flying heights", "that pieces share; less shows in gaps between points; more is slow")


@dataclass(frozen=True)
class _Span:
    """Nodes of a piece along one axis, from `first` to before `end`; share (n,): what each counts."""

    first: int
    end: int
    share: Floats

    @property
    def nodes(self) -> slice:
        return slice(self.first, self.end)


def by_pieces(trial: Trial, fitted: Callable[[Sequence[Trial]], list[GroundSurface]]) -> GroundSurface:
    """The surface of a trial, in overlapping pieces about a trend in common if it has many nodes. Each node
    is the mean of its pieces, which count less towards their edges. Args: fitted: makes the pieces."""
    cols, rows = trial.nodes
    overlap = min(int(np.ceil(_OVERLAP * trial.heights.height_m / trial.spacing_m)), _SIDE // 4)
    spans = [(r, c) for r in _spans(rows, overlap) for c in _spans(cols, overlap)]
    if rows * cols <= _SIDE**2:
        return fitted([trial])[0]
    heights, (terms, off) = trial.heights, trial.standing
    trend = even_ground(heights.points_m, heights.sd_up_m, terms)
    points_m = heights.points_m.copy()
    points_m[:, 2] -= trend(points_m[:, 0], points_m[:, 1])
    about_trend = replace(trial, heights=replace(heights, points_m=points_m), standing=(0, off))
    pieces = [_piece(about_trend, r, c) for r, c in spans]
    surfaces = iter(fitted([piece for piece in pieces if len(piece.heights.points_m)]))
    up, total = np.zeros((rows, cols)), np.zeros((rows, cols))
    for (r, c), piece in zip(spans, pieces, strict=True):
        share = r.share[:, None] * c.share
        total[r.nodes, c.nodes] += share
        if len(piece.heights.points_m):  # others are the trend
            up[r.nodes, c.nodes] += share * next(surfaces).up_m
    east, north = (heights.low_m[k] + trial.spacing_m * np.arange(n) for k, n in enumerate((cols, rows)))
    up = up / total + trend(east, north[:, None])
    return GroundSurface("tie_surface", float(heights.low_m[0]), float(heights.low_m[1]), trial.spacing_m, up)


def _spans(count: int, overlap: int) -> Iterator[_Span]:
    """Pieces of an axis of so many nodes."""
    own = _SIDE - 2 * overlap
    bounds = np.linspace(0, count, int(np.ceil(count / own)) + 1).round().astype(int).tolist()
    for begin, stop in pairwise(bounds):
        first, end = max(begin - overlap, 0), min(stop + overlap, count)
        node = np.arange(first, end) + 0.5
        before = (node - begin + overlap) / (2.0 * overlap) if begin else np.ones(len(node))
        behind = (stop + overlap - node) / (2.0 * overlap) if stop < count else np.ones(len(node))
        yield _Span(first, end, np.clip(np.minimum(before, behind), 0.0, 1.0))


def _piece(trial: Trial, rows: _Span, cols: _Span) -> Trial:
    """The trial of some nodes, by the points among them."""
    heights, spacing_m = trial.heights, trial.spacing_m
    low_m = heights.low_m + spacing_m * np.array([cols.first, rows.first])
    last_m = heights.low_m + spacing_m * np.array([cols.end - 1, rows.end - 1])
    at = heights.points_m[:, :2]
    its = heights.without(np.any((at < low_m) | (at > last_m), axis=1))
    high_m = last_m - 0.5 * spacing_m  # half a step less, so that rounding adds no node
    return replace(trial, heights=replace(its, low_m=low_m, high_m=high_m))
