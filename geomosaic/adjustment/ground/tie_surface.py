"""A smooth robust surface of the ground through adjusted tie points, with standard deviations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import KDTree

from geomosaic.adjustment.ground.surface_pieces import by_pieces
from geomosaic.adjustment.ground.trial_surface import Heights, Trial, even_ground, fitted
from geomosaic.arrays import Bools, Floats
from geomosaic.constants import MEDIAN_ONE, NORMAL_PER_MAD, ROUNDS, SLIGHT, sourced, tuned
from geomosaic.estimation.robust import BLUNDER, THREE_SIGMA
from geomosaic.projection.ground import GroundSurface, node_spacing_m
from geomosaic.spread import AtOnce, Spread

Standing = tuple[int, float]
LeftOut = tuple[Bools, Heights]
_MOST_TRIAL_NODES = tuned(4_000, "nodes", "of a trial surface; some thirty are made of a block")
_POINTS_PER_NODE = tuned(3.0, "tie points a node", "fewer: stiffness decides; more: relief is lost")
_CURVINGS = tuned(
    (2.0, 8.0, 32.0, 128.0, 512.0, 2048.0),
    "1 / flying height²",
    "tried; fields take 2 to 32, mountains 512: a least above 32 tears seams of relief by 8 px",
)
_USUAL_CURVING = _CURVINGS[1]
_STANDINGS: tuple[Standing, ...] = tuned(
    ((3, 0.0), (3, 0.0125), (6, 0.1), (6, 0.0125)),
    "terms, flying heights",
    "0: a free plane; 0.1: hills; 0.01: even land",
)
_FREE = _STANDINGS[0]
_CLEARLY = tuned(0.9, "of the free surface's error", "more: planes by chance; less: crowns become ground")
_FEWEST = tuned(10, "tie points", "fewer have no median or quantile that means something")
_LOW = tuned(0.5, "share of the points", "that may be ground; more: crowns; less: low wrong matches")
_GAP = tuned(0.2, "flying heights", "side of a left-out square; less: any stiffness predicts it; more: none")
SIDE = tuned(0.25, "flying heights", "side of places that err alike or are left out: a third of a frame")
_AWAY = tuned((0.02, 0.04, 0.06, 0.09, 0.13, 0.18, 0.25, 0.35), "flying heights", "bins; finer: few points")
_OUTERMOST = tuned(0.98, "share of the points", "within a side; less: a side would begin inside the block")
_AROUND = sourced(100, "points", "give the spread at a place to 12 %", "Rousseeuw and Croux 1993: 1.17/√n")
_USUAL_BEYOND = tuned(0.03, "m per m", "error beyond the points of small blocks, as of hills and woods")


def tie_surface(heights: Heights, *, rough: bool = False, spread: Spread | None = None) -> GroundSurface:
    """Robust smoothing surface through tie points, a spline with tension (Mitášová and Mitáš 1993).

    Minimises sum rho((up - surface) / sd) over the points, with Cauchy's rho, plus squared slopes and third
    derivatives over their usual sizes; lengths count in flying heights. Cross-validation chooses the usual
    third derivative at left-out squares. At low points of left-out corners, it chooses whether a plane or
    paraboloid supports the surface from below. It also finds how deviations grow with the distance from the
    points: between them at the squares, beyond them at left-out sides. Args: rough: with the usual third
    derivative about a free plane, without deviations; a twentieth of the work. spread: runs trials.
    """
    points_m = heights.points_m
    inside = np.ptp(points_m[:, :2], axis=0)
    spacing = float(np.sqrt(np.prod(inside) * _POINTS_PER_NODE / max(len(points_m), 1)))
    trials = _Trials(heights, spread or AtOnce())
    trial_m = node_spacing_m(heights.low_m, heights.high_m, spacing, _MOST_TRIAL_NODES)
    if rough:
        return fitted(Trial(trials.heights, trial_m, _USUAL_CURVING, _FREE))
    curving = _best_curving(trials, trial_m)
    standing = _best_standing(trials, trial_m, curving)
    fine_m = node_spacing_m(heights.low_m, heights.high_m, spacing)
    last = Trial(trials.heights, fine_m, curving, standing, ROUNDS)
    residual = _residual(points_m, surface := by_pieces(last, trials.surfaces))
    followed = points_m[residual * MEDIAN_ONE <= THREE_SIGMA * np.median(residual), :2]
    away_m, _ = KDTree(followed).query(surface.nodes_m())
    whole = Trial(heights, trial_m, curving, standing)
    within = _left_out_errors(trials, whole, trials.without_squares)
    beyond = _left_out_errors(trials, whole, tuple(trials.without_each_side.values()))
    usual_within, gap = _growth(within), _in_gaps(away_m, _GAP * heights.height_m, fine_m)
    off_m = _growth(beyond)(away_m)
    off_m[gap] = usual_within(away_m[gap]) * _roughness(within, usual_within, surface.nodes_m()[gap])
    return replace(surface, sd_m=np.hypot(float(np.median(heights.sd_up_m)), off_m))


class _Trials:
    """Trial surfaces of one block, each made once."""

    def __init__(self, heights: Heights, spread: Spread) -> None:
        self.heights = heights
        self._spread = spread
        self._made: dict[Trial, GroundSurface] = {}

    @cached_property
    def without_squares(self) -> Sequence[LeftOut]:
        """Points (p,) of every fifth square, and the others; five times, to leave each point out once."""
        cells = (self.heights.points_m[:, :2] - self.heights.low_m) / (_GAP * self.heights.height_m)
        col, row = np.floor(cells).astype(np.intp).T
        folds = [(col + 2 * row) % 5 == fold for fold in range(5)]
        return [(out, self.heights.without(out)) for out in folds if out.sum() >= _FEWEST and not out.all()]

    @cached_property
    def without_each_side(self) -> dict[int, LeftOut]:
        """Points of each long enough side (p,), and the others; by eighths of a turn from the east."""
        others, heights = {}, self.heights
        for eighth in range(8):
            angle = eighth * np.pi / 4.0
            along = heights.points_m[:, :2] @ [np.cos(angle), np.sin(angle)]
            out = along > np.quantile(along, _OUTERMOST) - SIDE * heights.height_m
            if out.sum() >= _FEWEST and out.mean() <= 0.5:
                others[eighth] = out, heights.without(out)
        return others

    def surfaces(self, trials: Sequence[Trial]) -> list[GroundSurface]:
        """The surfaces of trials; new ones are made in parallel."""
        new = [trial for trial in trials if trial not in self._made]
        self._made.update(zip(new, self._spread.map("surfaces", fitted, new), strict=True))
        return [self._made[trial] for trial in trials]


def _in_gaps(away_m: Floats, radius_m: float, spacing_m: float) -> Bools:
    """Nodes between tie points, in gaps that a disc of this radius does not enter: a morphological closing.
    Args: away_m (rows, cols): distances from the nearest tie point."""
    near = np.pad(away_m <= radius_m, 1)
    return np.asarray(distance_transform_edt(near)[1:-1, 1:-1] * spacing_m > radius_m)


@dataclass(frozen=True)
class _LeftOutErrors:
    """Cross-validation of heights, in m. height_m: of flying; places_m (p, 2): of the left-out points; away_m
    (p,): distances from the nearest other; error_m, residual_m (p,): to the surface without and with them."""

    height_m: float
    places_m: Floats
    away_m: Floats
    error_m: Floats
    residual_m: Floats


def _left_out_errors(trials: _Trials, whole: Trial, left_out: Sequence[LeftOut]) -> _LeftOutErrors:
    """Errors of all parts that are left out in turn. Args: whole: the trial with all points."""
    with_all, *without = trials.surfaces([whole, *(replace(whole, heights=known) for _, known in left_out)])
    parts = [(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0))]
    for (out, known), surface in zip(left_out, without, strict=True):
        points_m = whole.heights.points_m[out]
        away_m, _ = KDTree(known.points_m[:, :2]).query(points_m[:, :2])
        parts.append((points_m[:, :2], away_m, _residual(points_m, surface), _residual(points_m, with_all)))
    joined = (np.concatenate(part) for part in zip(*parts, strict=True))
    return _LeftOutErrors(whole.heights.height_m, *joined)


def _growth(errors: _LeftOutErrors) -> Callable[[Floats], Floats]:
    """Standard deviation of heights in m by the distance from the tie points in m, beyond their own. Medians
    by distance: objects on the ground are outliers. Beyond the last bin it grows with the distance."""
    of_bin = np.digitize(errors.away_m / errors.height_m, _AWAY)
    bins = [mine for k in range(1, len(_AWAY)) if (mine := of_bin == k).sum() >= _FEWEST]
    if not bins:
        return lambda away_m: _USUAL_BEYOND * away_m
    off_m2 = [np.median(errors.error_m[mine]) ** 2 - np.median(errors.residual_m[mine]) ** 2 for mine in bins]
    grown_m = NORMAL_PER_MAD * np.sqrt(np.maximum.accumulate(np.maximum(off_m2, 0.0)))
    middle_m = np.array([np.median(errors.away_m[mine]) for mine in bins])
    return lambda away_m: np.asarray(away_m * np.interp(away_m, middle_m, grown_m / middle_m))


def _roughness(errors: _LeftOutErrors, growth: Callable[[Floats], Floats], places_m: Floats) -> Floats:
    """Factor (n,) on the growth at places (n, 2): errors of the left-out points around over those usual at
    their distances. Fields are smoother than woods and houses."""
    if len(errors.places_m) < _AROUND:
        return np.ones(len(places_m))
    usual_m = np.hypot(growth(errors.away_m), NORMAL_PER_MAD * float(np.median(errors.residual_m)))
    middles_m = errors.places_m[:: -(-len(errors.places_m) // _MOST_TRIAL_NODES)]
    _, around = KDTree(errors.places_m).query(middles_m, _AROUND)
    factor = NORMAL_PER_MAD * np.median((errors.error_m / np.maximum(usual_m, SLIGHT))[around], axis=1)
    return np.asarray(factor[KDTree(middles_m).query(places_m)[1]])


def _best_curving(trials: _Trials, spacing_m: float) -> float:
    """The third derivative that predicts every fifth square of points with the least mean error, capped."""
    if not trials.without_squares:
        return _USUAL_CURVING
    out, known = trials.without_squares[0]
    left_out = trials.heights.points_m[out]
    surfaces = trials.surfaces([Trial(known, spacing_m, curving, _FREE) for curving in _CURVINGS])
    errors = [_residual(left_out, surface) for surface in surfaces]
    return _CURVINGS[
        int(np.argmin([np.minimum(m, BLUNDER / MEDIAN_ONE * np.median(m)).mean() for m in errors]))
    ]


def _best_standing(trials: _Trials, spacing_m: float, curving: float) -> Standing:
    """The standing that predicts the low points of left-out corners with the least median error."""
    points_m = trials.heights.points_m
    trend = even_ground(points_m, trials.heights.sd_up_m, max(terms for terms, _ in _STANDINGS))
    above = points_m[:, 2] - trend(points_m[:, 0], points_m[:, 1])
    low = above <= np.quantile(above, _LOW)
    corners = [(out & low, known) for eighth, (out, known) in trials.without_each_side.items() if eighth % 2]
    corners = [(out, known) for out, known in corners if out.sum() >= _FEWEST]
    standings = possible_standings(trials.heights)
    total = np.zeros(len(standings))
    surfaces = trials.surfaces([Trial(k, spacing_m, curving, s) for _, k in corners for s in standings])
    for k, surface in enumerate(surfaces):
        corner, standing = divmod(k, len(standings))
        total[standing] += np.median(_residual(points_m[corners[corner][0]], surface))
    best = int(total.argmin())
    return standings[best] if total[best] < _CLEARLY * total[0] else _FREE


def possible_standings(heights: Heights) -> list[Standing]:
    """The standings, none more even than the low points show the ground to be: summits would be cut off."""
    out = []
    for terms, off in _STANDINGS:
        trend = even_ground(heights.points_m, heights.sd_up_m, terms)
        above = heights.points_m[:, 2] - trend(heights.points_m[:, 0], heights.points_m[:, 1])
        low = above[above <= np.quantile(above, _LOW)]
        scatter = NORMAL_PER_MAD * float(np.median(np.abs(low - np.median(low))))
        out.append((terms, max(off, scatter / heights.height_m) if off else off))
    return out


def _residual(points_m: Floats, surface: GroundSurface) -> Floats:
    """Heights (p,) between points and a surface, without sign."""
    return np.asarray(np.abs(points_m[:, 2] - surface.up_at(points_m[:, 0], points_m[:, 1])))
