"""Points surveyed on the ground and measured in the frames that show them: control and check points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.errors import InputError
from geomosaic_simulate.landscape import Bounds, Landscape
from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.readout import FrameReadout
from geomosaic_simulate.render import World

SURVEYED_SD_M = (0.02, 0.03)
"""Of a point's surveyed position, on each horizontal axis and in height: an RTK rover."""
MEASURED_SD_PX = 0.3
"""Of a point measured by hand in an image, on each axis."""
COLUMNS = (
    "name", "kind", "lon_deg", "lat_deg", "height_ellipsoidal_m", "sd_horizontal_m", "sd_vertical_m",
    "frame", "col", "row",
)  # fmt: skip
_TRIALS = 60
_EDGE_PX = 8.0
_LEAST_FRAMES = 2
_EACH_CHECK = 3


@dataclass(frozen=True)
class SurveyedPoint:
    """A point on the bare ground. map_m (3,): easting, northing, ellipsoidal height.

    seen: (frame, col, row) in each image as it is stored, corner origin, frames counted from 0.
    """

    name: str
    check: bool
    map_m: Floats
    seen: tuple[tuple[int, float, float], ...]


def true_points(
    plan: SurveyPlan,
    camera: Camera,
    poses: Poses,
    readouts: Sequence[FrameReadout],
    world: World,
    bounds_m: Sequence[Bounds],
) -> list[SurveyedPoint]:
    """`plan.control_points` points on open ground, far apart, each in two frames at least.

    Every third is a check point. Nothing that stands near them hides them.

    Args: readouts: how each frame is read; bounds_m: what each sees of the map.
    Raises: `InputError` if there is no room for so many.
    """
    rng = plan.rng("control")
    low, high = np.min(bounds_m, axis=0)[:2], np.max(bounds_m, axis=0)[2:]
    en = rng.uniform(low, high, (_TRIALS * plan.control_points, 2))
    en = en[_in_the_open(plan, camera, en)]
    at = np.column_stack([en, world.relief.height_at(*en.T)])
    enu = world.enu_from_map(*at.T)
    px = np.full((len(poses), len(at), 2), np.nan)
    for i in plan.kept:
        west, south, east, north = bounds_m[i]
        near = ((en >= [west, south]) & (en <= [east, north])).all(axis=1)
        px[i, near] = _stored_px(plan, camera, poses, readouts[i], i, enu[near])
    size = np.array([camera.width_px, camera.height_px])
    inside = np.asarray(((px > _EDGE_PX) & (px < size - _EDGE_PX)).all(axis=2))
    places = np.flatnonzero(inside.sum(axis=0) >= _LEAST_FRAMES)
    if len(places) < plan.control_points:
        raise InputError(
            f"room for {len(places)} control points on open ground that two frames see",
            fix="ask for fewer control_points, or for more overlap",
        )
    out = []
    for k, j in enumerate(places[_far_apart(en[places], plan.control_points)]):
        check = k % _EACH_CHECK == _EACH_CHECK - 1
        seen = tuple((int(i), float(px[i, j, 0]), float(px[i, j, 1])) for i in np.flatnonzero(inside[:, j]))
        out.append(SurveyedPoint(f"{'CHK' if check else 'GCP'}-{k + 1:02d}", check, at[j], seen))
    return out


def surveyed(plan: SurveyPlan, points: Sequence[SurveyedPoint]) -> list[SurveyedPoint]:
    """The points as they are given, with noise of SURVEYED_SD_M and MEASURED_SD_PX."""
    rng = plan.rng("control noise")
    out = []
    for p in points:
        at = p.map_m + rng.standard_normal(3) * [SURVEYED_SD_M[0], *SURVEYED_SD_M]
        noise = MEASURED_SD_PX * rng.standard_normal((len(p.seen), 2))
        seen = tuple(
            (i, col + float(d[0]), row + float(d[1])) for (i, col, row), d in zip(p.seen, noise, strict=True)
        )
        out.append(SurveyedPoint(p.name, p.check, at, seen))
    return out


def control_rows(
    points: Sequence[SurveyedPoint], names: Sequence[str], world: World, sd_m: tuple[float, float]
) -> list[list[str]]:
    """Rows of COLUMNS, one a measurement."""
    rows = []
    for p in points:
        lon, lat = world.projection.geodetic_from_map(p.map_m[0], p.map_m[1])
        where = [f"{lon:.10f}", f"{lat:.10f}", f"{p.map_m[2]:.4f}", *(f"{s:g}" for s in sd_m)]
        kind = "check" if p.check else "control"
        rows += [[p.name, kind, *where, names[i], f"{col:.3f}", f"{row:.3f}"] for i, col, row in p.seen]
    return rows


def gcp_list(points: Sequence[SurveyedPoint], names: Sequence[str], crs: str) -> str:
    """OpenDroneMap's gcp_list.txt: the CRS, then x, y, height, col, row, image, name."""
    lines = [
        f"{p.map_m[0]:.4f} {p.map_m[1]:.4f} {p.map_m[2]:.4f} {col:.3f} {row:.3f} {names[i]} {p.name}"
        for p in points
        for i, col, row in p.seen
    ]
    return "\n".join([crs, *lines, ""])


def _stored_px(
    plan: SurveyPlan, camera: Camera, poses: Poses, readout: FrameReadout, i: int, enu_m: Floats
) -> Floats:
    """Where frame i, as it is stored, shows points (k, 3)."""
    px = readout.image_from_ground(camera, poses[i], enu_m)
    return np.asarray([camera.width_px, camera.height_px] - px if i in plan.turned_frames() else px)


def _in_the_open(plan: SurveyPlan, camera: Camera, en: Floats) -> Bools:
    """Not behind or under a standing building or tree for any frame, however obliquely it looks, (k,)."""
    slant = np.hypot(camera.width_px, camera.height_px) / 2.0 / camera.focal_length_px + 0.1
    margin = 60.0
    bounds = (*(en.min(axis=0) - margin).tolist(), *(en.max(axis=0) + margin).tolist())
    land = Landscape(
        plan.seed, plan.buildings, plan.water_share, plan.smooth_forest_share, plan.hipped_roofs, plan.bridges
    )
    things = np.zeros((0, 3))
    if plan.buildings_stand:
        roofs = land.buildings_in(bounds)
        blocked = [
            (b.easting_m, b.northing_m, np.hypot(b.half_length_m, b.half_width_m) + slant * b.top_m)
            for b in roofs
        ]
        things = np.array(blocked).reshape(-1, 3)
    if plan.trees_stand:
        x, y, radius, height = land.trees_in(bounds).T
        things = np.concatenate([things, np.column_stack([x, y, radius + slant * height])])
    clear = np.ones(len(en), dtype=bool)
    for x, y, reach in things:
        clear &= np.hypot(en[:, 0] - x, en[:, 1] - y) > reach
    return clear


def _far_apart(en: Floats, count: int) -> Ints:
    """Indices of `count` points, each farthest from those before it, the first from the middle."""
    chosen = [int(np.linalg.norm(en - en.mean(axis=0), axis=1).argmax())]
    distance = np.linalg.norm(en - en[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(en - en[chosen[-1]], axis=1))
    return np.array(chosen, dtype=np.intp)
