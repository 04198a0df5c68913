"""Ground control points and check points: OpenDroneMap's gcp_list.txt, or a table with named columns."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from geomosaic.constants import CHOSEN, Because
from geomosaic.doors.plain import shown
from geomosaic.errors import InputError
from geomosaic.geodesy.ellipsoid import mid_latitude_offset_m
from geomosaic.survey.accuracy import CONTROL, POSITION
from geomosaic.survey.model import ControlPoint, Warn
from geomosaic.survey.names import FrameNames, some
from geomosaic.survey.places import check_columns, given_crs, heights_of, lonlat_of
from geomosaic.survey.plausible import RESURVEYED
from geomosaic.survey.pos import ALIASES as POS_ALIASES
from geomosaic.survey.table import Aliases, Table, crs_of_line, read_lines, read_table

ALIASES: Final[Aliases] = {
    "name": ("name", "point", "point_name", "gcp", "gcp_name", "label", "id"),
    **{
        c: POS_ALIASES[c]
        for c in ("lon", "lat", "x", "y", "height_ellipsoidal", "height_orthometric", "height")
    },
    "sd_horizontal": POS_ALIASES["sd_horizontal"],
    "sd_vertical": POS_ALIASES["sd_vertical"],
    "kind": ("kind", "type", "role"),
    "image": ("image", "frame", "image_name", "file", "filename", "photo"),
    "col": ("col", "column", "im_x", "pixel_x", "image_x"),
    "row": ("row", "line", "im_y", "pixel_y", "image_y"),
}
"""Columns of a table of control points; a point has one line per image it was measured in, or one."""

Floats = NDArray[np.float64]
_FAR_M: Annotated[
    float,
    Because(
        "m",
        "from the farthest frame's reach to the nearest point: beyond, the CRS is another or columns are "
        "swapped; with less, points beside frames with bad positions would be refused",
        CHOSEN,
    ),
] = 5000.0
_MOST_LINES: Annotated[
    int,
    Because(
        "lines",
        "of a file of control: the most points in ten images each; without a limit a file of another "
        "kind would take memory and time",
        CHOSEN,
    ),
] = 200_000
_MOST_POINTS: Annotated[
    int,
    Because(
        "points", "one every two minutes for four months of working days; each adds to the solve", CHOSEN
    ),
] = 20_000
_ROUNDED_M: Annotated[
    float,
    Because(
        "m",
        "two lines that are as far apart as is refused may come out nearer by so much: places are read "
        "from decimal degrees; a metre to the digit is refused",
        CHOSEN,
    ),
] = 1e-6
LEAST_POINTS: Annotated[
    int,
    Because(
        "points",
        "that lay a block without positions onto the map; one leaves turn and scale open",
        "a similarity of the plane has four unknowns",
    ),
] = 2
_HEIGHTS: Final = ("height_ellipsoidal", "height_orthometric", "height")
_GCP_LIST: Final = ("x", "y", "height", "col", "row", "image", "name")


def read_control(path: Path, frames: FrameNames) -> tuple[tuple[ControlPoint, ...], list[Warn]]:
    """Control points with where they were measured in images, and what was assumed.

    A point is a check point if its `kind` says check, or its name starts with CHK. Without a name,
    lines of the same coordinates are one point. A point whose lines differ a little lies in their mean, with
    half their spread added to its deviation. Pixels are counted from the corner of the first pixel.

    Where all heights are 0 they are those of a list without heights: the points determine the plan alone.

    Raises: `InputError` naming the file, the line and the mend.
    """
    lines = read_lines(path, _MOST_LINES, "measurements")
    if not lines:
        raise InputError("the file of control points is empty", file=path, mend="give a line per measurement")
    crs = crs_of_line(lines[0].text)
    if crs is not None:
        table = read_table(path, lines[1:], ALIASES, _GCP_LIST)
    else:
        crs = given_crs(path, None)
        table = read_table(path, lines, ALIASES)
        check_columns(table, ALIASES, "name", "point's name")
    lonlat, _, warnings = lonlat_of(table, crs)
    heights, doubts = heights_of(table, crs, lonlat)
    plan_only = len(heights) > 1 and all(
        not np.nan_to_num(table.numbers(c), nan=1.0).any() for c in _HEIGHTS if c in table.factors
    )
    if plan_only:
        text = (
            f"{path.name}: all heights are 0, taken as not given: the points determine the plan, not heights"
        )
        heights, doubts = np.zeros(len(heights)), [Warn("control-plan-only", "", text)]
    warnings += doubts
    places = np.column_stack([lonlat, heights])
    named = table.texts("name")
    names = [
        name or f"{lon:.8f} {lat:.8f}" for name, (lon, lat, _) in zip(named, places.tolist(), strict=True)
    ]
    of: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        if math.isnan(heights[i]):
            mend = "give a column height_ellipsoidal_m"
            raise InputError(f"line {table.lines[i]}: point '{name}' has no height", file=path, mend=mend)
        of.setdefault(name, []).append(i)
    if len(of) > _MOST_POINTS:
        problem = f"has {len(of):,} points, more than {_MOST_POINTS:,}"
        raise InputError(problem, file=path, mend="take the best of them")
    merged = {name: _one_place(name, places[rows], table, rows) for name, rows in of.items()}
    warnings += [_unsteady(path, merged)] if any(any(spread) for _, spread in merged.values()) else []
    seen, strangers = _measurements(table, names, frames)
    stated = [table.numbers("sd_horizontal"), table.numbers("sd_vertical")]
    sd = [
        np.where(values > 0.0, values, usual)
        for values, usual in zip(stated, (CONTROL.sd_horizontal_m, CONTROL.sd_vertical_m), strict=True)
    ]
    kinds = table.texts("kind")
    points = tuple(
        ControlPoint(
            name=name,
            lon_deg=place[0],
            lat_deg=place[1],
            height_ellipsoidal_m=place[2],
            sd_horizontal_m=math.hypot(sd[0][of[name][0]], spread[0] / 2.0),
            sd_vertical_m=POSITION["none"].sd_vertical_m
            if plan_only
            else math.hypot(sd[1][of[name][0]], spread[1] / 2.0),
            check=_is_check(kinds[of[name][0]], name, table.lines[of[name][0]], path),
            images=tuple(seen.get(name, ())),
            plan_only=plan_only,
            sd_assumed=not any(values[of[name][0]] > 0.0 for values in stated),
        )
        for name, (place, spread) in merged.items()
    )
    if strangers:
        text = f"{path.name}: {len(strangers)} measurements in images that aren't here ({some(strangers)})"
        warnings.append(Warn("control-image-missing", "", text))
    return points, warnings


def _one_place(
    name: str, places: Floats, table: Table, rows: Sequence[int]
) -> tuple[tuple[float, float, float], tuple[float, float]]:
    """Mean longitude, latitude and height of a point's lines (n, 3), and their spread in plan and height (m).

    Raises: `InputError` naming the line that lies too far from the point's first.
    """
    plan_m = mid_latitude_offset_m(*places[0, :2], *places[:, :2].T)
    away_m = np.maximum(np.linalg.norm(plan_m, axis=1), np.abs(places[:, 2] - places[0, 2]))
    worst = int(np.argmax(away_m))
    if away_m[worst] >= RESURVEYED.value - _ROUNDED_M:
        problem = f"line {table.lines[rows[worst]]}: point '{name}' has moved by {away_m[worst]:.3g} m"
        raise InputError(problem, file=table.path, mend="give each point one position")
    from_first = places - places[0]
    from_first[:, 0] = (from_first[:, 0] + 180.0) % 360.0 - 180.0 if worst else 0.0
    lon, lat, height = (places[0] + from_first.mean(axis=0)).tolist()
    spread_m = np.linalg.norm(np.ptp(plan_m, axis=0)), np.ptp(places[:, 2])
    return (lon, lat, height), (float(spread_m[0]), float(spread_m[1]))


def _unsteady(path: Path, merged: Mapping[str, tuple[object, tuple[float, float]]]) -> Warn:
    """One line for all points whose lines differ, with the largest spread."""
    which = [name for name, (_, spread) in merged.items() if any(spread)]
    plan_m, height_m = (max(merged[name][1][k] for name in which) for k in (0, 1))
    text = (
        f"{path.name}: {len(which)} of {len(merged)} points ({some(which)}) have lines that differ, by up to "
        f"{plan_m:.3g} m in plan and {height_m:.3g} m in height; their mean is taken, with a wider deviation"
    )
    return Warn("control-spread", "", text)


def _measurements(
    table: Table, names: Sequence[str], frames: FrameNames
) -> tuple[dict[str, list[tuple[str, float, float]]], list[str]]:
    """Where each point was measured, and the images that aren't here."""
    cols, rows = table.numbers("col").tolist(), table.numbers("row").tolist()
    seen: dict[str, list[tuple[str, float, float]]] = {}
    strangers: list[str] = []
    for i, (name, image) in enumerate(zip(names, table.texts("image"), strict=True)):
        if image is None:
            continue
        frame = frames.find(image)
        if frame is None:
            strangers.append(image)
            continue
        for column, value in (("col", cols[i]), ("row", rows[i])):
            if math.isnan(value):
                mend = "fill it in or remove the line"
                raise InputError(f"line {table.lines[i]}: no {column}", file=table.path, mend=mend)
        seen.setdefault(name, []).append((frame, cols[i], rows[i]))
    return seen, strangers


def check_control(
    path: Path, points: Sequence[ControlPoint], lonlat: Floats, sizes_px: Mapping[str, tuple[int, int]]
) -> None:
    """Measurements lie in their images, and some point lies near the frames.

    Args: lonlat: (n, 2) of the frames whose position is known; sizes_px: width and height of each frame by
        name.
    Raises: `InputError` naming the first point that is wrong.
    """
    for point in points:
        for frame, col, row in point.images:
            width, height = sizes_px[frame]
            if not (0.0 <= col <= width and 0.0 <= row <= height):
                raise InputError(
                    f"point '{point.name}' is measured at {col:g}, {row:g} in {frame}, "
                    f"which has {width} x {height} pixels",
                    file=path,
                    mend="count pixels of the frame as it was taken, columns first",
                )
    if not points or not len(lonlat):
        return
    at = np.array([[p.lon_deg, p.lat_deg] for p in points])
    middle = np.broadcast_to(np.median(lonlat, axis=0), at.shape)
    extent = np.linalg.norm(
        mid_latitude_offset_m(*lonlat.T, *np.broadcast_to(middle[0], lonlat.shape).T), axis=1
    )
    away = np.linalg.norm(mid_latitude_offset_m(*at.T, *middle.T), axis=1)
    i = int(np.argmin(away))
    if away[i] > extent.max() + _FAR_M:
        raise InputError(
            f"all control points lie far from the frames, the nearest, '{points[i].name}', "
            f"{away[i] / 1000.0:.1f} km from their middle",
            file=path,
            mend="check the coordinate reference system and the order of the columns",
        )


def lonlat_of_control(path: Path, points: Sequence[ControlPoint]) -> Floats:
    """Longitudes and latitudes (n, 2) of the points that can stand in for the positions of all frames.

    Raises: `InputError` where fewer than two points for control are measured in the images.
    """
    used = [p for p in points if p.images and not p.check]
    if len(used) < LEAST_POINTS:
        raise InputError(
            f"no frame has a position, and {len(used) or 'no'} control point{'s'[: len(used) != 1]} "
            f"{'is' if len(used) == 1 else 'are'} measured in the images: they can't be put on a map",
            file=path,
            mend="measure at least 2 control points (3 for heights), or leave --gcp away for a mosaic in a "
            "local frame",
        )
    return np.array([[p.lon_deg, p.lat_deg] for p in used])


def _is_check(kind: str | None, name: str, line: int, path: Path) -> bool:
    kind = (kind or "").lower()
    if kind not in ("", "check", "checkpoint", "check point", "control", "gcp"):
        raise InputError(
            f"line {line}: kind {shown(kind)} is unknown", file=path, mend="write control or check"
        )
    return kind.startswith("check") or (not kind and name.upper().startswith("CHK"))
