"""What the bundle method returns for a block."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geomosaic.adjustment.ground.ground_choice import flying_height_m
from geomosaic.adjustment.model import Adjusted, Block, GroundPlaces, ModelChoice, Round, Settings, SolveStep
from geomosaic.adjustment.problem.tracks import Tracks
from geomosaic.adjustment.procedure.block_solution import BlockSolution
from geomosaic.adjustment.procedure.blunder_detection import (
    contradicted_frames,
    counted_shares,
    implausible_lenses,
    shift_and_scale,
    undetermined_unknowns,
    unsolved_frames,
    wrong_tags,
)
from geomosaic.adjustment.procedure.common_offsets import common_error, with_common_error
from geomosaic.adjustment.procedure.control_points import spread_of
from geomosaic.adjustment.procedure.model_selection import image_residuals, model_warnings
from geomosaic.adjustment.procedure.outcome import Findings, outcome
from geomosaic.adjustment.procedure.reported_corrections import height_drift
from geomosaic.adjustment.solver.place_uncertainty import ground_places
from geomosaic.adjustment.solver.solution import Solution
from geomosaic.adjustment.terms.attitudes import TILT, YAW
from geomosaic.adjustment.terms.gnss_positions import HORIZONTAL, VERTICAL
from geomosaic.adjustment.terms.image_observations import IMAGE
from geomosaic.adjustment.terms.point_coordinates import precision_figures, precision_warnings, with_precision
from geomosaic.arrays import Floats
from geomosaic.errors import NotSolvableError
from geomosaic.spread import Spread
from geomosaic.survey.model import Warn


@dataclass(frozen=True)
class Work:
    """A block on its way through the procedure. given: the block as it came; misalignments_m: of its pairs.
    tracks: all tie points, few: those that the model is found by. rolling: rolling shutters were reported.
    block, settings: as corrected by now. found: the present solution. spread: runs tasks side by side.
    choice: of the model of lens and shutter. notes: warnings of the start. steps: of all solves that led
    here."""

    given: Block
    misalignments_m: Floats
    tracks: Tracks
    few: Tracks
    rolling: bool
    block: Block
    settings: Settings
    found: BlockSolution
    spread: Spread
    choice: ModelChoice | None = None
    notes: tuple[Warn, ...] = ()
    steps: tuple[SolveStep, ...] = ()

    @property
    def rough(self) -> bool:
        """Whether a solve by all tie points follows."""
        return self.few is not self.tracks

    def then(self, found: BlockSolution) -> Work:
        """With the next solution."""
        return replace(self, found=found, steps=self.steps + found.steps)


def bundle_outcome(work: Work) -> Adjusted:
    """The outcome with warnings, figures and covariances."""
    block, given, found = work.block, work.given, work.found
    solution, components = found.of_ties, found.solution.components
    observed = np.unique(found.problem.tracks.frame)
    common_m2 = common_error(block, solution.poses, found.ground, components)
    common_m2 = np.where(found.offset, 0.0, common_m2)  # in the covariance
    moves = (solution.poses.positions_m - given.poses.positions_m)[:, :2]
    shared, places = solution.shared_unknowns(), places_of(found)
    counted = counted_shares(found.ties, solution, len(block.names))
    rejected = contradicted_frames(block, solution.poses, counted)
    certain = with_common_error(solution.poses, common_m2)
    findings = Findings(
        cameras=tuple(solution.cameras[k] for k in block.lens_of),
        ground=found.ground,
        warnings=(
            *work.notes,
            *wrong_tags(block, certain, rejected, components[HORIZONTAL]),
            *rejected.values(),
            *shift_and_scale(block, solution.poses, observed),
            *height_drift(given, solution.poses, observed).warnings(given),
            *undetermined_unknowns(shared, given.cameras),
            *unsolved_frames(block, solution.left_out),
            *implausible_lenses(block.lenses, solution.implausible),
            *model_warnings(block, work.choice),
            *precision_warnings(block.control, components),
        ),
        unsolved=tuple(np.flatnonzero(solution.left_out).tolist()),
        rejected=tuple(rejected),
        figures=_figures(solution, found.ties)
        | ({"ground_relief_px": found.relief_px} if np.isfinite(found.relief_px) else {})
        | shape_figures(block, places)
        | precision_figures(block.control, components),
        spread=spread_of(solution, block.lens_of),
        covariance=solution.stated.pose_covariance,
        common_m2=common_m2,
    )
    control = with_precision(block.control, components)
    rounds = (Round(work.misalignments_m, moves),)
    adjusted = outcome(replace(block, poses=given.poses, control=control), solution.poses, rounds, findings)
    places = None if places is None else places.with_common_error(common_m2)
    residuals = image_residuals(found.ties, solution)
    return replace(adjusted, places=places, model=work.choice, shared=shared, image_residuals=residuals)


def places_of(found: BlockSolution) -> GroundPlaces | None:
    """How far the ground may be off, None where the equations do not say."""
    try:
        return ground_places(found.solution, found.ties.points)
    except NotSolvableError:
        return None


def shape_figures(block: Block, places: GroundPlaces | None) -> dict[str, float]:
    """The standard deviation of the map's shape, in pixels of the frames on the ground."""
    if places is None:
        return {}
    pixel_m = flying_height_m(block) / float(np.median([c.focal_length_px for c in block.cameras]))
    return {"shape_sd_px": places.shape_sd_m() / pixel_m}


def _figures(solution: Solution, tracks: Tracks) -> dict[str, float]:
    figures = {
        "sigma_px": solution.components[IMAGE],
        "design_effect": solution.problem.image.design_effect,
        "iterations": float(len(solution.steps)),
    }
    if tracks.points:
        length = np.linalg.norm(solution.residual_px, axis=1)[solution.weight > 0.1]
        known = length[np.isfinite(length)]
        figures |= {
            "reprojection_mean_px": float(known.mean()) if known.size else float("nan"),
            "tracks": float(tracks.points),
            "observations": float(len(tracks.frame)),
            "track_length_mean": float(tracks.lengths.mean()),
        }
    groups = HORIZONTAL, VERTICAL, TILT, YAW
    return figures | {f"sigma_{group}": solution.components[group] for group in groups}
