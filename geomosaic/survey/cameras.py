"""The camera of each frame: from a camera file, or from what its EXIF and XMP say."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from geomosaic.camera.interior import Camera
from geomosaic.survey.accuracy import FOCAL_LENGTH
from geomosaic.survey.focal_lengths import (
    ALIKE,
    action_camera,
    agreed,
    nearest_to_usual,
    reported_focal_lengths,
    too_wide,
    usual_focal_px,
    wide_mode,
)
from geomosaic.survey.header import FrameHeader
from geomosaic.survey.lens_tags import (
    dji_calibrated,
    dji_dewarp,
    fisheye,
    label,
    xmp_fisheye,
    xmp_perspective,
)
from geomosaic.survey.model import Warn
from geomosaic.survey.plausible import SLOWEST, focal_length_can_be, lens_problem, strange_lenses, warn
from geomosaic.survey.shutters import shutter

_GIVE_READOUT: Final = "give that time as readout_s in a --camera file"
_TAGS: Final = {
    "dji-dewarp": "DewarpData",
    "xmp-perspective": "PerspectiveDistortion",
    "xmp-fisheye": "FisheyePolynomial",
    "dji-calibrated": "CalibratedFocalLength",
}
_UNSURE: Final = {
    "assumed": "the frames don't report a focal length that can be",
    "contradicting": "the tags contradict each other about the focal length, or give one that no lens has",
    "action-camera": "an action camera, whose field of view depends on a mode that no tag gives",
}
_UNSURE_MEANS: Final = (
    ", and the images decide. Over flat land they can't: the map's scale and heights then rest on positions; "
    "give the camera's interior orientation with --camera FILE"
)


@dataclass(frozen=True)
class CameraChoice:
    """The cameras in use, the name of each frame's, and what was assumed."""

    cameras: tuple[Camera, ...] = ()
    names: tuple[str, ...] = ()
    warnings: tuple[Warn, ...] = ()


def cameras_from_headers(headers: Sequence[FrameHeader]) -> CameraChoice:
    """A camera for each make, model, size and focal length, from EXIF and XMP.

    A frame whose focal length can't be, or not among the others of its make, model and size, takes the one
    that most of those have. If none has one, it is assumed.
    """
    reported = [reported_camera(header) for header in headers]
    known, wrong = _among_others(headers, reported)
    found: dict[str, Camera] = {}
    names: list[str] = []
    warnings: list[Warn] = []
    for header, (camera, source) in zip(headers, known, strict=True):
        if camera.name not in found:
            warnings += _assumed(header, camera, source)
        elif found[camera.name] != camera:  # the same make and focal length, calibrated otherwise
            same = [n for n, c in found.items() if replace(c, name=camera.name) == camera]
            name = same[0] if same else f"{camera.name} ({len(found) + 1})"
            camera = replace(camera, name=name)
        found.setdefault(camera.name, camera)
        names.append(camera.name)
    if any(wrong):
        files = [h.name for h in headers]
        absurd = np.array([bool(w) for w in wrong])
        fix = "give the lens with --camera"
        warnings.append(warn("focal-length-absurd", files, absurd, wrong, fix))
    return CameraChoice(tuple(found.values()), tuple(names), tuple(warnings))


def _assumed(header: FrameHeader, camera: Camera, source: str) -> list[Warn]:
    """What is taken of a camera's lens and shutter, from the tags of its first frame."""
    focal = f"{camera.focal_length_px:.0f} px"
    if source in _UNSURE:
        lens = "a fisheye's " if camera.kind == "fisheye" else ""
        text = f"{camera.name}: {_UNSURE[source]}; {lens}{focal} is assumed to begin with{_UNSURE_MEANS}"
        return [Warn("focal-length-assumed", "", text), *shutter_warnings(header, camera)]
    text = f"{camera.name}: focal length {focal} (sd {camera.focal_length_sd_px:.0f}) from {source}"
    if source in _TAGS:
        text += f", principal point {camera.principal_col_px:.0f}, {camera.principal_row_px:.0f}"
        text += " and distortion" if camera.terms.any() else ""
    if camera.kind == "fisheye":
        text += " of a fisheye lens"
        text += "" if camera.terms.any() else ", whose distortion the adjustment has to find"
    return [Warn("camera-assumed", "", text), *shutter_warnings(header, camera)]


def shutter_warnings(header: FrameHeader, camera: Camera) -> list[Warn]:
    """What a frame's tags or model say of its shutter, where that isn't nothing."""
    source, rolling = shutter(header).source, f"{camera.name}: a rolling shutter that reads all rows in"
    if source == "tag":
        return [Warn("readout-by-tag", "", f"{rolling} {camera.readout_s:.3g} s (LineReadoutTime)")]
    if source == "model":
        text = (
            f"{rolling} {camera.readout_s:.3g} s, a published value of this model; the adjustment "
            "estimates it"
        )
        return [Warn("readout-by-model", "", text)]
    if source == "turned":
        text = (
            f"{camera.name}: its frames stand upright, so their pixels were turned after the flight, and the "
            "order in which a rolling shutter read them is lost; give the files as the camera wrote them"
        )
        return [Warn("pixels-turned", "", text)]
    if source == "absurd":
        text = (
            f"{camera.name}: its LineReadoutTime is implausible (all rows take {SLOWEST.value:g} s at "
            "most) and not used"
        )
        return [Warn("readout-absurd", "", f"{text}: if rows are read one after the other, {_GIVE_READOUT}")]
    return []


def unreported(headers: Sequence[FrameHeader]) -> list[int]:
    """Frames that report no lens, nor does another of their make, model and size."""
    known, _ = _among_others(headers, [reported_camera(header) for header in headers])
    return [i for i, (_, source) in enumerate(known) if source == "assumed"]


def reported_camera(header: FrameHeader) -> tuple[Camera | None, str, str]:
    """The camera that a header reports, by which source, and what it reports before that can't be.

    The surest source first whose focal length can be: the maker's calibration in the XMP (DJI's `DewarpData`,
    Pix4D's `Camera:Perspective...`, DJI's `CalibratedFocalLength`), then those of `reported_focal_lengths`
    that another one agrees with. `contradicting` where none does: that nearest to most cameras', with a
    deviation that covers all.
    """
    exif, width, height = header.exif, header.width_px, header.height_px
    reported = reported_focal_lengths(header)
    from_35mm = reported.by_source.get("exif-35mm")
    blank = _blank(header)
    makers = {
        "dji-dewarp": dji_dewarp(header, blank),
        "xmp-perspective": xmp_perspective(header, blank, reported.pixels_per_mm),
        "xmp-fisheye": xmp_fisheye(header, blank, reported.pixels_per_mm),
        "dji-calibrated": dji_calibrated(header, blank),
    }
    wrong, unlike = "", {}
    for source, lens in makers.items():
        if lens is None:
            continue
        if lens_problem(lens):
            wrong = wrong or _TAGS[source]
        elif from_35mm and abs(lens.focal_length_px / from_35mm - 1.0) >= ALIKE:
            unlike[source] = lens.focal_length_px
        else:
            return lens, source, ""
    focals = {}
    for source, focal in reported.by_source.items():
        if focal_length_can_be(focal, width, height):
            focals[source] = focal
        else:
            wrong = wrong or f"a focal length of {focal:.3g} px (from {source})"
    if not focals:
        return None, "", wrong
    chosen = agreed(focals if len(focals) > 1 else focals | unlike)
    if chosen is None:
        return _of_several(header, blank, focals | unlike), "contradicting", wrong
    focal = focals[chosen]
    if too_wide(focal, width, height) and blank.kind != "fisheye":
        return _of_several(header, blank, focals), "contradicting", wrong
    relative = FOCAL_LENGTH[chosen].sd_relative
    if chosen == "exif-35mm" and exif.focal_length_35mm is not None:
        relative = math.hypot(relative, 1.0 / math.sqrt(12.0) / exif.focal_length_35mm)
    if action_camera(header):
        relative, chosen = FOCAL_LENGTH["action-camera"].sd_relative, "action-camera"
    return replace(blank, focal_length_px=focal, focal_length_sd_px=relative * focal), chosen, wrong


def _blank(header: FrameHeader) -> Camera:
    """The frame's camera without a lens."""
    exif, width, height = header.exif, header.width_px, header.height_px
    mm, mm_35 = exif.focal_length_mm, exif.focal_length_35mm
    zoom = f" {mm:g} mm" if mm else f" {mm_35:g} mm (35 mm)" if mm_35 else ""
    zoom += f" x {exif.digital_zoom:g}" if zoom and (exif.digital_zoom or 1.0) > 1.0 else ""
    by_rows = shutter(header)
    return Camera(
        f"{label(header)} {width} x {height}{zoom}",
        width,
        height,
        1.0,
        width / 2.0,
        height / 2.0,
        readout_s=by_rows.readout_s,
        readout_sd_s=by_rows.sd_s,
        kind="fisheye" if fisheye(header) or wide_mode(header) else "brown",
    )


def _of_several(header: FrameHeader, blank: Camera, focals: dict[str, float]) -> Camera:
    """A lens of which sources contradict each other, or that is none: its deviation covers them all."""
    usual = usual_focal_px(header)
    flat = {s: f for s, f in focals.items() if not too_wide(f, blank.width_px, blank.height_px)}
    focal = nearest_to_usual(flat or {"assumed": usual}, usual)
    reach = max(abs(f - focal) for f in focals.values())
    sd_px = max(FOCAL_LENGTH["assumed"].sd_relative * focal, reach)
    return replace(blank, focal_length_px=focal, focal_length_sd_px=sd_px)


def _assumed_lens(header: FrameHeader) -> tuple[Camera, str]:
    """The lens of a frame that reports none."""
    focal = usual_focal_px(header)
    sd_px = FOCAL_LENGTH["assumed"].sd_relative * focal
    return replace(_blank(header), focal_length_px=focal, focal_length_sd_px=sd_px), "assumed"


def _among_others(
    headers: Sequence[FrameHeader], reported: Sequence[tuple[Camera | None, str, str]]
) -> tuple[list[tuple[Camera, str]], list[str]]:
    """Each frame's camera and source, and what was reported instead that can't be, or is '' where all can."""
    kinds: dict[tuple[str, int, int], list[int]] = {}
    for i, header in enumerate(headers):
        kinds.setdefault((label(header), header.width_px, header.height_px), []).append(i)
    known: list[tuple[Camera, str] | None] = [None if c is None else (c, source) for c, source, _ in reported]
    wrong = [w for _, _, w in reported]
    for alike in kinds.values():
        having = [(i, c.focal_length_px) for i in alike if (c := reported[i][0]) is not None]
        strange = strange_lenses(np.array([focal for _, focal in having]))
        for (i, focal), is_strange in zip(having, strange, strict=True):
            if is_strange:
                known[i], wrong[i] = None, f"a focal length of {focal:.3g} px (from {reported[i][1]})"
        usual = Counter(k for i in alike if (k := known[i]) is not None and not wrong[i]).most_common(1)
        for i in alike:
            if (wrong[i] or known[i] is None) and usual:
                known[i] = usual[0][0]
    cameras = [_assumed_lens(h) if c is None else c for h, c in zip(headers, known, strict=True)]
    return cameras, wrong
