"""The problem of a block: its observations, and what is assumed before the images count."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from geomosaic.adjustment.ground.ground_choice import DEM_SD_M, flying_height_m
from geomosaic.adjustment.kernels.interior import READOUT
from geomosaic.adjustment.kernels.row_functions import TERMS, VIBRATION_TERMS, recorded_share
from geomosaic.adjustment.model import Block, GroundControl, Settings
from geomosaic.adjustment.solver.problem import BlockProblem
from geomosaic.adjustment.terms.attitudes import Attitudes
from geomosaic.adjustment.terms.frame_components import PRIOR_FACTORS
from geomosaic.adjustment.terms.gnss_positions import GnssPositions
from geomosaic.adjustment.terms.image_observations import ImageObservations
from geomosaic.adjustment.terms.interior_orientation import NOMINAL_READOUT_S, interior_unknowns
from geomosaic.adjustment.terms.point_coordinates import PointCoordinates
from geomosaic.adjustment.terms.rolling_shutter_rotation import (
    GUST_M_PER_S,
    IMAGE_AXES,
    RATE_SD_RAD_PER_S,
    RollingShutterRotation,
)
from geomosaic.adjustment.terms.terrain import Terrain
from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.constants import sourced, tuned
from geomosaic.estimation.robust import THREE_SIGMA
from geomosaic.matching.tracks import Tracks
from geomosaic.placement.graph import connected_parts
from geomosaic.placement.heights import ASSUMED_SD_SHARE
from geomosaic.placement.prior import heading_assumed, position_assumed
from geomosaic.placement.reach import flying_heights_m

CRUISE_M_PER_S = sourced(10.0, "m/s", "of unknown velocities", "DJI Pilot 2: mapping at 1 to 15 m/s")
_ZERO_SD_RAD_PER_S = tuned(0.05, "rad/s", "of a small gyroscope's zero; less: it is followed")
_RELIEF = tuned(0.042, "share of the flying height", "of unknown ground; less: hills are pressed flat")
_ALIKE_M = tuned(50.0, "m", "side of a square in which a DEM errs alike; less: woods drag the block")
_LEVEL_SD_M = tuned(2.0, "m", "of the ground's level: datums and geoid models of a DEM, barometers")


def block_problem(block: Block, settings: Settings, tracks: Tracks, points_m: Floats) -> BlockProblem:
    """The problem of a block with tie points that begin at points_m (p, 3), bound to the terrain. A frame
    without position is weakly drawn to its initial place, which fixes a block that nothing else fixes."""
    assumed = position_assumed(block.poses)
    begun_sd_m = ASSUMED_SD_SHARE * flying_heights_m(block.poses, block.ground)
    sd_m = np.where(assumed[:, None], begun_sd_m[:, None], block.poses.positions_sd_m)
    reported = replace(block.poses, positions_sd_m=sd_m)
    interior = tuple(
        interior_unknowns(c, readout=settings.rolling_shutter, free_lens=settings.free_lens)
        for c in block.lenses
    )
    free = np.zeros(len(points_m), dtype=bool)
    image = ImageObservations(
        tracks=tracks,
        camera_of=block.lens_of,
        cameras=block.lenses,
        reported=reported,
        control=free,
        rolling=any(u.sd[READOUT] for u in interior) or any(c.readout_s for c in block.lenses),
        left_out=np.zeros(len(assumed), dtype=bool),
        local=np.ones(len(points_m)),
    )
    tilt_sd_rad = float(np.median(reported.rotations_sd_rad[:, :2]))
    # tie points are free; all together, no further from the start than a flying height
    sd_m = np.full((len(points_m), 3), flying_height_m(block) * np.sqrt(len(points_m)))
    points = PointCoordinates(points_m, sd_m, free, np.ones_like(points_m), tilt_sd_rad)
    part, one = part_of_frames(block), np.ones((len(assumed), 3))
    parts = tuple(np.flatnonzero(part == k) for k in np.unique(part))
    frames = [
        GnssPositions(
            *(reported, assumed, parts, one, settings.lever_arm, settings.gps_lag), flight=block.flight_of
        ),
        Attitudes(reported, parts, one, settings.boresight, *_heading_groups(block, part)),
    ]
    rotation = _rolling_shutter_rotation(block, settings)
    return BlockProblem(
        image=image,
        interior=interior,
        points=points,
        frames=(*frames, rotation) if rotation else tuple(frames),
        terrain=_terrain(block, image, points_m),
    )


def _heading_groups(block: Block, part: Ints) -> tuple[Ints, Floats]:
    """Groups of frames whose headings one compass or one crab angle may turn in common. They are those of a
    flight in a connected part (f,), observed ones apart from those by the course. Returns each frame's group
    (f,), -1 for none, and the groups' deviations (g,) in rad."""
    assumed, sd_rad = heading_assumed(block.poses), block.poses.rotations_sd_rad[:, 2]
    _, group, count = np.unique(
        np.column_stack([part, block.flight_of, assumed]), axis=0, return_inverse=True, return_counts=True
    )
    several = count > 1
    number = np.where(several, np.cumsum(several) - 1, -1)[group.ravel()]
    medians = [float(np.median(sd_rad[group.ravel() == k])) for k in np.flatnonzero(several)]
    return number, np.minimum(np.array(medians), np.pi)


def with_control(problem: BlockProblem, control: Sequence[GroundControl]) -> BlockProblem:
    """The problem with control points, which come last; check points are left out."""
    used = [c for c in control if not c.check]
    if not used:
        return problem
    p = len(problem.points.given_m)
    marks = [(frame, p + k, col, row) for k, c in enumerate(used) for frame, col, row in c.observations]
    frame, point, col, row = np.array(marks).T
    tracks = Tracks(
        np.concatenate([problem.tracks.frame, frame.astype(np.intp)]),
        np.concatenate([problem.tracks.point, point.astype(np.intp)]),
        np.concatenate([problem.tracks.image_px, np.column_stack([col, row])]),
    )
    by_hand = np.concatenate([problem.points.control, np.ones(len(used), dtype=bool)])
    given_m = np.concatenate([problem.points.given_m, [c.enu_m for c in used]])
    sd_m = np.concatenate([problem.points.sd_m, [c.sd_m for c in used]])
    local = np.concatenate([problem.image.local, np.ones(len(used))])
    image = replace(problem.image, tracks=tracks, control=by_hand, local=local)
    points = replace(
        problem.points, given_m=given_m, sd_m=sd_m, control=by_hand, weight=np.ones_like(given_m)
    )
    terrain = problem.terrain
    if terrain is not None:
        terrain = replace(terrain, bound=~by_hand, frame_share=image.frame_share())
    return replace(problem, image=image, points=points, terrain=terrain)


def with_offset(problem: BlockProblem, sd_m: Floats) -> BlockProblem:
    """The problem in which the positions of each flight may be off in common, with deviations (3,) east,
    north and up."""
    east, north, up = (float(v) for v in sd_m)
    frames = tuple(
        replace(t, offset_sd_m=(east, north, up)) if isinstance(t, GnssPositions) else t
        for t in problem.frames
    )
    return replace(problem, frames=frames)


def _rolling_shutter_rotation(block: Block, settings: Settings) -> RollingShutterRotation | None:
    """Rotation and drift of the frames while rows are read; None where all rows are read at once. Frames of
    cameras that read so have neither. Where frames rotate, drifts across the view differ too little from a
    rate about an image axis."""
    if not settings.rolling_shutter and not any(c.readout_s for c in block.cameras):
        return None
    unreported_s = NOMINAL_READOUT_S if settings.rolling_shutter else 0.0
    readouts_s = np.array([c.readout_s or unreported_s for c in block.cameras])
    level = np.sqrt(np.maximum(1.0 - block.poses.rotations[:, 2] ** 2, 0.0))
    drift_sd = _gust_per_s(block, level) * np.abs(readouts_s)[:, None]
    drift_sd = drift_sd * (IMAGE_AXES[::-1] if settings.turning else np.ones(3))
    most = PRIOR_FACTORS[1] if settings.turning else THREE_SIGMA
    common = settings.turning and _zero_unknown(block, settings)
    rotation_sd_rad = _rotation_sd_rad(block, settings, readouts_s)
    focal_px = float(np.median([c.focal_length_px for c in block.cameras]))
    return RollingShutterRotation(rotation_sd_rad, drift_sd, focal_px, common, most)


def velocities_known(block: Block) -> Bools:
    """Frames (f,) of which times or tags say how fast they flew."""
    flown = block.poses.velocities_m_per_s
    return np.zeros(len(block.names), dtype=bool) if flown is None else np.asarray(flown.any(axis=1))


def _gust_per_s(block: Block, level: Floats | float = 1.0) -> Floats:
    """Errors of the frames' velocities along the camera's axes, (f, 1) or (f, 3), as shares of the flying
    height in a second. Where most are known, single unknown ones are those of a level flight. level (f, 3):
    of each axis."""
    unsteady, known = block.unsteady_m_per_s, velocities_known(block)
    own = np.zeros((len(known), 1)) if unsteady is None else unsteady[:, None]
    if known.mean() > 0.5:
        own = np.where(known[:, None], own, CRUISE_M_PER_S * level)
    return np.asarray(np.hypot(GUST_M_PER_S, own) / flying_height_m(block))


def _rotation_sd_rad(block: Block, settings: Settings, readouts_s: Floats) -> Floats:
    """First deviations of the rotation terms, (f, t, 3). Without `turning` a constant rate about the image's
    axes stands for errors of the velocities; with a gyroscope whose zero is unknown, one about all axes for
    that."""
    recorded = recorded_share(block.poses.turns, np.arange(len(readouts_s)), readouts_s)
    known = np.isfinite(recorded)
    most = VIBRATION_TERMS if settings.vibrating else TERMS
    rate_sd: Floats | float = settings.rate_sd_rad_per_s or RATE_SD_RAD_PER_S
    terms = most
    if not settings.turning:
        rate_sd, terms = _gust_per_s(block)[:, 0], 1
    elif _zero_unknown(block, settings):
        rate_sd, terms = _ZERO_SD_RAD_PER_S, most if known.any() else 1
    sd = np.repeat((0.5 * rate_sd * np.abs(readouts_s))[:, None], terms, axis=1)
    guessed = 0.5 * RATE_SD_RAD_PER_S * np.abs(readouts_s[known]) * (0.5 - recorded[known])
    sd[known, 1:] = guessed[:, None]
    return sd[:, :, None] * (np.ones(3) if settings.turning else IMAGE_AXES)


def _zero_unknown(block: Block, settings: Settings) -> bool:
    return block.poses.turns is not None and settings.rate_sd_rad_per_s is None


def _terrain(block: Block, image: ImageObservations, points_m: Floats) -> Terrain:
    """A DEM binds the tie points (p, 3); a level ground only determines their common height. Relief is alike
    over many points: all of them together count as one, else they would tilt the block against the attitudes.
    Woods and errors of a DEM are alike in squares of `_ALIKE_M`, each of which counts as one."""
    height, bound, share = flying_height_m(block), ~image.control, image.frame_share()
    if block.ground.kind == "dem":
        squares = np.unique(np.floor(points_m[:, :2] / _ALIKE_M), axis=0)
        return Terrain(block.ground, DEM_SD_M / height, _LEVEL_SD_M, bound, share, places=len(squares))
    reported_sd_m = min(float(np.median(block.poses.positions_sd_m[:, 2])), height)
    level_sd_m = float(max(_RELIEF * height, _LEVEL_SD_M, reported_sd_m))
    return Terrain(block.ground, _RELIEF, level_sd_m, bound, share, places=1.0)


def near_ground(block: Block, problem: BlockProblem, off_m: float) -> Terrain:
    """The terrain of a problem from which points are off by a deviation in m. Level ground that was found
    flat binds each point by itself."""
    assert problem.terrain is not None
    places = problem.terrain.places if block.ground.kind == "dem" else np.inf
    return replace(problem.terrain, sd_share=off_m / flying_height_m(block), places=places)


def part_of_frames(block: Block) -> Ints:
    """Number of the connected part of the block that each frame belongs to, (f,)."""
    number = np.zeros(len(block.names), dtype=np.intp)
    for k, frames in enumerate(connected_parts(len(block.names), block.ties.frames)):
        number[frames] = k
    return number
