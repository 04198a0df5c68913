"""The global method: a block of similarities to start from, a bundle, the ground from its points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.ground.ground_choice import flying_height_m, levelled, surface_of
from geomosaic.adjustment.model import (
    Adjusted,
    Block,
    ImageResiduals,
    ModelChoice,
    Round,
    Settings,
    SolveStep,
)
from geomosaic.adjustment.paper.misalignment import offset_net
from geomosaic.adjustment.problem.bundle_model import GROUPS, Begun, Bundle
from geomosaic.adjustment.problem.half_turned import as_filed, as_taken
from geomosaic.adjustment.problem.priors import priors_of
from geomosaic.adjustment.problem.shared_unknowns import shared_unknowns
from geomosaic.adjustment.problem.tracks import Tracks, join_tracks, thin_tracks
from geomosaic.adjustment.problem.usable_input import usable
from geomosaic.adjustment.procedure.block_solution import Solution, by_all_points, points_on_ground, solution
from geomosaic.adjustment.procedure.blunder_detection import (
    doubtful_positions,
    lying_tags,
    strayed_frames,
    strayed_lenses,
    undetermined_wishes,
    unsolved_frames,
)
from geomosaic.adjustment.procedure.common_heading import with_common_heading
from geomosaic.adjustment.procedure.common_offsets import common_error, with_common_error
from geomosaic.adjustment.procedure.common_rate import with_common_rate
from geomosaic.adjustment.procedure.control_marks import with_marks_of_whole_images
from geomosaic.adjustment.procedure.control_reference import placed_by_control
from geomosaic.adjustment.procedure.fallback import with_fallbacks
from geomosaic.adjustment.procedure.height_drift import height_drift
from geomosaic.adjustment.procedure.initialisation import placed_by_images, start_poses
from geomosaic.adjustment.procedure.lens_start import with_lens_starts
from geomosaic.adjustment.procedure.model_selection import (
    chosen_model,
    contradicts,
    model_warnings,
    readout_shown,
    turns_shown,
    with_readout,
)
from geomosaic.adjustment.procedure.outcome import settled
from geomosaic.adjustment.procedure.resection import UNHEARD, heard_shares, resected
from geomosaic.adjustment.procedure.velocities import flown
from geomosaic.adjustment.solver.bundle import solve_bundle
from geomosaic.adjustment.solver.shape_uncertainty import shape_sd_m
from geomosaic.adjustment.terms.control_points import spread_of
from geomosaic.adjustment.terms.control_precision import (
    precision_figures,
    precision_warnings,
    with_precision,
)
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import sourced, tuned
from geomosaic.errors import NotSolvableError
from geomosaic.spread import AtOnce, Spread
from geomosaic.survey.model import Warn

Floats = NDArray[np.float64]

_FEW_PER_FRAME = tuned(
    192,
    "image observations a frame",
    "asked for by each frame for the solves that find the block: enough for poses, lens and variance "
    "components to a fraction of a pixel, at a tenth of the work of all; the last solve takes all",
)
_FEW_CELLS = tuned(
    8,
    "cells",
    "across and along a frame, each of which asks for 3 of the 192 observations: with fewer cells "
    "corners, which determine the lens, may stay empty; with more than 13 they ask for more than 192",
)
_SURE_PX = sourced(
    1.0,
    "px of the frames on the ground",
    "as sure a shape has to be with a model that no left-out point asks for, or as it was without. "
    "Halves of a flight, of which it made 4.6 and 5.3 px of 1.1 and 1.0, lay 6.2 px apart with it, 1.5 "
    "without; the whole, of which it made 1.6 of 1.1, 2.7 and 3.4 px from the halves, 1.4 and 1.3 "
    "without",
    "docs/results.md, split halves",
)
_WORTHWHILE = tuned(
    4,
    "times the few points",
    "all must be more than that, or the block is found by all at once: thinning fewer saves too little "
    "for a second solve",
)


def pose_block(block: Block, settings: Settings, spread: Spread | None = None) -> Adjusted:
    """Every frame's six pose parameters, the lenses and the tie points' ground at once.

    POS enters as weighted observations, so that no frame is the base and nothing accumulates; its
    deviations are estimated again from the residuals. Frames without tie or control points keep their POS.
    """
    sound, warnings = usable(as_taken(block))
    adjusted = with_fallbacks(sound, settings, lambda b, s: _solved(b, s, spread or AtOnce()))
    return as_filed(replace(adjusted, warnings=(*warnings, *adjusted.warnings)), block)


@dataclass(frozen=True)
class _Work:
    """A block on its way: as it was given, and as it is believed by now, with the settings, the solution by
    few tie points, and the model of lens and shutter that was chosen.

    misalignments_m: of the pairs as they were given; tracks: all tie points, few: of them, to find the model
    by; rolling: whether rows were said to be read one after the other; spread: who makes what can be made
    side by side; notes: warnings of the start.
    """

    given: Block
    misalignments_m: Floats
    tracks: Tracks
    few: Tracks
    rolling: bool
    block: Block
    settings: Settings
    found: Solution
    spread: Spread
    choice: ModelChoice | None = None
    notes: tuple[Warn, ...] = ()

    @property
    def rough(self) -> bool:
        """Whether all tie points are to follow."""
        return self.few is not self.tracks

    def again(
        self,
        block: Block,
        settings: Settings,
        before: Solution | None = None,
        begun: Begun | None = None,
    ) -> _Work:
        """Solved anew with another block or other settings, from the poses found so far, or what `begun`."""
        poses = self.found.bundle.poses if begun is None else begun.poses
        found = solution(block, settings, self.few, poses, before, begun, rough=self.rough)
        return replace(self, block=block, settings=settings, found=found)


def _solved(block: Block, settings: Settings, spread: Spread) -> Adjusted:
    block = with_lens_starts(block, settings, spread)
    sizes = np.array([[c.width_px, c.height_px] for c in block.cameras])
    tracks = thin_tracks(join_tracks(block.ties), sizes, settings.observations_per_frame)
    if not tracks.points and all(c.check for c in block.control):
        still = np.zeros((len(block.names), 2))
        return settled(block, block.poses, (Round(np.zeros((0, 2)), still),))
    few = thin_tracks(tracks, sizes, _FEW_PER_FRAME, _FEW_CELLS)
    few = few if _WORTHWHILE * few.points < tracks.points else tracks

    def free(its: Block) -> tuple[Poses, tuple[Camera, ...]]:
        work = _begun(its, replace(settings, model="given"), (few, few), spread)
        bundle = work.found.bundle
        return bundle.poses, tuple(bundle.cameras[k] for k in its.lens_of)

    block, notes = with_marks_of_whole_images(block, free)
    work = _begun(block, settings, (tracks, few), spread, placed_by_control(block, free))
    taken = _named("few tie points" if work.rough else "tie points", work, ())
    skipped: list[Warn] = []
    for name, step in _STEPS.items():
        try:
            work = step(work)
        except NotSolvableError as error:
            text = f"the step '{name}' of the adjustment cannot be solved ({error}); it is left out"
            skipped.append(Warn("adjustment-step-failed", "", text))
        taken = _named(name, work, taken)
    outcome = _outcome(work)
    steps = tuple(step for _, step in taken)
    return replace(outcome, steps=steps, warnings=(*notes, *skipped, *outcome.warnings))


def _named(
    name: str, work: _Work, before: tuple[tuple[SolveStep, SolveStep], ...]
) -> tuple[tuple[SolveStep, SolveStep], ...]:
    """Steps as solved and as told, with those that `work` has gone on by, which are named."""
    known = {id(solved) for solved, _ in before}
    more = [step for step in work.found.bundle.steps if id(step) not in known]
    return *before, *((step, replace(step, solve=name)) for step in more)


def _begun(
    given: Block,
    settings: Settings,
    all_and_few: tuple[Tracks, Tracks],
    spread: Spread,
    start: Poses | None = None,
) -> _Work:
    """Similarities, unless a start is known, then a bundle; where rows are read one after the other, first as
    if they weren't."""
    tracks, few = all_and_few
    net = offset_net(given)
    start = start or start_poses(given, net)
    block, notes = with_common_heading(placed_by_images(given, start), start)
    rolling = settings.rolling_shutter or any(c.readout_s for c in block.cameras)
    if rolling:
        start = _read_at_once(block, settings, few, start)
        block, _ = flown(block, start)
    misalignments_m = net.misalignments_m(np.zeros((net.n, 2)))
    del net  # where every tie point lies, twice
    found = solution(block, settings, few, start, rough=few is not tracks)
    return _Work(
        *(given, misalignments_m, tracks, few, rolling, block, settings, found, spread), notes=tuple(notes)
    )


def _read_at_once(block: Block, settings: Settings, tracks: Tracks, start: Poses) -> Poses:
    """Poses as if rows were not read one after the other, with lenses as given: sure to a part of what a
    platform flies meanwhile, which shows how fast it flew. By velocities of given positions, which
    are off by metres where frames are a few metres apart, lenses stray far to explain what they do to rows.
    """
    points, kept = points_on_ground(start, block.cameras, block.ground, tracks)
    if not len(points):
        return start
    still = replace(
        block,
        cameras=tuple(replace(c, readout_s=0.0, readout_sd_s=0.0) for c in block.cameras),
        poses=replace(block.poses, velocities_m_per_s=None, turns=None),
    )
    settings = replace(settings, rolling_shutter=False, turning=False)
    priors = priors_of(still, settings, still.lenses, points)
    solved = solve_bundle(kept, still.lens_of, priors, start, lens_held=True, rough=True)
    return replace(solved.poses, velocities_m_per_s=start.velocities_m_per_s, turns=start.turns)


def _wrong_ones_resected(work: _Work) -> _Work:
    """Frames with most of their tie points put aside, by what the others have found."""
    ties, bundle, cameras = work.found.ties, work.found.of_ties, work.block.cameras
    wrong = heard_shares(ties, bundle, len(cameras)) < UNHEARD
    poses = resected(ties, bundle, cameras, wrong) if wrong.any() else None
    if poses is None:
        return work
    found = solution(work.block, work.settings, work.few, poses, rough=work.rough)
    return replace(work, found=found)


def _heights_freed(work: _Work) -> _Work:
    """Velocities by the solved positions; heights that drift or jump don't any longer."""
    poses = work.found.bundle.poses
    block, other = flown(work.block, poses)
    drift = height_drift(block, poses, np.unique(work.found.seen.frame))
    block = drift.freed(block)
    if drift.parts or (other and work.rolling):
        return work.again(block, work.settings, work.found)
    return replace(work, block=block)


def _model_chosen(work: _Work) -> _Work:
    """With what tie points left out of a solve speak for, of lens and shutter."""
    found = work.found
    if work.settings.model != "auto" or not found.ties.points:
        return work
    block, settings, choice, begun = chosen_model(
        *(work.block, work.settings, found.ties, found.of_ties, work.spread)
    )
    if choice is None or not choice.taken:
        return replace(work, choice=choice)
    chosen = _heights_freed(replace(work.again(block, settings, begun=begun), choice=choice))
    if contradicts(chosen.found.bundle, found.bundle):
        return replace(work, choice=choice.contradicted_at_last())
    return chosen


def _turning_too(work: _Work) -> _Work:
    """Beside reported turns, what a gyroscope's filter and its last sample leave of them; and where frames
    turn faster while they are read than what is unknown of their velocities explains."""
    settings, before = work.settings, work.found.bundle
    rolling = work.rolling or settings.rolling_shutter
    if settings.model != "auto" or not rolling or settings.turning:
        return work
    reported = work.block.poses.turns is not None
    if not (reported or turns_shown(before)):
        return work
    turning = work.again(work.block, replace(settings, turning=True), begun=before)
    if reported:
        return turning
    if contradicts(turning.found.bundle, before) or _leaves_open(turning, work):
        return work
    tried = work.choice or ModelChoice((), (), ())
    return replace(turning, choice=replace(tried, taken=(*tried.taken, "turning"), shown=True))


def _leaves_open(its: _Work, now: _Work) -> bool:
    """Whether a model leaves the block's shape less sure than the one before: what the left-out tie points
    don't ask for has to be determined at least."""
    before_px, after_px = (_shape(w.block, w.found).get("shape_sd_px", np.inf) for w in (now, its))
    return bool(after_px > max(before_px, _SURE_PX))


def _zero_of_the_gyroscope(work: _Work) -> _Work:
    bundle = work.found.bundle
    if not work.settings.turning or bundle.swing is None or work.block.poses.turns is None:
        return work
    return work.again(*with_common_rate(work.block, work.settings, bundle))


def _by_all(work: _Work) -> _Work:
    """All tie points, and the last ground."""
    found, block = work.found, work.block
    if work.rough:
        found = by_all_points(block, work.settings, work.tracks, found)
    if found.ground.kind == "tie_surface":
        bundle = found.of_ties
        ground = surface_of(block, levelled(block.ground, bundle), bundle, spread=work.spread)
        found = replace(found, ground=ground)
    return replace(work, found=found)


def _readout_shown(work: _Work) -> _Work:
    """With rows read one after the other, where the solution by all points with all rows read at once shows
    it: what stretches a block is far below the noise of few."""
    before = work.found.bundle
    if work.settings.model != "auto" or not readout_shown(before):
        return work
    read = work.again(*with_readout(work.block, work.settings))
    if contradicts(read.found.bundle, before):
        return work
    tried = work.choice or ModelChoice((), (), ())
    choice = replace(tried, taken=(*tried.taken, "readout"), shown=True)
    return _by_all(replace(read, choice=choice))


_STEPS: dict[str, Callable[[_Work], _Work]] = {
    "wrong frames resected": _wrong_ones_resected,
    "heights": _heights_freed,
    "model of lens and shutter": _model_chosen,
    "turning": _turning_too,
    "zero of the gyroscope": _zero_of_the_gyroscope,
    "all tie points": _by_all,
    "readout": _readout_shown,
}


def _outcome(work: _Work) -> Adjusted:
    block, given, found = work.block, work.given, work.found
    bundle, seen = found.of_ties, found.seen
    moved = (found.priors.poses.positions_m != block.poses.positions_m).any(axis=0)
    common_m2 = common_error(block, bundle.poses, found.ground, bundle.factors, moved=moved)
    moves = (bundle.poses.positions_m - given.poses.positions_m)[:, :2]
    shared = shared_unknowns(bundle, found.priors)
    heard = heard_shares(found.ties, bundle, len(block.names))
    strayed = strayed_frames(block, bundle.poses, heard)
    control = with_precision(block.control, bundle.factors)
    outcome = settled(
        replace(block, poses=given.poses, control=control),
        bundle.poses,
        (Round(work.misalignments_m, moves),),
        cameras=tuple(bundle.cameras[k] for k in block.lens_of),
        ground=found.ground,
        warnings=(
            *work.notes,
            *lying_tags(
                block, with_common_error(bundle.poses, common_m2), strayed, bundle.factors.horizontal
            ),
            *strayed.values(),
            *doubtful_positions(block, bundle.poses, np.unique(seen.frame)),
            *height_drift(given, bundle.poses, np.unique(seen.frame)).warnings(given),
            *undetermined_wishes(shared, given.cameras),
            *unsolved_frames(block, bundle.left_out),
            *strayed_lenses(block.lenses, bundle.strayed),
            *model_warnings(block, work.choice),
            *precision_warnings(block.control, bundle.factors),
        ),
        unsolved=np.flatnonzero(bundle.left_out).tolist(),
        strayed=strayed,
        figures=_figures(bundle, found.ties)
        | _relief(found)
        | _shape(block, found)
        | precision_figures(block.control, bundle.factors),
        spread=spread_of(bundle, block.lens_of),
        covariance=bundle.pose_covariance,
        common_m2=common_m2,
    )
    residuals = ImageResiduals(found.ties.frame, found.ties.image_px, bundle.residual_px, bundle.weight)
    return replace(
        outcome,
        shared=shared,
        model=work.choice,
        image_residuals=residuals,
    )


def _shape(block: Block, found: Solution) -> dict[str, float]:
    """How far the map's shape may be off, in pixels of the frames on the ground."""
    pixel_m = flying_height_m(block) / float(np.median([c.focal_length_px for c in block.cameras]))
    try:
        sd_m = shape_sd_m(found.bundle, found.ties.points)
    except NotSolvableError:
        return {}
    return {"shape_sd_px": sd_m / pixel_m} if np.isfinite(sd_m) else {}


def _relief(found: Solution) -> dict[str, float]:
    return {"ground_relief_px": found.relief_px} if np.isfinite(found.relief_px) else {}


def _mean(values: Floats) -> float:
    """Of those that are known, NaN of none."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else float("nan")


def _figures(bundle: Bundle, tracks: Tracks) -> dict[str, float]:
    figures = {"sigma_px": bundle.factors.image_px, "iterations": float(bundle.iterations)}
    if tracks.points:
        length = np.linalg.norm(bundle.residual_px, axis=1)
        figures |= {
            "reprojection_mean_px": _mean(length[bundle.weight > 0.1]),
            "tracks": float(tracks.points),
            "observations": float(len(tracks.frame)),
            "track_length_mean": float(tracks.lengths.mean()),
        }
    return figures | {f"sigma_{group}": bundle.factors.of(group) for group in GROUPS}
