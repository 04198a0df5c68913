"""The rigorous model of CCD strips on disk: model.yaml, with orbit and attitude as tables beside it."""

from __future__ import annotations

import csv
import io
import reprlib
import stat
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from numpy.typing import NDArray

from geomosaic.camera.pushbroom import Pushbroom
from geomosaic.errors import FileError, InputError, UnknownNameError

Floats = NDArray[np.float64]
ORBIT_COLUMNS: Final = ("time_s", "x_m", "y_m", "z_m")
ATTITUDE_COLUMNS: Final = ("time_s", "roll_deg", "pitch_deg", "yaw_deg")
_KEYS: Final = ("line_rate_hz", "orbit", "attitude", "looks")
_LOOK_KEYS: Final = ("forward_tan", "right_tan")
_MOST_BYTES: Final = {"model": 64 << 10, "table": 256 << 20}
_LONGEST_PATH: Final = 255  # shown whole
_MEND: Final = "see docs/simulation.md for the model's form"
_SHORT: Final = reprlib.Repr()
_SHORT.maxstring = 60


def read_model(path: Path) -> Pushbroom:
    """The model of a YAML file; its tables' paths count from its folder.

    `line_rate_hz`; `orbit`: a CSV of time_s, x_m, y_m, z_m (WGS 84, fixed to the Earth); `attitude`: a CSV of
    time_s, roll_deg, pitch_deg, yaw_deg; `looks`: for each CCD, left to right, `forward_tan` and `right_tan`,
    each [constant, per column, per second]. What they mean stands in `camera.pushbroom.Pushbroom`.

    Raises: `FileError` or `InputError` naming the file and what is wrong.
    """
    path = Path(path)
    entry = _entry(path)
    rate = _numbers([entry["line_rate_hz"]], 1, "line_rate_hz", path)[0]
    if rate <= 0.0:
        raise InputError("line_rate_hz must be above 0", file=path, mend=_MEND)
    looks = entry["looks"]
    if not isinstance(looks, list) or not looks or not all(isinstance(one, dict) for one in looks):
        raise InputError("looks isn't a list of look angles, one for each CCD", file=path, mend=_MEND)
    tan = {
        key: np.array(
            [_numbers(one.get(key), 3, f"{key} of CCD {i}", path) for i, one in enumerate(looks, 1)]
        )
        for key in _LOOK_KEYS
    }
    if (tan["right_tan"][:, 1] == 0.0).any():
        raise InputError("a CCD's right_tan doesn't change with the column", file=path, mend=_MEND)
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
    entry = read_yaml(path, _MOST_BYTES["model"], "a model", _MEND)
    if not isinstance(entry, dict):
        raise InputError("is no model of CCD strips", file=path, mend=_MEND)
    for key in entry:
        if key not in _KEYS:
            raise UnknownNameError("model key", shown(key).strip("'"), _KEYS, file=path)
    for key in _KEYS:
        if key not in entry:
            raise InputError(f"has no {key}", file=path, mend=_MEND)
    return entry


class _PlainLoader(yaml.SafeLoader):
    """YAML without merge keys, whose nesting could make a small file endless."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        if any(key.tag == "tag:yaml.org,2002:merge" for key, _ in node.value):
            raise yaml.constructor.ConstructorError(None, None, "merge keys aren't read", node.start_mark)


def read_yaml(path: Path, most_bytes: int, kind: str, mend: str) -> Any:
    """What a YAML file holds; raises as `read_bytes` does, and `FileError` for what is no plain YAML."""
    content = read_bytes(path, most_bytes, kind, mend)
    try:
        return yaml.load(content.decode("utf-8-sig"), _PlainLoader)  # noqa: S506  a SafeLoader
    except (ValueError, KeyError, TypeError, yaml.YAMLError, RecursionError) as error:
        raise FileError("is no valid YAML", file=path, mend=mend) from error


def check_regular(path: Path, mend: str, named: str = "") -> None:
    """`FileError` for what is missing, or no regular file: a folder, a device or a pipe, which may never end.

    Args: named says in the message where the path stands.
    """
    text = str(path)
    file = text if len(text) <= _LONGEST_PATH else f"{text[:_LONGEST_PATH]}..."
    try:
        regular = stat.S_ISREG(path.stat().st_mode)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise FileError(f"there is no such file{named}", file=file, mend=mend) from error
    except OSError as error:
        raise FileError(f"can't be read ({error.strerror}){named}", file=file, mend=mend) from error
    if not regular:
        raise FileError(f"is no regular file{named}", file=file, mend=mend)


def read_bytes(path: Path, most_bytes: int, kind: str, mend: str) -> bytes:
    """A regular file's content; `FileError` where it is larger than most_bytes, or can't be read."""
    check_regular(path, mend)
    try:
        with path.open("rb") as file:
            content = file.read(most_bytes + 1)
    except OSError as error:
        raise FileError(f"can't be read ({error.strerror})", file=path) from error
    if len(content) > most_bytes:
        problem = f"is too large for {kind}: more than {most_bytes >> 10} kB"
        raise FileError(problem, file=path, mend="is it the right file?")
    return content


def shown(value: object) -> str:
    """A value out of a file as a message shows it: short, whatever it is."""
    try:
        return _SHORT.repr(value)[:80]
    except ValueError:  # an integer of more digits than Python prints
        return "too large a number"


def _numbers(value: Any, count: int, what: str, path: Path) -> Floats:
    good = isinstance(value, list) and len(value) == count
    if not good or not all(isinstance(v, int | float) and not isinstance(v, bool) for v in value):
        raise InputError(f"{what} isn't {count} number{'s' if count > 1 else ''}", file=path, mend=_MEND)
    try:
        numbers = np.array(value, dtype=np.float64)
    except OverflowError as error:
        raise InputError(f"{what} is too large", file=path, mend=_MEND) from error
    if not np.isfinite(numbers).all():
        raise InputError(f"{what} isn't finite", file=path, mend=_MEND)
    return numbers


def _table_path(model: Path, name: Any) -> Path:
    if not isinstance(name, str) or not name or "\0" in name:
        raise InputError(f"names {shown(name)} as a table", file=model, mend="give a CSV file's path")
    return model.absolute().parent / name


def _table(model: Path, name: Any, columns: tuple[str, ...]) -> Floats:
    path = _table_path(model, name)
    content = read_bytes(path, _MOST_BYTES["table"], "a model's table", _MEND)
    try:
        rows = list(csv.reader(io.StringIO(content.decode("utf-8-sig"))))
    except (ValueError, csv.Error) as error:
        raise FileError("is no table of text", file=path, mend=_MEND) from error
    if not rows or tuple(cell.strip() for cell in rows[0]) != columns:
        raise InputError(f"its first line isn't {','.join(columns)}", file=path, mend=_MEND)
    try:
        table = np.array([[float(cell) for cell in row] for row in rows[1:] if row], dtype=np.float64)
    except ValueError as error:
        raise InputError("holds what is no number", file=path, mend=_MEND) from error
    if table.ndim != 2 or table.shape[1] != len(columns) or len(table) < 4 or not np.isfinite(table).all():
        raise InputError(
            f"isn't a table of at least four lines of {len(columns)} numbers", file=path, mend=_MEND
        )
    if (np.diff(table[:, 0]) <= 0.0).any():
        raise InputError("its times don't rise from line to line", file=path, mend="sort it by time")
    return table
