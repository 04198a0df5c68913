"""The global method: a block of similarities to start from, a bundle, the ground from its points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.bundle import solve_bundle
from geomosaic.adjustment.bundle_model import Bundle, Priors
from geomosaic.adjustment.chosen_ground import (
    DEM_SD_M,
    LEAST_POINTS,
    chosen_ground,
    flying_height_m,
    levelled,
    lies_flat,
    off_ground_m,
    surface_of,
)
from geomosaic.adjustment.collinearity import INTERIOR, interior_of
from geomosaic.adjustment.control import control_residuals, spread_of, with_control
from geomosaic.adjustment.doubts import (
    doubtful_positions,
    drifting_heights,
    lying_tags,
    strayed_lenses,
    undetermined_wishes,
)
from geomosaic.adjustment.misalignment import OffsetNet, offset_net
from geomosaic.adjustment.model import Adjusted, Block, ImageResiduals, Round, Settings, SharedUnknowns
from geomosaic.adjustment.mounting import MOUNTING, UNIT, Mounting
from geomosaic.adjustment.outcome import settled
from geomosaic.adjustment.similarity_block import similarity_block
from geomosaic.adjustment.terrain import Terrain
from geomosaic.adjustment.tracks import Tracks, join_tracks, thin_tracks
from geomosaic.adjustment.turned import as_filed, as_taken
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import about_z
from geomosaic.placement.graph import connected_parts
from geomosaic.placement.reach import heights_above_ground_m
from geomosaic.projection.footprint import ground_from_images

Floats = NDArray[np.float64]

# Prior deviations of what a lens is not known to do, and of a focal length without a stated one.
_LENS_SD = {"k1": 0.1, "k2": 0.1, "k3": 0.1, "p1": 0.003, "p2": 0.003}
_FOCAL_SD = 0.005
_PRINCIPAL_SD = 0.003
_READOUT_SD_S = 0.05
_MOUNTING_SD = np.array([*np.radians([3.0, 3.0, 3.0]), 0.5, 0.5, 0.5, 1.0])
_DEM_LEVEL_SD_M = 2.0
_ANY_RELIEF = 0.3
_HILLS = 50.0
_LEVEL_SD_SHARE = 0.04
_LEAST_LEVEL_SD_M = 2.0
_DATUM_IN_DOUBT = 3.0


def pose_block(block: Block, settings: Settings) -> Adjusted:
    """Every frame's six pose parameters, the lenses and the tie points' ground at once.

    POS enters as weighted observations, so that no frame is the base and nothing accumulates; its
    deviations are estimated again from the residuals. Frames without tie or control points keep their POS.
    """
    return as_filed(_solve(as_taken(block), settings), block)


def _solve(block: Block, settings: Settings) -> Adjusted:
    tracks = thin_tracks(
        join_tracks(block.ties),
        np.array([[c.width_px, c.height_px] for c in block.cameras]),
        settings.observations_per_frame,
    )
    if not tracks.points and all(c.check for c in block.control):
        still = np.zeros((len(block.names), 2))
        return settled(block, block.poses, (Round(np.zeros((0, 2)), still),))
    net = offset_net(block)
    start = start_poses(block, net)
    cameras = tuple({c.name: c for c in block.cameras}.values())
    number = {c.name: k for k, c in enumerate(cameras)}
    camera_of = np.array([number[c.name] for c in block.cameras])
    points, kept = _points_on_ground(block, start, tracks)
    ties = len(points)
    priors = Priors(
        poses=block.poses,
        cameras=cameras,
        interior_sd=np.stack([interior_deviations(c, readout=settings.rolling_shutter) for c in cameras]),
        mounting=_mounting(settings),
        points_m=points,
        points_sd_m=_point_deviations(block, points),
        control=np.zeros(ties, dtype=bool),
        terrain=_believed_terrain(block, ties),
    )
    free = solve_bundle(kept, camera_of, priors, start) if ties else None
    seen, priors = with_control(kept, priors, block.control)
    if free is not None and seen is kept:
        solved = free
    else:
        priors, solved = _held_by_control(block, seen, camera_of, priors, start, free)
    ground, relief_px = block.ground, float("nan")
    if ties:
        part = _parts(block, kept)
        ground, relief_px = chosen_ground(block, settings.ground, _of_ties(solved, kept), kept.lengths, part)
    if ties and ground.kind != "tie_surface":
        off_m = off_ground_m(block, ground, _of_ties(solved, kept), part)
        near = replace(_believed_terrain(block, ties), sd_share=off_m / flying_height_m(block))
        bound = solve_bundle(seen, camera_of, replace(priors, terrain=near), solved.poses, again=solved)
        ground = levelled(ground, _of_ties(bound, kept))
        tried = ground.kind == "flat" and settings.ground == "auto" and ties >= LEAST_POINTS
        if tried and not lies_flat(block, ground, _of_ties(solved, kept), _of_ties(bound, kept)):
            ground = surface_of(block, ground, _of_ties(solved, kept))
        else:
            solved = bound
    bundle = _of_ties(solved, kept)
    moves = (bundle.poses.positions_m - block.poses.positions_m)[:, :2]
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
            *drifting_heights(block, bundle.poses, np.unique(seen.frame)),
            *undetermined_wishes(shared),
            *strayed_lenses(cameras, bundle.strayed),
        ),
        figures=_figures(bundle, kept) | ({"ground_relief_px": relief_px} if np.isfinite(relief_px) else {}),
        spread=spread_of(bundle, camera_of),
    )
    return replace(
        outcome,
        pose_covariance=bundle.pose_covariance,
        shared=shared,
        image_residuals=ImageResiduals(kept.frame, kept.image_px, bundle.residual_px, bundle.weight),
    )


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
        free = replace(free, points_m=points)
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


def start_poses(block: Block, net: OffsetNet) -> Poses:
    """POS turned, shifted and scaled over the ground so that the frames agree, see `similarity_block`."""
    poses = block.poses
    height = heights_above_ground_m(poses, block.ground)
    tilt = np.minimum(poses.rotations_sd_rad[:, :2].max(axis=1), 0.5)
    turn, nadir = similarity_block(
        net,
        poses.positions_m[:, :2],
        np.hypot(poses.positions_sd_m[:, :2].max(axis=1), height * tilt),
        np.minimum(poses.rotations_sd_rad[:, 2], np.pi),
        np.clip(poses.positions_sd_m[:, 2] / height, 0.01, 0.5),
    )
    scale = np.clip(np.abs(turn), 0.5, 2.0)
    up = poses.positions_m[:, 2] + (scale - 1.0) * height
    return replace(
        poses,
        positions_m=np.column_stack([nadir.real, nadir.imag, up]),
        rotations=about_z(np.angle(turn)) @ poses.rotations,
    )


def interior_deviations(camera: Camera, *, readout: bool = False) -> Floats:
    """Prior deviations of a camera's numbers in the order of INTERIOR; 0 for a readout that isn't asked.

    The principal point is known no better than the focal length: small drones' are off by one in a hundred.
    Of a distortion of known deviation each term alone moves the frame's corner by no more than that.
    """
    focal = camera.focal_length_sd_px or _FOCAL_SD * camera.focal_length_px
    principal = max(_PRINCIPAL_SD * max(camera.width_px, camera.height_px), focal)
    lens = [_LENS_SD[name] for name in INTERIOR[3:8]]
    if camera.distortion_sd:
        corner = np.hypot(camera.width_px, camera.height_px) / 2.0 / camera.focal_length_px
        moves = np.array([corner**2, corner**4, corner**6, 3.0 * corner, 3.0 * corner])
        lens = np.minimum(lens, camera.distortion_sd / moves).tolist()
    return np.array([focal, principal, principal, *lens, _READOUT_SD_S if readout else 0.0])


def _mounting(settings: Settings) -> Mounting:
    asked = [settings.boresight] * 3 + [settings.lever_arm] * 3 + [settings.gps_lag]
    return Mounting(np.where(asked, _MOUNTING_SD, 0.0))


def _parts(block: Block, tracks: Tracks) -> NDArray[np.intp]:
    """Number of the connected part of the block that each track's frames belong to, (p,)."""
    number = np.zeros(len(block.names), dtype=np.intp)
    pairs = [(t.left, t.right) for t in block.ties.pairs]
    for k, frames in enumerate(connected_parts(len(block.names), pairs)):
        number[frames] = k
    return np.asarray(number[tracks.frame[np.unique(tracks.point, return_index=True)[1]]])


def _points_on_ground(block: Block, poses: Poses, tracks: Tracks) -> tuple[Floats, Tracks]:
    """Each track's mean place on the ground from the start poses; tracks that miss it are dropped."""
    at = ground_from_images(tracks.frame, tracks.image_px, poses, block.cameras, block.ground)
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


def _point_deviations(block: Block, points: Floats) -> Floats:
    """Tie points are free; all together, no further from the start than a flying height."""
    return np.full((len(points), 3), flying_height_m(block) * np.sqrt(len(points)))


def _believed_terrain(block: Block, points: int) -> Terrain:
    """A DEM binds the points; what POS says of the ground's height only tells their common level.

    Relief is alike over many points: all of them together say no more than 50 would. Else their number would
    tilt the block until its hills lie level in the mean, against what the attitudes say.
    """
    height = flying_height_m(block)
    if block.ground.kind == "dem":
        return Terrain(block.ground, DEM_SD_M / height, _DEM_LEVEL_SD_M)
    level_sd_m = max(_LEVEL_SD_SHARE * height, _LEAST_LEVEL_SD_M, np.median(block.poses.positions_sd_m[:, 2]))
    return Terrain(block.ground, _ANY_RELIEF * np.sqrt(max(points / _HILLS, 1.0)), float(level_sd_m))


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
    figures = {"sigma_px": bundle.sigma_px, "iterations": float(bundle.iterations)}
    if tracks.points:
        length = np.linalg.norm(bundle.residual_px, axis=1)
        figures |= {
            "reprojection_mean_px": float(np.nanmean(length[bundle.weight > 0.1])),
            "tracks": float(tracks.points),
            "observations": float(len(tracks.frame)),
            "track_length_mean": float(tracks.lengths.mean()),
        }
    return figures | {f"sigma_{group}": value for group, value in bundle.sigma.items()}
