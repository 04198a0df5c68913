"""An earlier adjustment with a part of it solved anew, as one outcome."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from geomosaic.adjustment.model import Adjusted, Block, ImageResiduals, Round, SolvedBlock
from geomosaic.adjustment.paper.misalignment import keypoints_on_ground, offset_net
from geomosaic.adjustment.procedure.blunder_detection import wrong_tags
from geomosaic.adjustment.procedure.changed_part import ChangedPart, EarlierBlock
from geomosaic.adjustment.procedure.earlier_motion import merged_motion
from geomosaic.adjustment.solver.solution import Solution
from geomosaic.adjustment.terms.gnss_positions import HORIZONTAL
from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.matching.tracks import Tracks
from geomosaic.placement.collocation import moved_with_neighbours
from geomosaic.projection.ground import GroundSurface
from geomosaic.survey.model import Warn


@dataclass(frozen=True)
class SolvedPart:
    """A part of a block, its tracks and their solution."""

    block: Block
    ties: Tracks
    solution: Solution


def merged(block: Block, earlier: EarlierBlock, changed: ChangedPart, part: SolvedPart | None) -> Adjusted:
    """The block with the earlier outcome of all frames but those solved in the part; None where none was.

    A new frame has the covariance that its earlier neighbours leave it, and that of the nearest of these.
    """
    adjusted, was = earlier.adjusted, changed.was
    free = np.zeros(len(was), dtype=bool)
    free[changed.frames] = changed.free
    lenses = {camera.name: camera for camera in adjusted.cameras}
    cameras = tuple(lenses[camera.name] for camera in block.cameras)
    poses, covariance = _poses(block, earlier, changed, part)
    tied = np.isin(np.arange(len(was)), np.array(block.ties.frames, dtype=np.intp).ravel())
    poses = moved_with_neighbours(block.poses, poses, tied, ~tied)
    sd = np.column_stack([poses.positions_sd_m, poses.rotations_sd_rad])
    covariance[~tied] = (sd[:, :, None] ** 2 * np.eye(6))[~tied]
    as_found = replace(block, poses=poses, cameras=cameras, ground=adjusted.ground)
    net, still = offset_net(block), np.zeros((len(was), 2))
    moves = (poses.positions_m - block.poses.positions_m)[:, :2]
    residuals = _residuals(earlier, changed, free, part)
    plan_m, ends = keypoints_on_ground(as_found, poses, cameras, adjusted.ground)
    return replace(
        adjusted,
        poses=poses,
        cameras=cameras,
        status=tuple("tied" if its else "placed" for its in tied),
        rounds=(Round(net.misalignments_m(still), moves),),
        residuals_m=tuple(plan_m[right] - plan_m[left] for left, right in ends),
        warnings=_warnings(block, earlier, free, part),
        figures=adjusted.figures | _figures(residuals),
        pose_covariance=covariance,
        image_residuals=residuals,
        steps=() if part is None else part.solution.steps,
        solved=_solved(block, earlier, free, part),
    )


def _poses(
    block: Block, earlier: EarlierBlock, changed: ChangedPart, part: SolvedPart | None
) -> tuple[Poses, Floats]:
    """All poses, and their covariances (n, 6, 6)."""
    before, was = earlier.adjusted, changed.was
    known = np.flatnonzero(was >= 0)
    covariance, at = np.zeros((len(was), 6, 6)), was[known]
    assert before.pose_covariance is not None
    covariance[known] = before.pose_covariance[at]
    given = block.poses
    positions_m, rotations, positions_sd_m, rotations_sd_rad = (
        a.copy() for a in (given.positions_m, given.rotations, given.positions_sd_m, given.rotations_sd_rad)
    )
    positions_m[known], rotations[known] = before.poses.positions_m[at], before.poses.rotations[at]
    positions_sd_m[known] = before.poses.positions_sd_m[at]
    rotations_sd_rad[known] = before.poses.rotations_sd_rad[at]
    if part is not None:
        mine, found = changed.frames[changed.free], part.solution
        positions_m[mine] = found.poses.positions_m[changed.free]
        rotations[mine] = found.poses.rotations[changed.free]
        new = np.flatnonzero(changed.free & (was[changed.frames] < 0))
        if len(new):
            its = changed.frames[new]
            _, nearest = KDTree(positions_m[known]).query(positions_m[its])
            covariance[its] = found.stated.pose_covariance[new] + covariance[known[nearest]]
            sd = np.sqrt(np.maximum(np.diagonal(covariance[its], axis1=1, axis2=2), 0.0))
            positions_sd_m[its], rotations_sd_rad[its] = sd[:, :3], sd[:, 3:]
    poses = replace(
        given,
        positions_m=positions_m,
        rotations=rotations,
        positions_sd_m=positions_sd_m,
        rotations_sd_rad=rotations_sd_rad,
    )
    found_part = None if part is None else (part.solution.poses, changed.frames)
    return merged_motion(poses, was, before.poses, found_part), covariance


def _residuals(
    earlier: EarlierBlock, changed: ChangedPart, free: Bools, part: SolvedPart | None
) -> ImageResiduals | None:
    """Earlier image residuals of the frames that stay, and those of the part's frames that were solved."""
    before = earlier.adjusted.image_residuals
    if before is None:
        return None
    number = np.full(len(earlier.names), -1, dtype=np.intp)
    stays = np.flatnonzero((changed.was >= 0) & ~free)
    number[changed.was[stays]] = stays
    kept = number[before.frame] >= 0
    parts = [(number[before.frame[kept]], *(a[kept] for a in _columns(before)))]
    if part is not None:
        its = ImageResiduals(
            part.ties.frame, part.ties.image_px, part.solution.residual_px, part.solution.weight
        )
        mine = changed.free[its.frame]
        parts.append((changed.frames[its.frame[mine]], *(a[mine] for a in _columns(its))))
    frame, image_px, residual_px, weight = (np.concatenate(a) for a in zip(*parts, strict=True))
    return ImageResiduals(frame, image_px, residual_px, weight)


def _columns(residuals: ImageResiduals) -> tuple[Floats, Floats, Floats]:
    return residuals.image_px, residuals.residual_px, residuals.weight


def _figures(residuals: ImageResiduals | None) -> dict[str, float]:
    """What image residuals come to."""
    if residuals is None or not len(residuals.frame):
        return {}
    length = np.linalg.norm(residuals.residual_px, axis=1)[residuals.weight > 0.1]
    known = length[np.isfinite(length)]
    mean = float(known.mean()) if known.size else float("nan")
    return {"reprojection_mean_px": mean, "observations": float(len(residuals.frame))}


def _warnings(block: Block, earlier: EarlierBlock, free: Bools, part: SolvedPart | None) -> tuple[Warn, ...]:
    """Earlier ones of all and of the frames that stay, and wrong tags of those that were solved."""
    stays = {name for name, its in zip(block.names, free, strict=True) if not its}
    kept = tuple(w for w in earlier.adjusted.warnings if not w.frame or w.frame in stays)
    if part is None:
        return kept
    scatter = part.solution.components[HORIZONTAL]
    found = wrong_tags(part.block, part.solution.poses, (), scatter)
    return (*kept, *(w for w in found if w.frame and w.frame not in stays))


def _solved(block: Block, earlier: EarlierBlock, free: Bools, part: SolvedPart | None) -> SolvedBlock | None:
    """What a later adjustment begins from: earlier values of frames that stay, found ones of others."""
    solved = earlier.solved
    if solved is None:
        return None
    solved = solved.of({name for name, its in zip(block.names, free, strict=True) if not its})
    if part is None:
        return solved
    at, names = part.solution.estimate, part.block.names
    fresh = {name for name, its in zip(block.names, free, strict=True) if its}
    seen = set(np.unique(part.ties.frame).tolist())
    mine = np.array([k for k, name in enumerate(names) if name in fresh and k in seen], dtype=np.intp)
    order = _order(block, (*solved.names, *(names[k] for k in mine)))

    def both(before: Floats, found: Floats) -> Floats:
        return np.concatenate([before, found[mine]])[order]

    all_names = (*solved.names, *(names[k] for k in mine))
    return replace(
        solved,
        names=tuple(all_names[k] for k in order),
        positions_m=both(solved.positions_m, at.positions_m),
        rotations=both(solved.rotations, at.rotations),
        rotation_terms_rad=both(solved.rotation_terms_rad, at.rotation_terms_rad),
        drift=both(solved.drift, at.drift),
    )


def _order(block: Block, names: tuple[str, ...]) -> Ints:
    """The names' places in the order of the block's frames."""
    number = {name: k for k, name in enumerate(block.names)}
    return np.argsort([number[name] for name in names]).astype(np.intp)


def merged_surface(earlier: GroundSurface, local: GroundSurface) -> GroundSurface:
    """An earlier surface of tie points, extended to cover a local one, on its nodes. It stays exactly itself
    where it is at least as certain, and becomes the local one where that is far more certain."""
    side, corner = earlier.spacing_m, np.array([earlier.east_0_m, earlier.north_0_m])
    size = np.array(local.up_m.shape[::-1])
    low = np.array([local.east_0_m, local.north_0_m])
    high = low + (size - 1) * local.spacing_m
    shape = np.array(earlier.up_m.shape[::-1])
    first = np.minimum(np.floor((low - corner) / side), 0).astype(int)
    last = np.maximum(np.ceil((high - corner) / side), shape - 1).astype(int)
    cols, rows = (last - first + 1).tolist()
    at = np.s_[-first[1] : -first[1] + shape[1], -first[0] : -first[0] + shape[0]]
    east_m, north_m = (corner + first * side).tolist()
    up_m, sd_m = np.zeros((rows, cols)), np.full((rows, cols), np.inf)
    grown = GroundSurface(earlier.kind, east_m, north_m, side, up_m, sd_m)
    nodes = grown.nodes_m()
    up_m[:] = earlier.up_at(nodes[..., 0], nodes[..., 1])
    up_m[at] = earlier.up_m
    if earlier.sd_m is not None:
        sd_m[at] = earlier.sd_m
    inside = ((nodes >= low) & (nodes <= high)).all(axis=-1)
    found, of_local = (f(nodes[..., 0], nodes[..., 1]) for f in (local.up_at, local.sd_at))
    of_local = np.where(inside & np.isfinite(of_local), of_local, np.inf)
    with np.errstate(invalid="ignore"):
        share = np.where(np.isinf(sd_m), np.isfinite(of_local), 1.0 - of_local / sd_m)
    share = np.clip(share, 0.0, 1.0)
    up_m += share * np.where(share > 0.0, found - up_m, 0.0)
    surer = share > 0.0
    sd_m[surer] = of_local[surer]
    edge = np.isinf(sd_m)
    sd_m[edge] = sd_m[~edge].max(initial=0.0)
    return replace(grown, up_m=up_m, sd_m=sd_m)
