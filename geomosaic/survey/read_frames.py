"""Steps of reading a survey that concern its frames: which are used, what was observed, their cameras."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

from geomosaic.doors.thermograms import check_thermograms, thermogram
from geomosaic.errors import InputError
from geomosaic.survey.calibration_tags import temperature
from geomosaic.survey.camera_kinds import JOINED, captures_of_kinds, other_cameras
from geomosaic.survey.draft import SurveyDraft
from geomosaic.survey.extent import check_extent
from geomosaic.survey.folder import unused_images
from geomosaic.survey.header import JPEG_SUFFIXES, FrameHeader
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.model import Band, Frame, UnusedImage
from geomosaic.survey.motion_tags import turns_of, velocity_of
from geomosaic.survey.names import FrameNames, natural_key, some
from geomosaic.survey.observations import observe, on_datum
from geomosaic.survey.onboard import platform_of
from geomosaic.survey.other_files import unused_files
from geomosaic.survey.platforms import with_platforms
from geomosaic.survey.rig import captured_files, captures
from geomosaic.survey.strays import (
    Stray,
    bands_and_type,
    blurred,
    copies,
    misplaced,
    other_kinds,
    without,
    without_camera,
)
from geomosaic.survey.usable import Inspect, usable

Progress = Callable[[int, int, str], None]


def readable_frames(inputs: SurveyInputs, inspect: Inspect, progress: Progress | None) -> SurveyDraft:
    """The POS file, the camera file, and the folder's frames that can be read, in order of capture."""
    files = inputs.frame_files()
    cameras = inputs.cameras()
    masked, strict = inputs.damaged == "mask", inputs.strict
    found = usable(files, inspect, mask_damaged=masked, strict=strict, progress=progress)
    headers, in_time = _in_order(found.headers)
    together = captured_files(headers) if len(headers) == len(files) else ()
    pos = inputs.positions(FrameNames(files.values(), together))
    warnings = [*unused_images(inputs.frames, files, inputs.files.values()), *unused_files(files)]
    return SurveyDraft(inputs, pos, cameras, found, headers, in_time, folder_warnings=tuple(warnings))


def with_temperatures(draft: SurveyDraft) -> SurveyDraft:
    """FLIR's JPEG frames as their temperatures, where these are asked for; without the frames that have none,
    unless a camera is asked for.

    Raises: `InputError` where no frame has them.
    """
    if draft.inputs.radiometry != "temperature":
        return draft
    check_thermograms()
    errors: dict[str, InputError] = {}
    headers = []
    for header in draft.headers:
        if header.path.suffix.lower() in JPEG_SUFFIXES:
            try:
                rows, cols = thermogram(header.path).shape
                header = replace(header, width_px=cols, height_px=rows, bands=1, dtype="float32")
            except InputError as error:
                errors[header.name] = error
        headers.append(header)
    if errors and not any(temperature(header) for header in headers):
        raise next(iter(errors.values()))
    if draft.inputs.camera_kind is not None:
        errors = {}
    strays = [("frame-no-temperature", UnusedImage(name, error.problem)) for name, error in errors.items()]
    return replace(draft, headers=tuple(without(headers, strays)), strays=tuple(strays))


def without_other_cameras(draft: SurveyDraft) -> SurveyDraft:
    """Frames of one kind; of a rig that writes a file a band, those of one band, and of cameras that are
    mosaicked together those of the first."""
    inputs = draft.inputs
    kinds = (inputs.camera_kind or "").split(JOINED)
    if len(kinds) > 1:
        together = captures_of_kinds(draft.headers, kinds)
        headers, in_time = _in_order([band.header for band in together.own])
        strays = (*draft.strays, *other_cameras(draft.headers, kinds))
        return replace(draft, rig=together, headers=headers, in_time=in_time, strays=strays)
    others = [] if inputs.leave_out == "none" else other_kinds(draft.headers, inputs.camera_kind)
    draft = _without(draft, others)
    rig = captures(draft.headers)
    if rig is None:
        return draft
    headers, in_time = _in_order([band.header for band in rig.own])
    return replace(draft, rig=rig, headers=headers, in_time=in_time)


def without_strays(draft: SurveyDraft) -> SurveyDraft:
    """Frames that belong to the survey. Raises: `InputError` where these are of several kinds."""
    if draft.inputs.leave_out != "none":
        draft = _without(draft, _strays(draft))
    _check_alike(draft.headers)
    return draft


def thinned(draft: SurveyDraft) -> SurveyDraft:
    """One of every so many frames, in their order."""
    every = draft.inputs.every
    out = [h for i, h in enumerate(draft.headers) if i % every]
    unused = [("frame-every", UnusedImage(h.name, f"is left out by --every {every}")) for h in out]
    return replace(draft, headers=draft.headers[::every], strays=(*draft.strays, *unused))


def _strays(draft: SurveyDraft) -> list[Stray]:
    """Images that don't belong to the survey, of frames of one kind."""
    looks = draft.usable.looks
    out = copies(draft.headers, [looks[h.name] for h in draft.headers])
    rest = without(draft.headers, out)
    if draft.inputs.camera is None:
        out += without_camera(rest)
        rest = without(draft.headers, out)
    out += blurred(rest, [looks[h.name] for h in rest])
    rest = without(draft.headers, out)
    others = draft.other_images | {image.name: "" for _, image in out}
    observed = observe(rest, draft.pos, others)
    if draft.inputs.strict:
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
    its = bands_and_type(odd[0].bands, odd[0].dtype)
    raise InputError(
        f"has {its}, {kinds[usual]} other frames have {bands_and_type(*usual)}{few}",
        file=odd[0].path,
        fix="convert it, or take it out of the folder",
    )


def with_observations(draft: SurveyDraft) -> SurveyDraft:
    """Position and attitude of every frame. Raises: `InputError` where positions lie too far apart."""
    observed = observe(draft.headers, draft.pos, draft.other_images, strict=draft.inputs.strict)
    check_extent(draft.headers, observed.positions)
    datum = draft.inputs.datum
    return replace(draft, observed=observed if datum is None else on_datum(observed, datum))


def with_cameras(draft: SurveyDraft) -> SurveyDraft:
    """The camera of every frame."""
    return replace(draft, choice=draft.cameras_of(draft.headers, draft.observed.cameras))


def with_frames(draft: SurveyDraft) -> SurveyDraft:
    """What headers, observations and cameras say of every frame."""
    observed, found = draft.observed, draft.usable
    frames = tuple(
        Frame(
            name=h.name,
            path=str(h.path),
            width_px=h.width_px,
            height_px=h.height_px,
            bands=h.bands,
            dtype=h.dtype,
            camera=camera,
            position=position,
            attitude=attitude,
            time_s=h.exif.time_s,
            valid_mask=found.masks.get(h.name),
            nodata=h.nodata,
            velocity_m_per_s=velocity_of(h),
            turns=turns_of(h),
            whole_rows=found.whole_rows.get(h.name),
            platform=platform_of(h),
            calibration=draft.calibrations.get(str(h.path)),
            exposure=h.exif.exposure,
        )
        for h, camera, position, attitude in zip(
            draft.headers, draft.choice.names, observed.positions, observed.attitudes, strict=True
        )
    )
    return replace(draft, frames=with_platforms(frames))


def with_bands(draft: SurveyDraft) -> SurveyDraft:
    """The rig's other bands, each with a camera of its own."""
    bands = []
    for name, by_own in draft.rig.others.items() if draft.rig else ():
        files = [by_own.get(frame.name) for frame in draft.frames]
        some_file = next((file for file in files if file is not None), None)
        if some_file is None:  # all its captures are left out
            continue
        camera = draft.cameras_of([some_file.header], [name]).cameras[0]
        frames = tuple(
            None
            if file is None
            else replace(
                _in_band(frame, file.header, camera.name),
                valid_mask=draft.usable.masks.get(file.header.name),
                whole_rows=draft.usable.whole_rows.get(file.header.name),
                calibration=draft.calibrations.get(str(file.header.path)),
            )
            for frame, file in zip(draft.frames, files, strict=True)
        )
        bands.append(Band(name, some_file.wavelength_nm, camera, frames, draft.quantities.get(name)))
    return replace(draft, other_bands=tuple(bands))


def _in_band(frame: Frame, header: FrameHeader, camera: str) -> Frame:
    """The same capture's file of another band, whose colours count as one brightness."""
    return replace(
        frame,
        name=header.name,
        path=str(header.path),
        width_px=header.width_px,
        height_px=header.height_px,
        bands=1,
        dtype=header.dtype,
        camera=camera,
        nodata=header.nodata,
        exposure=header.exif.exposure,
    )


def _without(draft: SurveyDraft, strays: Sequence[Stray]) -> SurveyDraft:
    """The survey without some frames, in order of capture if these alone had no time."""
    headers, in_time = tuple(without(draft.headers, strays)), draft.in_time
    if strays and not in_time and draft.rig is None:
        headers, in_time = _in_order(headers)
    return replace(draft, headers=headers, in_time=in_time, strays=(*draft.strays, *strays))


def _in_order(headers: Sequence[FrameHeader]) -> tuple[tuple[FrameHeader, ...], bool]:
    """By time and name, by name alone where a frame has no time; and whether all have one."""
    in_time = all(h.exif.time_s is not None for h in headers)
    by_name = sorted(headers, key=lambda h: natural_key(h.name))
    return tuple(sorted(by_name, key=lambda h: h.exif.time_s or 0.0) if in_time else by_name), in_time
