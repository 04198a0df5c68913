"""What a bundle is given, and what it finds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import SolveStep
from geomosaic.adjustment.solver.normal_equations import Reduced
from geomosaic.adjustment.terms.collinearity import INTERIOR
from geomosaic.adjustment.terms.mounting import MOUNTING, Mounting
from geomosaic.adjustment.terms.rolling_shutter_rotation import MOST_SWING
from geomosaic.adjustment.terms.terrain import Terrain
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import exp_turn
from geomosaic.constants import sourced, tuned
from geomosaic.estimation.linear import pseudo_inverse

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
MEASURED_SD_PX = tuned(
    0.5,
    "px",
    "of a control or check point measured by hand in an image: a signal is hit to half a pixel",
)
READOUT = INTERIOR.index("readout_s")
NO_MOUNTING = Mounting(np.zeros(len(MOUNTING)))
GROUPS: dict[str, tuple[int, ...]] = sourced(
    {"horizontal": (0, 1), "vertical": (2,), "tilt": (3, 4), "yaw": (5,)},
    "columns of the pose priors",
    "each group has a variance component and a trust of its own: what one sensor measures goes together",
    "structure: east, north, up, and turns about them",
)


@dataclass(frozen=True)
class Factors:
    """Variance components: deviations of normal errors that would contribute as much as tie points' and
    control's image coordinates do, in px, and what the stated deviations of each group of pose priors, each
    function of a swing and, last, drifts along the ground and up are multiplied with; and those of control
    points in plan and in height."""

    image_px: float = 0.5
    control_px: float = MEASURED_SD_PX
    horizontal: float = 1.0
    vertical: float = 1.0
    tilt: float = 1.0
    yaw: float = 1.0
    while_read: tuple[float, ...] = ()
    control_plan: float = 1.0
    control_height: float = 1.0

    def of(self, group: str) -> float:
        """One of GROUPS."""
        return float(getattr(self, group))

    @property
    def of_control(self) -> Floats:
        """(3,): east, north, up."""
        return np.array([self.control_plan, self.control_plan, self.control_height])

    @property
    def by_column(self) -> Floats:
        """(6,), in the order of the pose priors."""
        return np.array([self.of(g) for g, columns in GROUPS.items() for _ in columns])


@dataclass(frozen=True)
class Priors:
    """What is believed before the images speak, with standard deviations.

    interior_sd (c, 9) in the order of INTERIOR, 0 for what is known. points_m, points_sd_m (p, 3): for
    control points their own; for tie points the ground below, weakly. control (p,): which points are
    control, measured by hand and not bound to the terrain. terrain: a surface that tie points lie on, if
    one is known.
    mounting: what POS and poses differ by in common. part (f,): the number of the connected part of the block
    that each frame belongs to; all are one if it isn't given. assumed (f,): frames whose position nobody
    observed, so that it shows nothing of the others' deviations. swing_sd_rad (f, t, 3): of
    how frames swing about east, north and up while their rows are read, beside the poses' turns, drift_sd_m
    (f, 3): of how far they go meanwhile along each axis, beside their velocities, see `swing`; both None
    where all rows are read at once; swing_common: whether a part of the swing may be common to all;
    most_swing: the largest of its components. trust
    (f, 6): factors of the pose priors' weights, 1 but for tags that lie; held (s,): which of the shared
    unknowns, cameras' numbers before the mounting's, keep what they were given as the block does not
    determine them; left_out (f,): frames whose images have no say, since they made the system unsolvable;
    unrest (p,): how many times the image's deviation tie points have, 1 where None, see `unrest`;
    clearance_m (f,): see `clearance`; control_say (p, 3): factors of the weights of the points' coordinates,
    1 where None, see `control_precision`; all six set by the solver.
    """

    poses: Poses
    cameras: tuple[Camera, ...]
    interior_sd: Floats
    points_m: Floats
    points_sd_m: Floats
    control: Bools
    terrain: Terrain | None = None
    mounting: Mounting = NO_MOUNTING
    part: NDArray[np.intp] | None = None
    assumed: Bools | None = None
    swing_sd_rad: Floats | None = None
    drift_sd_m: Floats | None = None
    swing_common: bool = False
    most_swing: float = MOST_SWING
    trust: Floats | None = None
    held: Bools | None = None
    left_out: Bools | None = None
    unrest: Floats | None = None
    clearance_m: Floats | None = None
    control_say: Floats | None = None


@dataclass(frozen=True)
class Begun:
    """What another solve goes on from; see `Bundle`."""

    poses: Poses
    cameras: tuple[Camera, ...]
    points_m: Floats
    mounting: Floats
    held: Bools
    unrest: Floats | None
    factors: Factors
    swing: Floats | None
    drift_m: Floats | None
    level_m: float

    def of_points(self, points_m: Floats, cameras: tuple[Camera, ...] | None = None) -> Begun:
        """That alone, with other points, about which nothing else is known, and other lenses."""
        kept = {f.name: getattr(self, f.name) for f in fields(Begun)}
        return Begun(**kept | {"points_m": points_m, "unrest": None, "cameras": cameras or self.cameras})


@dataclass(frozen=True)
class Bundle(Begun):
    """The solution. Covariances are scaled with the estimated variance components.

    points_sd_m: (p, 3), as if poses and cameras were known.
    pose_covariance: (f, 6, 6) of east, north, up (m) and turns about them (rad). interior_sd: (c, 9).
    mounting, mounting_sd: (7,). shared_correlation (s, s), s = 9c + 7: of the cameras' numbers and the
    mounting's; held (s,): which of them the block does not determine. Held numbers keep what they were
    given, and the covariances hold what is not known of them. strayed (s,): those held since the images
    drew them where no lens has them. residual_px: (m, 2) observed minus computed.
    weight: (m,) robust weights, 1 for a good observation; unrest: see `Priors`. factors: the estimated
    variance components.
    trust (f, 6): see `Priors`. left_out (f,): frames that could not be solved for and keep where they began.
    swing (f, t, 3), drift_m (f, 3): see `Priors`; the poses' turns and velocities hold them. level_m: of
    the ground above the terrain's own. reduced: the last normal equations. readout_shown (c,): by how many of
    its deviations the solution would leave the readout of none that is held where none is reported, of each
    camera. steps: that led here, those of the bundle it went on from first.
    """

    points_sd_m: Floats
    pose_covariance: Floats
    interior_sd: Floats
    mounting_sd: Floats
    shared_correlation: Floats
    strayed: Bools
    residual_px: Floats
    weight: Floats
    trust: Floats
    left_out: Bools
    iterations: int
    reduced: Reduced
    readout_shown: Floats
    steps: tuple[SolveStep, ...] = ()


@dataclass
class State:
    """Present values of the unknowns; seen_px (m, 2): see `bundle_equations.seen_px`, which sets it."""

    positions: Floats
    rotations: Floats
    interior: Floats
    points: Floats
    mounting: Floats
    level: float = 0.0
    swing: Floats | None = None
    drift_m: Floats | None = None
    seen_px: Floats | None = field(default=None, init=False)


def stepped(state: State, share: float, *step: Any) -> State:
    """The state after a share of a step, see `Reduced.solve`; what it turns and scales the whole block by
    comes last.

    Images see neither, however far they go. Added to the rest instead of multiplied, both miss the images
    by their products: a principal point that shifts by 4 px goes with positions that move, and 5 % of these
    are 0.2 px in every image; a block of 300 m whose headings were 3 degrees off is 0.4 m wider.
    Steps were cut to a tenth and less, thirty in a row, by that.
    """
    pose, interior, point, level, mounting = (share * part for part in step)
    frames = len(state.positions)
    if not len(point):
        middle, shift = state.positions.mean(axis=0), pose[:, :3].mean(axis=0)
    else:
        middle, shift = state.points.mean(axis=0), point.mean(axis=0)
    away = np.concatenate([state.positions, state.points]) - middle
    move = np.concatenate([pose[:, :3], point]) - shift
    turn, scale = _turn_and_scale(away[frames:], move[frames:]) if len(point) else (np.zeros(3), 0.0)
    turned = exp_turn(turn[None])[0]
    away += move - np.cross(turn, away) - scale * away
    places = (1.0 + scale) * away @ turned.T + middle + shift
    readout, in_step = interior[:, READOUT], scale * state.interior[:, READOUT]
    interior = interior.copy()
    interior[:, READOUT] += np.where(readout == 0.0, 0.0, scale * (readout - in_step))
    swing, drift_m = state.swing, state.drift_m
    if swing is not None and drift_m is not None:
        swing = (swing + pose[:, 6:-3].reshape(swing.shape)) @ turned.T
        drift = pose[:, -3:] - np.cross(turn, drift_m) - scale * drift_m
        drift_m = (1.0 + scale) * (drift_m + drift) @ turned.T
    return State(
        places[:frames],
        turned @ exp_turn(pose[:, 3:6] - turn) @ state.rotations,
        state.interior + interior,
        places[frames:],
        state.mounting + mounting if mounting.size else state.mounting,
        state.level + level,
        swing,
        drift_m,
    )


def _turn_and_scale(away: Floats, move: Floats) -> tuple[Floats, float]:
    """The turn, (3,) in rad, and the part to scale by, that moves (n, 3) of points have in common, by least
    squares; the few that lie far off have little say."""
    square = (away**2).sum(axis=1)
    weight = 1.0 / np.maximum(square + np.median(square), 1e-300)
    weighted = away * weight[:, None]
    inertia = float(weight @ square) * np.eye(3) - weighted.T @ away
    turn = pseudo_inverse(inertia, symmetric=True) @ np.cross(weighted, move).sum(axis=0)
    return turn, float((weighted * move).sum()) / max(float(weight @ square), 1e-300)


def with_interior(camera: Camera, interior: Sequence[float] | Floats) -> Camera:
    """The camera with other numbers, in the order of INTERIOR."""
    values: dict[str, Any] = {name: float(v) for name, v in zip(INTERIOR, interior, strict=True)}
    return replace(camera, **values)
