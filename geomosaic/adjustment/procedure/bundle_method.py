"""The bundle method: an initial block of similarities, a bundle adjustment, the ground from its points."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from geomosaic.adjustment.ground.ground_choice import levelled, surface_of
from geomosaic.adjustment.model import Adjusted, Block, ModelChoice, Round, Settings, SolveStep
from geomosaic.adjustment.problem.usable_block import as_filed, as_taken, turned_poses, usable
from geomosaic.adjustment.procedure.block_solution import (
    BlockSolution,
    BlockTask,
    block_solution,
    by_all_points,
    flights_sd_m,
)
from geomosaic.adjustment.procedure.blunder_detection import counted_shares, resected
from geomosaic.adjustment.procedure.control_points import placed_by_control, with_marks_of_whole_images
from geomosaic.adjustment.procedure.fallback import with_fallbacks
from geomosaic.adjustment.procedure.first_solution import begun
from geomosaic.adjustment.procedure.lens_start import with_lens_starts
from geomosaic.adjustment.procedure.levelling import levelled_block
from geomosaic.adjustment.procedure.model_selection import (
    GOOD_PX,
    chosen_model,
    contradicts,
    readout_shown,
    turns_shown,
    with_readout,
)
from geomosaic.adjustment.procedure.outcome import (
    BlockState,
    bundle_outcome,
    outcome,
    places_of,
    shape_figures,
)
from geomosaic.adjustment.procedure.reading_order import read_backwards, surely_better, turned_back
from geomosaic.adjustment.procedure.reported_corrections import (
    height_drift,
    with_common_rate,
    with_solved_velocities,
)
from geomosaic.adjustment.solver.place_uncertainty import design_effect, with_design_effect
from geomosaic.adjustment.solver.solution import Start
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import tuned
from geomosaic.errors import NotSolvableError
from geomosaic.matching.tracks import FEW_CELLS, FEW_PER_FRAME, join_tracks, thin_tracks
from geomosaic.spread import AtOnce, Spread
from geomosaic.survey.model import Warn

_WORTHWHILE = tuned(4, "times the few points", "fewer: thinning saves too little for a second solve")


def pose_block(block: Block, settings: Settings, spread: Spread | None = None) -> Adjusted:
    """Every frame's six pose parameters, the lenses and the tie points' ground at once. Positions and
    attitudes are weighted observations, whose deviations are estimated again from the residuals. Frames
    without tie or control points keep theirs."""
    sound, warnings = usable(as_taken(block))
    adjusted = with_fallbacks(sound, settings, lambda b, s: _solved(b, s, spread or AtOnce()))
    return as_filed(replace(adjusted, warnings=(*warnings, *adjusted.warnings)), block)


def _solved(block: Block, settings: Settings, spread: Spread) -> Adjusted:
    block = with_lens_starts(block, settings, spread)
    sizes = np.array([[c.width_px, c.height_px] for c in block.cameras])
    tracks = thin_tracks(join_tracks(block.ties), sizes, settings.observations_per_frame)
    if not tracks.points and all(c.check for c in block.control):
        still = np.zeros((len(block.names), 2))
        return outcome(block, block.poses, (Round(np.zeros((0, 2)), still),))
    few = thin_tracks(tracks, sizes, FEW_PER_FRAME, FEW_CELLS)
    few = few if _WORTHWHILE * few.points < tracks.points else tracks

    def free(its: Block) -> tuple[Poses, tuple[Camera, ...]]:
        solution = begun(its, replace(settings, model="given"), (few, few), spread).found.solution
        return solution.poses, tuple(solution.cameras[k] for k in its.lens_of)

    block, notes = with_marks_of_whole_images(block, free)
    spread.progress(0, len(PROCEDURE), "first solution, step")
    work = begun(block, settings, (tracks, few), spread, placed_by_control(block, free))
    steps = _named("few tie points" if work.rough else "tie points", work.steps)
    skipped: list[Warn] = []
    for number, (name, step) in enumerate(PROCEDURE.items()):
        spread.progress(number, len(PROCEDURE), f"{name}, step")
        before = len(work.steps)
        try:
            work = step(work)
        except NotSolvableError as error:
            text = f"the step '{name}' of the adjustment cannot be solved ({error}) and is left out: "
            text += "nothing to do if the verdict is good, else give a calibrated lens with --camera"
            skipped.append(Warn("adjustment-step-failed", "", text))
        steps += _named(name, work.steps[before:])
    adjusted = as_filed(bundle_outcome(work), replace(block, turned=work.turned))
    return replace(adjusted, steps=steps, warnings=(*notes, *skipped, *adjusted.warnings))


def _named(name: str, steps: tuple[SolveStep, ...]) -> tuple[SolveStep, ...]:
    return tuple(replace(step, solve=name) for step in steps)


def again(
    work: BlockState, block: Block, settings: Settings, start: BlockSolution | Start | None = None
) -> BlockState:
    """The block solved anew with another block or settings, from the present poses or a solver's solution."""
    poses = start.poses if isinstance(start, Start) else work.found.solution.poses
    found = block_solution(_task(replace(work, block=block, settings=settings)), poses, start)
    return replace(work.then(found), block=block, settings=settings)


def _task(work: BlockState) -> BlockTask:
    """Its block by few tie points, whose flights are off as found before."""
    return BlockTask(work.block, work.settings, work.few, work.rough, flights_sd_m(work.found.problem))


def _ground_levelled(work: BlockState) -> BlockState:
    """Of cameras that look ahead, while nothing says where down is: solved again over level ground."""
    found = levelled_block(work.block, work.found)
    if found is None:
        return work
    text = f"nothing says where down is, and the cameras look {found.ahead_deg:.0f}° ahead of the ground's "
    text += (
        "perpendicular: the ground is taken for level; if it slopes, give attitudes or positions with --pos"
    )
    work = replace(work, block=found.block, notes=(*work.notes, Warn("ground-levelled", "", text)))
    return work.then(block_solution(_task(work), found.poses))


def _wrong_ones_resected(work: BlockState) -> BlockState:
    """Frames with most of their tie points put aside, by what the others have found."""
    ties, solution, cameras = work.found.ties, work.found.of_ties, work.block.cameras
    wrong = counted_shares(ties, solution, len(cameras)) < 0.5
    poses = resected(ties, solution, cameras, wrong) if wrong.any() else None
    if poses is None:
        return work
    return work.then(block_solution(_task(work), poses))


def _read_in_order(work: BlockState) -> BlockState:
    """Images turned back that were turned after the flight, where rolling shutters show it."""
    quarters = read_backwards(work)
    if not quarters or work.turned:
        return work
    other = turned_back(work, quarters)
    poses = turned_poses(work.found.solution.poses, quarters)
    with suppress(NotSolvableError):
        other = other.then(block_solution(_task(other), poses))
        return other if surely_better(other.found.solution, work.found.solution) else work
    return work


def _heights_freed(work: BlockState) -> BlockState:
    """Velocities by the solved positions; heights that drift or jump don't any longer."""
    poses = work.found.solution.poses
    block, other = with_solved_velocities(work.block, poses)
    drift = height_drift(block, poses, np.unique(work.found.problem.tracks.frame))
    block = drift.freed(block)
    if drift.parts or (other and work.rolling):
        return again(work, block, work.settings, work.found)
    return replace(work, block=block)


def _model_chosen(work: BlockState) -> BlockState:
    """With the model of lens and shutter that cross-validation chooses."""
    found = work.found
    if work.settings.model != "auto" or not found.ties.points:
        return work
    block, settings, choice, begun = chosen_model(
        *(work.block, work.settings, found.ties, found.of_ties, work.spread)
    )
    if choice is None or not choice.taken:
        return replace(work, choice=choice)
    try:
        chosen = again(work, block, settings, begun)
    except NotSolvableError:  # of a large block, some frames were compared, the others are only near
        chosen = again(work, block, settings)
    chosen = _read_in_order(_heights_freed(replace(chosen, choice=choice)))
    if contradicts(chosen.found.solution, found.solution):
        contradicted = (*choice.contradicted, "+".join(choice.taken))
        return replace(work, choice=replace(choice, taken=(), contradicted=contradicted))
    return chosen


def _turning_too(work: BlockState) -> BlockState:
    """Rotations while rows are read: besides reported ones, what a gyroscope's filter and last sample leave
    of them; and where frames rotate faster than unknown velocities explain."""
    settings, before = work.settings, work.found.solution
    rolling = work.rolling or settings.rolling_shutter
    if settings.model != "auto" or not rolling or settings.turning:
        return work
    reported = work.block.poses.turns is not None
    if not (reported or turns_shown(before, work.block)):
        return work
    turning = again(work, work.block, replace(settings, turning=True), before)
    if reported:
        return turning
    if contradicts(turning.found.solution, before) or _leaves_open(turning, work):
        return work
    tried = work.choice or ModelChoice((), (), ())
    return replace(turning, choice=replace(tried, taken=(*tried.taken, "turning"), shown=tried.shown + 1))


def _leaves_open(its: BlockState, now: BlockState) -> bool:
    """Whether a model leaves the block's shape less certain than the one before."""
    before_px, after_px = (
        shape_figures(w.block, places_of(w.found)).get("shape_sd_px", np.inf) for w in (now, its)
    )
    return bool(after_px > max(before_px, GOOD_PX))


def _zero_of_the_gyroscope(work: BlockState) -> BlockState:
    solution = work.found.solution
    rotating = work.settings.turning and solution.estimate.rotation_terms_rad.shape[1]
    if not rotating or work.block.poses.turns is None:
        return work
    return again(work, *with_common_rate(work.block, work.settings, solution))


def _by_all(work: BlockState) -> BlockState:
    """All tie points, weighed by what those of a frame have in common, and the last ground."""
    found, block = work.found, work.block
    effect = design_effect(found.solution, found.ties.points).among(work.tracks)
    if work.rough or effect > 1.0:
        found = by_all_points(block, work.settings, work.tracks, found, effect)
        work = work.then(found)
    if found.ground.kind == "tie_surface":
        solution = found.of_ties
        ground, houses = surface_of(block, levelled(block.ground, solution), solution, work.spread)
        found = replace(found, ground=ground, houses=houses)
    return replace(work, found=found)


def _readout_shown(work: BlockState) -> BlockState:
    """With a rolling shutter, where the solution by all points with all rows read at once shows it."""
    before = work.found.solution
    if work.settings.model != "auto" or not readout_shown(before):
        return work
    read = again(work, *with_readout(work.block, work.settings))
    if contradicts(read.found.solution, before):
        return work
    tried = work.choice or ModelChoice((), (), ())
    choice = replace(tried, taken=(*tried.taken, "readout"), shown=tried.shown + 1)
    shown = _by_all(replace(read, choice=choice))
    return work if contradicts(shown.found.solution, before) else shown


def _accuracy_stated(work: BlockState) -> BlockState:
    """With covariances that hold what the image errors of a frame have in common."""
    found = work.found
    solution = with_design_effect(found.solution, found.ties.points)
    return replace(work, found=replace(found, solution=solution))


PROCEDURE: dict[str, Callable[[BlockState], BlockState]] = {
    "level ground": _ground_levelled,
    "wrong frames resected": _wrong_ones_resected,
    "heights": _heights_freed,
    "order of reading": _read_in_order,
    "model of lens and shutter": _model_chosen,
    "turning": _turning_too,
    "zero of the gyroscope": _zero_of_the_gyroscope,
    "all tie points": _by_all,
    "readout": _readout_shown,
    "accuracy": _accuracy_stated,
}
