"""What every adjustment method takes and gives."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from geomosaic.adjustment.ground_places import GroundPlaces
from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.matching.model import TiePoints
from geomosaic.projection.ground import GroundSurface
from geomosaic.survey.height_reference import HeightReference
from geomosaic.survey.model import Warn


@dataclass(frozen=True)
class GroundControl:
    """A control point in the work frame; `check` points are never used in a solve. enu_m, sd_m (3,).
    observations: frame index, col and row of each image it was measured in."""

    name: str
    enu_m: Floats
    sd_m: Floats
    check: bool
    observations: tuple[tuple[int, float, float], ...]


@dataclass(frozen=True)
class ControlResidual:
    """Residual of a control or check point. check: it took no part in the solve. images: in how many it was
    measured. residual_m: surveyed minus found, east, north and up; sd_m: its standard deviation, too large
    for a point that took part. surveyed_sd_m: of the surveyed coordinates alone; common_sd_m: of the error
    that all positions share."""

    name: str
    check: bool
    images: int
    residual_m: Floats
    sd_m: Floats
    surveyed_sd_m: Floats
    common_sd_m: Floats = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True)
class SolvedBlock:
    """A solution that a later run begins from to solve what changed, with the frames that it is certain of.

    names (n,): of these frames. positions_m (n, 3), rotations (n, 3, 3): in the work frame.
    rotation_terms_rad (n, t, 3), drift (n, 3): while rows are read. settings: of its model. cameras: as
    found. shared, fixed: values of the shared unknowns by the name of their part, and which were kept as
    given. components: variance components by name.
    """

    FORMERLY: ClassVar[dict[str, str]] = {"swing_rad": "rotation_terms_rad", "lenses": "", "choice": ""}
    names: tuple[str, ...]
    positions_m: Floats
    rotations: Floats
    rotation_terms_rad: Floats
    drift: Floats
    settings: Settings
    cameras: tuple[Camera, ...]
    shared: dict[str, Floats]
    fixed: dict[str, Bools]
    components: dict[str, float]

    def __post_init__(self) -> None:
        """Components of earlier versions get their present names."""
        renamed = {re.sub(r"^swing (?=\d)", "rotation term ", k): v for k, v in self.components.items()}
        object.__setattr__(self, "components", renamed)

    def of(self, names: Collection[str]) -> SolvedBlock:
        """Without other frames."""
        kept = np.array([name in names for name in self.names], dtype=bool)
        arrays = ("positions_m", "rotations", "rotation_terms_rad", "drift")
        rows = {name: getattr(self, name)[kept] for name in arrays}
        return replace(self, names=tuple(name for name in self.names if name in names), **rows)


@dataclass(frozen=True)
class Block:
    """A survey ready to be adjusted. `cameras[i]` took frame i, `lines[i]` is its flight line, `sequence`
    lists frames in order of flight. `ground_pixel_m` is the paper's D. `turned` is `Placement.turned`: all is
    given for the images as they lie in the files. times_s (n,): of frames whose velocity no tag reports, when
    they were taken, or NaN. unsteady_m_per_s (n,): by how much velocities change about each frame. heights:
    None with a DEM, or where heights fix nothing. flights: number of each frame's flight, whose positions
    have an error in common; empty for one flight."""

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    poses: Poses
    ground: GroundSurface
    ties: TiePoints
    sequence: tuple[int, ...]
    lines: tuple[int, ...]
    ground_pixel_m: float
    turned: tuple[int, ...] = ()
    control: tuple[GroundControl, ...] = ()
    times_s: Floats | None = None
    unsteady_m_per_s: Floats | None = None
    heights: HeightReference | None = None
    flights: tuple[int, ...] = ()

    @property
    def flight_of(self) -> Ints:
        """(n,): number of each frame's flight."""
        return np.array(self.flights or (0,) * len(self.names), dtype=np.intp)

    @property
    def lenses(self) -> tuple[Camera, ...]:
        """Each camera once."""
        return tuple({c.name: c for c in self.cameras}.values())

    @property
    def lens_of(self) -> Ints:
        """(n,): of each frame, its place in `lenses`."""
        number = {name: k for k, name in enumerate(dict.fromkeys(c.name for c in self.cameras))}
        return np.array([number[c.name] for c in self.cameras], dtype=np.intp)


@dataclass(frozen=True)
class Settings:
    """Settings of the methods.

    epsilon_px: in ground pixels (the paper's D), where error sharing stops; max_rounds: its most rounds.
    ground: of a bundle without a DEM, `auto`, `flat` or `tie_surface`. boresight, lever_arm, gps_lag,
    rolling_shutter, turning: solved for by a bundle; vibrating: rotations of several periods while a frame is
    read; rate_sd_rad_per_s: of these rotations, if known. free_lens: a maker's distortion is only the start.
    model: `auto` adds what the evidence supports, see `chosen_model`. self_calibration: shared unknowns
    (lens, shutter, mounting) are solved for.
    """

    epsilon_px: float = 10.0
    max_rounds: int = 12
    ground: str = "auto"
    observations_per_frame: int = 2000
    boresight: bool = False
    lever_arm: bool = False
    gps_lag: bool = False
    rolling_shutter: bool = False
    turning: bool = False
    vibrating: bool = False
    rate_sd_rad_per_s: float | None = None
    free_lens: bool = False
    model: str = "auto"
    self_calibration: bool = True


@dataclass(frozen=True)
class Round:
    """One recorded round of an adjustment. misalignments_m (pairs, 2): east and north of right minus left
    before the moves, NaN if unknown. moves_m (frames, 2): of each frame in this round."""

    misalignments_m: Floats
    moves_m: Floats


@dataclass(frozen=True)
class SolveStep:
    """One recorded step of a bundle. solve: its name. cost: the sum of weighted squares after it; sigma_px:
    deviation of image coordinates; damping: share of the diagonal; step_m: the largest move of a frame, 0
    where the step was rejected; share_down_weighted: image observations with less than half of the full
    weight."""

    solve: str
    cost: float
    sigma_px: float
    damping: float
    step_m: float
    share_down_weighted: float


@dataclass(frozen=True)
class SharedUnknowns:
    """Numbers that frames share and a solve estimated. of: a camera's name or `platform`. names: ending in
    the unit. given, found, sd (k,): prior, estimate, deviation. correlation (k, k). fixed (k,): kept as
    given, since the block does not determine it."""

    FORMERLY: ClassVar[dict[str, str]] = {"held": "fixed"}
    of: tuple[str, ...]
    names: tuple[str, ...]
    given: Floats
    found: Floats
    sd: Floats
    correlation: Floats
    fixed: Bools

    def flights_apart_m(self) -> float:
        """The largest distance in plan between the offsets of two flights' positions, 0 for one flight."""
        east, north = (
            [m for name, m in zip(self.names, self.found, strict=True) if name.startswith(f"offset_{axis}_")]
            for axis in ("east", "north")
        )
        plan = np.array(east) + 1j * np.array(north)
        return float(np.abs(plan[:, None] - plan).max(initial=0.0))


@dataclass(frozen=True)
class ModelChoice:
    """Models of lens and shutter that were tried, and the one that was taken. taken: additions to the given
    model, see `chosen_model`, in order. names, left_out_px: every model, its additions joined by +, and the
    median residual of the tie points left out of its solve. contradicted: those that fit tie points, but not
    the positions. shown: how many of the last additions were taken for what all images together show."""

    taken: tuple[str, ...]
    names: tuple[str, ...]
    left_out_px: tuple[float, ...]
    contradicted: tuple[str, ...] = ()
    shown: int | bool = 0

    def __post_init__(self) -> None:
        """Models of earlier versions get their present names."""
        for key in ("taken", "names", "contradicted"):
            names = (n.replace("untold_turns", "without_reported_turns") for n in getattr(self, key))
            object.__setattr__(self, key, tuple(names))


@dataclass(frozen=True)
class ImageResiduals:
    """Image residuals of tie points. frame (m,): index. image_px (m, 2): measured. residual_px (m, 2):
    measured minus computed. weight (m,): robust weights, 1 for a good observation."""

    frame: Ints
    image_px: Floats
    residual_px: Floats
    weight: Floats


@dataclass(frozen=True)
class Adjusted:
    """The outcome. status[i] is `tied`, `placed` (by POS alone) or `rejected`.

    residuals_m: per pair of `Block.ties.pairs` (k, 2), tie points on the ground, right minus left, east and
    north. ground: the block's own unless the method estimates it. control: of all measured control and check
    points.

    The rest comes from methods that solve for it. pose_covariance (f, 6, 6): of east, north, up (m) and turns
    about them (rad), that of the POS for frames that took no part. places, shared, image_residuals: None from
    other methods. model: where more than the given one was tried. solved: what a later run may begin from.
    """

    poses: Poses
    cameras: tuple[Camera, ...]
    status: tuple[str, ...]
    rounds: tuple[Round, ...]
    residuals_m: tuple[Floats, ...]
    ground: GroundSurface
    warnings: tuple[Warn, ...] = ()
    figures: dict[str, float] = field(default_factory=dict)
    control: tuple[ControlResidual, ...] = ()
    pose_covariance: Floats | None = None
    places: GroundPlaces | None = None
    shared: SharedUnknowns | None = None
    image_residuals: ImageResiduals | None = None
    model: ModelChoice | None = None
    steps: tuple[SolveStep, ...] = ()
    solved: SolvedBlock | None = None

    def __post_init__(self) -> None:
        """Raises ValueError for a camera that can't be one."""
        for camera in self.cameras:
            camera.check()
