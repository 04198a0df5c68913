"""A block solved with free points, then with control, then bound to the ground if its points lie on one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.ground.ground_choice import (
    LEAST_POINTS,
    chosen_ground,
    flying_height_m,
    levelled,
    lies_flat,
    off_ground_m,
    surface_and_relief,
)
from geomosaic.adjustment.model import Block, Settings
from geomosaic.adjustment.problem.bundle_model import Begun, Bundle, Priors
from geomosaic.adjustment.problem.priors import believed_terrain, part_of_frames, priors_of
from geomosaic.adjustment.problem.tracks import Tracks, nearest_to_rays
from geomosaic.adjustment.procedure.common_offsets import common_error
from geomosaic.adjustment.solver.bundle import solve_bundle
from geomosaic.adjustment.solver.clearance import clearances_m, too_near
from geomosaic.adjustment.terms.control_points import control_residuals, with_control
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import NORMAL_PER_MAD, tuned
from geomosaic.placement.prior import position_assumed
from geomosaic.projection.footprint import ground_from_images
from geomosaic.projection.ground import GroundSurface

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
_DATUM_IN_DOUBT = tuned(
    3.0,
    "deviations of a position, and of the shift as control scatters",
    "by which control lies off the block in the median before its positions are taken to be of another "
    "datum and shifted along: with less their common noise is; with more, heights of another datum pull "
    "against control",
)

_OFFSET_ROUNDS = tuned(3, "solves", "after which the common offset of positions is known beside control")
_OFFSET_STANDS = tuned(0.02, "share of a position's deviation", "by which it may still change")


@dataclass(frozen=True)
class Solution:
    """Tie points, the same with control points, what was believed, what was solved, and the ground that goes
    with it. relief_px: see `chosen_ground`, of a surface that was taken since flat ground was tried in vain
    with its bends and slopes."""

    ties: Tracks
    seen: Tracks
    priors: Priors
    bundle: Bundle
    ground: GroundSurface
    relief_px: float

    @property
    def of_ties(self) -> Bundle:
        """The bundle without what it says of control points, which come last."""
        return _of_ties(self.bundle, self.ties)


def solution(
    block: Block,
    settings: Settings,
    tracks: Tracks,
    start: Poses,
    before: Solution | None = None,
    begun: Begun | None = None,
    *,
    rough: bool = False,
) -> Solution:
    """Free points first, then with control, then bound to the ground if they lie on one. before: a solution
    to go on from, with the same lenses; begun: one by the same model and other tracks; rough: another is to
    follow, by more tracks."""
    again: Begun | None = None
    if before is None:
        lenses = block.cameras if begun is None else [begun.cameras[k] for k in block.lens_of]
        points, kept = points_on_ground(start, lenses, block.ground, tracks)
        if begun is not None:
            again = begun.of_points(_nearest_to_rays(kept, begun.poses, lenses, points))
    else:
        points, kept = before.priors.points_m[: before.ties.points], before.ties
        again = before.of_ties
    ties, priors = len(points), priors_of(block, settings, block.lenses, points)
    held = not settings.self_calibration
    free = (
        solve_bundle(kept, block.lens_of, priors, start, again=again, rough=rough, lens_held=held)
        if ties
        else None
    )
    seen, priors = with_control(kept, priors, block.control)
    if free is not None and seen is kept:
        solved = free
    else:
        priors, solved = _held_by_control(block, seen, priors, start, free, rough=rough, lens_held=held)
    if not ties:
        return Solution(kept, seen, priors, solved, block.ground, float("nan"))
    part = part_of_frames(block)[kept.frame[np.unique(kept.point, return_index=True)[1]]]
    ground, relief_px = chosen_ground(block, settings.ground, _of_ties(solved, kept), kept.lengths, part)
    if ground.kind == "tie_surface":
        return Solution(kept, seen, priors, solved, ground, relief_px)
    off_m = off_ground_m(block, ground, _of_ties(solved, kept), part)
    near = replace(believed_terrain(block, ties), sd_share=off_m / flying_height_m(block))
    bound_priors = replace(priors, terrain=near)
    bound = solve_bundle(
        *(seen, block.lens_of, bound_priors, solved.poses), again=solved, rough=rough, lens_held=held
    )
    ground = levelled(ground, _of_ties(bound, kept))
    tried = ground.kind == "flat" and settings.ground == "auto" and ties >= LEAST_POINTS
    if tried and not lies_flat(block, ground, _of_ties(solved, kept), _of_ties(bound, kept)):
        return Solution(
            kept, seen, priors, solved, *surface_and_relief(block, ground, _of_ties(solved, kept))
        )
    return Solution(kept, seen, bound_priors, bound, ground, relief_px)


def by_all_points(block: Block, settings: Settings, tracks: Tracks, few: Solution) -> Solution:
    """The solution by all tie points, from that by few of them, on the same kind of ground; a surface is
    still that of the few."""
    lenses, poses = [few.bundle.cameras[k] for k in block.lens_of], few.bundle.poses
    points, kept = points_on_ground(poses, lenses, few.ground, tracks)
    surface = few.ground.kind == "tie_surface"
    if surface:
        points = _nearest_to_rays(kept, poses, lenses, points)
    terrain = None if surface else few.priors.terrain
    priors = replace(priors_of(block, settings, block.lenses, points, terrain), poses=few.priors.poses)
    seen, priors = with_control(kept, priors, block.control)
    control_m = few.bundle.points_m[few.ties.points :]
    again = replace(few.bundle, points_m=np.concatenate([points, control_m]), unrest=None)
    solved = solve_bundle(
        *(seen, block.lens_of, priors, poses), again=again, lens_held=not settings.self_calibration
    )
    ground = few.ground if surface else levelled(few.ground, _of_ties(solved, kept))
    return Solution(kept, seen, priors, solved, ground, few.relief_px)


def _nearest_to_rays(tracks: Tracks, poses: Poses, lenses: Sequence[Camera], ground_m: Floats) -> Floats:
    """`nearest_to_rays`, but for those that come too near to a camera: they begin on the ground."""
    points = nearest_to_rays(tracks, poses, lenses, ground_m)
    clearance_m = clearances_m(tracks, poses.positions_m, ground_m)
    near = too_near(tracks, clearance_m, poses.positions_m, points)
    points[near] = ground_m[near]
    return points


def _shift_to_control(block: Block, poses: Poses, cameras: tuple[Camera, ...]) -> tuple[Floats, Floats, bool]:
    """Median of control minus what the poses make of it, (3,); its deviation, (3,); and whether that is
    another datum: three points or more agree on what the deviations of the positions and the points' own
    scatter can't explain."""
    used = replace(block, control=tuple(c for c in block.control if not c.check))
    off = np.array([c.residual_m for c in control_residuals(used, poses, cameras, block.ground)])
    if not len(off):
        return np.zeros(3), np.full(3, np.inf), False
    shift = np.median(off, axis=0)
    scatter_m = NORMAL_PER_MAD * np.median(np.abs(off - shift), axis=0)
    own_m = np.median([c.sd_m for c in used.control], axis=0)
    of_shift_m = np.sqrt(np.pi / 2.0 / len(off)) * scatter_m  # a median's, of normal errors
    sd_m = np.hypot(np.median(block.poses.positions_sd_m, axis=0), of_shift_m)
    beyond = np.abs(shift) > _DATUM_IN_DOUBT * sd_m
    of_shift_m = np.hypot(of_shift_m, own_m / np.sqrt(len(off)))
    return shift, of_shift_m, bool(len(off) >= 3 and beyond.any())


def _held_by_control(
    block: Block,
    seen: Tracks,
    priors: Priors,
    start: Poses,
    free: Bundle | None,
    *,
    rough: bool,
    lens_held: bool,
) -> tuple[Priors, Bundle]:
    """The solution with control points, begun from the free one shifted onto them.

    So each point is judged against the others, not against positions that may be off in common. These are
    shifted along: wholly where they are of another datum, else along the axes in which their common error
    (`common_error`) is larger than the shift's, by the share of the shift that it explains. Else the common
    error of many positions outweighs control, and the block leans and bends.
    """
    lenses, poses = (free.cameras, free.poses) if free else (priors.cameras, start)
    shift, sd_m, datum = _shift_to_control(block, poses, tuple(lenses[k] for k in block.lens_of))
    start, share = replace(poses, positions_m=poses.positions_m + shift), np.ones(3)
    if free is not None:
        points = np.concatenate([free.points_m + shift, priors.points_m[len(free.points_m) :]])
        if not datum:
            common_m2 = common_error(replace(block, control=()), poses, block.ground, free.factors)
            share = np.where(common_m2 > sd_m**2, common_m2 / (common_m2 + sd_m**2), 0.0)
        free = replace(free, points_m=points, unrest=None, level_m=free.level_m + float(shift[2]))
    elif not datum:
        share = np.zeros(3)
    solved, off_m = free, share * shift
    for _ in range(_OFFSET_ROUNDS):
        priors = replace(priors, poses=replace(priors.poses, positions_m=priors.poses.positions_m + off_m))
        solved = solve_bundle(
            *(seen, block.lens_of, priors, start), again=solved, rough=rough, lens_held=lens_held
        )
        start = solved.poses
        off_m = -share * _common_miss_m(priors.poses, start)
        if (np.abs(off_m) < _OFFSET_STANDS * np.median(priors.poses.positions_sd_m, axis=0)).all():
            break
    assert solved is not None
    return priors, solved


def _common_miss_m(given: Poses, found: Poses) -> Floats:
    """Median of given minus found positions (3,), of frames whose position was observed; 0 of none."""
    known = ~position_assumed(given)
    if not known.any():
        return np.zeros(3)
    return np.asarray(np.median(given.positions_m[known] - found.positions_m[known], axis=0))


def _of_ties(bundle: Bundle, ties: Tracks) -> Bundle:
    p, m = ties.points, len(ties.frame)
    return replace(
        bundle,
        points_m=bundle.points_m[:p],
        points_sd_m=bundle.points_sd_m[:p],
        residual_px=bundle.residual_px[:m],
        weight=bundle.weight[:m],
        unrest=None if bundle.unrest is None else bundle.unrest[:p],
    )


def points_on_ground(
    poses: Poses, cameras: Sequence[Camera], ground: GroundSurface, tracks: Tracks
) -> tuple[Floats, Tracks]:
    """Each track's mean place on the ground; tracks that miss it are dropped."""
    at = ground_from_images(tracks.frame, tracks.image_px, poses, cameras, ground)
    hit = np.isfinite(at).all(axis=1)
    lost = np.bincount(tracks.point, ~hit, minlength=tracks.points) > 0
    if not lost.any():
        return _means(tracks, at), tracks
    keep = ~lost[tracks.point]
    _, point = np.unique(tracks.point[keep], return_inverse=True)
    kept = Tracks(tracks.frame[keep], point.astype(np.intp), tracks.image_px[keep])
    return _means(kept, at[keep]), kept


def _means(tracks: Tracks, at_m: Floats) -> Floats:
    """Of what observations say (m, 3), for each point (p, 3)."""
    sums = [np.bincount(tracks.point, column, tracks.points) for column in at_m.T]
    return np.stack(sums, axis=1) / tracks.lengths[:, None]
