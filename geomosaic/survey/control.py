"""Ground control points and check points: OpenDroneMap's gcp_list.txt, or a table with named columns."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pyproj import CRS

from geomosaic.arrays import Floats
from geomosaic.constants import SLIGHT, sourced
from geomosaic.doors.files import MOST_PARTS
from geomosaic.doors.plain import shown
from geomosaic.errors import InputError
from geomosaic.geodesy.ellipsoid import mid_latitude_offset_m
from geomosaic.survey.accuracy import CONTROL, POSITION
from geomosaic.survey.control_table import GIVE_CRS, control_table
from geomosaic.survey.model import ControlPoint, Warn
from geomosaic.survey.names import FrameNames, some
from geomosaic.survey.places import NOWHERE, places_of
from geomosaic.survey.plausible import RESURVEYED
from geomosaic.survey.pos import deviation
from geomosaic.survey.table import ParsedTable
from geomosaic.survey.table_heights import HEIGHTS, heights_of, in_units_of

LEAST_POINTS = sourced(2, "points", "that place a block without positions", "a similarity has 4 unknowns")


@dataclass(frozen=True)
class ControlFile:
    """What a file of control points holds. absent: point and image of each mark in an image that is not in
    the survey; notes: what was assumed."""

    path: Path
    points: tuple[ControlPoint, ...]
    absent: tuple[tuple[str, str], ...]
    notes: tuple[Warn, ...]


def read_control(
    path: Path,
    frames: FrameNames,
    near: Floats = NOWHERE,
    datum: CRS | None = None,
    crs: str | None = None,
) -> ControlFile:
    """Control points with where they were measured in images, and what was assumed.

    A point is a check point if its `kind` says check, or its name starts with CHK. Without a name,
    lines of the same coordinates are one point. A point whose lines differ a little lies in their mean, with
    half their spread added to its deviation. Pixels are counted from the corner of the first pixel.

    A point without a height determines the plan alone; where all heights are 0 none has one.

    Args: near: longitudes and latitudes (k, 2) of the frames, where these have positions. datum: what
    heights count from that state nothing else. crs: of x and y, where the file does not state one.
    Raises: `InputError` naming the file, the line and the fix.
    """
    table, stated = control_table(path, frames, crs)
    found = places_of(table, stated, near, GIVE_CRS)
    table, units = in_units_of(table, found.crs, datum)
    heights, doubts = heights_of(table, found.crs, found.lonlat, datum)
    given = np.concatenate([table.numbers(c) for c in HEIGHTS if c in table.factors] or [heights])
    if len(heights) > 1 and np.isfinite(given).any() and not np.nan_to_num(given).any():
        heights, doubts = np.full(len(heights), np.nan), []
    places = np.column_stack([found.lonlat, heights])
    of: dict[str, list[int]] = {}
    for i, (name, (lon, lat, _)) in enumerate(zip(table.texts("name"), places.tolist(), strict=True)):
        of.setdefault(name or f"{lon:.8f} {lat:.8f}", []).append(i)
    if len(of) > MOST_PARTS:
        problem = f"has {len(of):,} points, more than {MOST_PARTS:,}"
        raise InputError(problem, file=path, fix="leave out the less accurate ones")
    merged = {name: _one_place(name, places[rows], table, rows) for name, rows in of.items()}
    seen, absent = _measurements(table, of, frames)
    marks, repeated = _once_an_image(path, seen)
    stated_m = _stated_deviations_m(table)
    known_m = [place[2] for place, _ in merged.values() if not math.isnan(place[2])]
    stand_in_m = float(np.median(known_m)) if known_m else 0.0
    points = []
    for name, (place, spread) in merged.items():
        rows = of[name]
        plan_only = math.isnan(place[2])
        sd_m = np.fmax.reduce(stated_m[rows], axis=0)
        usual_m = np.where(np.isnan(sd_m), [CONTROL.sd_horizontal_m, CONTROL.sd_vertical_m], sd_m)
        point = ControlPoint(
            name=name,
            lon_deg=place[0],
            lat_deg=place[1],
            height_ellipsoidal_m=stand_in_m if plan_only else place[2],
            sd_horizontal_m=math.hypot(usual_m[0], spread[0] / 2.0),
            sd_vertical_m=POSITION["none"].sd_vertical_m
            if plan_only
            else math.hypot(usual_m[1], spread[1] / 2.0),
            check=_is_check(name, table, rows),
            images=marks.get(name, ()),
            plan_only=plan_only,
            sd_assumed=bool(np.isnan(sd_m).all()),
        )
        points.append(point)
    notes = [_unused_columns(table), _plan_only(path, points), _unsteady(path, merged)]
    return ControlFile(
        path=path,
        points=tuple(points),
        absent=tuple(absent),
        notes=(*found.notes, *units, *doubts, *repeated, *(note for note in notes if note is not None)),
    )


def _stated_deviations_m(table: ParsedTable) -> Floats:
    """Deviations (n, 2) in plan and in height that a table states, NaN where it doesn't."""
    both = deviation(table, "sd")
    stated = (deviation(table, "sd_horizontal", "sd_e", "sd_n"), deviation(table, "sd_vertical"))
    return np.column_stack([np.where(np.isnan(sd), both, sd) for sd in stated])


def _one_place(
    name: str, places: Floats, table: ParsedTable, rows: Sequence[int]
) -> tuple[tuple[float, float, float], tuple[float, float]]:
    """Mean longitude, latitude and height of a point's lines (n, 3), and their spread in plan and height (m).

    The height is NaN where no line has one.

    Raises: `InputError` naming the line that lies too far from the point's first.
    """
    plan_m = mid_latitude_offset_m(*places[0, :2], *places[:, :2].T)
    heights_m = places[np.isfinite(places[:, 2]), 2]
    off_m = np.abs(places[:, 2] - heights_m[0]) if heights_m.size else np.zeros(len(places))
    away_m = np.fmax(np.linalg.norm(plan_m, axis=1), off_m)
    worst = int(np.argmax(away_m))
    if away_m[worst] >= RESURVEYED.value - SLIGHT:
        problem = f"point '{name}' stands {away_m[worst]:.3g} m from its first line"
        raise table.error(rows[worst], problem, "give each point one position, or another name")
    from_first = places[:, :2] - places[0, :2]
    from_first[:, 0] = (from_first[:, 0] + 180.0) % 360.0 - 180.0 if worst else 0.0
    lon, lat = (places[0, :2] + from_first.mean(axis=0)).tolist()
    if not heights_m.size:
        return (lon, lat, math.nan), (float(np.linalg.norm(np.ptp(plan_m, axis=0))), 0.0)
    height = float(heights_m[0] + (heights_m - heights_m[0]).mean())
    return (lon, lat, height), (float(np.linalg.norm(np.ptp(plan_m, axis=0))), float(np.ptp(heights_m)))


def _unused_columns(table: ParsedTable) -> Warn | None:
    """One line for the columns whose names are not known."""
    if not table.unknown_columns:
        return None
    text = f"{table.path.name}: columns not used: {some(table.unknown_columns, 20)}; name those "
    text += "that matter lon, lat, x, y, height, image, col, row or sd"
    return Warn("control-columns-ignored", "", text)


def _plan_only(path: Path, points: Sequence[ControlPoint]) -> Warn | None:
    """One line for all points without a height."""
    which = [p.name for p in points if p.plan_only]
    if not which:
        return None
    what = (
        "all heights are 0 or missing"
        if len(which) == len(points)
        else f"{len(which)} of {len(points)} points ({some(which)}) have no height"
    )
    text = (
        f"{path.name}: {what}, so the points place the map in plan only; give heights to place it in "
        "height too"
    )
    return Warn("control-plan-only", "", text)


def _unsteady(path: Path, merged: Mapping[str, tuple[object, tuple[float, float]]]) -> Warn | None:
    """One line for all points whose lines differ, with the largest spread."""
    which = [name for name, (_, spread) in merged.items() if any(spread)]
    if not which:
        return None
    plan_m, height_m = (max(merged[name][1][k] for name in which) for k in (0, 1))
    text = (
        f"{path.name}: {len(which)} of {len(merged)} points ({some(which)}) have lines that differ, by up to "
        f"{plan_m:.3g} m in plan and {height_m:.3g} m in height; their mean is used with a larger "
        "standard deviation; correct the lines that are wrong"
    )
    return Warn("control-spread", "", text)


def _measurements(
    table: ParsedTable, of: Mapping[str, Sequence[int]], frames: FrameNames
) -> tuple[dict[str, list[tuple[str, float, float]]], list[tuple[str, str]]]:
    """Where each point was measured, by its name and lines, and those in images that are not here."""
    names = {i: name for name, rows in of.items() for i in rows}
    cols, rows = table.numbers("col").tolist(), table.numbers("row").tolist()
    seen: dict[str, list[tuple[str, float, float]]] = {}
    absent: list[tuple[str, str]] = []
    for i, image in enumerate(table.texts("image")):
        if image is None:
            continue
        frame = frames.find(image)
        if frame is None:
            absent.append((names[i], image))
            continue
        for column, value in (("col", cols[i]), ("row", rows[i])):
            if math.isnan(value):
                raise table.error(i, f"no {column}", "fill it in or remove the line")
        seen.setdefault(names[i], []).append((frame, cols[i], rows[i]))
    return seen, absent


def _once_an_image(
    path: Path, seen: Mapping[str, Sequence[tuple[str, float, float]]]
) -> tuple[dict[str, tuple[tuple[str, float, float], ...]], list[Warn]]:
    """The marks of each point, one an image: the mean of those that stand there more than once."""
    once, apart = {}, []
    for name, marks in seen.items():
        by_image: dict[str, list[tuple[float, float]]] = {}
        for frame, col, row in marks:
            by_image.setdefault(frame, []).append((col, row))
        means = {frame: np.mean(at, axis=0).tolist() for frame, at in by_image.items()}
        once[name] = tuple((frame, col, row) for frame, (col, row) in means.items())
        apart += [
            (float(np.hypot(*np.ptp(at, axis=0))), name, frame)
            for frame, at in by_image.items()
            if len(at) > 1
        ]
    differ = sorted((which for which in apart if which[0] > 0.0), reverse=True)
    if not differ:
        return once, []
    places = some(f"{name} in {frame}, {px:.3g} px" for px, name, frame in differ)
    text = (
        f"{path.name}: marks of one point in one image that differ ({places}); their mean is used; "
        "remove the wrong ones"
    )
    return once, [Warn("control-mark-repeated", "", text)]


def _is_check(name: str, table: ParsedTable, rows: Sequence[int]) -> bool:
    """Whether a point is a check point, by the kind in any of its lines, else by its name.

    Raises: `InputError` naming the line of an unknown kind, or of one that contradicts another line's.
    """
    kinds = table.texts("kind")
    lines: dict[bool, int] = {}
    for i in rows:
        kind = re.sub(r"[\s_-]+", " ", (kinds[i] or "").lower()).removeprefix("3d ").removeprefix("2d ")
        if kind not in ("", "check", "checkpoint", "check point", "control", "control point", "gcp"):
            raise table.error(i, f"kind {shown(str(kinds[i]))} is unknown", "write control or check")
        if kind:
            lines.setdefault(kind.startswith("check"), i)
    if len(lines) > 1:
        problem = f"point {shown(name)} is for check here and for control in line {table.lines[lines[False]]}"
        raise table.error(lines[True], problem, "give it the same kind in all its lines")
    return next(iter(lines)) if lines else name.upper().startswith("CHK")
