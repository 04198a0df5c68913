"""The global method: a block of similarities to start from, a bundle, the ground from its points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.beliefs import believed_terrain, part_of_frames, priors_of
from geomosaic.adjustment.bundle import solve_bundle
from geomosaic.adjustment.bundle_model import GROUPS, Bundle, Priors
from geomosaic.adjustment.chosen_ground import (
    LEAST_POINTS,
    chosen_ground,
    flying_height_m,
    levelled,
    lies_flat,
    off_ground_m,
    surface_of,
)
from geomosaic.adjustment.chosen_model import chosen_model, contradicts, model_warnings
from geomosaic.adjustment.collinearity import INTERIOR, interior_of
from geomosaic.adjustment.common_rate import with_common_rate
from geomosaic.adjustment.control import control_residuals, spread_of, with_control
from geomosaic.adjustment.doubts import (
    doubtful_positions,
    lying_tags,
    strayed_lenses,
    undetermined_wishes,
    unsolved_frames,
)
from geomosaic.adjustment.flown import flown
from geomosaic.adjustment.height_drift import height_drift
from geomosaic.adjustment.misalignment import offset_net
from geomosaic.adjustment.model import Adjusted, Block, ImageResiduals, Round, Settings, SharedUnknowns
from geomosaic.adjustment.mounting import MOUNTING, UNIT
from geomosaic.adjustment.outcome import settled
from geomosaic.adjustment.shape import shape_sd_m
from geomosaic.adjustment.start import placed_by_pictures, start_poses
from geomosaic.adjustment.tracks import Tracks, join_tracks, nearest_to_rays, thin_tracks
from geomosaic.adjustment.turned import as_filed, as_taken
from geomosaic.adjustment.variance import common_error, with_common_error
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.errors import NotSolvableError
from geomosaic.projection.footprint import ground_from_images
from geomosaic.projection.ground import GroundSurface
from geomosaic.survey.model import Warn

Floats = NDArray[np.float64]

_DATUM_IN_DOUBT = 3.0
_FEW_PER_FRAME, _FEW_CELLS = 192, 8
"""Enough to find poses, lens and variance components to a fraction of a pixel, at a tenth of the work."""
_WORTHWHILE = 4


def pose_block(block: Block, settings: Settings) -> Adjusted:
    """Every frame's six pose parameters, the lenses and the tie points' ground at once.

    POS enters as weighted observations, so that no frame is the base and nothing accumulates; its
    deviations are estimated again from the residuals. Frames without tie or control points keep their POS.
    """
    taken = as_taken(block)
    try:
        return as_filed(_solve(taken, settings), block)
    except NotSolvableError as error:
        return as_filed(_start_alone(taken, str(error)), block)


def _start_alone(block: Block, why: str) -> Adjusted:
    """Where a bundle would have begun: better than no mosaic."""
    net = offset_net(block)
    poses = start_poses(block, net)
    moves = (poses.positions_m - block.poses.positions_m)[:, :2]
    text = f"{why}; frames are laid beside each other by similarities alone, without tilts or lens"
    return settled(
        block,
        poses,
        (Round(net.misalignments_m(np.zeros_like(moves)), moves),),
        warnings=(Warn("bundle-failed", "", text),),
    )


def _solve(block: Block, settings: Settings) -> Adjusted:
    sizes = np.array([[c.width_px, c.height_px] for c in block.cameras])
    tracks = thin_tracks(join_tracks(block.ties), sizes, settings.observations_per_frame)
    if not tracks.points and all(c.check for c in block.control):
        still = np.zeros((len(block.names), 2))
        return settled(block, block.poses, (Round(np.zeros((0, 2)), still),))
    told, net = block, offset_net(block)
    start = start_poses(block, net)
    block = placed_by_pictures(block, start)
    cameras = tuple({c.name: c for c in block.cameras}.values())
    number = {c.name: k for k, c in enumerate(cameras)}
    camera_of = np.array([number[c.name] for c in block.cameras])
    few = thin_tracks(tracks, sizes, _FEW_PER_FRAME, _FEW_CELLS)
    few = few if _WORTHWHILE * few.points < tracks.points else tracks
    rolling = settings.rolling_shutter or any(c.readout_s for c in cameras)
    if rolling:
        start = _read_at_once(block, settings, few, camera_of, cameras, start)
        block, _ = flown(block, start)
    found, choice = _found(block, settings, few, camera_of, cameras, start), None
    block, other = flown(block, found.solved.poses)
    drift = height_drift(block, found.solved.poses, np.unique(found.seen.frame))
    block = drift.freed(block)
    if drift.parts or (other and rolling):
        found = _found(block, settings, few, camera_of, cameras, found.solved.poses, found)
    if settings.model == "auto" and found.ties.points:
        solve = partial(_free, camera_of=camera_of, start=found.solved.poses)
        as_given = _of_ties(found.solved, found.ties)
        its_block, its_settings, choice = chosen_model(block, settings, found.ties, as_given, solve)
    if choice is not None and choice.taken:
        lenses = tuple({c.name: c for c in its_block.cameras}.values())
        chosen = _found(its_block, its_settings, few, camera_of, lenses, found.solved.poses)
        if contradicts(chosen.solved, found.solved):
            choice = choice.contradicted_at_last()
        else:
            block, settings, cameras, found = its_block, its_settings, lenses, chosen
    if settings.model == "auto" and rolling and block.poses.turns is not None and not settings.turning:
        settings = replace(settings, turning=True)  # what a gyroscope's filter and its last sample leave
        found = _found(block, settings, few, camera_of, cameras, found.solved.poses)
    if settings.turning and found.solved.swing is not None and block.poses.turns is not None:
        block, settings = with_common_rate(block, settings, found.solved)
        found = _found(block, settings, few, camera_of, cameras, found.solved.poses)
    if few is not tracks:
        found = _with_all(block, settings, tracks, camera_of, cameras, found)
    kept, seen, ground, priors = found.ties, found.seen, found.ground, found.priors
    bundle = _of_ties(found.solved, kept)
    held = any(not c.check and c.observations for c in block.control)
    common_m2 = np.zeros(3) if held else common_error(bundle, block.poses)
    bundle = with_common_error(bundle, common_m2)
    moves = (bundle.poses.positions_m - told.poses.positions_m)[:, :2]
    first = Round(net.misalignments_m(np.zeros_like(moves)), moves)
    shared = _shared(bundle, priors)
    outcome = settled(
        block,
        bundle.poses,
        (first,),
        cameras=tuple(bundle.cameras[k] for k in camera_of),
        ground=ground,
        warnings=(
            *lying_tags(block, bundle.poses),
            *doubtful_positions(block, bundle.poses, np.unique(seen.frame)),
            *height_drift(told, bundle.poses, np.unique(seen.frame)).warnings(told),
            *undetermined_wishes(shared, told.cameras),
            *unsolved_frames(block, bundle.left_out),
            *strayed_lenses(cameras, bundle.strayed),
            *model_warnings(block, choice),
        ),
        unsolved=np.flatnonzero(bundle.left_out).tolist(),
        figures=_figures(bundle, kept) | _relief(found) | _shape(block, found),
        spread=spread_of(bundle, camera_of, common_m2),
    )
    return replace(
        outcome,
        pose_covariance=bundle.pose_covariance,
        shared=shared,
        model=choice,
        image_residuals=ImageResiduals(kept.frame, kept.image_px, bundle.residual_px, bundle.weight),
    )


def _read_at_once(
    block: Block,
    settings: Settings,
    tracks: Tracks,
    camera_of: NDArray[np.intp],
    cameras: tuple[Camera, ...],
    start: Poses,
) -> Poses:
    """Poses as if rows were not read one after the other, with lenses as given: sure to a part of what a
    platform flies meanwhile, from which it is told how fast it flew. By velocities of told positions, which
    are off by metres where frames are a few metres apart, lenses stray far to explain what they do to rows.
    """
    points, kept = _points_on_ground(start, block.cameras, block.ground, tracks)
    if not len(points):
        return start
    at_once = tuple(replace(c, readout_s=0.0, readout_sd_s=0.0) for c in cameras)
    still = replace(
        block,
        cameras=tuple(at_once[k] for k in camera_of),
        poses=replace(block.poses, velocities_m_per_s=None, turns=None),
    )
    settings = replace(settings, rolling_shutter=False, turning=False)
    priors = priors_of(still, settings, at_once, points)
    solved = solve_bundle(kept, camera_of, priors, start, lens_held=True, rough=True)
    return replace(solved.poses, velocities_m_per_s=start.velocities_m_per_s, turns=start.turns)


def _free(
    block: Block, settings: Settings, tracks: Tracks, camera_of: NDArray[np.intp], start: Poses
) -> Bundle:
    """The solution with points of their own and no control, as models are compared."""
    cameras = tuple({c.name: c for c in block.cameras}.values())
    points, kept = _points_on_ground(start, block.cameras, block.ground, tracks)
    return solve_bundle(kept, camera_of, priors_of(block, settings, cameras, points), start, rough=True)


@dataclass(frozen=True)
class _Found:
    """A solution: tie points, the same with control points, what was believed, and the ground that goes with
    it. relief_px: see `chosen_ground`."""

    ties: Tracks
    seen: Tracks
    priors: Priors
    solved: Bundle
    ground: GroundSurface
    relief_px: float


def _found(
    block: Block,
    settings: Settings,
    tracks: Tracks,
    camera_of: NDArray[np.intp],
    cameras: tuple[Camera, ...],
    start: Poses,
    before: _Found | None = None,
) -> _Found:
    """Free points first, then with control, then bound to the ground if they lie on one. before: a solution
    to go on from, with the same lenses."""
    if before is None:
        points, kept = _points_on_ground(start, block.cameras, block.ground, tracks)
        again = None
    else:
        points, kept = before.priors.points_m[: before.ties.points], before.ties
        again = _of_ties(before.solved, kept)
    ties, priors = len(points), priors_of(block, settings, cameras, points)
    free = solve_bundle(kept, camera_of, priors, start, again=again) if ties else None
    seen, priors = with_control(kept, priors, block.control)
    if free is not None and seen is kept:
        solved = free
    else:
        priors, solved = _held_by_control(block, seen, camera_of, priors, start, free)
    if not ties:
        return _Found(kept, seen, priors, solved, block.ground, float("nan"))
    part = part_of_frames(block)[kept.frame[np.unique(kept.point, return_index=True)[1]]]
    ground, relief_px = chosen_ground(block, settings.ground, _of_ties(solved, kept), kept.lengths, part)
    if ground.kind == "tie_surface":
        return _Found(kept, seen, priors, solved, ground, relief_px)
    off_m = off_ground_m(block, ground, _of_ties(solved, kept), part)
    near = replace(believed_terrain(block, ties), sd_share=off_m / flying_height_m(block))
    bound_priors = replace(priors, terrain=near)
    bound = solve_bundle(seen, camera_of, bound_priors, solved.poses, again=solved)
    ground = levelled(ground, _of_ties(bound, kept))
    tried = ground.kind == "flat" and settings.ground == "auto" and ties >= LEAST_POINTS
    if tried and not lies_flat(block, ground, _of_ties(solved, kept), _of_ties(bound, kept)):
        return _Found(
            kept, seen, priors, solved, surface_of(block, ground, _of_ties(solved, kept)), relief_px
        )
    return _Found(kept, seen, bound_priors, bound, ground, relief_px)


def _with_all(
    block: Block,
    settings: Settings,
    tracks: Tracks,
    camera_of: NDArray[np.intp],
    cameras: tuple[Camera, ...],
    few: _Found,
) -> _Found:
    """The solution by all tie points, from that by few of them, on the same kind of ground."""
    lenses, poses = [few.solved.cameras[k] for k in camera_of], few.solved.poses
    points, kept = _points_on_ground(poses, lenses, few.ground, tracks)
    surface = few.ground.kind == "tie_surface"
    if surface:
        points = nearest_to_rays(kept, poses, lenses, points)
    terrain = None if surface else few.priors.terrain
    priors = replace(priors_of(block, settings, cameras, points, terrain), poses=few.priors.poses)
    seen, priors = with_control(kept, priors, block.control)
    control_m = few.solved.points_m[few.ties.points :]
    again = replace(few.solved, points_m=np.concatenate([points, control_m]))
    solved = solve_bundle(seen, camera_of, priors, poses, again=again)
    bundle = _of_ties(solved, kept)
    if surface:
        ground = surface_of(block, levelled(block.ground, bundle), bundle)
    else:
        ground = levelled(few.ground, bundle)
    return _Found(kept, seen, priors, solved, ground, few.relief_px)


def _shape(block: Block, found: _Found) -> dict[str, float]:
    """How far the map's shape may be off, in pixels of the frames on the ground."""
    pixel_m = flying_height_m(block) / float(np.median([c.focal_length_px for c in block.cameras]))
    sd_m = shape_sd_m(found.solved, found.ties.points)
    return {"shape_sd_px": sd_m / pixel_m} if np.isfinite(sd_m) else {}


def _relief(found: _Found) -> dict[str, float]:
    return {"ground_relief_px": found.relief_px} if np.isfinite(found.relief_px) else {}


def _shift_to_control(block: Block, poses: Poses, cameras: tuple[Camera, ...]) -> tuple[Floats, bool]:
    """Median of control minus what the poses make of it, (3,); and whether that is another datum: three
    points or more agree on what the positions' deviations can't explain."""
    used = replace(block, control=tuple(c for c in block.control if not c.check))
    off = np.array([c.residual_m for c in control_residuals(used, poses, cameras, block.ground)])
    if not len(off):
        return np.zeros(3), False
    shift = np.median(off, axis=0)
    beyond = np.abs(shift) > _DATUM_IN_DOUBT * np.median(block.poses.positions_sd_m, axis=0)
    return shift, bool(len(off) >= 3 and beyond.any())


def _held_by_control(
    block: Block, seen: Tracks, camera_of: NDArray[np.intp], priors: Priors, start: Poses, free: Bundle | None
) -> tuple[Priors, Bundle]:
    """The solution with control points, begun from the free one shifted onto them.

    So each point is judged against the others, not against positions that may be off in common (a height
    of another datum), and these are shifted along where control says so.
    """
    lenses, poses = (free.cameras, free.poses) if free else (priors.cameras, start)
    shift, datum = _shift_to_control(block, poses, tuple(lenses[k] for k in camera_of))
    start = replace(poses, positions_m=poses.positions_m + shift)
    if datum:
        priors = replace(priors, poses=replace(priors.poses, positions_m=priors.poses.positions_m + shift))
    if free is not None:
        points = np.concatenate([free.points_m + shift, priors.points_m[len(free.points_m) :]])
        free = replace(free, points_m=points, level_m=free.level_m + float(shift[2]))
    return priors, solve_bundle(seen, camera_of, priors, start, again=free)


def _of_ties(bundle: Bundle, ties: Tracks) -> Bundle:
    """The solution without what it says of control points, which come last."""
    p, m = ties.points, len(ties.frame)
    return replace(
        bundle,
        points_m=bundle.points_m[:p],
        points_sd_m=bundle.points_sd_m[:p],
        residual_px=bundle.residual_px[:m],
        weight=bundle.weight[:m],
    )


def _points_on_ground(
    poses: Poses, cameras: Sequence[Camera], ground: GroundSurface, tracks: Tracks
) -> tuple[Floats, Tracks]:
    """Each track's mean place on the ground; tracks that miss it are dropped."""
    at = ground_from_images(tracks.frame, tracks.image_px, poses, cameras, ground)
    hit = np.isfinite(at).all(axis=1)
    lost = np.bincount(tracks.point, ~hit, minlength=tracks.points) > 0
    keep = ~lost[tracks.point]
    names, point = np.unique(tracks.point[keep], return_inverse=True)
    kept = Tracks(tracks.frame[keep], point.astype(np.intp), tracks.image_px[keep])
    count = np.bincount(point, minlength=len(names))
    mean = np.stack(
        [np.bincount(point, at[keep][:, k], minlength=len(names)) / count for k in range(3)], axis=1
    )
    return mean, kept


def _shared(bundle: Bundle, priors: Priors) -> SharedUnknowns:
    """The cameras' numbers and the mounting's that are not known beforehand, in the units of their names."""
    cameras, unit = priors.cameras, np.concatenate([np.ones(bundle.interior_sd.size), UNIT])
    told = np.concatenate([*(interior_of(c) for c in cameras), np.zeros(len(MOUNTING))])
    found = np.concatenate([*(interior_of(c) for c in bundle.cameras), bundle.mounting])
    of = [c.name for c in cameras for _ in INTERIOR] + ["platform"] * len(MOUNTING)
    names = INTERIOR * len(cameras) + MOUNTING
    rows = np.flatnonzero(np.concatenate([priors.interior_sd.ravel(), priors.mounting.sd]))
    return SharedUnknowns(
        of=tuple(of[k] for k in rows),
        names=tuple(names[k] for k in rows),
        given=(told / unit)[rows],
        found=(found / unit)[rows],
        sd=(np.concatenate([bundle.interior_sd.ravel(), bundle.mounting_sd]) / unit)[rows],
        correlation=bundle.shared_correlation[np.ix_(rows, rows)],
        held=bundle.held[rows],
    )


def _figures(bundle: Bundle, tracks: Tracks) -> dict[str, float]:
    figures = {"sigma_px": bundle.factors.image_px, "iterations": float(bundle.iterations)}
    if tracks.points:
        length = np.linalg.norm(bundle.residual_px, axis=1)
        figures |= {
            "reprojection_mean_px": float(np.nanmean(length[bundle.weight > 0.1])),
            "tracks": float(tracks.points),
            "observations": float(len(tracks.frame)),
            "track_length_mean": float(tracks.lengths.mean()),
        }
    return figures | {f"sigma_{group}": bundle.factors.of(group) for group in GROUPS}
