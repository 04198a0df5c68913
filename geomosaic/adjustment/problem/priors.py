"""What is believed of a block before its images speak."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.ground.ground_choice import DEM_SD_M, flying_height_m
from geomosaic.adjustment.model import Block, Settings
from geomosaic.adjustment.problem.bundle_model import Priors
from geomosaic.adjustment.terms.mounting import Mounting
from geomosaic.adjustment.terms.rolling_shutter_rotation import (
    GUST_M_PER_S,
    LEVEL_AXES,
    MOST_GUSTS,
    MOST_SWING,
    RATE_SD_RAD_PER_S,
    TERMS,
    UPWARDS,
    VIBRATION_TERMS,
    recorded_share,
)
from geomosaic.adjustment.terms.terrain import Terrain
from geomosaic.camera.interior import Camera
from geomosaic.constants import sourced, tuned
from geomosaic.placement.graph import connected_parts
from geomosaic.placement.prior import position_assumed
from geomosaic.placement.reach import flying_heights_m

Floats = NDArray[np.float64]

_LENS_SD: dict[str, tuple[float, float, float, float, float]] = tuned(
    {"brown": (0.1, 0.1, 0.1, 0.003, 0.003), "fisheye": (0.1, 0.1, 0.1, 0.0, 0.0)},
    "the terms' own, in the order of `lens.TERMS`",
    "prior deviations of what a lens is not known to do: wide lenses reach 0.3 and more in k1, and k2"
    " and k3 follow it; decentring is a hundredth of that; 0 for a fisheye's even powers, which no "
    "lens has",
)
_FOCAL_SD = tuned(
    0.005,
    "share of the focal length",
    "where none is stated: see survey.accuracy, a calibrated one",
)
WIDE_FOCAL = tuned(
    0.1,
    "share of the focal length",
    "deviation beyond which it was assumed rather than reported: tags that agree are good to 0.05",
)
_WIDE_DISTORTION = sourced(
    4.0,
    "times a lens's own deviations",
    "of the radial terms where the focal length was assumed: nothing is known of such a lens, and terms "
    "go with powers of the focal length; OpenSfM's action cameras reach -0.39 in k1",
    "OpenSfM, opensfm/data/camera_calibration.yaml",
)
_PRINCIPAL_SD: tuple[float, float] = sourced(
    (0.003, 0.01),
    "share of the image's longer side",
    "least and largest deviation of a principal point: small drones' are off by one in a hundred, "
    "whatever is known of their focal length; with more, a point goes where turns while rows are read"
    " draw it",
    "chosen; docs/results.md, real flights: a Sequoia's is 0.8 % of the side off its maker's",
)
_READOUT_SD_S = tuned(0.05, "s", "of a readout that nothing reports: small cameras take 0.01 to 0.1 s")
NOMINAL_READOUT_S = tuned(
    0.05,
    "s",
    "where one is asked for and nothing reports it: small cameras take 0.01 to 0.1 s",
)
_ZERO_SD_RAD_PER_S = tuned(
    0.05,
    "rad/s",
    "a small gyroscope's zero is off by a degree or two a second; with less it would be followed",
)
_MOUNTING_SD: Floats = tuned(
    np.array([*np.radians([3.0, 3.0, 3.0]), 0.5, 0.5, 0.5, 1.0]),
    "rad, m, s",
    "three angles of a camera in its mount, three of its lever arm, and how late positions are: of "
    "small drones; with less, what is asked for would be held",
)
_DEM_LEVEL_SD_M = tuned(
    2.0,
    "m",
    "by which a DEM and the frames' heights may differ as a whole: datums and models of the geoid "
    "that are alike but not the same",
)
_ANY_RELIEF = tuned(
    0.3,
    "share of the flying height",
    "that ground may rise or fall where nothing is known of it: with less, hills would be pressed flat",
)
_HILLS = sourced(
    50.0,
    "points",
    "that relief is independent at: all tie points together say no more, else their number tilts a "
    "block until its hills lie level in the mean",
    "docs/results.md, accuracy on simulated surveys: hills without a DEM tilted blocks by up to 34 mrad",
)
_LEVEL_SD_SHARE = tuned(
    0.04,
    "share of the flying height",
    "of the ground's level below frames: heights above it come from barometers and from a ground that"
    " is flat in no survey",
)
_BEGUN_SD_SHARE = tuned(
    0.1,
    "share of the flying height",
    "by which frames without a position are off at the start: tilts of 5 degrees put them so far",
)
_LEAST_LEVEL_SD_M = tuned(
    2.0,
    "m",
    "of the ground's level, however low the flight: barometers drift by as much in an hour",
)


def priors_of(
    block: Block,
    settings: Settings,
    cameras: tuple[Camera, ...],
    points_m: Floats,
    terrain: Terrain | None = None,
) -> Priors:
    """Poses as given, lenses, tie points (p, 3) about where they begin, and the terrain that binds them.

    A frame without position is drawn to where it begins, with a share of its height above the ground for a
    deviation: next to nothing beside its ties, but it holds a block that nothing else holds.
    """
    assumed = position_assumed(block.poses)
    begun_sd_m = _BEGUN_SD_SHARE * flying_heights_m(block.poses, block.ground)
    sd_m = np.where(assumed[:, None], begun_sd_m[:, None], block.poses.positions_sd_m)
    return Priors(
        poses=replace(block.poses, positions_sd_m=sd_m),
        cameras=cameras,
        interior_sd=np.stack([_interior_deviations(c, settings) for c in cameras]),
        mounting=_mounting(settings),
        points_m=points_m,
        points_sd_m=_point_deviations(block, points_m),
        control=np.zeros(len(points_m), dtype=bool),
        terrain=terrain or believed_terrain(block, len(points_m)),
        part=part_of_frames(block),
        assumed=assumed,
        swing_sd_rad=_swing_sd_rad(block, settings),
        drift_sd_m=_drift_sd_m(block, settings),
        swing_common=settings.turning and _zero_unknown(block, settings),
        most_swing=MOST_SWING if settings.turning else MOST_GUSTS,
    )


def _interior_deviations(camera: Camera, settings: Settings) -> Floats:
    known = replace(camera, distortion_sd=0.0) if settings.free_lens else camera
    return interior_deviations(known, readout=settings.rolling_shutter)


def _swing_sd_rad(block: Block, settings: Settings) -> Floats | None:
    """Where no turns are asked for, a constant rate about level axes stands for what velocities are off by;
    beside a gyroscope whose zero isn't known yet, one about all axes for that."""
    readouts_s = _readouts_s(block, settings)
    if readouts_s is None:
        return None
    recorded = recorded_share(block.poses.turns, np.arange(len(readouts_s)), readouts_s)
    known = np.isfinite(recorded)
    most = VIBRATION_TERMS if settings.vibrating else TERMS
    rate_sd, terms = settings.rate_sd_rad_per_s or RATE_SD_RAD_PER_S, most
    if not settings.turning:
        rate_sd, terms = GUST_M_PER_S / flying_height_m(block), 1
    elif _zero_unknown(block, settings):
        rate_sd, terms = _ZERO_SD_RAD_PER_S, most if known.any() else 1
    sd = np.repeat(0.5 * rate_sd * np.abs(readouts_s)[:, None], terms, axis=1)
    guessed = 0.5 * RATE_SD_RAD_PER_S * np.abs(readouts_s[known]) * (0.5 - recorded[known])
    sd[known, 1:] = guessed[:, None]
    return sd[:, :, None] * (np.ones(3) if settings.turning else LEVEL_AXES)


def _drift_sd_m(block: Block, settings: Settings) -> Floats | None:
    """No turn stands for what velocities are off by upwards: while rows are read scale changes by it, as it
    does by a tilt that all frames share. Along the ground a rate about a level axis differs from it by the
    square of the row's tangent: too little to be seen beside frames that do turn."""
    readouts_s = _readouts_s(block, settings)
    if readouts_s is None:
        return None
    return GUST_M_PER_S * np.abs(readouts_s)[:, None] * (UPWARDS if settings.turning else np.ones(3))


def _readouts_s(block: Block, settings: Settings) -> Floats | None:
    """Of each frame, (f,); None where all rows are read at once."""
    if not settings.rolling_shutter and not any(c.readout_s for c in block.cameras):
        return None
    return np.array([c.readout_s or NOMINAL_READOUT_S for c in block.cameras])


def _zero_unknown(block: Block, settings: Settings) -> bool:
    return block.poses.turns is not None and settings.rate_sd_rad_per_s is None


def interior_deviations(camera: Camera, *, readout: bool = False) -> Floats:
    """Prior deviations of a camera's numbers in the order of INTERIOR; 0 for a readout that is known, or that
    is neither reported nor asked for.

    The principal point is known no better than the focal length, between three and ten in a thousand of the
    longer side: small drones' are off by one in a hundred, whatever is known of their focal length.
    Of a distortion of known deviation each term alone moves the frame's corner by no more than that.
    """
    focal = camera.focal_length_sd_px or _FOCAL_SD * camera.focal_length_px
    least, most = (sd * max(camera.width_px, camera.height_px) for sd in _PRINCIPAL_SD)
    principal = min(max(focal, least), most)
    lens = np.array(_LENS_SD[camera.kind])
    if focal > WIDE_FOCAL * camera.focal_length_px:
        lens[:3] *= _WIDE_DISTORTION
    if camera.distortion_sd:
        corner = np.hypot(camera.width_px, camera.height_px) / 2.0 / camera.focal_length_px
        lens = np.minimum(lens, camera.distortion_sd / camera.lens.shares(corner))
    about_s = camera.readout_sd_s if camera.readout_s else 0.0
    return np.array([focal, principal, principal, *lens, about_s or (_READOUT_SD_S if readout else 0.0)])


def _mounting(settings: Settings) -> Mounting:
    asked = [settings.boresight] * 3 + [settings.lever_arm] * 3 + [settings.gps_lag]
    return Mounting(np.where(asked, _MOUNTING_SD, 0.0))


def _point_deviations(block: Block, points: Floats) -> Floats:
    """Tie points are free; all together, no further from the start than a flying height."""
    return np.full((len(points), 3), flying_height_m(block) * np.sqrt(len(points)))


def believed_terrain(block: Block, points: int) -> Terrain:
    """A DEM binds the points; what POS says of the ground's height only determines their common level.

    Relief is alike over many points: all of them together say no more than 50 would. Else their number would
    tilt the block until its hills lie level in the mean, against what the attitudes say.
    """
    height = flying_height_m(block)
    if block.ground.kind == "dem":
        return Terrain(block.ground, DEM_SD_M / height, _DEM_LEVEL_SD_M)
    reported_sd_m = min(float(np.median(block.poses.positions_sd_m[:, 2])), height)
    level_sd_m = max(_LEVEL_SD_SHARE * height, _LEAST_LEVEL_SD_M, reported_sd_m)
    return Terrain(block.ground, _ANY_RELIEF * np.sqrt(max(points / _HILLS, 1.0)), float(level_sd_m))


def part_of_frames(block: Block) -> NDArray[np.intp]:
    """Number of the connected part of the block that each frame belongs to, (f,)."""
    number = np.zeros(len(block.names), dtype=np.intp)
    for k, frames in enumerate(connected_parts(len(block.names), block.ties.frames)):
        number[frames] = k
    return number
