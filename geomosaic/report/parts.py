"""What the report shows, worked out of the artefacts: rows of tables and images as SVG."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import Adjusted, ControlResidual
from geomosaic.camera.interior import Camera
from geomosaic.export.on_map import map_from_work
from geomosaic.export.orientation import Orientations
from geomosaic.matching.model import TiePoints
from geomosaic.placement.model import Placement
from geomosaic.projection.footprint import footprint
from geomosaic.quality.control import ControlFigures, control_figures
from geomosaic.quality.misalignment import PairMisalignments
from geomosaic.report.map_plots import network_map, vector_map
from geomosaic.report.plots import Axis, Series, histogram, line_plot
from geomosaic.report.svg import short
from geomosaic.survey.model import Survey

Floats = NDArray[np.float64]

_WORST_PAIRS = 15
_OUTLINES = 400


@dataclass(frozen=True)
class FrameRow:
    """One line of the table of frames; lengths in m, the turn in degrees."""

    name: str
    line: int
    status: str
    ties: int
    moved_m: float
    turned_deg: float
    sd_horizontal_m: float


def frame_rows(placement: Placement, ties: TiePoints, orientation: Orientations) -> list[FrameRow]:
    """Rows in order of the survey: how far each frame was moved (3D) and turned from its POS."""
    count = np.zeros(len(orientation.names), dtype=np.int64)
    for pair in ties.pairs:
        count[[pair.left, pair.right]] += len(pair)
    sd = np.linalg.norm(orientation.sd_m[:, :2], axis=1)
    return [
        FrameRow(
            name,
            placement.lines[i],
            orientation.status[i],
            int(count[i]),
            float(orientation.moved_m[i]),
            float(orientation.turned_deg[i]),
            float(sd[i]),
        )
        for i, name in enumerate(orientation.names)
    ]


def map_footprints_m(survey: Survey, adjusted: Adjusted) -> list[Floats]:
    """The frames' outlines on the map, (k, 2) each, without points whose ray misses the ground."""
    per_side = 4 if len(survey.frames) <= _OUTLINES else 1
    out = []
    for i, camera in enumerate(adjusted.cameras):
        outline = footprint(adjusted.poses[i], camera, adjusted.ground, per_side)
        seen = outline[np.isfinite(outline).all(axis=1)]
        out.append(map_from_work(survey, seen) if len(seen) else np.empty((0, 2)))
    return out


def rounds_plot(adjusted: Adjusted, ground_pixel_m: float) -> str | None:
    """Misalignment of the tied pairs before each round, in ground pixels; None for less than two rounds."""
    if len(adjusted.rounds) < 2:
        return None
    mean, most = zip(
        *(misaligned_px(adjusted, i, ground_pixel_m) for i in range(len(adjusted.rounds))), strict=True
    )
    number = np.arange(1, len(adjusted.rounds) + 1)
    label = "misalignment of tied pairs before each round of the adjustment"
    series = [Series("largest", number, most), Series("root mean square", number, mean)]
    ends = Axis("round", low=1.0, high=float(len(number)), whole=True)
    return line_plot(series, ends, Axis("misalignment", "ground px"), label=label)


def misaligned_px(adjusted: Adjusted, i: int, ground_pixel_m: float) -> tuple[float, float]:
    """Root mean square and largest misalignment before round i, in ground pixels; NaN if none is known."""
    length = np.linalg.norm(adjusted.rounds[i].misalignments_m, axis=1) / ground_pixel_m
    length = length[np.isfinite(length)]
    if not length.size:
        return float("nan"), float("nan")
    return float(np.sqrt((length**2).mean())), float(length.max())


def moves_map(survey: Survey, placement: Placement, adjusted: Adjusted, footprints_m: list[Floats]) -> str:
    """Arrows from where POS put the projection centres to where the adjustment puts them."""
    before = map_from_work(survey, placement.poses.positions_m)
    after = map_from_work(survey, adjusted.poses.positions_m)
    odd = np.array([s != "tied" for s in adjusted.status])
    outlines = [o for o in footprints_m if len(o) > 2] if len(footprints_m) <= _OUTLINES else []
    return vector_map(
        before, after - before, label="how far each frame was moved", outlines_m=outlines, weak=odd
    )


def ties_map(survey: Survey, ties: TiePoints, adjusted: Adjusted) -> str:
    """The graph of tied frames."""
    edges = np.array([(p.left, p.right) for p in ties.pairs], dtype=np.int64).reshape(-1, 2)
    return network_map(
        map_from_work(survey, adjusted.poses.positions_m),
        edges,
        np.array([len(p) for p in ties.pairs], dtype=np.float64),
        label="which frames are tied, and by how many tie points",
        what="tie points",
        dashed=np.array(ties.untied, dtype=np.int64).reshape(-1, 2),
        names=[f.name for f in survey.frames],
        marked=np.array([s != "tied" for s in adjusted.status]),
    )


def residuals_plot(adjusted: Adjusted, ground_pixel_m: float) -> str | None:
    """Histogram of the tie points' residual lengths; None without residuals."""
    left = [r for r in adjusted.residuals_m if len(r)]
    if not left:
        return None
    length = np.linalg.norm(np.concatenate(left), axis=1) / ground_pixel_m
    return histogram(length, Axis("residual", "ground px"), label="residuals of the tie points on the ground")


def worst_pairs(survey: Survey, pairs: PairMisalignments) -> list[dict[str, object]]:
    """The pairs with the largest residuals."""
    order = np.argsort(-np.nan_to_num(pairs.rms_m, nan=-1.0))[:_WORST_PAIRS]
    return [
        {
            "left": survey.frames[pairs.left[i]].name,
            "right": survey.frames[pairs.right[i]].name,
            "points": int(pairs.points[i]),
            "mean_m": float(pairs.length_m[i]),
            "rms_m": float(pairs.rms_m[i]),
            "max_m": float(pairs.max_m[i]),
        }
        for i in order
        if np.isfinite(pairs.rms_m[i])
    ]


def control_tables(adjusted: Adjusted) -> list[tuple[str, ControlFigures, list[ControlResidual]]]:
    """Check points, then control points: title, figures, the points, the worst first."""
    out = []
    for title, check in (("Check points", True), ("Control points", False)):
        points = [c for c in adjusted.control if c.check == check]
        if points:
            points.sort(key=lambda c: -float(np.linalg.norm(c.residual_m)))
            out.append((title, control_figures(np.stack([c.residual_m for c in points])), points))
    return out


def camera_rows(survey: Survey, adjusted: Adjusted) -> list[tuple[str, list[tuple[str, str, str]]]]:
    """For each camera that no solve reports the parameters of: name, as given, as adjusted."""
    solved = () if adjusted.shared is None else adjusted.shared.of
    used: dict[str, Camera] = {c.name: c for c in adjusted.cameras if c.name not in solved}
    parameters = (
        ("focal length", "focal_length_px", "px"),
        ("principal point, col", "principal_col_px", "px"),
        ("principal point, row", "principal_row_px", "px"),
        ("k1", "k1", ""),
        ("k2", "k2", ""),
        ("k3", "k3", ""),
        ("p1", "p1", ""),
        ("p2", "p2", ""),
    )
    out = []
    for camera in survey.cameras:
        if camera.name in used:
            title = f"{camera.name}, {camera.width_px} × {camera.height_px} px"
            title += "" if camera.kind == "brown" else f", {camera.kind}"
            rows = [
                (
                    name,
                    _parameter(getattr(camera, key), unit),
                    _parameter(getattr(used[camera.name], key), unit),
                )
                for name, key, unit in parameters
            ]
            out.append((title, rows))
    return out


def _parameter(value: float, unit: str) -> str:
    return f"{value:.2f}\u00a0{unit}" if unit else f"{value:.6f}"


def composition_rows(metrics: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    """How frames were evened and where their seams lie: name, before, after, what it means. None where frames
    stayed as they are."""
    out = []
    if (grey := metrics.get("tones", {}).get("difference_grey")) is not None:
        out.append(
            (
                "light",
                f"{short(grey['before_median'])} ({short(grey['before_90'])})",
                f"{short(grey['after_median'])} ({short(grey['after_90'])})",
                "grey levels by which two frames differ where they show the same ground: median (and 90 %), "
                "before and after exposure, white balance and dark corners are evened out",
            )
        )
    seams = metrics.get("seams", {})
    if (cut := seams.get("least_difference")) is not None:
        nearest = seams["nearest_nadir"]
        out.append(
            (
                "seams",
                f"{short(nearest['difference_mean'])} ({short(nearest['difference_90'])})",
                f"{short(cut['difference_mean'])} ({short(cut['difference_90'])})",
                "grey levels by which both frames differ along the seams: mean (and 90 %), on lines halfway "
                "between frames and where they were cut instead",
            )
        )
        out.append(
            (
                "length of seams",
                short(nearest["length_m"], "m"),
                short(cut["length_m"], "m"),
                "in steps of the cells they are cut in",
            )
        )
        if (before := nearest.get("on_objects")) is not None:
            out.append(
                (
                    "seams on objects",
                    short(100.0 * before, "%"),
                    short(100.0 * cut["on_objects"], "%"),
                    "of their length, on what stands 2 m and more above the ground, by the elevation model",
                )
            )
    return out
