"""Position and attitude of every frame: the POS file's where there is one, the frame's own where not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath

import numpy as np
from pyproj import CRS

from geomosaic.errors import InputError
from geomosaic.geodesy.heights import ellipsoidal_offsets_m
from geomosaic.survey.accuracy import ATTITUDE, POSITION
from geomosaic.survey.extent import lonlat_of
from geomosaic.survey.header import FrameHeader
from geomosaic.survey.model import Attitude, Position, Warn
from geomosaic.survey.names import FrameNames, some
from geomosaic.survey.observation_warnings import observation_warnings
from geomosaic.survey.onboard import (
    UNKNOWN_ATTITUDE,
    onboard_attitude,
    onboard_position,
)
from geomosaic.survey.plausible import plausible_attitudes, plausible_positions
from geomosaic.survey.pos_against_tags import against_tags
from geomosaic.survey.pos_row import PosFile, PosRow


@dataclass(frozen=True)
class Observations:
    """Per frame: position, attitude, and the camera's name as the POS file has it; what was assumed."""

    positions: tuple[Position, ...] = ()
    attitudes: tuple[Attitude, ...] = ()
    cameras: tuple[str | None, ...] = ()
    warnings: tuple[Warn, ...] = ()


def observe(
    headers: Sequence[FrameHeader],
    pos: PosFile | None,
    others: Mapping[str, str] | None = None,
    anywhere: tuple[float, float] = (0.0, 0.0),
    *,
    strict: bool = False,
) -> Observations:
    """Put EXIF, XMP and the POS file together.

    The POS file's position counts; a height or an attitude it doesn't have is the frame's own. Rows without a
    frame (or another image) are warned of, and so are frames without a row, whose own tags count. A frame
    that has no position is taken to be between those before and after it, or `anywhere` (longitude, latitude)
    where none has one. Its deviation says how little that is worth.

    Args: others: the folder's images that are no frames, each with the frame that it was taken with, '' for
    none. Their rows stand in for a frame's own. strict: no row without an image, no frame without a row.

    Heights and attitudes that can't be are taken as not given, see `survey.plausible`.

    Raises: `InputError` naming the first frame or line that is wrong, and how many are.
    """
    own = [onboard_position(h.exif, h.xmp or {}) for h in headers]
    attitudes = [onboard_attitude(h.exif, h.xmp or {}) for h in headers]
    if pos is None:
        positions = _with_missing(own, anywhere)
        rows: list[PosRow | None] = [None] * len(headers)
        warnings: list[Warn] = []
    else:
        rows, unmatched = _matched(headers, pos, others or {}, strict=strict)
        warnings = [*pos.warnings, *unmatched, *against_tags([h.name for h in headers], own, rows, pos)]
        positions = _with_missing(
            [
                p if row is None else _position(row, p, datum_stated=pos.datum_stated)
                for row, p in zip(rows, own, strict=True)
            ],
            anywhere,
        )
        attitudes = [a if row is None else _attitude(row, a) for row, a in zip(rows, attitudes, strict=True)]
    warnings += observation_warnings(headers, positions, attitudes)
    names = [h.name for h in headers]
    kept, high = plausible_positions(names, positions)
    upright, tilted = plausible_attitudes(names, attitudes, UNKNOWN_ATTITUDE)
    cameras = tuple(None if row is None else row.camera for row in rows)
    return Observations(kept, upright, cameras, (*warnings, *high, *tilted))


def on_datum(observed: Observations, datum: CRS) -> Observations:
    """Observations whose heights are ellipsoidal, where those of tags that state no datum count from this.

    Raises: `InputError` where the grid of its geoid isn't installed.
    """
    positions = list(observed.positions)
    known = [i for i, p in enumerate(positions) if p.known]
    if not known:
        return observed
    try:
        offsets_m = ellipsoidal_offsets_m(datum, *lonlat_of([positions[i] for i in known]).T)
    except InputError as error:
        fix = f"{error.fix}; or give --height-datum EGM96, which needs no file"
        raise InputError(error.problem, fix=fix) from error
    for i, offset_m in zip(known, offsets_m.tolist(), strict=True):
        own_m = positions[i].height_ellipsoidal_m
        if own_m is not None and not positions[i].datum_stated:
            positions[i] = replace(positions[i], height_ellipsoidal_m=own_m + offset_m, datum_stated=True)
    warnings = tuple(w for w in observed.warnings if w.code != "height-datum-unknown")
    return replace(observed, positions=tuple(positions), warnings=warnings)


def _with_missing(own: Sequence[Position | None], anywhere: tuple[float, float]) -> list[Position]:
    """All positions: those that nobody observed evenly between the ones before and after."""
    known = [i for i, p in enumerate(own) if p is not None]
    lonlat = lonlat_of([p for p in own if p is not None]) if known else np.array([anywhere])
    at = [np.interp(np.arange(len(own)), known or [0], column) for column in lonlat.T]
    default = POSITION["none"]
    plan, up = default.sd_horizontal_m, default.sd_vertical_m
    return [
        p or Position((float(lon) + 180.0) % 360.0 - 180.0, float(lat), None, None, plan, plan, up, "none")
        for p, lon, lat in zip(own, *at, strict=True)
    ]


def _of_another_file(written: str, frame: str) -> bool:
    """Whether a line names a file with another extension than the frame it is taken for."""
    name = PurePosixPath(written.replace("\\", "/"))
    return bool(name.suffix) and name.suffix.casefold() != PurePosixPath(frame).suffix.casefold()


def _matched(
    headers: Sequence[FrameHeader], pos: PosFile, others: Mapping[str, str], *, strict: bool
) -> tuple[list[PosRow | None], list[Warn]]:
    """Each frame's row, and what is said of rows and frames that have none of the other."""
    own = [h.name for h in headers]
    names = FrameNames([*own, *others])
    rows: dict[str, PosRow] = {}
    of_others: dict[str, PosRow] = {}
    strangers = []
    for row in pos.rows:
        try:
            frame = names.find(row.name)
        except InputError as error:
            raise InputError(f"line {row.line}: {error.problem}", file=pos.path, fix=error.fix) from error
        if frame is None:
            strangers.append(row)
            continue
        if frame in others:
            of_others.setdefault(others[frame], replace(row, camera=None))
            continue
        if frame in rows and _of_another_file(row.name, frame):
            strangers.append(row)  # such as a raw image next to it
            continue
        if frame in rows and not _of_another_file(rows[frame].name, frame):
            raise InputError(
                f"frame {frame} stands in line {rows[frame].line} and again in line {row.line}",
                file=pos.path,
                fix="remove one of them",
            )
        rows[frame] = row
    rows = of_others | rows
    lacking = [name for name in own if name not in rows]
    if strangers and (strict or not rows):
        row = strangers[0]
        raise InputError(
            f"line {row.line}: '{row.name}' is no frame in {headers[0].path.parent}",
            file=pos.path,
            fix=f"remove the line or add the frame; {names.near(row.name)}",
        )
    if lacking and strict:
        raise InputError(
            f"no line for {len(lacking)} of {len(own)} frames: {some(lacking)}",
            file=pos.path,
            fix="add lines, or take these frames out of the folder",
        )
    warnings = []
    if strangers:
        text = (
            f"{len(strangers)} of {len(pos.rows)} lines name no frame in the folder and are not used: "
            f"{some(r.name for r in strangers)}; correct the names if they are of these frames"
        )
        warnings.append(Warn("pos-line-without-frame", "", f"{pos.path.name}: {text}"))
    if lacking:
        text = (
            f"no line for {len(lacking)} of {len(own)} frames: {some(lacking)}; they keep the "
            "positions in their tags, if they have any; add lines for them to --pos"
        )
        warnings.append(Warn("pos-frame-without-line", "", f"{pos.path.name}: {text}"))
    return [rows.get(name) for name in own], warnings


def _position(row: PosRow, own: Position | None, *, datum_stated: bool) -> Position:
    default = POSITION["pos"]
    position = Position(
        row.lon_deg,
        row.lat_deg,
        row.height_ellipsoidal_m,
        row.height_above_ground_m,
        row.sd_east_m or default.sd_horizontal_m,
        row.sd_north_m or default.sd_horizontal_m,
        row.sd_vertical_m or default.sd_vertical_m,
        "pos",
        datum_stated,
    )
    if own is None:
        return position
    if position.height_above_ground_m is None:
        position = replace(position, height_above_ground_m=own.height_above_ground_m)
    if position.height_ellipsoidal_m is None and own.height_ellipsoidal_m is not None:
        return replace(
            position,
            height_ellipsoidal_m=own.height_ellipsoidal_m,
            sd_vertical_m=own.sd_vertical_m,
            source=f"pos, height from {own.source}",
            datum_stated=own.datum_stated,
        )
    return position


def _attitude(row: PosRow, own: Attitude) -> Attitude:
    """The POS file's, unless it lacks angles that the frame itself knows: the two are never mixed."""
    angles = (row.yaw_deg, row.pitch_deg, row.roll_deg)
    own_known = sum(a is not None for a in (own.yaw_deg, own.pitch_deg, own.roll_deg))
    if sum(a is not None for a in angles) < max(own_known, 1):
        return own
    default, unknown = ATTITUDE[row.attitude_source], ATTITUDE["none"]
    level = row.pitch_deg is not None and row.roll_deg is not None
    return Attitude(
        *angles,
        unknown.sd_yaw_deg if row.yaw_deg is None else row.sd_yaw_deg or default.sd_yaw_deg,
        row.sd_tilt_deg or default.sd_tilt_deg if level else unknown.sd_tilt_deg,
        row.attitude_source,
    )
