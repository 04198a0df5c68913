"""Surveyed points with their marks: read from the file given and the one saved, written after every mark."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from pyproj import CRS

from geomosaic.errors import InputError, OutputError
from geomosaic.export.references import write_odm_control
from geomosaic.marking.oriented_frames import OrientedFrames
from geomosaic.pipeline import files
from geomosaic.survey.control import read_control
from geomosaic.survey.extent import lonlat_of
from geomosaic.survey.model import ControlPoint, Warn
from geomosaic.survey.names import FrameNames
from geomosaic.survey.places import NOWHERE

TABLE: Final = "gcp.csv"
LIST: Final = "gcp_list.txt"
_COLUMNS: Final = (
    "name", "kind", "lon_deg", "lat_deg", "height_ellipsoidal_m", "sd_horizontal_m", "sd_vertical_m", "image",
    "col", "row",
)  # fmt: skip
_CHECK: Final = "CHK"
"""What names of check points begin with in OpenDroneMap's list."""


def read_points(
    path: Path, folder: Path, frames: OrientedFrames, datum: CRS | None = None, crs: str | None = None
) -> tuple[tuple[ControlPoint, ...], tuple[Warn, ...]]:
    """The points of a file, with the marks and kinds that the folder's gcp.csv has for them, and what was
    assumed of the file. Points that only gcp.csv has come last.

    Args: datum: what heights of the file count from that state nothing else. crs: of x and y, where the file
    states none.
    Raises: `InputError` for a file that cannot be read, or marks of gcp.csv in frames that are not there.
    Raises: `OutputError` where a file that this command did not write would be replaced.
    """
    names = FrameNames(frame.name for frame in frames.frames)
    positions = [frame.position for frame in frames.frames]
    near = lonlat_of([p for p in positions if p.known] or positions) if frames.on_earth else NOWHERE
    try:
        given = read_control(path, names, near, datum, crs)
    except InputError as error:
        error.reword(lambda text: text.replace("--gcp", "--points"))
        raise
    notes = [*given.notes]
    if given.absent:
        text = f"{len(given.absent)} marks are in images that are not in the folder and are left out; "
        text += "give the folder that holds these images to keep them"
        notes.append(Warn("control-image-missing", "", f"{path.name}: {text}"))
    points = {point.name: point for point in given.points}
    _check_own(folder)
    if (folder / TABLE).is_file():
        saved = read_control(folder / TABLE, names, near)
        if saved.absent:
            problem = f"has {len(saved.absent)} marks in images that are not in the folder of frames"
            fix = "give the folder of all frames, or another folder for the marks with -o"
            raise InputError(problem, file=folder / TABLE, fix=fix)
        for point in saved.points:
            known = points.get(point.name, point)
            points[point.name] = replace(known, images=point.images, check=point.check)
    return tuple(points.values()), tuple(notes)


def _check_own(folder: Path) -> None:
    """Raises `OutputError` where gcp.csv or gcp_list.txt is there and was not written by `save_points`."""
    table = folder / TABLE
    if table.is_file():
        with table.open(encoding="utf-8", errors="replace") as file:
            if file.readline().rstrip() == ",".join(_COLUMNS):
                return
    for path in (table, folder / LIST):
        if path.exists():
            fix = "give another folder for the marks with -o"
            raise OutputError("is in the way, and geomosaic did not make it", file=path, fix=fix)


def save_points(folder: Path, points: Sequence[ControlPoint], crs: str) -> None:
    """Writes gcp.csv and gcp_list.txt, each as a whole. crs: of the list's x and y, a map's.

    Raises: `OutputError` where they cannot be written.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(_COLUMNS)
    table.writerows(row for point in points for row in _rows(point))
    files.write_bytes(folder / TABLE, text.getvalue().encode())
    with files.writing(folder / LIST) as temporary:
        write_odm_control(temporary, [replace(p, name=_name_in_list(p)) for p in points], crs)


def _rows(point: ControlPoint) -> list[list[str]]:
    """A line per mark, or one without; what was not given stays empty."""
    height = "" if point.plan_only else f"{point.height_ellipsoidal_m:.4f}"
    horizontal = "" if point.sd_assumed else f"{point.sd_horizontal_m:g}"
    vertical = "" if point.sd_assumed or point.plan_only else f"{point.sd_vertical_m:g}"
    kind = "check" if point.check else "control"
    place = [f"{point.lon_deg:.10f}", f"{point.lat_deg:.10f}", height, horizontal, vertical]
    marks = [[image, f"{col:.3f}", f"{row:.3f}"] for image, col, row in point.images]
    return [[point.name, kind, *place, *mark] for mark in marks or [["", "", ""]]]


def _name_in_list(point: ControlPoint) -> str:
    """A name that says of itself whether the point is a check point: the list has no column for it."""
    begins = point.name.upper().startswith(_CHECK)
    if point.check:
        return point.name if begins else f"{_CHECK}-{point.name}"
    return f"GCP-{point.name}" if begins else point.name
