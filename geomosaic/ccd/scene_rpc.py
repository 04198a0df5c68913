"""The RPC of a stitched scene, fitted to what its pixels look at by the rigorous model, or the given one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.camera.rpc import Rpc, fit_rpc
from geomosaic.ccd.layout import SceneLayout
from geomosaic.ccd.line_poses import STEP_LINES, LinePoses
from geomosaic.ccd.object_space import SAMPLE_LINES, ObjectSpace
from geomosaic.ccd.virtual_layout import ideal_camera
from geomosaic.constants import tuned
from geomosaic.errors import InputError
from geomosaic.estimation.linear import least_squares
from geomosaic.geodesy.local import geodetic_from_ecef
from geomosaic.survey.strip_companions import read_rpc
from geomosaic.survey.strips import StripGeometry

_NODES = tuned((15, 25, 5), "columns, lines, heights", "of the fit: 3 heights leave 1.1 px, 5 1e-4 px")
_SPAN_M = tuned(500.0, "m", "margin of heights: 0 leaves level ground no span; 2000 fits as well")


@dataclass(frozen=True, eq=False)
class SceneRpc:
    """An RPC of the raster, whose origin is the raster's own, and what it leaves of the pixels' places.

    rms_px, worst_px: of the residuals' lengths on the ground that the strips see; None for
    a given RPC.
    """

    rpc: Rpc
    rms_px: float | None = None
    worst_px: float | None = None


def scene_rpc(geometry: StripGeometry, layout: SceneLayout, space: ObjectSpace | None) -> SceneRpc | None:
    """The RPC of a raster of this layout; None where there is neither a model nor an RPC.

    With a model: what pixels of every strip see on the ground, at their places in the raster. Where higher or
    lower ground would lie follows the ideal line's rays, since neighbouring strips see height the opposite
    way; 500 m more than the ground's own span. What a cubic can't follow, such as the jitter that is left in
    a raster of image-space layout, the RPC doesn't follow, as its residuals show. Without a model: the given
    RPC, which is of scene lines from 0.
    Raises: `InputError` if the model sees too little of the raster.
    """
    if space is None:
        if geometry.rpc is None:
            return None
        given = read_rpc(geometry.rpc)
        moved = given.offset - np.array([layout.first_line, 0.0, 0.0, 0.0, 0.0])
        return SceneRpc(replace(given, offset=moved))
    camera = ideal_camera(geometry, space.model)
    seen = list(_seen(geometry, layout, space))
    if not seen:
        raise InputError(
            "no strip has a line in the scene", file=geometry.model, fix="check the model's times"
        )
    raster, ground = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    line = raster[:, 1] + layout.first_line
    poses = LinePoses(camera, line.min() - STEP_LINES, line.max() + STEP_LINES, STEP_LINES)
    ideal = np.stack(poses.image(0, ground, line), axis=-1)
    moved = _cubic(ideal, raster - ideal)
    low, high = space.span_m
    heights = np.linspace(low - _SPAN_M, high + _SPAN_M, _NODES[2])
    (left, top), (right, bottom) = ideal.min(axis=0), ideal.max(axis=0)
    axes = np.linspace(left, right, _NODES[0]), np.linspace(top, bottom, _NODES[1])
    col, at, height = (a.ravel() for a in np.meshgrid(*axes, heights, indexing="ij"))
    nodes = np.stack([col, at], axis=-1)
    rpc, _ = fit_rpc(camera.ground_from_image(0, col, at, height), nodes + moved(nodes))
    away = np.linalg.norm(rpc.image_from_ground(geodetic_from_ecef(ground)) - raster, axis=1)
    return SceneRpc(rpc, float(np.sqrt((away**2).mean())), float(away.max()))


def _cubic(at: Floats, value: Floats) -> Callable[[Floats], Floats]:
    """The cubics of cols and lines (n, 2) nearest to values (n, 2).

    They take jitter off: an RPC fitted to it would have poles in its denominators.
    """
    middle, half = at.mean(axis=0), np.maximum(np.ptp(at, axis=0) / 2.0, 1.0)

    def terms(places: Floats) -> Floats:
        x, y = ((places - middle) / half).T
        return np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)

    found = least_squares(terms(at), value)
    return lambda places: np.asarray(terms(places) @ found)


def _seen(
    geometry: StripGeometry, layout: SceneLayout, space: ObjectSpace
) -> Iterator[tuple[Floats, Floats]]:
    """Raster cols and rows (n, 2), and what the strips' pixels there see (n, 3), Earth-fixed."""
    rows = np.unique(np.linspace(0, layout.height_px - 1, SAMPLE_LINES).round().astype(int))
    seams = layout.seams_px
    for k, lines in enumerate(geometry.lines):
        if not lines:
            continue
        first, last = layout.cols(k)
        if k and geometry.lines[k - 1]:
            first = max(first, int(np.ceil(seams[k - 1])))
        if k < len(seams) and geometry.lines[k + 1]:
            last = min(last, int(np.floor(seams[k])))
        x = np.array([first, last], dtype=np.float64)
        for row in rows:
            places = layout.places(k, int(row), int(row) + 1)
            col, line = (np.interp(x, places.knots_px, image[0]) for image in places.image_px)
            there = (line >= 0.0) & (line <= lines)
            if there.any():
                col, line = col[there], line[there]
                poses = LinePoses(space.model, line.min() - 1.0, line.max() + 1.0)
                at = np.stack([x, np.full(x.size, row + 0.5)], axis=-1)
                yield at[there], space.ground(poses, k, col, line)
