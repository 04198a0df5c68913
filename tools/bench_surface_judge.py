"""A surface of a simulated survey against its true heights, class by class."""

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
from geomosaic.pipeline.finished import load_artefact, read_summary
from geomosaic.simulate.plan import SurveyPlan
from geomosaic.simulate.relief import Relief
from geomosaic.simulate.standing import heights_on_grid
from geomosaic.simulate.survey import landscape_of
from geomosaic.surface.model import DenseSurface
from geomosaic.survey.model import Survey

Floats = NDArray[np.float64]
CLASSES = ("ground", "roofs", "trees", "edges", "beside trees")
_FINE_M = 0.1
_BAND_M = 1.0
_LEAST_FRAMES = 3
_AT_ONCE = 200_000
"""Cells that are judged together: some 200 MB, whatever the size of the town."""


@dataclass(frozen=True)
class Judged:
    """A class's cells: how many, NMAD (m), shares off by more than 1 m, within 1 and 2 stated deviations, and
    held."""

    cells: int
    nmad_m: float
    off_1_m: float
    within_1_sd: float
    within_2_sd: float
    held: float


def judged(run: Path, truth: Path, other: DenseSurface | None = None) -> tuple[dict[str, Judged], float]:
    """By class the cells that three frames see, and the side of a cell (m); of another surface if given.

    Heights are compared in each cell's middle with the land there, roofs and crowns as they stand. What all
    frames miss in common (place, turn, scale) is taken off by the projection centres, the ground's median
    height as well: it is the positions' error, not the surface's.
    """
    summary = read_summary(run)
    survey: Survey = load_artefact(run, summary, "survey", Survey)
    adjusted: Adjusted = load_artefact(run, summary, "adjusted", Adjusted)
    surface = other or load_artefact(run, summary, "surface", DenseSurface)
    true = true_positions(truth, survey)
    told = json.loads((truth / "truth.json").read_text(encoding="utf-8"))
    east, north = surface.cells.axes_m()
    bands = []
    for some in np.array_split(np.arange(len(north)), -(-surface.up_m.size // _AT_ONCE)):
        points = np.stack(
            np.broadcast_arrays(east, north[some, None], surface.up_m[some].astype(float)), axis=-1
        )
        bands.append((*errors_at(told, survey, adjusted, true, points), seen_by(adjusted, points)))
    errors, kind, seen = (np.concatenate(parts) for parts in zip(*bands, strict=True))
    there = seen >= _LEAST_FRAMES
    errors -= np.median(errors[there & (kind == 0)])
    found = {}
    for number, name in enumerate(CLASSES):
        of = there & (kind == number)
        if of.any():
            off, sd = np.abs(errors[of]), surface.sd_m[of]
            spread = np.median(np.abs(errors[of] - np.median(errors[of])))
            shares = (
                float(np.mean(m)) for m in (off > 1.0, off < sd, off < 2.0 * sd, surface.views[of] == 0)
            )
            found[name] = Judged(int(of.sum()), 1.4826 * float(spread), *shares)
    return found, surface.cells.cell_m


def errors_at(
    told: dict[str, Any], survey: Survey, adjusted: Adjusted, true: Floats, points: Floats
) -> tuple[Floats, NDArray[np.uint8]]:
    """Height errors (m) of points (..., 3) of the work frame, and which of `CLASSES` lies there, after the
    similarity that lays the solved projection centres on the true ones."""
    geodetic = survey.work_frame.geodetic_from_enu(_similarity(adjusted.poses.positions_m, true, points))
    at = MapProjection(told["map_crs"]).map_from_geodetic(geodetic[..., 0], geodetic[..., 1])
    height_m, kind = _land(told, at)
    return geodetic[..., 2] - height_m, kind


def seen_by(adjusted: Adjusted, points: Floats) -> NDArray[np.int64]:
    """How many frames see points (..., 3), whatever hides them."""
    seen = np.zeros(points.shape[:-1], dtype=np.int64)
    for pose, camera in zip(adjusted.poses, adjusted.cameras, strict=True):
        col, row = np.moveaxis(pose.image_from_ground(camera, points), -1, 0)
        seen += (col >= 0) & (col < camera.width_px) & (row >= 0) & (row < camera.height_px)
    return seen


def true_positions(truth: Path, survey: Survey) -> Floats:
    """The true projection centres (n, 3) in the survey's work frame."""
    with (truth / "positions.csv").open(encoding="utf-8") as file:
        rows = {row["frame"]: row for row in csv.DictReader(file)}
    told = [
        [float(rows[f.name][k]) for k in ("lon_deg", "lat_deg", "height_ellipsoidal_m")]
        for f in survey.frames
    ]
    return survey.work_frame.enu_from_geodetic(*np.array(told).T)


def _similarity(a: Floats, b: Floats, points: Floats) -> Floats:
    """Points as the similarity takes them that lays a on b (Umeyama 1991)."""
    of_a, of_b = a - a.mean(axis=0), b - b.mean(axis=0)
    u, s, vt = np.linalg.svd(of_b.T @ of_a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    scale = float((s * sign).sum() / (of_a**2).sum())
    return np.asarray(scale * (points - a.mean(axis=0)) @ ((u * sign) @ vt).T + b.mean(axis=0))


def _land(told: dict[str, Any], at: Floats) -> tuple[Floats, NDArray[np.uint8]]:
    """True heights at map places (..., 2), and which of `CLASSES` lies there."""
    plan = SurveyPlan(**told["plan"])
    land, relief = landscape_of(plan), Relief(**told["relief"])
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
