"""Adjusted positions and attitudes and control points as Metashape, Pix4D and OpenDroneMap take them."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.camera.rotation import Rotation, about_z
from geomosaic.export.orientation import Orientations
from geomosaic.geodesy.mapcrs import MapProjection, utm_crs
from geomosaic.survey.model import ControlPoint

_DEGREES: Final = 9
_METRES: Final = 4
_ANGLES: Final = 6
_NADIR_DEG: Final = 90.0
"""What is added to our pitch, -90 at the nadir, for programs that count from there."""


def write_metashape(path: Path, o: Orientations) -> None:
    """Metashape's camera reference (Import Reference): yaw, pitch and roll, 0 at the nadir; WGS 84.

    Deviations of the angles are not in it: Metashape's are of its own angles.
    """
    head = [
        "#Label", "X/Longitude", "Y/Latitude", "Z/Altitude", "Accuracy_X/Y_(m)", "Accuracy_Z_(m)", "Yaw",
        "Pitch", "Roll",
    ]  # fmt: skip
    _write(path, head, _rows(o, [0, 1, 2], _nadir_angles(o)), ",")


def write_pix4d(path: Path, o: Orientations) -> None:
    """Pix4D's image geolocation with omega, phi, kappa in the axes of the UTM zone of the first frame, since
    the file names no system; WGS 84, no head."""
    lon, lat = o.lon_lat_height[:, 0], o.lon_lat_height[:, 1]
    known = np.flatnonzero(np.isfinite(lon))
    angles_deg = o.omega_phi_kappa_deg
    if known.size:
        utm = MapProjection(utm_crs(float(lon[known[0]]), float(lat[known[0]])))
        north = about_z(utm.grid_convergence_rad(lon, lat))
        yaw, pitch, roll = np.radians(np.add(o.yaw_pitch_roll_deg, [0.0, _NADIR_DEG, 0.0])).T
        turned = Rotation(north @ Rotation.from_yaw_pitch_roll(yaw, pitch, roll).matrix)
        angles_deg = np.degrees(np.stack(turned.omega_phi_kappa(), axis=-1))
    _write(path, None, _rows(o, [1, 0, 2], angles_deg, accuracy_last=True), ",")


def write_odm_geo(path: Path, o: Orientations) -> None:
    """OpenDroneMap's geo.txt: name, lon, lat, height, yaw, pitch, roll (0 at the nadir), accuracies."""
    rows = _rows(o, [0, 1, 2], _nadir_angles(o), accuracy_last=True)
    known = [row[: row.index("")] if "" in row else row for row in rows]  # blanks part the columns
    _write(path, ["EPSG:4326"], known, " ")


def write_odm_control(path: Path, points: Iterable[ControlPoint], crs: str) -> None:
    """OpenDroneMap's gcp_list.txt: of each image that a point was measured in a line.

    A CRS that is neither an EPSG code nor a PROJ string is none that it reads: then places are in degrees.
    """
    decimals = _METRES
    if not crs.startswith(("EPSG:", "+proj")):
        crs, decimals = "EPSG:4326", _DEGREES
    projection = MapProjection(crs)
    rows = []
    for point in points:
        x, y = projection.map_from_geodetic(point.lon_deg, point.lat_deg)
        height = "NaN" if point.plan_only else f"{point.height_ellipsoidal_m:.4f}"
        place = [f"{float(x):.{decimals}f}", f"{float(y):.{decimals}f}", height]
        rows += [
            [*place, f"{col:.3f}", f"{row:.3f}", image, "_".join(point.name.split())]
            for image, col, row in point.images
        ]
    _write(path, [crs], rows, " ")


def _rows(
    o: Orientations, place: list[int], angles_deg: Floats, *, accuracy_last: bool = False
) -> list[list[str]]:
    """Of each frame that isn't rejected: name, its place in this order, accuracy per horizontal axis and
    vertically, angles."""
    decimals = (_DEGREES, _DEGREES, _METRES)
    flat_m = np.hypot(o.sd_m[:, 0], o.sd_m[:, 1]) / np.sqrt(2.0)
    rows = []
    for k, name in enumerate(o.names):
        if o.status[k] == "rejected":
            continue
        at = [f"{o.lon_lat_height[k, i]:.{decimals[i]}f}" for i in place]
        accuracy = [_number(flat_m[k], _METRES), _number(o.sd_m[k, 2], _METRES)]
        angles = [_number(angle, _ANGLES) for angle in angles_deg[k]]
        rows.append([name, *at, *(angles + accuracy if accuracy_last else accuracy + angles)])
    return rows


def _nadir_angles(o: Orientations) -> Floats:
    return np.asarray(o.yaw_pitch_roll_deg + np.array([0.0, _NADIR_DEG, 0.0]))


def _number(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}" if np.isfinite(value) else ""


def _write(path: Path, head: list[str] | None, rows: list[list[str]], separator: str) -> None:
    """Raises `OSError` if the file can't be written."""
    with path.open("w", encoding="utf-8", newline="") as file:
        if separator == " ":
            lines = [*([] if head is None else [head]), *rows]
            file.writelines(" ".join(line).rstrip() + "\n" for line in lines)
            return
        table = csv.writer(file, delimiter=separator, lineterminator="\n")
        table.writerows([*([] if head is None else [head]), *rows])
