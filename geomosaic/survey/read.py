"""The front door: a folder of frames, and the files beside it, become a `Survey`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from geomosaic.errors import InputError
from geomosaic.geodesy.crs_names import AmbiguousCrsError, label, required_crs
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import LOCAL_CRS, map_crs, utm_crs
from geomosaic.survey.camera_files import read_cameras
from geomosaic.survey.cameras import CameraChoice, cameras_from_file, cameras_from_headers
from geomosaic.survey.control import read_control
from geomosaic.survey.control_use import check_marks, lonlat_of_control, used_control
from geomosaic.survey.elevation import check_dem, read_elevation
from geomosaic.survey.folder import frame_files, unused_folders
from geomosaic.survey.header import FrameHeader
from geomosaic.survey.model import Band, ControlPoint, Frame, Position, Survey, Warn
from geomosaic.survey.motion_tags import turns_of, velocity_of
from geomosaic.survey.names import FrameNames, natural_key, some
from geomosaic.survey.observations import check_extent, lonlat_of, observe
from geomosaic.survey.onboard import platform_of
from geomosaic.survey.places import NOWHERE, check_area
from geomosaic.survey.pos import read_pos
from geomosaic.survey.pos_row import PosFile
from geomosaic.survey.rig import CaptureGroups, captures, incomplete_captures
from geomosaic.survey.strays import (
    Stray,
    blurred,
    copies,
    misplaced,
    other_kinds,
    stray_warnings,
    without,
    without_camera,
)
from geomosaic.survey.usable import Inspect, Usable, inspect_all, usable
from geomosaic.survey.zone import proposing_zone

Floats = NDArray[np.float64]
Progress = Callable[[int, int, str], None]
_LOCAL: Final = (
    "no frame has a position and there are no control points: the mosaic has no place on the Earth, "
    "its unit is "
    "about a ground pixel, and its orientation is arbitrary; give --pos or --gcp to have a map"
)


def check_survey_files(
    folder: Path,
    *,
    pos: Path | None = None,
    camera: Path | None = None,
    dem: Path | None = None,
    gcp: Path | None = None,
    gcp_optional: bool = False,
    crs: str = "auto",
    pos_crs: str | None = None,
    attitude_convention: str = "auto",
) -> None:
    """Raises what `read_survey` would raise without opening a frame: of a survey's files each by itself."""
    files = frame_files(folder, [p for p in (dem, gcp, pos, camera) if p is not None])
    near: list[tuple[float, float]] = []
    with proposing_zone(files, near):
        if crs != "auto":
            with suppress(AmbiguousCrsError):  # decided by the frames' positions when these are read
                map_crs(crs)
        if pos is not None:
            names = FrameNames(files.values())
            table = read_pos(pos, crs=pos_crs, attitude_convention=attitude_convention, frames=names)
            near += [(row.lon_deg, row.lat_deg) for row in table.rows]
        if camera is not None:
            read_cameras(camera)
        if dem is not None:
            check_dem(dem)
        if gcp is not None:
            with suppress(AmbiguousCrsError):
                control = read_control(gcp, FrameNames(files.values()))
                if not gcp_optional:
                    check_marks(control)


def read_survey(
    folder: Path,
    *,
    pos: Path | None = None,
    camera: Path | None = None,
    dem: Path | None = None,
    dem_offset_m: float | None = None,
    gcp: Path | None = None,
    gcp_optional: bool = False,
    crs: str = "auto",
    pos_crs: str | None = None,
    attitude_convention: str = "auto",
    damaged: str = "leave_out",
    leave_out: str = "auto",
    camera_kind: str | None = None,
    strict: bool = False,
    inspect: Inspect = inspect_all,
    progress: Progress | None = None,
) -> Survey:
    """Read everything a survey is made of; nothing is written. Every frame is decoded once, small.

    Frames are those of `frame_files`, in order of capture (time, then name; by name alone
    where a frame has no time). The work frame lies at the median position, at the median height of the
    ground as far as it is known (DEM, else absolute less relative heights, else control), else at height 0.
    Where no frame has a position it lies amid the control points; without those it is nowhere, and the map's
    CRS is `LOCAL_CRS`.

    Args: pos, camera, dem, gcp: files as docs/inputs.md describes them; dem_offset_m: what is added to
    the DEM's values to have ellipsoidal heights; gcp_optional: a gcp of which no point can be used is a
    warning; crs: the map's, `auto` for the UTM zone of the
    middle; pos_crs: of x and y in pos; attitude_convention: one of `attitude.CONVENTIONS`; damaged: one of
    `usable.DAMAGED`; leave_out: one of `strays.LEAVE_OUT`; camera_kind: of the aircraft's cameras, see
    `strays.camera_kind`; strict: frames that can't be used, frames without
    a line in pos and lines without a frame are errors; inspect: `damage.wholeness` of many frames;
    progress: called with frames done, frames in all, and what is being done.
    Raises: `InputError` and `FileError`, one line that names the file and the fix.
    """
    files = frame_files(folder, [p for p in (dem, gcp, pos, camera) if p is not None])
    table = None
    if pos is not None:
        of = FrameNames(files.values())
        table = read_pos(pos, crs=pos_crs, attitude_convention=attitude_convention, frames=of)
    cameras = None if camera is None else read_cameras(camera)
    inner = unused_folders(folder)
    found = usable(files, inspect, mask_damaged=damaged == "mask", strict=strict, progress=progress)
    headers, by_time = _in_order(found.headers)
    strays = [] if leave_out == "none" else other_kinds(headers, camera_kind)
    headers = without(headers, strays)
    rig = captures(headers)
    if rig is not None:
        headers, by_time = _in_order([b.header for b in rig.own])
    if leave_out != "none":
        strays += _strays(headers, found, table, with_lens=cameras is not None, strict=strict)
        headers = without(headers, strays)
    _check_alike(headers)
    left_out = (*found.left_out, *(out for _, out in strays))
    names = [h.name for h in headers]
    observed = observe(headers, table, [out.name for out in left_out], strict=strict)
    check_extent(headers, observed.positions)
    located = [p for p in observed.positions if p.known]
    near = lonlat_of(located) if located else NOWHERE
    control: tuple[ControlPoint, ...] = ()
    control_warnings: list[Warn] = []
    if gcp is not None:
        sizes = {h.name: (h.width_px, h.height_px) for h in headers}
        with proposing_zone([h.path for h in headers], near.tolist()):
            points = read_control(gcp, FrameNames(names), near)
        control, control_warnings = used_control(points, near, sizes, optional=gcp_optional)
    local = not located and not control
    if not located and control:
        there = np.median(lonlat_of_control(control), axis=0)
        observed = observe(headers, table, anywhere=(float(there[0]), float(there[1])))
    _check_local(local, folder, crs, dem)

    def lenses(of: Sequence[FrameHeader], wanted: Sequence[str | None]) -> CameraChoice:
        if cameras is None or camera is None:
            return cameras_from_headers(of)
        return cameras_from_file(of, cameras, camera, wanted)

    choice = lenses(headers, observed.cameras)
    lonlat = lonlat_of(located or observed.positions)
    elevation, heights = None, np.array([])
    dem_warnings: list[Warn] = []
    if dem is not None:
        under = [n for n, p in zip(names, observed.positions, strict=True) if p.known or not located]
        elevation, heights, dem_warnings = read_elevation(dem, dem_offset_m, under, lonlat)
    middle = np.median(lonlat, axis=0)
    lon = float((middle[0] + 180.0) % 360.0 - 180.0)
    work_frame = LocalFrame(lon, float(middle[1]), _ground_height_m(observed.positions, control, heights))
    with proposing_zone((), [(lon, work_frame.lat_deg)]):
        wanted_crs, crs_notes = _wanted_crs(crs, lon, work_frame.lat_deg)
    frames = tuple(
        Frame(
            name=h.name,
            path=str(h.path),
            width_px=h.width_px,
            height_px=h.height_px,
            bands=h.bands,
            dtype=h.dtype,
            camera=name,
            position=position,
            attitude=attitude,
            time_s=h.exif.time_s,
            valid_mask=found.masks.get(h.name),
            nodata=h.nodata,
            velocity_m_per_s=velocity_of(h),
            turns=turns_of(h),
            whole_rows=found.whole_rows.get(h.name),
            platform=platform_of(h),
        )
        for h, name, position, attitude in zip(
            headers, choice.names, observed.positions, observed.attitudes, strict=True
        )
    )
    band, other_bands = _bands(rig, frames, lenses) if rig else ("", ())
    lost = [] if rig is None else incomplete_captures(rig, names)
    order = (
        []
        if by_time
        else [Warn("order-by-name", "", ("not all frames have a time: frames are ordered by name"))]
    )
    return Survey(
        frames=frames,
        cameras=choice.cameras,
        work_frame=work_frame,
        map_crs=LOCAL_CRS
        if local
        else utm_crs(lon, work_frame.lat_deg)
        if wanted_crs is None
        else wanted_crs.to_string(),
        elevation=elevation,
        control=control,
        left_out=left_out,
        band=band,
        other_bands=other_bands,
        warnings=(
            *([Warn("frames-in-folders", "", _inner_words(inner))] if inner else []),
            *lost,
            *([Warn("local-frame", "", _LOCAL)] if local else []),
            *found.warnings,
            *stray_warnings(strays),
            *order,
            *crs_notes,
            *observed.warnings,
            *choice.warnings,
            *dem_warnings,
            *control_warnings,
        ),
    )


def _wanted_crs(text: str, lon_deg: float, lat_deg: float) -> tuple[CRS | None, list[Warn]]:
    """The map's CRS where one is asked for, and what was assumed; its middle lies at lon_deg, lat_deg."""
    if text == "auto":
        return None, []
    crs = map_crs(text, (lon_deg, lat_deg))
    named = (
        []
        if required_crs(text, "").is_name_of(crs)
        else [
            Warn(
                "crs-by-name",
                "",
                (f"--crs '{text}' is taken as {label(crs)}; give its EPSG code if it is another"),
            )
        ]
    )
    return crs, [*named, *check_area(crs, lon_deg, lat_deg, "the frames")]


def _inner_words(inner: Sequence[str]) -> str:
    return (
        f"images in folders next to the frames are not used: {some(inner)}; give the folder above to use all"
    )


def _bands(
    rig: CaptureGroups,
    frames: Sequence[Frame],
    lenses: Callable[[Sequence[FrameHeader], Sequence[str | None]], CameraChoice],
) -> tuple[str, tuple[Band, ...]]:
    """What the frames show, and the rig's other bands, each with a camera of its own."""
    bands = []
    for name, by_own in rig.others.items():
        files = [by_own.get(f.name) for f in frames]
        some_file = next(f for f in files if f is not None)
        camera = lenses([some_file.header], [name]).cameras[0]
        shown = tuple(
            None if file is None else _in_band(frame, file.header, camera.name)
            for frame, file in zip(frames, files, strict=True)
        )
        bands.append(Band(name, some_file.wavelength_nm, camera, shown))
    return rig.own[0].band, tuple(bands)


def _in_band(frame: Frame, header: FrameHeader, camera: str) -> Frame:
    """The same capture's file of another band."""
    return replace(
        frame,
        name=header.name,
        path=str(header.path),
        width_px=header.width_px,
        height_px=header.height_px,
        camera=camera,
        nodata=header.nodata,
        valid_mask=None,
        whole_rows=None,
    )


def _strays(
    headers: Sequence[FrameHeader], found: Usable, table: PosFile | None, *, with_lens: bool, strict: bool
) -> list[Stray]:
    """Images that don't belong to the survey. Args: headers of one kind, in order of capture; with_lens: a
    camera file gives the lenses."""
    out = copies(headers, [found.looks[h.name] for h in headers])
    rest = without(headers, out)
    if not with_lens:
        out += without_camera(rest)
        rest = without(headers, out)
    out += blurred(rest, [found.looks[h.name] for h in rest])
    rest = without(headers, out)
    observed = observe(rest, table, [o.name for o in (*found.left_out, *(o for _, o in out))])
    if strict:
        check_extent(rest, observed.positions)
    return out + misplaced(rest, observed.positions)


def _check_alike(headers: Sequence[FrameHeader]) -> None:
    """`InputError` naming the odd frames where not all have the same bands and type: no mosaic holds both."""
    kinds = Counter((h.bands, h.dtype) for h in headers)
    if len(kinds) == 1:
        return
    usual = kinds.most_common(1)[0][0]
    odd = [h for h in headers if (h.bands, h.dtype) != usual]
    few = f" ({len(odd)} such: {some(h.name for h in odd)})" if len(odd) > 1 else ""
    raise InputError(
        f"has {_kind(odd[0].bands, odd[0].dtype)}, {kinds[usual]} other frames have {_kind(*usual)}{few}",
        file=odd[0].path,
        fix="convert it, or take it out of the folder",
    )


def _kind(bands: int, dtype: str) -> str:
    return f"{bands} band{'s' if bands > 1 else ''} of {dtype}"


def _in_order(headers: Sequence[FrameHeader]) -> tuple[list[FrameHeader], bool]:
    times = {h.name: h.exif.time_s for h in headers}
    if any(t is None for t in times.values()):
        return sorted(headers, key=lambda h: natural_key(h.name)), False
    return sorted(headers, key=lambda h: (times[h.name] or 0.0, natural_key(h.name))), True


def _check_local(local: bool, folder: Path, crs: str, dem: Path | None) -> None:
    """`InputError` for what needs a place on the Earth, where frames have none."""
    for wanted, what in (
        (crs != "auto", f"there can be no map in {crs}"),
        (dem is not None, "a DEM cannot be used"),
    ):
        if local and wanted:
            raise InputError(
                f"no frame has a position: {what}",
                file=folder,
                fix="give positions with --pos or control points with --gcp",
            )


def _ground_height_m(
    positions: Sequence[Position], control: Sequence[ControlPoint], dem_heights_m: Floats
) -> float:
    known = dem_heights_m[np.isfinite(dem_heights_m)]
    if not known.size:
        known = np.array(
            [
                p.height_ellipsoidal_m - p.height_above_ground_m
                for p in positions
                if p.height_ellipsoidal_m is not None and p.height_above_ground_m is not None
            ]
        )
    if not known.size:
        known = np.array([c.height_ellipsoidal_m for c in control])
    return float(np.median(known)) if known.size else 0.0
