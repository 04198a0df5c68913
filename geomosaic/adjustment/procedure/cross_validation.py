"""Models of lens and shutter side by side: what each leaves at tie points that took no part in its solve."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.ground.ground_choice import flying_height_m
from geomosaic.adjustment.model import Block, ImageResiduals, Settings
from geomosaic.adjustment.problem.interior import INTERIOR, READOUT, interior_of, with_interior
from geomosaic.adjustment.problem.tracks import (
    Tracks,
    asked_tracks,
    chosen_tracks,
    frame_by_frame,
    nearest_to_rays,
)
from geomosaic.adjustment.procedure.block_problem import block_problem
from geomosaic.adjustment.procedure.residual_pattern import left_by_vibration
from geomosaic.adjustment.solver.solution import Start
from geomosaic.adjustment.solver.solve import SolveOptions, solve
from geomosaic.camera.interior import Camera
from geomosaic.constants import sourced, tuned
from geomosaic.errors import NotSolvableError
from geomosaic.estimation.robust import cauchy_weight, median_of_known
from geomosaic.matching.model import TiePair, TiePoints
from geomosaic.spread import Spread

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
_OF_ALL_LENSES = INTERIOR.index("k1")
BETTER = sourced(
    0.95,
    "share of the residuals of left-out points",
    "that a richer model has to stay below, beside the last one; of two that leave as much but for so "
    "little the simpler one is taken: with more, models that say nothing new would be taken; with less, "
    "turns that bend a block are not",
    "docs/results.md, surveys as people deliver them: models that were not true left 0.98 to 1.04 in 12 "
    "surveys, true ones 0.45 to 0.93",
)
_SURELY = sourced(
    3.0,
    "deviations",
    "of a median that so many places give, by which it has to be less: with two, steady frames in gusts "
    "came within 0.001 of turning; with more, a small block takes no model",
    "normal distribution: 0.1 % by chance",
)
LEFT_OUT = tuned(
    5,
    "tracks",
    "one of so many takes no part in the solve: with more left out the solve is poorer, with fewer "
    "the judgement",
)
_LEAST_TRACKS = tuned(300, "tracks", "that thinning leaves: with fewer all are taken")
_PER_FRAME = tuned(64, "tracks", "asked for by each frame: enough to distinguish models by a twentieth")
_CELLS = tuned(8, "cells a side", "of an image over which they are spread: the corners distinguish lenses")
_SURE = tuned(
    0.25,
    "share of the median",
    "of what both models leave together, below which a point shows no more than others: with less, a few "
    "points that happen to fit would decide",
)
_ALIKE = tuned(
    0.25,
    "flying heights",
    "side of a place in which tracks err alike: a third of what a frame sees across, over which turns, "
    "lenses and gusts are much the same; of smaller ones neighbours would count as independent, of "
    "larger ones a block has too few",
)
_EXACT_PX = tuned(1e-4, "px", "residuals of a point at least, so that two exact ones have a ratio")
_NOT_SEEN_PX = tuned(1e5, "px", "residual of a point behind a camera: as far off as any image is wide")


@dataclass(frozen=True)
class Model:
    """A model of lens and shutter, and the solution to begin its own from; same: which is of this model."""

    block: Block
    settings: Settings
    before: Start
    same: bool = False


@dataclass(frozen=True)
class Judged:
    """A model's solution (None where there is none), and the residual of each track left out of it, (t,);
    place (t,): number of the place where it lies; vibration: `left_by_vibration` of the left-out tracks."""

    solved: Start | None
    each_px: Floats
    place: Ints
    vibration: float = 1.0

    @property
    def median_px(self) -> float:
        return float(np.median(self.each_px))

    def beats(self, other: Judged) -> bool:
        """Whether it leaves less by what makes a model worth its unknowns, and surely less."""
        share, at_most = self.beside(other)
        return share < BETTER and at_most < 1.0

    def beside(self, other: Judged) -> tuple[float, float]:
        """The share of another model's residuals that this one leaves, and what it is at most: the median of
        the tracks' own shares.

        So what moves in the wind, and fits no model, decides nothing. Tracks count the more the less both
        models leave of them together, which favours neither, down to a quarter of the median. Those of one
        place err alike, whatever they fit: the median is as sure as places differ, not tracks.
        """
        if self.solved is None or other.solved is None:
            return (0.0, 0.0) if self.solved is not None else (np.inf, np.inf)
        mine, others = (np.maximum(a, _EXACT_PX) for a in (self.each_px, other.each_px))
        both = np.hypot(mine, others)
        weight = 1.0 / np.maximum(both, _SURE * np.median(both))
        order = np.argsort(mine / others)
        shares, below = (mine / others)[order], np.cumsum(weight[order]) / weight.sum()
        half = int(np.searchsorted(below, 0.5))
        side = np.where(np.arange(len(shares)) < half, 0.5, -0.5) * weight[order]
        sd = np.sqrt((np.bincount(self.place[order], side) ** 2).sum()) / weight.sum()
        most = int(np.searchsorted(below, 0.5 + _SURELY * sd))
        return float(shares[half]), float(shares[min(most, len(shares) - 1)])


class LeftOut:
    """Tracks that models are solved by, and all others, which judge them. first: the solution by both."""

    def __init__(self, block: Block, tracks: Tracks, first: Start, spread: Spread) -> None:
        sizes = np.array([[c.width_px, c.height_px] for c in block.cameras])
        asked = np.flatnonzero(asked_tracks(tracks, sizes, _PER_FRAME, _CELLS))
        few = asked if len(asked) >= _LEAST_TRACKS else np.arange(tracks.points)
        out = np.random.default_rng(0).permutation(len(few)) % LEFT_OUT == 0
        solving = np.isin(np.arange(tracks.points), few[~out])
        self.begun = first.of_points(first.points_m[solving])
        place = places(first.points_m[~solving], flying_height_m(block))
        self._judged = partial(
            _judged, chosen_tracks(tracks, solving), chosen_tracks(tracks, ~solving), place
        )
        self._spread = spread

    def judged(self, name: str, models: dict[str, Model]) -> dict[str, Judged]:
        """What each model leaves. The last has most unknowns and takes longest: it is begun first."""
        names = list(models)[::-1]
        sent = [replace(models[n], block=_without_tie_points(models[n].block)) for n in names]
        found = dict(zip(names, self._spread.map(name, self._judged, sent, names), strict=True))
        return {n: found[n] for n in models}


def _without_tie_points(block: Block) -> Block:
    """The block with the bare pairs: it goes to other processes."""
    at, number = np.zeros((0, 2)), np.zeros(0, np.int32)
    bare = (TiePair(left, right, at, at, number, number) for left, right in block.ties.frames)
    return replace(block, ties=TiePoints(tuple(bare)))


def places(points_m: Floats, height_m: float) -> Ints:
    """Number of the place of each point, (p,)."""
    square = np.floor(points_m[:, :2] / (_ALIKE * height_m))
    return np.unique(square, axis=0, return_inverse=True)[1].astype(np.intp).ravel()


def _judged(tracks: Tracks, judges: Tracks, place: Ints, model: Model) -> Judged:
    """The solution with points of their own and no control, and what it leaves."""
    block, before = model.block, model.before
    lenses = tuple(_begun_lens(*both) for both in zip(block.lenses, before.cameras, strict=True))
    begun = before.of_points(before.points_m, lenses)
    problem = block_problem(block, model.settings, tracks, before.points_m)
    options = SolveOptions(
        rough=True, self_calibration=model.settings.self_calibration, same_model=model.same
    )
    try:
        solved = solve(problem, before.poses, begun, options)
    except NotSolvableError:
        return Judged(None, np.full(judges.points, np.inf), place)
    image = left_out_residuals(judges, block, solved)
    vibration = left_by_vibration(image, block.cameras)
    return Judged(solved.of_points(solved.points_m), left_out_px(judges, image), place, vibration)


def _begun_lens(given: Camera, found: Camera) -> Camera:
    """A lens as it was found with another model, as far as this one has the same numbers."""
    numbers, before = interior_of(given), interior_of(found)
    same = READOUT if given.kind == found.kind else _OF_ALL_LENSES
    numbers[:same] = before[:same]
    numbers[READOUT] = before[READOUT] or numbers[READOUT]
    return with_interior(given, numbers)


def left_out_px(tracks: Tracks, image: ImageResiduals) -> Floats:
    """Deviations (t,) of tracks, by what a solution leaves of them."""
    length = np.linalg.norm(image.residual_px, axis=1)
    squares = np.bincount(tracks.point, np.nan_to_num(length, nan=_NOT_SEEN_PX) ** 2, tracks.points)
    return np.asarray(np.sqrt(squares / np.maximum(2.0 * tracks.lengths - 3.0, 1.0)))


def left_out_residuals(tracks: Tracks, block: Block, solved: Start) -> ImageResiduals:
    """Of tracks that took no part in a solution, their points put nearest to their rays."""
    number = {c.name: k for k, c in enumerate(solved.cameras)}
    cameras = [solved.cameras[number[c.name]] for c in block.cameras]
    centre = np.median(solved.points_m, axis=0)
    near = np.broadcast_to(centre, (tracks.points, 3))
    points = nearest_to_rays(tracks, solved.poses, cameras, near)
    computed_px = np.empty_like(tracks.image_px)
    for i, mine in frame_by_frame(tracks.frame):
        computed_px[mine] = solved.poses[i].image_from_ground(cameras[i], points[tracks.point[mine]])
    residual_px = tracks.image_px - computed_px
    length = np.linalg.norm(residual_px, axis=1)
    weight = cauchy_weight(length / max(median_of_known(length), _EXACT_PX))
    return ImageResiduals(tracks.frame, tracks.image_px, residual_px, weight)
