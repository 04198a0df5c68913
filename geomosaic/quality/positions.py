"""True poses from a positions.csv, to judge adjusted ones by."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import Rotation
from geomosaic.doors.files import TEXT_BYTES, read_text
from geomosaic.errors import FileError, UnknownNameError
from geomosaic.geodesy.local import LocalFrame

_NUMBERS = ("lon_deg", "lat_deg", "height_ellipsoidal_m", "yaw_deg", "pitch_deg", "roll_deg")


def read_poses(path: Path, names: Sequence[str], work_frame: LocalFrame) -> Poses:
    """The poses of the named frames, in their order, from a file with positions.csv's columns.

    yaw is the true heading of the image's top edge, pitch_deg -90 at the nadir, roll the body's.
    Standard deviations are zero: the file is taken as the truth.

    Raises: FileError for a file that isn't such a table, UnknownNameError for a frame it lacks.
    """
    rows = _rows(path)
    for name in names:
        if name not in rows:
            raise UnknownNameError("frame", name, rows, file=path)
    table = np.array([rows[name] for name in names], dtype=np.float64).reshape(-1, 6)
    lon, lat, height = table[:, :3].T
    yaw, pitch, roll = np.radians(table[:, 3:]).T
    local = Rotation.from_yaw_pitch_roll(yaw, pitch + np.pi / 2.0, roll).matrix
    zeros = np.zeros((len(names), 3))
    return Poses(
        work_frame.enu_from_geodetic(lon, lat, height),
        work_frame.enu_from_local_rotation(lon, lat) @ local,
        zeros,
        zeros,
    )


def _rows(path: Path) -> dict[str, list[float]]:
    text = read_text(path, TEXT_BYTES, "a positions.csv", "give a positions.csv")
    try:
        reader = csv.DictReader(io.StringIO(text, newline=""))
        columns, rows = reader.fieldnames or (), list(reader)
    except csv.Error as error:
        raise FileError(f"can't be read: {error}", file=path, fix="give a positions.csv") from error
    missing = [c for c in ("frame", *_NUMBERS) if c not in columns]
    if missing:
        raise FileError(
            f"no column '{missing[0]}'", file=path, fix="give a positions.csv as geomosaic writes it"
        )
    out = {}
    for line, row in enumerate(rows, start=2):
        if row.get("status") == "left_out" or (row.get("status") == "rejected" and not row["lon_deg"]):
            continue
        try:
            numbers = [float(row[c]) for c in _NUMBERS]
            if not all(map(math.isfinite, numbers)):
                raise ValueError("a number isn't finite")
            out[row["frame"]] = numbers
        except (ValueError, TypeError) as error:
            raise FileError(f"line {line}: {error}", file=path, fix="correct the row") from error
    return out
