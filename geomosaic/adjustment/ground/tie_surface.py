"""The ground from adjusted tie points: one robust level, or a smooth robust surface."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from geomosaic.adjustment.ground.trial_surface import Heights, Trial, even_ground, fitted
from geomosaic.constants import sourced, tuned
from geomosaic.projection.ground import GroundSurface, node_spacing_m
from geomosaic.spread import AtOnce, Spread

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
_MOST_NODES = tuned(
    40_000,
    "nodes",
    "of the surface: more make its equations slow and large, fewer lose relief between the tie points "
    "of a large block",
)
_MOST_TRIAL_NODES = tuned(
    4_000,
    "nodes",
    "of a surface that only predicts points which were left out: some thirty are made of each block, "
    "so a tenth of the last one's",
)
_POINTS_PER_NODE = tuned(
    3.0,
    "tie points a node",
    "with fewer points a node stiffness alone would determine many nodes; with more, relief that points "
    "show is lost between nodes",
)
_ROUNDS = tuned(8, "rounds", "of new weights, until trees and wrong matches have lost their say")
_CURVINGS: tuple[float, ...] = tuned(
    (2.0, 4.0, 8.0, 16.0, 32.0),
    "1 / flying height²",
    "usual third derivatives of land that are tried, a factor of two apart: land that is gentler than "
    "all would take over noise, rougher land would be smoothed",
)
_USUAL_CURVING = tuned(
    8.0,
    "1 / flying height²",
    "the middle one of those tried, where too few points can be left out to ask, and of rough surfaces",
)
_UNHELD: tuple[int, float] = tuned(
    (3, 0.0),
    "terms, flying heights",
    "the standing of a surface that nothing holds: heights count from a plane (3 terms), and go off it "
    "freely (0 stands for that)",
)
_STANDINGS: tuple[tuple[int, float], ...] = tuned(
    (_UNHELD, (3, 0.0125), (6, 0.1), (6, 0.0125)),
    "terms, flying heights",
    "tried: what ground stands on, a plane (3) or a paraboloid (6), and how far it goes off it. Off a "
    "tenth go hills, off a hundredth what trees and houses leave of even land",
)
_CLEARLY = tuned(
    0.9,
    "share of the misses",
    "of the surface that nothing holds, below which those of a held one must be: with more, chance "
    "would hold hills to a plane; with less, crowns at the rim pass for ground",
)
_LOW = tuned(
    0.5,
    "share of the points",
    "that may be ground, the lower ones: they alone judge what the ground stands on; with more, crowns "
    "would; with less, low wrong matches",
)
_FEWEST = tuned(
    10,
    "tie points",
    "left out, or in a bin of distances, so that their median or quantile means something",
)
_GAP = tuned(
    0.2,
    "flying heights",
    "side of the squares of which every fifth is left out: a smaller gap is predicted by any stiffness, "
    "a larger one by none",
)
_CAP = tuned(
    10.0,
    "median misses",
    "what a left-out point counts as at most: else a few wrong matches choose the stiffness",
)
_SIDES: tuple[float, ...] = sourced(
    tuple(np.arange(8) * np.pi / 4.0),
    "rad",
    "directions from the east to the block's sides and corners, an eighth of a turn apart",
    "geometry: 2 pi / 8; the corners are every second",
)
_CORNERS = _SIDES[1::2]
_SIDE = tuned(
    0.25,
    "flying heights",
    "width of what is left out of the block's sides and corners in turn: as far as frames show ground "
    "beyond their last tie points; by a narrower one nothing is known of that ground",
)
_MOST_OF_ALL = tuned(
    0.5,
    "share of the points",
    "that may be left out as one side: where it is more, the rest is no longer the block that is judged",
)
_AWAY: tuple[float, ...] = tuned(
    (0.02, 0.04, 0.06, 0.09, 0.13, 0.18, 0.25),
    "flying heights",
    "between which misses are put together by their distance from the other points, up to the width of "
    "a side: of wider bins too few are left for a power, in narrower ones lie too few points",
)
_ONE_DEVIATION = sourced(
    0.683,
    "share of the misses",
    "that lie within one deviation; of misses with long tails, as at the edges of woods, too. By the "
    "median (and the distance itself) the ground's doubt was stated at 0.56 of the true one, and two "
    "blocks with a corner 11 px off passed for good",
    "normal distribution: erf(1 / sqrt 2); the median: docs/results.md, how sure the ground is (29 "
    "surveys, seeds 102 to 538)",
)
_POWERS: tuple[float, float] = sourced(
    (1.0, 2.5),
    "power of the distance",
    "least and largest by which heights go astray: land that goes on straight with a wrong slope by the "
    "distance, land whose curvature changes by chance by its power 2.5",
    "a Wiener process integrated twice has the variance t^5 / 20",
)
_OUTERMOST = tuned(
    0.98,
    "share of the points",
    "within a side: the few that lie farther out are no measure of where points end; with less, a side "
    "would begin inside the block",
)
_USUAL_BEYOND = tuned(
    0.03,
    "m per m",
    "by which heights go astray beyond the points of blocks too small to leave a side out: hills and "
    "the edges of woods do as much; with 0 such a block would call its rim sure",
)
_FOLLOWED = tuned(
    4.5,
    "median misses",
    "three deviations: the surface doesn't follow points that are farther off, so the ground there is "
    "no surer for them",
)


def level_m(up_m: Floats, sd_m: Floats) -> float:
    """The height that most points share: a Cauchy-weighted mean from the median on."""
    level = float(np.median(up_m))
    for _ in range(20):
        scale = np.maximum(1.5 * float(np.median(np.abs(up_m - level))), sd_m)
        weight = 1.0 / (1.0 + ((up_m - level) / scale) ** 2) / sd_m**2
        level = float(np.average(up_m, weights=weight))
    return level


def tie_surface(
    points_m: Floats,
    sd_up_m: Floats,
    low_m: Floats,
    high_m: Floats,
    height_m: float,
    *,
    rough: bool = False,
    spread: Spread | None = None,
) -> GroundSurface:
    """Robust smoothing surface through tie points, a spline with tension (Mitášová and Mitáš 1993).

    Minimises sum rho((up - surface) / sd) over the points plus the squared slopes and third derivatives of
    the surface, each over what this ground does in the mean. Third derivatives let hills go on beyond the
    last points as they curve there, where second derivatives would go straight on; slopes bring the surface
    back to level further out. How much the curvature changes is found by cross-validation: every fifth
    square of a fifth of the flying height is left out and predicted by the others. In the same way it is
    found by the block's corners, as ground beyond the points has to be predicted, whether and how strongly a
    plane or a paraboloid laid below the points holds the surface, judged by low points: beyond a wood lies
    the ground it stands on, not its crowns. Lengths count in flying heights, so that a smaller block gets the
    same surface, smaller. The grid has about one node to three points; rho is Cauchy's, so that single trees,
    poles and wrong matches don't pull the ground.

    The surface states how far its heights may be off: they go astray with the distance from the points, by as
    much as the points of the block's sides are missed if they are left out.

    Args: points_m (p, 3), sd_up_m (p,), low_m and high_m (2,): the rectangle to cover, which may reach
        beyond the points; height_m: the frames' height above the points. rough: by a usual curvature, on
        nothing, without deviations; a twentieth of the work. spread: who makes trial surfaces.
    """
    inside = np.ptp(points_m[:, :2], axis=0)
    spacing = float(np.sqrt(np.prod(inside) * _POINTS_PER_NODE / max(len(points_m), 1)))
    task = _Task(Heights(points_m, sd_up_m, low_m, high_m, height_m), spread or AtOnce())
    trial_m = node_spacing_m(low_m, high_m, spacing, _MOST_TRIAL_NODES)
    if rough:
        return fitted(Trial(task.heights, trial_m, _USUAL_CURVING, _UNHELD))
    curving = _curving(task, trial_m)
    standing = _standing(task, trial_m, curving)
    fine_m = node_spacing_m(low_m, high_m, spacing, _MOST_NODES)
    last = Trial(task.heights, fine_m, curving, standing, _ROUNDS)
    sides = [Trial(known, trial_m, curving, standing) for _, known in task.without_each_side.values()]
    surface, *_ = task.laid([last, *sides])
    return task.rated(surface, _astray(task, trial_m, curving, standing))


class _Task:
    """What `tie_surface` is asked for, and surfaces that were made for it so far."""

    def __init__(self, heights: Heights, spread: Spread) -> None:
        self.heights = heights
        self._spread = spread
        self._made: dict[Trial, GroundSurface] = {}

    @cached_property
    def without_each_side(self) -> dict[float, tuple[Bools, Heights]]:
        """For each way to the block's rim that is long enough: which points lie there, and the others."""
        others, heights = {}, self.heights
        for angle in _SIDES:
            along = heights.points_m[:, :2] @ [np.cos(angle), np.sin(angle)]
            out = along > np.quantile(along, _OUTERMOST) - _SIDE * heights.height_m
            if out.sum() >= _FEWEST and out.mean() <= _MOST_OF_ALL:
                others[angle] = out, heights.without(out)
        return others

    def laid(self, trials: Sequence[Trial]) -> list[GroundSurface]:
        """The surfaces, side by side as far as they aren't there."""
        new = [trial for trial in trials if trial not in self._made]
        self._made.update(zip(new, self._spread.map("surfaces", fitted, new), strict=True))
        return [self._made[trial] for trial in trials]

    def rated(self, surface: GroundSurface, astray: Callable[[Floats], Floats]) -> GroundSurface:
        """The surface with the deviations of its heights: what they are off by so far from the next point
        that it follows, beside the points' own."""
        points_m = self.heights.points_m
        miss = _missed(points_m, surface)
        followed = points_m[miss <= _FOLLOWED * np.median(miss), :2]
        away_m, _ = KDTree(followed).query(surface.nodes_m().reshape(-1, 2))
        own = float(np.median(self.heights.sd_up_m))
        return replace(surface, sd_m=np.hypot(own, astray(away_m)).reshape(surface.up_m.shape))


def _astray(
    task: _Task, spacing_m: float, curving: float, standing: tuple[int, float]
) -> Callable[[Floats], Floats]:
    """How far heights beyond the points are off, one deviation in m, by the distance from the last of them:
    a power of it, by what the surfaces without each of the block's sides and corners miss there."""
    sides, height_m = task.without_each_side.values(), task.heights.height_m
    surfaces = task.laid([Trial(known, spacing_m, curving, standing) for _, known in sides])
    away, missed = [np.zeros(0)], [np.zeros(0)]
    for (out, known), surface in zip(sides, surfaces, strict=True):
        asked = task.heights.points_m[out]
        away.append(KDTree(known.points_m[:, :2]).query(asked[:, :2])[0] / height_m)
        missed.append(_missed(asked, surface))
    of_bin = np.digitize(np.concatenate(away), _AWAY)
    bins = [k for k in range(1, len(_AWAY)) if np.sum(of_bin == k) >= _FEWEST]
    if len(bins) < 2:
        return lambda away_m: _USUAL_BEYOND * away_m
    middle = np.log([np.sqrt(_AWAY[k - 1] * _AWAY[k]) * height_m for k in bins])
    miss = np.concatenate(missed)
    off = np.log([max(np.quantile(miss[of_bin == k], _ONE_DEVIATION), 1e-9) for k in bins])
    power = float(np.clip(np.polyfit(middle, off, 1)[0], *_POWERS))
    of_one_metre = float(np.exp(np.mean(off - power * middle)))
    return lambda away_m: of_one_metre * away_m**power


def _curving(task: _Task, spacing_m: float) -> float:
    """The curving that predicts every fifth square of points best: least mean miss, wild ones capped."""
    heights = task.heights
    col, row = (
        np.floor((heights.points_m[:, :2] - heights.low_m) / (_GAP * heights.height_m)).astype(np.intp).T
    )
    out = (col + 2 * row) % 5 == 0
    if out.sum() < _FEWEST or out.all():
        return _USUAL_CURVING
    known, asked = heights.without(out), heights.points_m[out]
    surfaces = task.laid([Trial(known, spacing_m, curving, _UNHELD) for curving in _CURVINGS])
    misses = [_missed(asked, surface) for surface in surfaces]
    return _CURVINGS[int(np.argmin([np.minimum(m, _CAP * np.median(m)).mean() for m in misses]))]


def _standing(task: _Task, spacing_m: float, curving: float) -> tuple[int, float]:
    """The standing that predicts the low points of left-out corners best, by the median: crowns are no
    ground, and it is beyond the points that ground needs something to stand on."""
    points_m = task.heights.points_m
    even = even_ground(points_m, task.heights.sd_up_m, max(terms for terms, _ in _STANDINGS))
    above = points_m[:, 2] - even(points_m[:, 0], points_m[:, 1])
    corners = [task.without_each_side[way] for way in _CORNERS if way in task.without_each_side]
    lows = [(points_m[out & (above <= np.quantile(above, _LOW))], known) for out, known in corners]
    lows = [(low, known) for low, known in lows if len(low) >= _FEWEST]
    trials = [Trial(known, spacing_m, curving, standing) for _, known in lows for standing in _STANDINGS]
    asked = [low for low, _ in lows for _ in _STANDINGS]
    missed = [np.median(_missed(*both)) for both in zip(asked, task.laid(trials), strict=True)]
    total = np.reshape(missed, (-1, len(_STANDINGS))).sum(axis=0)
    best = int(total.argmin())
    return _STANDINGS[best] if total[best] < _CLEARLY * total[0] else _UNHELD


def _missed(points_m: Floats, surface: GroundSurface) -> Floats:
    """How far a surface is off points."""
    return np.asarray(np.abs(points_m[:, 2] - surface.up_at(points_m[:, 0], points_m[:, 1])))
