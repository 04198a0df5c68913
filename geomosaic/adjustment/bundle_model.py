"""What a bundle is told, and what it finds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.collinearity import INTERIOR
from geomosaic.adjustment.mounting import MOUNTING, Mounting
from geomosaic.adjustment.normal import Reduced
from geomosaic.adjustment.terrain import Terrain
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
MEASURED_SD_PX = 0.5
"""Of a control or check point measured by hand in a picture: about half a pixel."""
NO_MOUNTING = Mounting(np.zeros(len(MOUNTING)))
GROUPS = ("horizontal", "vertical", "tilt", "yaw")
"""Of the pose priors, each with a variance component of its own."""


@dataclass(frozen=True)
class Priors:
    """What is believed before the pictures speak, with standard deviations.

    interior_sd (c, 9) in the order of INTERIOR, 0 for what is known. points_m, points_sd_m (p, 3): for
    control points their own; for tie points the ground below, weakly. control (p,): which points are
    control, measured by hand and not bound to the terrain. terrain: a surface that tie points lie on, if
    one is known.
    mounting: what POS and poses differ by in common. trust (f, 6): factors of the pose priors' weights, 1
    but for tags that lie; held (s,): which of the shared unknowns, cameras' numbers before the mounting's,
    keep what they were given as the block does not determine them; both set by the solver.
    """

    poses: Poses
    cameras: tuple[Camera, ...]
    interior_sd: Floats
    points_m: Floats
    points_sd_m: Floats
    control: Bools
    terrain: Terrain | None = None
    mounting: Mounting = NO_MOUNTING
    trust: Floats | None = None
    held: Bools | None = None


@dataclass(frozen=True)
class Bundle:
    """The solution. Covariances are scaled with the estimated variance components.

    points_sd_m: (p, 3), as if poses and cameras were known.
    pose_covariance: (f, 6, 6) of east, north, up (m) and turns about them (rad). interior_sd: (c, 9).
    mounting, mounting_sd: (7,). shared_correlation (s, s), s = 9c + 7: of the cameras' numbers and the
    mounting's; held (s,): which of them the block does not determine. Held numbers keep what they were
    given, and the covariances hold what is not known of them. strayed (s,): those held since the pictures
    drew them where no lens has them. residual_px: (m, 2) observed minus computed.
    weight: (m,) robust weights, 1 for a good observation. sigma_px: estimated deviation of a tie point's
    image coordinate.
    sigma: estimated deviation over stated deviation per group. reduced: the last normal equations.
    """

    poses: Poses
    cameras: tuple[Camera, ...]
    points_m: Floats
    points_sd_m: Floats
    pose_covariance: Floats
    interior_sd: Floats
    mounting: Floats
    mounting_sd: Floats
    shared_correlation: Floats
    held: Bools
    strayed: Bools
    residual_px: Floats
    weight: Floats
    sigma_px: float
    sigma: dict[str, float]
    iterations: int
    reduced: Reduced


@dataclass
class State:
    positions: Floats
    rotations: Floats
    interior: Floats
    points: Floats
    mounting: Floats
    level: float = 0.0


def with_interior(camera: Camera, interior: Sequence[float] | Floats) -> Camera:
    """The camera with other numbers, in the order of INTERIOR."""
    values: dict[str, Any] = {name: float(v) for name, v in zip(INTERIOR, interior, strict=True)}
    return replace(camera, **values)
