"""The rigorous model of CCD strips on disk: model.yaml, with orbit and attitude as tables in its folder."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import Any, Final

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.camera.pushbroom import Pushbroom
from geomosaic.doors.files import TEXT_BYTES, read_text
from geomosaic.doors.plain import YAML_BYTES, read_yaml, shown
from geomosaic.errors import InputError, UnknownNameError

ORBIT_COLUMNS: Final = ("time_s", "x_m", "y_m", "z_m")
ATTITUDE_COLUMNS: Final = ("time_s", "roll_deg", "pitch_deg", "yaw_deg")
_KEYS: Final = ("line_rate_hz", "orbit", "attitude", "looks")
_LOOK_KEYS: Final = ("forward_tan", "right_tan")
_FIX: Final = "give YAML with line_rate_hz, looks, and the CSV files orbit and attitude"


def read_model(path: Path) -> Pushbroom:
    """The model of a YAML file; its tables' paths count from its folder.

    Its keys: `line_rate_hz`. `orbit`: a CSV of time_s, x_m, y_m, z_m (WGS 84, fixed to the Earth).
    `attitude`: a CSV of time_s, roll_deg, pitch_deg, yaw_deg. `looks`: for each CCD, left to right,
    `forward_tan` and `right_tan`, each [constant, per column, per second]. What they mean stands in
    `camera.pushbroom.Pushbroom`.

    Raises: `FileError` or `InputError` naming the file and what is wrong.
    """
    path = Path(path)
    entry = _entry(path)
    rate = _numbers([entry["line_rate_hz"]], 1, "line_rate_hz", path)[0]
    if rate <= 0.0:
        raise InputError("line_rate_hz must be above 0", file=path, fix=_FIX)
    looks = entry["looks"]
    if not isinstance(looks, list) or not looks or not all(isinstance(one, dict) for one in looks):
        raise InputError("looks isn't a list of look angles, one for each CCD", file=path, fix=_FIX)
    tan = {
        key: np.array(
            [_numbers(one.get(key), 3, f"{key} of CCD {i}", path) for i, one in enumerate(looks, 1)]
        )
        for key in _LOOK_KEYS
    }
    if (tan["right_tan"][:, 1] == 0.0).any():
        raise InputError("a CCD's right_tan doesn't change with the column", file=path, fix=_FIX)
    orbit = _table(path, entry["orbit"], ORBIT_COLUMNS)
    attitude = _table(path, entry["attitude"], ATTITUDE_COLUMNS)
    return Pushbroom(
        line_rate_hz=float(rate),
        orbit_time_s=orbit[:, 0],
        orbit_ecef_m=orbit[:, 1:],
        attitude_time_s=attitude[:, 0],
        roll_pitch_yaw_rad=np.radians(attitude[:, 1:]),
        forward_tan=tan["forward_tan"],
        right_tan=tan["right_tan"],
    )


def model_tables(path: Path) -> dict[str, Path]:
    """The tables that a model's file names, `orbit` and `attitude`; raises as `read_model` does."""
    path = Path(path)
    entry = _entry(path)
    return {key: _table_path(path, entry[key]) for key in ("orbit", "attitude")}


def _entry(path: Path) -> dict[str, Any]:
    entry = read_yaml(path, YAML_BYTES, "a model", _FIX)
    if not isinstance(entry, dict):
        raise InputError("is no model of CCD strips", file=path, fix=_FIX)
    for key in entry:
        if key not in _KEYS:
            raise UnknownNameError("model key", shown(key).strip("'"), _KEYS, file=path)
    for key in _KEYS:
        if key not in entry:
            raise InputError(f"has no {key}", file=path, fix=_FIX)
    return entry


def _numbers(value: Any, count: int, what: str, path: Path) -> Floats:
    good = isinstance(value, list) and len(value) == count
    if not good or not all(isinstance(v, int | float) and not isinstance(v, bool) for v in value):
        raise InputError(f"{what} isn't {count} number{'s' if count > 1 else ''}", file=path, fix=_FIX)
    try:
        numbers = np.array(value, dtype=np.float64)
    except OverflowError as error:
        raise InputError(f"{what} is too large", file=path, fix=_FIX) from error
    if not np.isfinite(numbers).all():
        raise InputError(f"{what} isn't finite", file=path, fix=_FIX)
    return numbers


def _table_path(model: Path, name: Any) -> Path:
    if not isinstance(name, str) or not name or "\0" in name:
        raise InputError(f"names {shown(name)} as a table", file=model, fix="give a CSV file's path")
    return model.absolute().parent / name


def _table(model: Path, name: Any, columns: tuple[str, ...]) -> Floats:
    path = _table_path(model, name)
    first, _, rest = read_text(path, TEXT_BYTES, "a model's table", _FIX).partition("\n")
    if tuple(cell.strip() for cell in first.split(",")) != columns:
        raise InputError(f"its first line isn't {','.join(columns)}", file=path, fix=_FIX)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of a file without rows
            table = np.loadtxt(io.StringIO(rest), delimiter=",", comments=None, quotechar='"', ndmin=2)
    except ValueError as error:
        raise InputError("holds what is no number, or a line is short", file=path, fix=_FIX) from error
    if table.ndim != 2 or table.shape[1] != len(columns) or len(table) < 4 or not np.isfinite(table).all():
        raise InputError(
            f"isn't a table of at least four lines of {len(columns)} numbers", file=path, fix=_FIX
        )
    if (np.diff(table[:, 0]) <= 0.0).any():
        raise InputError("its times don't rise from line to line", file=path, fix="sort it by time")
    return table
