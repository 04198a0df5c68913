"""What a method's poses mean for the block: status, residuals, covariances, figures and warnings."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from geomosaic.adjustment.ground.ground_choice import flying_height_m
from geomosaic.adjustment.ground.walls import leaning_houses
from geomosaic.adjustment.ground_places import GroundPlaces
from geomosaic.adjustment.model import (
    Adjusted,
    Block,
    ModelChoice,
    Round,
    Settings,
    SolvedBlock,
    SolveStep,
)
from geomosaic.adjustment.paper.misalignment import keypoints_on_ground
from geomosaic.adjustment.procedure.block_solution import BlockSolution
from geomosaic.adjustment.procedure.blunder_detection import (
    contradicted_frames,
    counted_shares,
    implausible_lenses,
    undetermined_frames,
    undetermined_unknowns,
    unsolved_frames,
    wrong_tags,
)
from geomosaic.adjustment.procedure.common_offsets import common_error, with_common_error
from geomosaic.adjustment.procedure.control_points import (
    CovarianceOf,
    control_residuals,
    covariance_of,
    covariance_of_poses,
)
from geomosaic.adjustment.procedure.model_selection import image_residuals, model_warnings
from geomosaic.adjustment.procedure.position_checks import OF_ANOTHER_SHAPE, shift_and_scale
from geomosaic.adjustment.procedure.reported_corrections import height_drift
from geomosaic.adjustment.solver.place_uncertainty import ground_places
from geomosaic.adjustment.solver.solution import Solution
from geomosaic.adjustment.terms.attitudes import TILT, YAW
from geomosaic.adjustment.terms.gnss_positions import HORIZONTAL, VERTICAL
from geomosaic.adjustment.terms.image_observations import IMAGE
from geomosaic.adjustment.terms.point_coordinates import precision_figures, with_precision
from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.errors import NotSolvableError
from geomosaic.matching.tracks import Tracks
from geomosaic.placement.collocation import moved_with_neighbours
from geomosaic.placement.graph import connected_parts
from geomosaic.placement.prior import position_assumed
from geomosaic.spread import Spread
from geomosaic.survey.control import LEAST_POINTS
from geomosaic.survey.model import Warn


def unplaced_parts(block: Block) -> list[list[int]]:
    """The connected parts of a block that nothing places: no frame in them has a position, and they see fewer
    than two control points. Where all are such, the largest lies in a frame of its own, and is none of
    these."""
    assumed = position_assumed(block.poses)
    if not assumed.any():
        return []
    parts = connected_parts(len(block.names), block.ties.frames)
    seen = [{i for i, _, _ in c.observations} for c in block.control if not c.check]
    nowhere = [
        part for part in parts
        if assumed[part].all() and sum(not frames.isdisjoint(part) for frames in seen) < LEAST_POINTS
    ]  # fmt: skip
    return nowhere[1:] if len(nowhere) == len(parts) else nowhere


@dataclass(frozen=True)
class BundleAccuracy:
    """Of a bundle's solution. propagate: see `control_residuals`. covariance (f, 6, 6): of the
    poses. common_m2 (3,): see `common_error`. tied: frames with tie points in the solve; unsolved: frames
    that the images do not determine; rejected: frames whose poses are rejected."""

    propagate: CovarianceOf
    covariance: Floats
    common_m2: Floats
    tied: frozenset[int]
    unsolved: frozenset[int]
    rejected: frozenset[int]


def outcome(
    block: Block, poses: Poses, rounds: tuple[Round, ...], accuracy: BundleAccuracy | None = None
) -> Adjusted:
    """The outcome for poses found by any method; cameras and ground are the block's. `tied` are frames with
    tie points, in a bundle with such whose rays meet the ground. The others, and those unsolved, are `placed`
    by POS alone and moved with the tied ones around them unless control points fix them. Frames of
    `unplaced_parts` and those rejected are `rejected`."""
    tied = frozenset(i for pair in block.ties.frames for i in pair)
    nowhere = {i for part in unplaced_parts(block) for i in part}
    if accuracy is not None:
        tied, nowhere = accuracy.tied - accuracy.unsolved, nowhere | accuracy.rejected
    status = np.array(
        ["rejected" if i in nowhere else "tied" if i in tied else "placed" for i in range(len(block.names))]
    )
    untied: Bools = status == "placed"
    propagate: CovarianceOf | None = None
    covariance: Floats | None = None
    if accuracy is not None:
        untied[[i for c in block.control if not c.check for i, _, _ in c.observations]] = False
        untied[list(accuracy.unsolved)] = True
    poses = moved_with_neighbours(block.poses, poses, status == "tied", untied)
    if accuracy is None:
        common_m2 = common_error(block, poses, block.ground)
    else:
        common_m2, propagate = accuracy.common_m2, _with_untied(accuracy, poses, untied)
        sd = np.column_stack([poses.positions_sd_m, poses.rotations_sd_rad])
        covariance = np.where(untied[:, None, None], sd[:, :, None] ** 2 * np.eye(6), accuracy.covariance)
        covariance = covariance + np.diag(np.append(common_m2, np.zeros(3)))
    control = control_residuals(block, poses, propagate)
    if accuracy is not None:
        control = tuple(replace(c, common_sd_m=np.sqrt(common_m2)) for c in control)
    plan_m, ends = keypoints_on_ground(block, poses, block.cameras, block.ground)
    return Adjusted(
        poses=with_common_error(poses, common_m2),
        cameras=block.cameras,
        status=tuple(status.tolist()),
        rounds=rounds,
        residuals_m=tuple(plan_m[right] - plan_m[left] for left, right in ends),
        ground=block.ground,
        figures={"common_height_sd_m": float(np.sqrt(common_m2[2]))},
        control=control,
        pose_covariance=covariance,
    )


def _with_untied(accuracy: BundleAccuracy, poses: Poses, untied: Bools) -> CovarianceOf:
    """Covariances in which poses that took no part in the solve have their own deviations."""
    alone = covariance_of_poses(poses)

    def both(frames: Ints, by_pose: Floats, by_interior: Floats) -> Floats:
        apart = untied[frames][:, None, None]
        try:
            solved = accuracy.propagate(frames, np.where(apart, 0.0, by_pose), by_interior)
        except NotSolvableError:
            solved, apart = np.zeros((3, 3)), np.ones_like(apart)
        of_alone = alone(frames, np.where(apart, by_pose, 0.0), by_interior)
        return solved + of_alone + np.diag(accuracy.common_m2)

    return both


@dataclass(frozen=True)
class BlockState:
    """A block on its way through the procedure. given: the block as it came; misalignments_m: of its pairs.
    tracks: all tie points, few: those that the model is found by. rolling: rolling shutters were reported.
    block, settings: as corrected by now. found: the present solution. spread: runs tasks side by side.
    choice: of the model of lens and shutter. notes: warnings of the start. steps: of all solves that led
    here. turned: quarters of images that the procedure turned back, see `read_backwards`."""

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
    turned: tuple[int, ...] = ()

    @property
    def rough(self) -> bool:
        """Whether a solve by all tie points follows."""
        return self.few is not self.tracks

    def then(self, found: BlockSolution) -> BlockState:
        """With the next solution."""
        return replace(self, found=found, steps=self.steps + found.steps)


def bundle_outcome(work: BlockState) -> Adjusted:
    """The outcome with warnings, figures and covariances."""
    block, given, found = work.block, work.given, work.found
    solution, components = found.of_ties, found.solution.components
    observed = np.unique(found.problem.tracks.frame)
    common_m2 = common_error(block, solution.poses, found.ground, components)
    common_m2 = np.where(found.offset, 0.0, common_m2)  # in the covariance
    moves = (solution.poses.positions_m - given.poses.positions_m)[:, :2]
    shared, places = solution.shared_unknowns(), places_of(found)
    counted = counted_shares(found.ties, solution, len(block.names))
    unsolved = found.solution.left_out | undetermined_frames(found.ties, found.solution, len(block.names))
    rejected = contradicted_frames(block, solution.poses, np.where(unsolved, np.nan, counted))
    certain = with_common_error(solution.poses, common_m2)
    accuracy = BundleAccuracy(
        propagate=covariance_of(solution, block.lens_of),
        covariance=solution.stated.pose_covariance,
        common_m2=common_m2,
        tied=frozenset(np.unique(found.ties.frame).tolist()),
        unsolved=frozenset(np.flatnonzero(unsolved).tolist()),
        rejected=frozenset(rejected),
    )
    as_found = replace(
        block,
        poses=given.poses,
        cameras=tuple(solution.cameras[k] for k in block.lens_of),
        ground=found.ground,
        control=with_precision(block.control, components),
    )
    adjusted = outcome(as_found, solution.poses, (Round(work.misalignments_m, moves),), accuracy)
    of_frames = wrong_tags(block, certain, rejected, components[HORIZONTAL])
    of_positions = shift_and_scale(block, solution.poses, observed)
    unlike = any(w.code in OF_ANOTHER_SHAPE for w in of_positions)
    return replace(
        adjusted,
        warnings=(
            *work.notes,
            *(w for w in of_frames if w.code != "position-wrong" or not unlike),
            *rejected.values(),
            *of_positions,
            *height_drift(given, solution.poses, observed).warnings(given),
            *undetermined_unknowns(shared, given.cameras),
            *unsolved_frames(block, unsolved),
            *implausible_lenses(block.lenses, solution.implausible),
            *model_warnings(block, work.choice),
            *leaning_houses(found.houses),
        ),
        figures=_figures(solution, found.ties)
        | ({"ground_relief_px": found.relief_px} if np.isfinite(found.relief_px) else {})
        | shape_figures(block, places)
        | precision_figures(block.control, components)
        | adjusted.figures,
        places=None if places is None else places.with_common_error(common_m2),
        model=work.choice,
        shared=shared,
        image_residuals=image_residuals(found.ties, solution),
        solved=None if work.turned else _solved(work, unsolved, rejected),
    )


def _solved(work: BlockState, unsolved: Bools, rejected: Collection[int]) -> SolvedBlock:
    """What a later adjustment may begin from."""
    solution, names = work.found.solution, work.block.names
    at, slices = solution.estimate, solution.estimate.layout.slices
    certain = np.isin(np.arange(len(names)), np.unique(work.found.problem.tracks.frame))
    certain &= ~unsolved
    certain[list(rejected)] = False
    return SolvedBlock(
        names=tuple(name for name, its in zip(names, certain, strict=True) if its),
        positions_m=at.positions_m[certain],
        rotations=at.rotations[certain],
        rotation_terms_rad=at.rotation_terms_rad[certain],
        drift=at.drift[certain],
        settings=work.settings,
        cameras=solution.cameras,
        shared={name: at.shared[its] for name, its in slices.items()},
        fixed={name: solution.fixed[its] for name, its in slices.items()},
        components=dict(solution.components.values),
    )


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
