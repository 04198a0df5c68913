"""POS files: position and attitude of frames, in the many ways they are written down."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from pyproj import CRS

from geomosaic.arrays import Floats
from geomosaic.errors import InputError
from geomosaic.geodesy.crs_names import StatedCrs, crs_of, required_crs
from geomosaic.geodesy.mapcrs import MapProjection, utm_crs
from geomosaic.survey.attitude import read_angles
from geomosaic.survey.column_names import Aliases
from geomosaic.survey.head import has_numbers, names_known, read_head
from geomosaic.survey.model import Warn
from geomosaic.survey.names import NO_NAMES, FrameNames, some
from geomosaic.survey.places import NOWHERE, check_columns, given_crs, places_of
from geomosaic.survey.pos_row import PosFile, PosRow
from geomosaic.survey.rtklib_events import is_rtklib_events, read_rtklib_events
from geomosaic.survey.table import Line, ParsedTable, quoted_image, read_lines, read_table, split
from geomosaic.survey.table_heights import heights_of, in_units_of
from geomosaic.survey.timestamp_mrk import is_timestamp_mrk, read_timestamp_mrk

ALIASES: Final[Aliases] = {
    "frame": (
        "frame", "image", "image_name", "imagename", "img", "file", "filename", "file_name", "name", "label",
        "photo", "photo_name", "photoid", "photo_id", "picture", "sourcefile", "image_id", "imageid",
        "image_file",
    ),
    "lon": (
        "lon", "long", "lng", "longitude", "gps_longitude", "gpslongitude", "gps_lon", "gps_long",
        "longitude_x",
    ),
    "lat": ("lat", "latitude", "gps_latitude", "gpslatitude", "gps_lat", "latitude_y"),
    "lon_ref": ("lon_ref", "longitude_ref", "longituderef", "gpslongituderef", "gps_longitude_ref"),
    "lat_ref": ("lat_ref", "latitude_ref", "latituderef", "gpslatituderef", "gps_latitude_ref"),
    "x": ("x", "e", "east", "easting", "x_east", "x_easting", "x_longitude", "geo_x"),
    "y": ("y", "n", "north", "northing", "y_north", "y_northing", "y_latitude", "geo_y"),
    "height_ellipsoidal": (
        "height_ellipsoidal", "ellipsoidal_height", "height_ellipsoid", "ellipsoid_height", "h_ell", "hae",
        "altitude_ellipsoidal", "altitude_wgs84", "height_wgs84", "alt_wgs84", "wgs84_height",
        "wgs84_altitude", "ell_height", "ellip_height", "z_ellipsoidal",
    ),
    "height_orthometric": (
        "height_orthometric", "orthometric_height", "altitude_msl", "height_msl", "alt_msl", "amsl",
        "msl", "msl_height", "msl_altitude", "altitudemsl", "altitude_amsl", "height_amsl", "elevation_msl",
        "z_msl", "altitude_orthometric", "height_geoid",
    ),
    "height": (
        "height", "altitude", "alt", "z", "h", "elevation", "elev", "gps_altitude", "gpsaltitude",
        "gps_height", "gps_alt", "gps_elevation", "z_altitude", "absolute_altitude", "absolutealtitude",
        "height_z", "geo_z",
    ),
    "height_above_ground": (
        "height_above_ground", "agl", "alt_agl", "altitude_agl", "relative_altitude", "relativealtitude",
    ),
    "yaw": ("yaw", "heading", "hdg", "camera_yaw"),
    "pitch": ("pitch", "camera_pitch"),
    "roll": ("roll", "camera_roll"),
    "gimbal_yaw": ("gimbal_yaw", "gimbalyaw", "gimbalyawdegree", "gimbal_yaw_degree"),
    "gimbal_pitch": ("gimbal_pitch", "gimbalpitch", "gimbalpitchdegree", "gimbal_pitch_degree"),
    "gimbal_roll": ("gimbal_roll", "gimbalroll", "gimbalrolldegree", "gimbal_roll_degree"),
    "omega": ("omega",),
    "phi": ("phi",),
    "kappa": ("kappa",),
    "sd_horizontal": (
        "sd_horizontal", "accuracy_horizontal", "horizontal_accuracy", "horz_accuracy", "accuracy_horz",
        "accuracy_xy", "accuracy_x_y", "sigma_xy", "sd_xy", "lateral_rms", "hrms", "h_rms", "hacc", "h_acc",
    ),
    "sd_vertical": (
        "sd_vertical", "accuracy_vertical", "vertical_accuracy", "vert_accuracy", "accuracy_vert",
        "accuracy_z", "sigma_z", "sd_z", "sd_u", "sdu", "std_u", "std_z", "elevation_rms", "vrms", "v_rms",
        "vacc", "v_acc",
    ),
    "sd_e": ("sd_e", "sigma_x", "sd_x", "sd_easting", "sde", "easting_rms", "std_e", "std_x", "accuracy_x"),
    "sd_n": ("sd_n", "sigma_y", "sd_y", "sd_northing", "sdn", "northing_rms", "std_n", "std_y", "accuracy_y"),
    "sd_yaw": ("sd_yaw", "sigma_yaw", "sd_kappa", "sigma_kappa"),
    "sd_tilt": ("sd_tilt", "sigma_tilt"),
    "sd_omega": ("sd_omega", "sigma_omega", "sd_roll", "sigma_roll"),
    "sd_phi": ("sd_phi", "sigma_phi", "sd_pitch", "sigma_pitch"),
    "camera": ("camera", "camera_name"),
    "moved": ("moved",),
    "turned": ("turned",),
    "status": ("status",),
}  # fmt: skip
"""Columns and the names they go by; capitals, blanks and units don't matter. docs/inputs.md has it too."""

_ANGLES: Final = (
    ("yaw", "pitch", "roll"), ("gimbal_yaw", "gimbal_pitch", "gimbal_roll"), ("omega", "phi", "kappa")
)  # fmt: skip
_GEO_TXT: Final = ("frame", "x", "y", "height", "yaw", "pitch", "roll", "sd_horizontal", "sd_vertical")
_GIVE_CRS: Final = "give the EPSG code of x and y with --pos-crs, such as EPSG:n"
_PIX4D: Final = ("frame", "lat", "lon", "height", "sd_horizontal", "sd_vertical")
_PIX4D_TURNED: Final = (*_PIX4D[:4], "omega", "phi", "kappa", *_PIX4D[4:])


def read_pos(
    path: Path,
    *,
    crs: str | None = None,
    attitude_convention: str = "auto",
    frames: FrameNames = NO_NAMES,
    datum: CRS | None = None,
) -> PosFile:
    """Read a POS file: a table with named columns, ODM's geo.txt, Pix4D's table without a header, DJI's
    Timestamp.MRK, or RTKLIB's events.

    Args: crs of x and y (and, if it has heights, of those), where neither geo.txt's first line nor a
    companion .prj file says so; attitude_convention, one of `attitude.CONVENTIONS`; frames: among
    whose names those with blanks are found; datum: what heights count from that state nothing else.
    Raises: `InputError` naming the file, the line and the fix.
    """
    if is_timestamp_mrk(path):
        return read_timestamp_mrk(path, frames)
    if is_rtklib_events(path):
        return read_rtklib_events(path, frames)
    notes: list[Warn] = []
    table, stated, pix4d = _table(path, crs, frames, notes)
    if attitude_convention == "auto":
        table = _without_empty_angles(table, notes)
    if table.unknown_columns:
        unused = some(table.unknown_columns, 20)
        text = (
            f"{path.name}: columns not used: {unused}; name those that matter lon, lat, x, y, height, yaw, "
        )
        text += "pitch, roll, sd_horizontal or sd_vertical"
        notes.append(Warn("pos-columns-ignored", "", text))
    places = places_of(table, stated, NOWHERE, _GIVE_CRS)
    lonlat = places.lonlat
    table, units = in_units_of(table, places.crs, datum)
    heights, doubts = heights_of(table, places.crs, lonlat, datum)
    grid = places.projection or (MapProjection(utm_crs(*lonlat[0])) if pix4d else None)
    angles, source, assumed = read_angles(table, attitude_convention, grid, lonlat)
    names, lines = table.texts("frame"), table.lines
    if None in names:
        raise table.error(names.index(None), "no frame name", "fill it in or remove it")
    known: dict[str, Floats] = {
        "height_ellipsoidal_m": heights,
        "height_above_ground_m": table.numbers("height_above_ground"),
        "yaw_deg": angles[:, 0],
        "pitch_deg": angles[:, 1],
        "roll_deg": angles[:, 2],
        "sd_east_m": deviation(table, "sd_horizontal", "sd_e"),
        "sd_north_m": deviation(table, "sd_horizontal", "sd_n"),
        "sd_vertical_m": deviation(table, "sd_vertical"),
        "sd_yaw_deg": deviation(table, "sd_yaw"),
        "sd_tilt_deg": deviation(table, "sd_tilt", "sd_omega", "sd_phi"),
    }
    columns = [[None if v != v else v for v in values.tolist()] for values in known.values()]
    rows = [
        PosRow(
            str(name),
            line,
            lon,
            lat,
            camera=camera,
            attitude_source=source,
            **dict(zip(known, row, strict=True)),
        )
        for name, line, (lon, lat), camera, row in zip(
            names, lines, lonlat.tolist(), table.texts("camera"), zip(*columns, strict=True), strict=True
        )
    ]
    datum_stated = all(doubt.code != "height-datum-assumed" for doubt in doubts)
    return PosFile(path, tuple(rows), (*notes, *places.notes, *units, *doubts, *assumed), datum_stated)


def _table(
    path: Path, given: str | None, frames: FrameNames, notes: list[Warn]
) -> tuple[ParsedTable, StatedCrs | None, bool]:
    """The table, the CRS that the file states, and whether it is Pix4D's without a header."""
    lines = read_lines(path, "lines of frames")
    if not lines:
        raise InputError("the POS file is empty", file=path, fix="give a header line and a line per frame")
    odm, lines = read_head(path, lines, ALIASES, _GIVE_CRS)
    lines = [replace(line, text=frames.quoted(line.text)) for line in lines]
    if odm is not None and len(lines) > 1 and lines[0].comment and _names_too_few(*lines[:2]):
        lines = lines[1:]
    file_crs = odm or given_crs(path, given, _GIVE_CRS)
    if odm is not None and given is not None and required_crs(given, _GIVE_CRS).groups != odm.groups:
        text = f"{path.name}: its first line states {odm.text}, which counts; --pos-crs {given} does not; "
        notes.append(Warn("pos-crs-unused", "", f"{text}if that line is wrong, correct it"))
    if lines and not has_numbers(lines[0]) and any(names_known(lines[0], ALIASES, path)):
        table = read_table(path, lines, ALIASES)
        check_columns(table, ALIASES, "frame", "frame's name")
        of = zip(table.texts("status"), table.texts("lon"), table.texts("x"), strict=True)
        nowhere = [s == "left_out" or (s == "rejected" and lon is None and x is None) for s, lon, x in of]
        used = table.without(nowhere)
        if not used.lines:
            raise InputError("all its frames are left out", file=path, fix="give a line per frame in use")
        return used, file_crs, False
    if odm is not None:
        return read_table(path, lines, ALIASES, _GEO_TXT), odm, False
    data = [line for line in lines if not line.comment]
    first = quoted_image(data[0].text, 0) if data else ""
    count = len(split(first, first)) if data else 0
    projected = file_crs is not None and not all(crs_of(c).is_geographic for c in file_crs.groups[0])
    columns = (_PIX4D if count in (3, 4, 6) else _PIX4D_TURNED)[:count]
    if projected:
        columns = ("frame", "x", "y", *columns[3:])
    found = read_table(path, data, ALIASES, columns) if count in (3, 4, 6, 7, 9) else None
    if found is None or not _looks_down(found):
        raise InputError(
            "has no header line that names the columns",
            file=path,
            fix="put one first: frame,lon_deg,lat_deg,height_ellipsoidal_m,yaw_deg,pitch_deg,roll_deg",
        )
    text = (
        f"{path.name} has no header line: columns are read as {', '.join(columns)} (Pix4D's "
        "order); else put one first"
    )
    notes.append(Warn("pos-header-assumed", "", text))
    return found, file_crs, True


def _looks_down(table: ParsedTable) -> bool:
    """Whether omega and phi, where there are any, are nearer to the nadir than to the horizon. Else they may
    be yaw and pitch."""
    tilts = np.stack([table.numbers("omega"), table.numbers("phi")])
    return bool((np.abs(np.nan_to_num(tilts)) < 45.0).all())


def _names_too_few(names: Line, data: Line) -> bool:
    """Whether a comment above a geo.txt names fewer columns than it has, so that it is not its header."""
    return len(split(names.text, names.text)) < len(split(data.text, data.text))


def _without_empty_angles(table: ParsedTable, notes: list[Warn]) -> ParsedTable:
    """Zeros in all rows stand for unknown angles, as ODM's page on geo.txt says."""
    for group in _ANGLES:
        angles = np.stack([table.numbers(column) for column in group])
        if np.isnan(angles).all() or (np.nan_to_num(angles) != 0.0).any():
            continue
        text = f"{table.path.name}: all angles are 0 and taken as unknown ({', '.join(group)}): "
        text += "nothing to do unless they were measured, else give --attitude NAME"
        notes.append(Warn("pos-attitude-empty", "", text))
        table = replace(
            table,
            cells={c: cells for c, cells in table.cells.items() if c not in group},
            factors={c: factor for c, factor in table.factors.items() if c not in group},
        )
    return table


def deviation(table: ParsedTable, whole: str, *parts: str) -> Floats:
    """A standard deviation, or the root mean square of its parts; 0 stands for unknown."""
    columns = parts if parts and whole not in table.factors else (whole,)
    values = np.stack([table.numbers(c) for c in columns])
    if (values < 0.0).any():
        row = int(np.argmax((values < 0.0).any(axis=0)))
        raise table.error(row, f"a standard deviation of {np.nanmin(values):g}", "correct it")
    sd = np.sqrt(np.mean(np.square(values), axis=0))
    return np.where(sd == 0.0, np.nan, sd)
