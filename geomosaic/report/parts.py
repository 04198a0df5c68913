"""What the report of frames shows, worked out of the artefacts: tables, and plots as SVG."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.camera.interior import Camera
from geomosaic.composition.model import Trimmed
from geomosaic.export.orientation import Orientations
from geomosaic.geodesy.mapcrs import is_local
from geomosaic.matching.model import TiePoints
from geomosaic.placement.model import Placement
from geomosaic.quality import ranking
from geomosaic.quality.misalignment import PairMisalignments
from geomosaic.quality.solved_tables import DOWN_WEIGHTED, tie_weights
from geomosaic.report.numbers import UNKNOWN, on_ground, percent, short
from geomosaic.report.plots import Axis, Series, histogram, line_plot
from geomosaic.report.table import Cell, ReportTable, TableRow, count, number
from geomosaic.survey.model import Survey

_WORST_PAIRS = 15
_MOST_ROWS = 3000
_STATUS = {
    "tied": "joined to its neighbours by tie points",
    "placed": "placed by its position and attitude alone",
    "rejected": "left out of the mosaic",
}


def frame_table(
    placement: Placement,
    ties: TiePoints,
    adjusted: Adjusted,
    orientation: Orientations,
    warned: Mapping[str, int],
) -> ReportTable:
    """Frames in order of the survey: how far each was moved (3D) and turned from its POS, what is left at its
    tie points, how sure its place is. Lengths are in ground pixels in a local frame.

    warned: how often each is named in a warning.
    """
    n = len(orientation.names)
    points, taken = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    squares = np.zeros(n)
    for pair in ties.pairs:
        points[[pair.left, pair.right]] += len(pair)
    weights = tie_weights(ties, adjusted.image_residuals)
    for pair, residual, weight in zip(ties.pairs, adjusted.residuals_m, weights, strict=False):
        counts = np.isfinite(residual).all(axis=1) & ~(weight < DOWN_WEIGHTED)
        squares[[pair.left, pair.right]] += float(np.square(residual[counts]).sum())
        taken[[pair.left, pair.right]] += int(counts.sum())
    left_m = np.where(taken > 0, np.sqrt(squares / np.maximum(taken, 1)), np.nan)
    sd_m = np.linalg.norm(orientation.sd_m[:, :2], axis=1)
    local = bool(np.isnan(orientation.lon_lat_height[:, 0]).all())
    unit, unit_m = ("px", placement.ground_pixel_m) if local else ("m", 1.0)
    rows = [
        TableRow(
            i,
            orientation.status[i],
            (
                Cell(name),
                Cell(orientation.status[i]),
                number(float(left_m[i] / placement.ground_pixel_m), "px"),
                number(float(orientation.moved_m[i] / unit_m), unit),
                number(float(orientation.turned_deg[i]), "°"),
                number(float(sd_m[i] / unit_m), unit),
                count(int(points[i])),
                count(warned.get(name, 0)),
                count(placement.lines[i]),
            ),
        )
        for i, name in enumerate(orientation.names[:_MOST_ROWS])
    ]
    return ReportTable(
        "frame",
        (
            ("frame", False), ("status", False), ("residual", True), ("moved", True), ("turned", True),
            ("± in plan", True), ("tie points", True), ("warnings", True), ("line", True),
        ),
        rows,
        tuple(_STATUS.items()),
        n - len(rows),
        "positions.csv",
    )  # fmt: skip


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


def residuals_plot(adjusted: Adjusted, ground_pixel_m: float) -> str | None:
    """Histogram of the tie points' residual lengths; None without residuals."""
    left = [r for r in adjusted.residuals_m if len(r)]
    if not left:
        return None
    length = np.linalg.norm(np.concatenate(left), axis=1) / ground_pixel_m
    return histogram(length, Axis("residual", "ground px"), label="residuals of the tie points on the ground")


def worst_pairs(
    survey: Survey, pairs: PairMisalignments, pixel_m: float | None = None
) -> list[dict[str, object]]:
    """The pairs with the largest residuals. pixel_m: what these are stated in, in a local frame."""
    return [
        {
            "left": survey.frames[pairs.left[i]].name,
            "right": survey.frames[pairs.right[i]].name,
            "points": int(pairs.points[i]),
            "mean": on_ground(float(pairs.length_m[i]), pixel_m),
            "rms": on_ground(float(pairs.rms_m[i]), pixel_m),
            "largest": on_ground(float(pairs.max_m[i]), pixel_m),
        }
        for i in ranking.worst_pairs(pairs.rms_m, _WORST_PAIRS)
        if np.isfinite(pairs.rms_m[i])
    ]


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
    return short(value, unit, 6)


def trimmed_rows(trimmed: Trimmed | None, map_crs: str) -> list[tuple[str, str, str]]:
    """What the mosaic leaves out of the land that frames see: why, its area where the map has a scale, and
    share."""
    if trimmed is None or not trimmed.parts:
        return []
    return [
        (
            part.reason,
            UNKNOWN if is_local(map_crs) else f"{short(part.area_m2 / 1e4)} ha",
            percent(part.area_m2 / trimmed.seen_m2),
        )
        for part in trimmed.parts
    ]


def composition_rows(
    metrics: Mapping[str, Any], pixel_m: float | None = None
) -> list[tuple[str, str, str, str]]:
    """How frames were evened and where their seams lie: name, before, after, what it means. None where frames
    stayed as they are. pixel_m: what lengths are stated in, in a local frame."""
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
                on_ground(nearest["length_m"], pixel_m),
                on_ground(cut["length_m"], pixel_m),
                "in steps of the cells they are cut in",
            )
        )
        if (before := nearest.get("on_objects")) is not None:
            out.append(
                (
                    "seams on objects",
                    percent(before),
                    percent(cut["on_objects"]),
                    "of their length, on what stands 2 m and more above the ground, by the elevation model",
                )
            )
    return out
