"""Where pairs are expected to match, by position and attitude."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import sourced, tuned
from geomosaic.matching.planes import Guess, guessed, plane_through
from geomosaic.projection.footprint import ground_from_image
from geomosaic.projection.ground import GroundSurface

LEAST_RADIUS_PX = sourced(300.0, "px", "coarse misplacement of two frames", "Yue et al. 2021, IRLA20200529")
_NODES = tuned(6, "nodes", "per frame side, to fit a plane: fewer fail where a frame sees past the ground")


@dataclass(frozen=True)
class ExpectedOverlap:
    """Reported poses, and ground points (frames, k, 3) of a lattice of each frame's image points (k, 2)."""

    poses: Poses
    cameras: Sequence[Camera]
    image_px: Sequence[Floats]
    ground_m: Sequence[Floats]

    @classmethod
    def of(cls, poses: Poses, cameras: Sequence[Camera], ground: GroundSurface) -> ExpectedOverlap:
        """What poses say of frames over a ground."""
        image_px = [lattice(c) for c in cameras]
        found = [ground_from_image(poses[i], cameras[i], ground, px) for i, px in enumerate(image_px)]
        return cls(poses, cameras, image_px, found)

    def guess(self, a: int, b: int, radius_px: float) -> Guess:
        """Where frame b is expected to show what frame a shows, to within a radius."""
        camera = self.cameras[a]
        there = self.poses[b].image_from_ground(self.cameras[b], self.ground_m[a])
        plane = plane_through(self.image_px[a], there) if np.isfinite(radius_px) else None
        return guessed((camera.width_px, camera.height_px), plane, radius_px)


def lattice(camera: Camera) -> Floats:
    """Image points (k, 2), evenly."""
    cols = (np.arange(_NODES) + 0.5) / _NODES * camera.width_px
    rows = (np.arange(_NODES) + 0.5) / _NODES * camera.height_px
    return np.stack(np.meshgrid(cols, rows), axis=-1).reshape(-1, 2)
