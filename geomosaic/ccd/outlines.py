"""Outlines of the strips and of the scene on the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.camera.rpc import Rpc
from geomosaic.ccd.layout import SceneLayout
from geomosaic.ccd.line_poses import STEP_LINES, LinePoses
from geomosaic.ccd.object_space import ObjectSpace
from geomosaic.ccd.scene_rpc import SceneRpc
from geomosaic.ccd.virtual_layout import ideal_camera
from geomosaic.constants import ROUNDS, tuned
from geomosaic.estimation.linear import solve_each
from geomosaic.geodesy.local import geodetic_from_ecef
from geomosaic.survey.strips import StripGeometry

_POINTS = tuned(33, "points", "per side: 33 are within 1.1 m, 9 within 4 m; more make long files")
_STEP_DEG = tuned(1e-5, "degrees", "of a numerical slope, 1 m: less drowns in rounding; more misses bends")


@dataclass(frozen=True, eq=False)
class Outlines:
    """Closed rings (n, 2) of longitude and latitude in degrees, the first point once more at the end."""

    scene: Floats
    ccds: dict[int, Floats]


def outlines(
    geometry: StripGeometry, layout: SceneLayout, space: ObjectSpace | None, rpc: SceneRpc | None
) -> Outlines | None:
    """The scene's and the living CCDs' outlines; None where there is neither a model nor an RPC.

    By the model on the ground's heights; else by the scene's RPC at its middle height, the strips at their
    nominal places.
    """
    g = geometry
    rings = {k: _ring(g.width_px, lines) for k, lines in enumerate(g.lines) if lines}
    raster = _ring(layout.width_px, layout.height_px)
    if space is not None:
        scene = raster + np.array([0.0, layout.first_line])
        camera = ideal_camera(g, space.model)
        ideal = LinePoses(camera, scene[:, 1].min(), scene[:, 1].max(), STEP_LINES)
        real = LinePoses(space.model, 0.0, max(g.lines), STEP_LINES)
        return Outlines(
            _lonlat(space, ideal, 0, scene), {k: _lonlat(space, real, k, ring) for k, ring in rings.items()}
        )
    if rpc is None:
        return None
    placed = {}
    for k, ring in rings.items():
        ahead = g.row_separation_lines * (0.5 if g.ccds[k].row == 1 else -0.5)
        nominal = ring + np.array([k * (g.width_px - g.overlap_px), ahead - layout.first_line])
        placed[k] = lonlat_by_rpc(rpc.rpc, nominal)
    return Outlines(lonlat_by_rpc(rpc.rpc, raster), placed)


def lonlat_by_rpc(rpc: Rpc, image: Floats) -> Floats:
    """Longitude and latitude (n, 2) that cols and lines (n, 2) have at the RPC's middle height."""
    at = np.tile(rpc.offset[[3, 2, 4]], (len(image), 1))
    for _ in range(ROUNDS):
        here = rpc.image_from_ground(at)
        by = [(rpc.image_from_ground(at + _STEP_DEG * unit) - here) / _STEP_DEG for unit in np.eye(3)[:2]]
        at[:, :2] += solve_each(np.stack(by, axis=-1), (image - here)[..., None])[..., 0]
    return at[:, :2]


def _lonlat(space: ObjectSpace, poses: LinePoses, ccd: int, ring: Floats) -> Floats:
    return geodetic_from_ecef(space.ground(poses, ccd, ring[:, 0], ring[:, 1]))[:, :2]


def _ring(width: float, height: float) -> Floats:
    """Cols and lines (n, 2) around a raster, clockwise as seen in it, from its origin back to it."""
    right, down = np.linspace(0.0, width, _POINTS), np.linspace(0.0, height, _POINTS)
    top = np.stack([right, np.zeros(_POINTS)], axis=-1)
    far = np.stack([np.full(_POINTS, width), down], axis=-1)
    bottom, near = top[::-1] + np.array([0.0, height]), far[::-1] - np.array([width, 0.0])
    return np.concatenate([top, far[1:], bottom[1:], near[1:]])
