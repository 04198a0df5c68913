"""A surface of a simulated survey against its true heights, class by class.

Judged are all cells whose middle, at its true height, two frames have in their images. Distinguished are
those that two and three frames see, with nothing of the true land before it: what fewer than two see no
method can match, only guess.
"""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import Adjusted
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.pipeline.run_results import load_artefact, read_summary
from geomosaic.surface.cells import Cells
from geomosaic.surface.model import DenseSurface
from geomosaic.survey.model import Survey
from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.relief import Relief
from geomosaic_simulate.standing import heights_on_grid
from geomosaic_simulate.survey import landscape_of

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Counts = NDArray[np.int64]
CLASSES = ("ground", "roofs", "trees", "edges", "next to trees")
_FINE_M = 0.1
_BAND_M = 1.0
_AT_ONCE = 200_000
"""Cells that are judged together: some 200 MB, whatever the size of the town."""
_LAND_M = 0.2
"""Side of the squares of the true land that may stand before a place."""
_NEAREST_SQUARES = 1.5
"""Away from a place: what is nearer leans, and hides itself."""
_BEFORE_M = 0.15
"""By which land has to reach above a line of sight to hide what lies behind: half a square of a steep
roof."""


@dataclass(frozen=True)
class SurfaceErrors:
    """Errors of a class's cells.

    cells: how many. nmad_m: their NMAD. off_1_m: share off by more than 1 m. within_1_sd, within_2_sd: shares
    within 1 and 2 stated deviations. filled: share that is filled. two_see, three_see: how many of them two
    and three frames see. two_off_1_m, three_off_1_m: shares of those that are off by more than 1 m.
    """

    cells: int
    nmad_m: float
    off_1_m: float
    within_1_sd: float
    within_2_sd: float
    filled: float
    two_see: int
    two_off_1_m: float
    three_see: int
    three_off_1_m: float


def judged(
    run: Path, truth: Path, other: DenseSurface | None = None
) -> tuple[dict[str, SurfaceErrors], float]:
    """By class, and the side of a cell (m); of another surface if given.

    Heights are compared in each cell's middle with the land there, roofs and crowns as they stand. What all
    frames miss in common (place, turn, scale) is taken off by the projection centres, as is the median height
    of the ground that three frames see. Both are the positions' error, not the surface's.
    """
    summary = read_summary(run)
    survey: Survey = load_artefact(run, summary, "survey", Survey)
    adjusted: Adjusted = load_artefact(run, summary, "adjusted", Adjusted)
    surface = other or load_artefact(run, summary, "surface", DenseSurface)
    true = true_positions(truth, survey)
    truth_record = json.loads((truth / "truth.json").read_text(encoding="utf-8"))

    def errors(cells: Cells, up_m: Floats32 | None = None) -> tuple[Floats32, NDArray[np.uint8]]:
        return _errors(truth_record, survey, adjusted, true, cells, up_m)

    off_m, kind = errors(surface.cells, surface.up_m)
    squares = _squares(surface.cells)
    east, north = surface.cells.axes_m()
    points = np.stack(np.broadcast_arrays(east, north[:, None], surface.up_m - off_m), axis=-1)
    looking, seeing = frames_seeing(adjusted, points, squares, -errors(squares)[0])
    off_m -= np.median(off_m[(seeing > 2) & (kind == 0)])
    found = {}
    for number, name in enumerate(CLASSES):
        of = (looking > 1) & (kind == number)
        if of.any():
            off, sd = np.abs(off_m[of]), surface.sd_m[of]
            spread = np.median(np.abs(off_m[of] - np.median(off_m[of])))
            shares = (
                float(np.mean(m)) for m in (off > 1.0, off < sd, off < 2.0 * sd, surface.views[of] == 0)
            )
            two, three = (
                (int(m.sum()), float(np.mean(off[m] > 1.0))) for m in (seeing[of] > 1, seeing[of] > 2)
            )
            found[name] = SurfaceErrors(int(of.sum()), 1.4826 * float(spread), *shares, *two, *three)
    return found, surface.cells.cell_m


def _squares(cells: Cells) -> Cells:
    """Of about `_LAND_M`, over the same rectangle."""
    by = max(round(cells.cell_m / _LAND_M), 1)
    return Cells(cells.west_m, cells.south_m, cells.cell_m / by, cells.rows * by, cells.cols * by)


def _errors(
    truth_record: dict[str, Any],
    survey: Survey,
    adjusted: Adjusted,
    true: Floats,
    cells: Cells,
    up_m: Floats32 | None,
) -> tuple[Floats32, NDArray[np.uint8]]:
    """`errors_at` of cells' middles at given heights, at 0 if none are."""
    east, north = cells.axes_m()
    found = []
    for some in np.array_split(np.arange(cells.rows), -(-cells.rows * cells.cols // _AT_ONCE)):
        up = np.zeros(1) if up_m is None else up_m[some].astype(float)
        points = np.stack(np.broadcast_arrays(east, north[some, None], up), axis=-1)
        off_m, kind = errors_at(truth_record, survey, adjusted, true, points)
        found.append((off_m.astype(np.float32), kind))
    off, kinds = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return off, kinds


def errors_at(
    truth_record: dict[str, Any], survey: Survey, adjusted: Adjusted, true: Floats, points: Floats
) -> tuple[Floats, NDArray[np.uint8]]:
    """Height errors (m) of points (..., 3) of the work frame, and which of `CLASSES` lies there, after the
    similarity that lays the solved projection centres on the true ones."""
    geodetic = survey.work_frame.geodetic_from_enu(_similarity(adjusted.poses.positions_m, true, points))
    at = MapProjection(truth_record["map_crs"]).map_from_geodetic(geodetic[..., 0], geodetic[..., 1])
    height_m, kind = _land(truth_record, at)
    return geodetic[..., 2] - height_m, kind


def frames_seeing(
    adjusted: Adjusted, points: Floats, squares: Cells, land_m: Floats32
) -> tuple[Counts, Counts]:
    """How many frames have points (..., 3) inside their image, and how many see them past
    land_m (rows, cols), the heights of squares."""
    looking, seeing = (np.zeros(points.shape[:-1], dtype=np.int64) for _ in range(2))
    for pose, camera in zip(adjusted.poses, adjusted.cameras, strict=True):
        col, row = np.moveaxis(pose.image_from_ground(camera, points), -1, 0)
        inside = (col >= 0) & (col < camera.width_px) & (row >= 0) & (row < camera.height_px)
        looking += inside
        seeing[inside] += _unhidden(pose.position_m, points[inside], squares, land_m)
    return looking, seeing


def _unhidden(camera_m: Floats, points: Floats, squares: Cells, land_m: Floats32) -> NDArray[np.bool_]:
    """Which points (n, 3) nothing of the land stands before, seen from a place above it (3,)."""
    towards = camera_m - points
    away = np.maximum(np.hypot(*towards[:, :2].T), 1e-6)
    per_square = (towards * (squares.cell_m / away)[:, None]).astype(np.float32)
    at = (points - [squares.west_m, squares.south_m, -_BEFORE_M]).astype(np.float32)
    at[:, :2] /= squares.cell_m
    per_square[:, :2] /= squares.cell_m
    at += np.float32(_NEAREST_SQUARES) * per_square
    found = np.ones(len(points), dtype=bool)
    which = np.arange(len(points))
    highest = land_m.max()
    while which.size:
        col, row = np.floor(at[:, :2]).astype(np.int32).T
        inside = (col >= 0) & (col < squares.cols) & (row >= 0) & (row < squares.rows)
        at, per_square, which = (a[inside] for a in (at, per_square, which))
        hidden = land_m[row[inside], col[inside]] > at[:, 2]
        found[which[hidden]] = False
        on = ~hidden & (at[:, 2] < highest)
        at, per_square, which = (a[on] for a in (at, per_square, which))
        at += per_square
    return found


def true_positions(truth: Path, survey: Survey) -> Floats:
    """The true projection centres (n, 3) in the survey's work frame."""
    with (truth / "positions.csv").open(encoding="utf-8") as file:
        rows = {row["frame"]: row for row in csv.DictReader(file)}
    reported = [
        [float(rows[f.name][k]) for k in ("lon_deg", "lat_deg", "height_ellipsoidal_m")]
        for f in survey.frames
    ]
    return survey.work_frame.enu_from_geodetic(*np.array(reported).T)


def _similarity(a: Floats, b: Floats, points: Floats) -> Floats:
    """Points as the similarity takes them that lays a on b (Umeyama 1991)."""
    of_a, of_b = a - a.mean(axis=0), b - b.mean(axis=0)
    u, s, vt = np.linalg.svd(of_b.T @ of_a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    scale = float((s * sign).sum() / (of_a**2).sum())
    return np.asarray(scale * (points - a.mean(axis=0)) @ ((u * sign) @ vt).T + b.mean(axis=0))


def _land(truth_record: dict[str, Any], at: Floats) -> tuple[Floats, NDArray[np.uint8]]:
    """True heights at map places (..., 2), and which of `CLASSES` lies there."""
    plan = SurveyPlan(**truth_record["plan"])
    land, relief = landscape_of(plan), Relief(**truth_record["relief"])
    west, south = at.reshape(-1, 2).min(axis=0) - 2.0
    east, north = at.reshape(-1, 2).max(axis=0) + 2.0
    bounds = west - 20.0, south - 20.0, east + 20.0, north + 20.0
    shape = int((north - south) / _FINE_M), int((east - west) / _FINE_M)
    height, kind = heights_on_grid(
        relief, land.buildings_in(bounds), land.trees_in(bounds), west, north, _FINE_M, shape
    )
    side = 2 * round(_BAND_M / _FINE_M) + 1
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    roof, crown = ((kind == k).astype(np.uint8) for k in (1, 2))
    wall = (cv2.dilate(roof, disk) > 0) & (cv2.erode(roof, disk) == 0)
    classes = np.where((kind == 0) & (cv2.dilate(crown, disk) > 0), 4, kind)
    classes = np.where(wall, 3, classes).astype(np.uint8)
    row = ((north - at[..., 1]) / _FINE_M).astype(int).clip(0, shape[0] - 1)
    col = ((at[..., 0] - west) / _FINE_M).astype(int).clip(0, shape[1] - 1)
    return height[row, col].astype(np.float64), classes[row, col]
