"""CCD strips: the nouns of a focal plane of staggered TDI-CCDs, and the reader of GEOMETRY.yaml."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from geomosaic.camera.pushbroom import Pushbroom
from geomosaic.constants import tuned
from geomosaic.doors.files import check_regular
from geomosaic.doors.plain import YAML_BYTES, read_yaml, shown
from geomosaic.doors.raster import STRIP, open_raster
from geomosaic.errors import FileError, InputError, UnknownNameError
from geomosaic.geodesy.ellipsoid import MEAN_RADIUS_M
from geomosaic.geodesy.local import geodetic_from_ecef
from geomosaic.survey.elevation import check_dem
from geomosaic.survey.strip_companions import check_cover, check_pixel, check_rpc, checked_model
from geomosaic.survey.strip_pixels import GreyScale

_MOST_CCDS = tuned(64, "CCDs", "of a focal plane: TH-1 has 8; each opens a file and takes memory")
_MOST = tuned(1e9, "any unit", "largest number in a geometry file: products stay in 64 bits")
_ALTITUDE_M = tuned(500e3, "m", "where no model says it: imaging satellites fly at 400 to 800 km")
_LEAST_OVERLAP_PX = tuned(8, "px", "of neighbouring strips: narrower ones cannot be matched")
_KINDS: Final = frozenset({"uint8", "uint16", "int16", "float32"})
_KEYS: Final = (
    "ccds", "width_px", "overlap_px", "read_px", "row_separation_lines", "ground_pixel_m", "line_rate_hz",
    "altitude_m", "bit_depth", "nodata", "dem", "rpc", "model",
)  # fmt: skip
_FIX: Final = "give YAML with the strips: ccds: [{path: FILE, row: 1}, {path: FILE, row: 2}]"


@dataclass(frozen=True)
class Ccd:
    """One TDI-CCD: its strip (None where the CCD is missing) and its row, 1 the leading, 2 the trailing."""

    path: Path | None
    row: int


@dataclass(frozen=True, kw_only=True)
class StripGeometry:
    """A focal plane of CCDs in two staggered rows, left to right, and the strips they took.

    Convention: a ground point at (col, line) of a pair's left strip lies in the right strip at
    `col - (width_px - overlap_px) + dcol` and `line + side(pair) * row_separation_lines + dline`, with dcol
    and dline the pair's offsets. Lines count each strip's own lines, columns the CCD's pixels, corner origin.

    width_px: of every strip. lines: of each file, 0 where the CCD is missing. overlap_px: what neighbours
    share by design; read_px: what is read of each side. altitude_m: of the flight above the ground.
    nodata None: every pixel counts. scale: by which float32 and negative values are read as
    greys, nodata as grey 0.
    dem: a DEM of the ground; rpc: of the stitched scene; model: the rigorous model.
    """

    ccds: tuple[Ccd, ...]
    width_px: int
    lines: tuple[int, ...]
    overlap_px: int = 96
    read_px: int = 110
    row_separation_lines: float = 2114.0
    ground_pixel_m: float = 2.0
    line_rate_hz: float
    altitude_m: float = _ALTITUDE_M
    bit_depth: int
    nodata: float | None = None
    scale: GreyScale | None = None
    dem: Path | None = None
    rpc: Path | None = None
    model: Path | None = None

    @property
    def pairs(self) -> range:
        """The pairs of neighbours: pair k is of CCDs k and k + 1."""
        return range(len(self.ccds) - 1)

    def side(self, pair: int) -> int:
        """+1 where the left CCD is in the leading row and the right one in the trailing row, else -1."""
        return 1 if self.ccds[pair].row == 1 else -1

    @property
    def height_m_per_line(self) -> float:
        """The height (m) that shifts a place by one line between the two rows, 0 where they are one.

        Their rays meet at an angle of separation * pixel * (1 / altitude + 1 / R). The second part is the
        turn of the vertical between the two places from which they look.
        """
        bend = 1.0 / self.altitude_m + 1.0 / MEAN_RADIUS_M
        return 1.0 / (self.row_separation_lines * bend) if self.row_separation_lines else 0.0

    @property
    def scene_width_px(self) -> int:
        """Columns of the ideal unbroken line: every CCD less the overlaps."""
        return len(self.ccds) * self.width_px - (len(self.ccds) - 1) * self.overlap_px

    @property
    def scene_lines(self) -> int:
        """Lines from the first of a leading strip to the last of a trailing one, nominally."""
        return max(self.lines) + math.ceil(self.row_separation_lines)


def read_geometry(path: Path) -> StripGeometry:
    """The geometry of a YAML file, checked against the strips it names; paths count from its folder.

    `ccds` (`path` and `row`, left to right; no `path` where a CCD is dead) and `line_rate_hz` are needed,
    the rest has defaults. `bit_depth` is the files' where it isn't given. DEM, RPC and model, where named,
    must be readable and fit: as many CCDs, the same line rate, the same scene.

    Raises: `FileError` or `InputError` with one line that names the file and the fix.
    """
    path = Path(path)
    entry = read_yaml(path, YAML_BYTES, "a geometry file", _FIX)
    if not isinstance(entry, dict) or "ccds" not in entry:
        raise InputError("is no geometry of CCD strips: it has no 'ccds'", file=path, fix=_FIX)
    for key in entry:
        if key not in _KEYS:
            raise UnknownNameError("geometry key", shown(key).strip("'"), _KEYS, file=path)
    ccds = _ccds(entry, path)
    number = _numbers(entry, path)
    width_px, lines, kind, nodata = _strips(ccds)
    if "width_px" in entry and number("width_px", None, 1, whole=True) != width_px:
        raise InputError(
            f"says strips of {entry['width_px']:g} columns, but they have {width_px}",
            file=path,
            fix="correct width_px or give the strips that belong to it",
        )
    values = np.finfo(kind) if kind == "float32" else np.iinfo(kind)
    ends, bits = (float(values.min), float(values.max)), min(int(values.max).bit_length(), 16)
    bit_depth = int(number("bit_depth", bits, 8, whole=True))
    if bit_depth > bits:
        raise InputError(
            f"bit_depth is {bit_depth}, but the strips are {kind}", file=path, fix="give at most theirs"
        )
    given_nodata = entry.get("nodata") is not None
    geometry = StripGeometry(
        ccds=ccds,
        width_px=width_px,
        lines=lines,
        overlap_px=int(number("overlap_px", 96, _LEAST_OVERLAP_PX, whole=True)),
        read_px=int(number("read_px", 110, 1, whole=True)),
        row_separation_lines=number("row_separation_lines", 2114.0, 0.0),
        ground_pixel_m=number("ground_pixel_m", 2.0, 1e-3),
        line_rate_hz=number("line_rate_hz", None, 1e-3),
        altitude_m=number("altitude_m", _ALTITUDE_M, 10.0),
        bit_depth=bit_depth,
        nodata=number("nodata", nodata, *ends, whole=kind != "float32") if given_nodata else nodata,
        scale=None,
        **{key: _file(entry, key, path) for key in ("dem", "rpc", "model")},
    )
    _check(geometry, path)
    model = _check_companions(geometry, path)
    if model is None or "altitude_m" in entry:
        return geometry
    middle_m = model.orbit_ecef_m[len(model.orbit_ecef_m) // 2]
    return replace(geometry, altitude_m=float(geodetic_from_ecef(middle_m)[2]))


def _ccds(entry: Mapping[str, Any], path: Path) -> tuple[Ccd, ...]:
    listed = entry["ccds"]
    if not isinstance(listed, list) or not 2 <= len(listed) <= _MOST_CCDS:
        raise InputError("'ccds' isn't a list of at least two CCDs, left to right", file=path, fix=_FIX)
    ccds: list[Ccd] = []
    for i, one in enumerate(listed, 1):
        if not isinstance(one, dict) or not one.keys() <= {"path", "row"}:
            raise InputError(f"CCD {i} isn't a pair of 'path' and 'row'", file=path, fix=_FIX)
        row = one.get("row")
        if isinstance(row, bool) or row not in (1, 2):
            raise InputError(
                f"CCD {i} has row {shown(row)}", file=path, fix="1 is the leading row, 2 the other"
            )
        if ccds and ccds[-1].row == row:
            raise InputError(
                f"CCDs {i - 1} and {i} are both in row {row}", file=path, fix="neighbours are in other rows"
            )
        strip = _file(one, "path", path)
        if strip is not None and strip in [c.path for c in ccds]:
            raise InputError(f"CCD {i} names a strip a second time: {strip.name}", file=path, fix=_FIX)
        ccds.append(Ccd(strip, int(row)))
    if sum(c.path is not None for c in ccds) < 2:
        raise InputError("names fewer than two strips", file=path, fix="give the strips' paths")
    return tuple(ccds)


def _file(entry: Mapping[str, Any], key: str, path: Path) -> Path | None:
    value = entry.get(key)
    if value is None:
        return None
    if not isinstance(value, str) or not value or "\0" in value:
        raise InputError(f"{key} is {shown(value)}", file=path, fix="give a file's path")
    found = path.absolute().parent / value
    fix = "correct it, or take 'path' out where the CCD is dead" if key == "path" else f"correct '{key}'"
    check_regular(found, fix, f", named as {key} in {path.name}")
    return found


def _numbers(entry: Mapping[str, Any], path: Path) -> Callable[..., float]:
    def number(
        key: str, default: float | None, least: float, most: float = _MOST, whole: bool = False
    ) -> float:
        value = entry.get(key, default)
        known = isinstance(value, int | float) and not isinstance(value, bool)
        if not known or not least <= value <= most or (whole and value != int(value)):
            problem = f"has no {key}" if value is None else f"{key} is {shown(value)}"
            wanted = "a whole number" if whole else "a number"
            bounded = most < _MOST or (known and value > most)
            bounds = f"from {least:g} to {most:g}" if bounded else f"of at least {least:g}"
            raise InputError(problem, file=path, fix=f"give {wanted} {bounds}")
        return float(value)

    return number


def _strips(ccds: tuple[Ccd, ...]) -> tuple[int, tuple[int, ...], str, float | None]:
    """Width, lines of each, data type and nodata of the strips; `FileError` where they don't agree."""
    lines: list[int] = []
    first: tuple[Path, tuple[int, str, float | None]] | None = None
    for ccd in ccds:
        if ccd.path is None:
            lines.append(0)
            continue
        with open_raster(ccd.path, STRIP) as strip:
            width, count, kind, nodata = strip.width, strip.count, strip.dtypes[0], strip.nodata
            lines.append(int(strip.height))
        if count != 1 or kind not in _KINDS:
            problem = f"has {count} bands" if count != 1 else f"has {kind} pixels"
            raise FileError(problem, file=ccd.path, fix="a strip has one band of 8 to 16 bits, or float32")
        found = int(width), str(kind), None if nodata is None or math.isnan(nodata) else nodata
        if first is None:
            first = ccd.path, found
        elif found != first[1]:
            raise FileError(
                f"has {_described(*found)}, but {first[0].name} has {_described(*first[1])}",
                file=ccd.path,
                fix="strips of one camera agree; give those of one scene",
            )
    assert first is not None
    width_px, pixels, nodata_value = first[1]
    return width_px, tuple(lines), pixels, nodata_value


def _described(width: int, kind: str, nodata: float | None) -> str:
    return f"{width} columns of {kind}" + ("" if nodata is None else f" with nodata {nodata:g}")


def _check(geometry: StripGeometry, path: Path) -> None:
    """`InputError` for numbers that don't fit each other or the files."""
    g = geometry
    if g.overlap_px * 2 >= g.width_px:
        raise InputError(
            f"overlap_px is {g.overlap_px}, strips have {g.width_px} columns",
            file=path,
            fix="an overlap is less than half a strip",
        )
    if not g.overlap_px <= g.read_px <= g.width_px:
        raise InputError(
            f"read_px is {g.read_px}",
            file=path,
            fix=f"give from {g.overlap_px} (the overlap) to {g.width_px} (the strip)",
        )
    longest = max(g.lines)
    if longest <= g.row_separation_lines:
        raise InputError(
            f"rows are {g.row_separation_lines:g} lines apart, the longest strip has {longest} lines",
            file=path,
            fix="give longer strips, or correct row_separation_lines",
        )


def _check_companions(geometry: StripGeometry, path: Path) -> Pushbroom | None:
    """The model; `FileError` or `InputError` where it, the DEM or the RPC aren't of these strips' scene."""
    g, model, rpc = geometry, None, None
    strip_px = g.width_px, max(g.lines)
    if g.dem is not None:
        check_dem(g.dem)
    if g.model is not None:
        model = checked_model(g.model, len(g.ccds), g.line_rate_hz)
        check_pixel(model, strip_px, g.ground_pixel_m, path, g.model)
    if g.rpc is not None:
        rpc = check_rpc(g.rpc, (g.scene_width_px, max(g.lines)), g.ground_pixel_m, model, g.dem)
    if g.dem is not None and model is not None:
        check_cover(g.dem, model, strip_px, 0.0 if rpc is None else float(rpc.offset[4]))
    return model
