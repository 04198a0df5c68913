"""Models of lens and shutter compared by what each leaves at tie points that took no part in its solve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from geomosaic.adjustment.ground.ground_choice import flying_height_m
from geomosaic.adjustment.ground.tie_surface import SIDE
from geomosaic.adjustment.kernels.interior import INTERIOR, READOUT, interior_of, with_interior
from geomosaic.adjustment.model import Block, ImageResiduals, Settings
from geomosaic.adjustment.procedure.block_part import (
    neighbours,
    part_of_block,
    part_of_solution,
    part_of_tracks,
    solution_of_whole,
)
from geomosaic.adjustment.procedure.block_problem import block_problem
from geomosaic.adjustment.procedure.residual_pattern import left_by_vibration
from geomosaic.adjustment.solver.solution import Start
from geomosaic.adjustment.solver.solve import SolveOptions, few_steps, solved_start
from geomosaic.adjustment.solver.variance_components import EXACT_PX
from geomosaic.adjustment.terms.image_observations import BEHIND
from geomosaic.adjustment.terms.interior_orientation import part_of_camera
from geomosaic.arrays import Floats, Ints
from geomosaic.camera.interior import Camera
from geomosaic.camera.lens import STEPS
from geomosaic.constants import tuned
from geomosaic.errors import NotSolvableError
from geomosaic.estimation.linear import least_squares
from geomosaic.estimation.robust import THREE_SIGMA, cauchy_weight, median_of_known
from geomosaic.matching.model import TiePair, TiePoints
from geomosaic.matching.tracks import (
    FEW_CELLS,
    Tracks,
    asked_tracks,
    chosen_tracks,
    frame_by_frame,
    nearest_to_rays,
)
from geomosaic.spread import AtOnce, Spread

_OF_ALL_LENSES = INTERIOR.index("k1")
BETTER = tuned(0.95, "share of left-out residuals", "less is better: true models 0.93 at most, others 0.98")
LEFT_OUT = tuned(5, "tracks", "of which one is left out: more weaken the solve, fewer the judgement")
_LEAST_TRACKS = tuned(300, "tracks", "that thinning leaves: with fewer all are taken, chance chooses models")
_SURE = tuned(0.25, "share of the median", "a track's least residual by both models: less, exact fits decide")
MOST_FRAMES = tuned(200, "frames", "that are compared: with 100 of 195 a readout came out negative")


@dataclass(frozen=True)
class Model:
    """A model of lens and shutter, and the solution that its own begins from."""

    block: Block
    settings: Settings
    before: Start


def solved(tracks: Tracks, model: Model) -> Start:
    """The model's solution. Raises: NotSolvableError where there is none."""
    start = _start(model)
    problem = block_problem(model.block, model.settings, tracks, start.points_m)
    options = SolveOptions(rough=True, self_calibration=model.settings.self_calibration)
    found = solved_start(problem, start.poses, start, options)
    return found.of_points(found.points_m)


def tested(tracks: Tracks, model: Model) -> Start:
    """The model a few steps from the solution before, see `few_steps`."""
    start = _start(model)
    return few_steps(block_problem(model.block, model.settings, tracks, start.points_m), start)


def _start(model: Model) -> Start:
    """What the model's solve begins from: lenses of its kind, whose terms are determined anew."""
    before = model.before
    by_name, fixed = {c.name: c for c in model.block.lenses}, before.fixed.copy()
    lenses = tuple(_begun_lens(by_name.get(c.name, c), c) for c in before.cameras)
    for lens, found in zip(lenses, before.cameras, strict=True):
        if lens.kind != found.kind and model.settings.self_calibration:
            its = fixed[before.estimate.layout.slices[part_of_camera(lens.name)]]
            its[_OF_ALL_LENSES:READOUT] = False
    return replace(before.of_points(before.points_m, lenses), fixed=fixed)


def _begun_lens(given: Camera, found: Camera) -> Camera:
    """A lens as found with another model; one of another kind gets terms that bend rays alike."""
    numbers, before = interior_of(given), interior_of(found)
    same = READOUT if given.kind == found.kind else _OF_ALL_LENSES
    numbers[:same] = before[:same]
    if given.kind != found.kind:
        numbers[_OF_ALL_LENSES : _OF_ALL_LENSES + 3] = _odd_terms(found)
    numbers[READOUT] = before[READOUT] or numbers[READOUT]
    return with_interior(given, numbers)


def _odd_terms(lens: Camera) -> Floats:
    """k1 to k3 of the fisheye of the same focal length that bends rays as a lens does."""
    widest = np.linalg.norm(lens.ray_from_image(lens.corners_px)[:, :2], axis=1).max()
    angle = np.linspace(0.0, float(np.arctan(widest)), STEPS)
    design = angle[:, None] ** [3, 5, 7]
    return least_squares(design, lens.lens.radial(lens.terms, np.tan(angle)) - angle)


@dataclass(frozen=True)
class ModelScore:
    """A model's solution (None where there is none), and the residual of each track left out of it, (t,);
    place (t,): number of the place where it lies; vibration: `left_by_vibration` of the left-out tracks."""

    solved: Start | None
    each_px: Floats
    place: Ints
    vibration: float = 1.0

    @property
    def median_px(self) -> float:
        return float(np.median(self.each_px))

    def beats(self, other: ModelScore) -> bool:
        """Whether it leaves less by what makes a model worth its unknowns, and surely less."""
        share, at_most = self.compared_to(other)
        return share < BETTER and at_most < 1.0

    def compared_to(self, other: ModelScore) -> tuple[float, float]:
        """The share of another model's residuals that this one leaves, and its upper limit: the median of the
        tracks' own shares, so that what moves in the wind decides nothing. Tracks weigh by the inverse of
        what both models leave together, down to a quarter of the median. Those of one place err alike: the
        median is as certain as places differ."""
        if self.solved is None or other.solved is None:
            return (0.0, 0.0) if self.solved is not None else (np.inf, np.inf)
        mine, others = (np.maximum(a, EXACT_PX) for a in (self.each_px, other.each_px))
        both = np.hypot(mine, others)
        weight = 1.0 / np.maximum(both, _SURE * np.median(both))
        order = np.argsort(mine / others)
        shares, below = (mine / others)[order], np.cumsum(weight[order]) / weight.sum()
        half = int(np.searchsorted(below, 0.5))
        side = np.where(np.arange(len(shares)) < half, 0.5, -0.5) * weight[order]
        sd = np.sqrt((np.bincount(self.place[order], side) ** 2).sum()) / weight.sum()
        most = int(np.searchsorted(below, 0.5 + THREE_SIGMA * sd))
        return float(shares[half]), float(shares[min(most, len(shares) - 1)])


@dataclass(frozen=True)
class LeftOutTest:
    """Tracks to solve by, tracks that judge, and the place of each of these, (t,)."""

    solving: Tracks
    judges: Tracks
    place: Ints


class LeftOutTracks:
    """Tracks that models are solved by, and all others, which judge them; of a large block those of some
    neighbouring frames. Args: first: the solution by all tracks."""

    def __init__(self, block: Block, tracks: Tracks, first: Start, spread: Spread) -> None:
        self._whole, self._spread = first, spread
        self._frames = _compared_frames(block)
        block = self._part(block)
        tracks, kept = part_of_tracks(tracks, self._frames)
        points_m = first.points_m[kept]
        sizes = np.array([[c.width_px, c.height_px] for c in block.cameras])
        asked = np.flatnonzero(asked_tracks(tracks, sizes, FEW_CELLS**2, FEW_CELLS))
        few = asked if len(asked) >= _LEAST_TRACKS else np.arange(tracks.points)
        out = np.random.default_rng(0).permutation(len(few)) % LEFT_OUT == 0
        solving = np.isin(np.arange(tracks.points), few[~out])
        self.begun = part_of_solution(first, self._frames, points_m[solving])
        self._test = LeftOutTest(
            chosen_tracks(tracks, solving),
            chosen_tracks(tracks, ~solving),
            places(points_m[~solving], flying_height_m(block)),
        )

    def of_whole(self, found: Start) -> Start:
        """What the whole block's solve begins from."""
        return solution_of_whole(found, self._whole, self._frames)

    def judged(
        self, name: str, models: dict[str, Model], solve: Callable[[Tracks, Model], Start] = solved
    ) -> dict[str, ModelScore]:
        """What each model leaves, solved or `tested`. The last takes longest: it is begun first. One alone is
        solved here, where numpy has all threads."""
        names, spread = list(models)[::-1], self._spread if len(models) > 1 else AtOnce()
        sent = [replace(models[n], block=self._part(models[n].block)) for n in names]
        found = spread.map(name, partial(_judged, self._test, solve), sent, names)
        its = dict(zip(names, found, strict=True))
        return {n: its[n] for n in models}

    def _part(self, block: Block) -> Block:
        """The compared frames with bare pairs: they go to other processes."""
        at, number = np.zeros((0, 2)), np.zeros(0, np.int32)
        bare = (TiePair(left, right, at, at, number, number) for left, right in block.ties.frames)
        return part_of_block(replace(block, ties=TiePoints(tuple(bare))), self._frames)


def _compared_frames(block: Block) -> Ints:
    """Neighbouring frames of a large block if all its cameras are among them, else all frames."""
    every = np.arange(len(block.names))
    if len(every) <= MOST_FRAMES:
        return every
    some = neighbours(block, np.ones(len(every), dtype=bool), MOST_FRAMES)
    return some if len({block.lens_of[i] for i in some}) == len(block.lenses) else every


def places(points_m: Floats, height_m: float) -> Ints:
    """Number of the place of each point, (p,)."""
    square = np.floor(points_m[:, :2] / (SIDE * height_m))
    return np.unique(square, axis=0, return_inverse=True)[1].astype(np.intp).ravel()


def _judged(test: LeftOutTest, solve: Callable[[Tracks, Model], Start], model: Model) -> ModelScore:
    """A solution by points of its own and no control, and what it leaves."""
    try:
        solved = solve(test.solving, model)
    except NotSolvableError:
        return ModelScore(None, np.full(test.judges.points, np.inf), test.place)
    image = left_out_residuals(test.judges, model.block, solved)
    vibration = left_by_vibration(image, model.block.cameras)
    return ModelScore(solved, left_out_px(test.judges, image), test.place, vibration)


def left_out_px(tracks: Tracks, image: ImageResiduals) -> Floats:
    """Deviations (t,) of tracks, by what a solution leaves of them."""
    length = np.linalg.norm(image.residual_px, axis=1)
    squares = np.bincount(tracks.point, np.nan_to_num(length, nan=BEHIND) ** 2, tracks.points)
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
    weight = cauchy_weight(length / max(median_of_known(length), EXACT_PX))
    return ImageResiduals(tracks.frame, tracks.image_px, residual_px, weight)
