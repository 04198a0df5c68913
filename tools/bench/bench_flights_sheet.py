"""The sheet of a flight: a YAML file next to its frames that says how to run it and what to expect.

    frames: caliterra/images             # folder, relative to the sheet
    options: {gcp: caliterra/gcp.txt}    # of `geomosaic mosaic`, without dashes; files relative to the sheet
    known: GPS only (github.com/...)     # on the flight and its source
    check_points: caliterra/check.txt    # control points that the run does not get
    expect: {tied_share: 0.9, seams_px: 1.0, parts: 1, megapixels: 400}

`tied_share` is the least; `seams_px` (median), `parts` and `megapixels` are the most.
"""

from __future__ import annotations

import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from geomosaic.doors.plain import read_yaml, shown
from geomosaic.errors import FileError
from geomosaic.requests.mosaic_request import MosaicRequest
from geomosaic.requests.option import kinds_of

KEYS = ("frames", "options", "known", "check_points", "expect")
EXPECTED = ("tied_share", "seams_px", "parts", "megapixels")
_OF_THE_BENCH = ("frames", "output", "seed", "workers")
_MOST_BYTES = 1 << 16
_FIX = "see the head of tools/bench/bench_flights_sheet.py"


@dataclass(frozen=True)
class SheetFlight:
    """A flight to run. words: the options as on the command line, with paths below the sheet's folder."""

    name: str
    frames: Path
    words: tuple[str, ...] = ()
    known: str = ""
    check_points: Path | None = None
    expect: Mapping[str, float] = field(default_factory=dict)


def read_flights(data: Path, only: Sequence[str] = ()) -> list[SheetFlight]:
    """All flights of a folder, or those named, by name. Raises `FileError` naming the sheet and the key."""
    sheets = {path.stem: path for path in sorted(data.glob("*.yaml"))}
    for name in only:
        if name not in sheets:
            raise FileError(f"there is no sheet {name}.yaml", file=data, fix=f"there are {', '.join(sheets)}")
    return [read_sheet(path) for name, path in sheets.items() if not only or name in only]


def read_sheet(path: Path) -> SheetFlight:
    """A flight by its sheet. Raises `FileError` naming the sheet and the key that is wrong."""
    sheet = _mapping(read_yaml(path, _MOST_BYTES, "a flight's sheet", _FIX), path, "the sheet", KEYS)
    for key in ("frames", "known", "check_points"):
        if not isinstance(sheet.get(key, ""), str):
            raise FileError(f"'{key}' is {shown(sheet[key])}, no text", file=path, fix=_FIX)
    if not sheet.get("frames"):
        raise FileError("has no key 'frames'", file=path, fix=_FIX)
    expect = _mapping(sheet.get("expect", {}), path, "'expect'", EXPECTED)
    for key, value in expect.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise FileError(f"'expect: {key}' is {shown(value)}, no number", file=path, fix=_FIX)
    check_points = sheet.get("check_points")
    return SheetFlight(
        path.stem,
        path.parent / sheet["frames"],
        tuple(_words(sheet.get("options", {}), path)),
        sheet.get("known", ""),
        path.parent / check_points if check_points else None,
        expect,
    )


def _mapping(value: Any, path: Path, what: str, keys: Sequence[str]) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise FileError(f"{what} is no mapping", file=path, fix=_FIX)
    for key in value:
        if key not in keys:
            raise FileError(
                f"{what} has an unknown key {shown(key)}", file=path, fix=f"keys are {', '.join(keys)}"
            )
    return value


def _words(options: Any, path: Path) -> list[str]:
    """Options of `geomosaic mosaic` as words of its command line."""
    kinds = {n.replace("_", "-"): k for n, k in kinds_of(MosaicRequest).items() if n not in _OF_THE_BENCH}
    words = []
    for name, value in _mapping(options, path, "'options'", tuple(kinds)).items():
        kind = kinds[name]
        if kind is bool:
            words += [f"--{name}"] if value else []
            continue
        for one in value if isinstance(value, list) else [value]:
            of_file = kind is Path or Path in typing.get_args(kind)
            words += [f"--{name}", str(path.parent / str(one)) if of_file else str(one)]
    return words
