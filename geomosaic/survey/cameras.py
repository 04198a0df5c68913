"""The camera of each frame: from a camera file, or from what its EXIF and XMP say."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Final

import numpy as np

from geomosaic.camera.interior import Camera
from geomosaic.constants import CHOSEN, Because
from geomosaic.errors import InputError
from geomosaic.survey.accuracy import FOCAL_LENGTH
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

FILM_DIAGONAL_MM: Annotated[
    float,
    Because(
        "mm",
        "of an image of 36 x 24 mm: 35 mm equivalents of focal lengths compare diagonals",
        "CIPA DCG-001",
    ),
] = math.hypot(36.0, 24.0)
SENSOR_WIDTHS_MM: Annotated[
    dict[str, float],
    Because(
        "mm",
        "width of the whole sensor by EXIF's model, which a frame of any shape fills from side to side: a "
        "wrong one makes the focal length wrong by as much",
        "nominal sizes of the formats: 1/2.3 inch 6.17, 1 inch 13.2, APS-C 23.5, four thirds 17.3, 35 mm "
        "35.9; where the rest are from is not known",
    ),
] = {
    "fc300c": 6.17, "fc300s": 6.17, "fc300x": 6.17, "fc330": 6.17, "fc220": 6.17, "fc350": 6.17,
    "fc550": 17.3, "fc6310": 13.2, "fc6310r": 13.2, "fc6310s": 13.2, "fc6510": 13.2, "fc6520": 17.3,
    "l1d-20c": 13.2, "fc3411": 13.2, "l2d-20c": 17.3, "m3e": 17.3, "zenmusep1": 35.9, "s.o.d.a.": 12.75,
    "dsc-wx220": 6.17, "ilce-6000": 23.5, "ilce-7rm2": 35.9,
}  # fmt: skip
_MAX_ASPECT_DIFFERENCE: Annotated[
    float,
    Because(
        "share of the ratio of the sides",
        "between a camera and a frame of another size: resizing rounds sides to whole pixels; with more a "
        "cropped image would get the lens of the whole one",
        CHOSEN,
    ),
] = 0.003
_BESIDE_35MM: Annotated[
    float,
    Because(
        "share of the 35 mm equivalent",
        "by which a maker's focal length may differ from it and still be this image's: whole millimetres "
        "leave some per cent, an image that was cut or taken by another lens differs by more",
        CHOSEN,
    ),
] = 0.15
_UNLIKE_TAGS: Annotated[
    float,
    Because(
        "ratio",
        "between the focal lengths of a camera file and the tags beyond which one is wrong: tags are good "
        "to a twentieth, another unit is off by far more",
        CHOSEN,
    ),
] = 1.5
_TAGS: Final = {
    "dji-dewarp": "DewarpData",
    "xmp-perspective": "PerspectiveDistortion",
    "xmp-fisheye": "FisheyePolynomial",
    "dji-calibrated": "CalibratedFocalLength",
}
_GIVE: Final = "give the camera's interior orientation with --camera FILE (docs/inputs.md)"


@dataclass(frozen=True)
class CameraChoice:
    """The cameras in use, the name of each frame's, and what was assumed."""

    cameras: tuple[Camera, ...]
    names: tuple[str, ...]
    warnings: tuple[Warn, ...]


def cameras_from_headers(headers: Sequence[FrameHeader]) -> CameraChoice:
    """A camera for each make, model, size and focal length, from EXIF and XMP.

    A frame whose focal length can't be, or not among the others of its make, model and size, takes the one
    that most of those have.

    Raises: `InputError` naming a frame that doesn't report its focal length, where no such other does.
    """
    reported = [_reported(header) for header in headers]
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
        warnings.append(warn("focal-length-absurd", files, np.array([bool(w) for w in wrong]), wrong))
    return CameraChoice(tuple(found.values()), tuple(names), tuple(warnings))


def _assumed(header: FrameHeader, camera: Camera, source: str) -> list[Warn]:
    """What is taken of a camera's lens and shutter, from the tags of its first frame."""
    focal = f"{camera.focal_length_px:.0f} px"
    text = f"{camera.name}: focal length {focal} (sd {camera.focal_length_sd_px:.0f}) from {source}"
    if source in _TAGS:
        text += f", principal point {camera.principal_col_px:.0f}, {camera.principal_row_px:.0f}"
        text += " and distortion" if camera.terms.any() else ""
    if camera.kind == "fisheye":
        text += " of a fisheye lens"
        text += "" if camera.terms.any() else ", whose distortion the adjustment has to find"
    return [Warn("camera-assumed", "", text), *_shutter_reported(header, camera)]


def _shutter_reported(header: FrameHeader, camera: Camera) -> list[Warn]:
    """What a frame's tags or model say of its shutter, where that isn't nothing."""
    source, rolling = shutter(header).source, f"{camera.name}: a rolling shutter, all rows read within"
    if source == "tag":
        return [Warn("readout-by-tag", "", f"{rolling} {camera.readout_s:.3g} s (LineReadoutTime)")]
    if source == "model":
        text = f"{rolling} {camera.readout_s:.3g} s, as others measured of this model; solved for about that"
        return [Warn("readout-by-model", "", text)]
    if source == "absurd":
        text = f"{camera.name}: its LineReadoutTime can't be (all rows in {SLOWEST.value:g} s at most)"
        return [Warn("readout-absurd", "", f"{text}: taken as not given")]
    return []


def camera_from_header(header: FrameHeader) -> tuple[Camera, str]:
    """A frame's camera and which source reported it, the surest first whose focal length can be.

    The maker's calibration in the XMP (DJI's `DewarpData`, Pix4D's `Camera:Perspective...`, DJI's
    `CalibratedFocalLength`); focal length with the focal plane's resolution; focal length with the
    sensor's width from `SENSOR_WIDTHS_MM`; the 35 mm equivalent, which compares diagonals
    (CIPA DCG-001): for frames wider than 3:2 that of a 4:3 sensor they are cut from.

    Raises: `InputError` where none reports a focal length that can be.
    """
    camera, source, wrong = _reported(header)
    if camera is None:
        raise _unreported(header, wrong)
    return camera, source


def _reported(header: FrameHeader) -> tuple[Camera | None, str, str]:
    """The camera that a header reports, by which source, and what it reports before that can't be."""
    exif, width, height = header.exif, header.width_px, header.height_px
    mm = exif.focal_length_mm
    zoom = (
        f" {mm:g} mm" if mm else f" {exif.focal_length_35mm:g} mm (35 mm)" if exif.focal_length_35mm else ""
    )
    name = f"{label(header)} {width} x {height}{zoom}"
    scale = width / exif.width_px if exif.width_px else 1.0
    by_rows = shutter(header)
    blank = Camera(
        name,
        width,
        height,
        1.0,
        width / 2.0,
        height / 2.0,
        readout_s=by_rows.readout_s,
        readout_sd_s=by_rows.sd_s,
        kind="fisheye" if fisheye(header) else "brown",
    )
    from_35mm = None
    if exif.focal_length_35mm is not None:
        diagonal = math.hypot(width, height) if width <= 1.55 * height else 1.25 * width
        from_35mm = exif.focal_length_35mm * diagonal / FILM_DIAGONAL_MM
    per_mm = None if exif.pixels_per_mm is None else exif.pixels_per_mm * scale
    sensor = SENSOR_WIDTHS_MM.get(exif.model.lower())
    of_mm = per_mm or (width / sensor if sensor else None)
    makers = {
        "dji-dewarp": dji_dewarp(header, blank),
        "xmp-perspective": xmp_perspective(header, blank, of_mm),
        "xmp-fisheye": xmp_fisheye(header, blank, of_mm),
        "dji-calibrated": dji_calibrated(header, blank),
    }
    wrong = ""
    for source, lens in makers.items():
        if lens is None or (from_35mm and abs(lens.focal_length_px / from_35mm - 1.0) >= _BESIDE_35MM):
            continue
        if not lens_problem(lens):
            return lens, source, ""
        wrong = wrong or _TAGS[source]
    focals = {
        "focal-plane": None if mm is None or per_mm is None else mm * per_mm,
        "sensor-table": None if mm is None or sensor is None else mm * width / sensor,
        "exif-35mm": from_35mm,
    }
    for source, focal in focals.items():
        if focal is None:
            continue
        if not focal_length_can_be(focal, width, height):
            wrong = wrong or f"a focal length of {focal:.3g} px (from {source})"
            continue
        relative = FOCAL_LENGTH[source].sd_relative
        if source == "exif-35mm" and exif.focal_length_35mm is not None:
            relative = math.hypot(relative, 1.0 / math.sqrt(12.0) / exif.focal_length_35mm)
        return replace(blank, focal_length_px=focal, focal_length_sd_px=relative * focal), source, wrong
    return None, "", wrong


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
            if wrong[i] and usual:
                known[i] = usual[0][0]
    cameras = []
    for header, camera, problem in zip(headers, known, wrong, strict=True):
        if camera is None:
            raise _unreported(header, problem)
        cameras.append(camera)
    return cameras, wrong


def _unreported(header: FrameHeader, wrong: str) -> InputError:
    problem = f"{wrong} can't be" if wrong else "the frame doesn't report its focal length"
    return InputError(problem, file=header.path, mend=_GIVE)


def cameras_from_file(
    headers: Sequence[FrameHeader], cameras: Sequence[Camera], path: Path, wanted: Sequence[str | None]
) -> CameraChoice:
    """The file's camera for each frame, scaled where the frame is a resized whole image.

    With several cameras in the file: the one that the POS file names (`wanted`), else those whose name
    holds the frame's make and model, else those of the frame's size, else of its shape. Of the shutter, where
    the file says nothing, the frame's tags and model count.

    Raises: `InputError` when none fits a frame or several do.
    """
    found: dict[str, Camera] = {}
    names: list[str] = []
    warnings: list[Warn] = []
    for header, name in zip(headers, wanted, strict=True):
        camera = _fitting(header, cameras, path, name)
        scale = header.width_px / camera.width_px
        if (camera.width_px, camera.height_px) != (header.width_px, header.height_px):
            scaled = _scaled(camera, header.width_px, header.height_px, len(cameras) > 1 or bool(found))
            if scaled.name not in found:
                text = (
                    f"{camera.name}: of {camera.width_px} x {camera.height_px} pixels, scaled by {scale:.4g}"
                )
                warnings.append(Warn("camera-scaled", "", text))
            camera = scaled
        if camera.name not in found:
            warnings += _unlike_tags(header, camera)
            if not camera.readout_s and camera.readout_sd_s:
                reported = shutter(header)
                camera = replace(camera, readout_s=reported.readout_s, readout_sd_s=reported.sd_s)
                warnings += _shutter_reported(header, camera)
        found.setdefault(camera.name, camera)
        names.append(camera.name)
    return CameraChoice(tuple(found.values()), tuple(names), tuple(warnings))


def _unlike_tags(header: FrameHeader, camera: Camera) -> list[Warn]:
    """A word where a camera file's focal length is far from what the frame's own tags say: another unit?"""
    tagged, source, _ = _reported(header)
    if tagged is None or 1.0 / _UNLIKE_TAGS < camera.focal_length_px / tagged.focal_length_px < _UNLIKE_TAGS:
        return []
    text = (
        f"{camera.name}: the focal length of {camera.focal_length_px:.0f} px is far from the "
        f"{tagged.focal_length_px:.0f} px of the frames' tags ({source}); the file is followed: "
        "check its units"
    )
    return [Warn("focal-length-differs", "", text)]


def _fitting(header: FrameHeader, cameras: Sequence[Camera], path: Path, wanted: str | None) -> Camera:
    candidates = [c for c in cameras if wanted and (c.name == wanted or wanted.lower() in c.name.lower())]
    if not candidates:
        label = f"{header.exif.make} {header.exif.model}".strip().lower()
        by_label = [c for c in cameras if label and label in c.name.lower()]
        candidates = by_label or list(cameras)
    shaped = [c for c in candidates if _same_shape(c, header)]
    sized = [c for c in shaped if (c.width_px, c.height_px) == (header.width_px, header.height_px)]
    fitting = sized or shaped
    if len(fitting) == 1:
        return fitting[0]
    size = f"{header.width_px} x {header.height_px} pixels"
    known = ", ".join(f"{c.name} ({c.width_px} x {c.height_px})" for c in candidates[:5])
    if fitting:
        raise InputError(
            f"several cameras fit frame {header.name} of {size}: {known}",
            file=path,
            mend="name each frame's in the POS file's column 'camera'",
        )
    raise InputError(
        f"no camera for frame {header.name} of {size}: {known}",
        file=path,
        mend="give a camera file of this frame size, or of a whole multiple's shape",
    )


def _same_shape(camera: Camera, header: FrameHeader) -> bool:
    scales = header.width_px / camera.width_px, header.height_px / camera.height_px
    return abs(scales[0] / scales[1] - 1.0) <= _MAX_ASPECT_DIFFERENCE


def _scaled(camera: Camera, width_px: int, height_px: int, say_size: bool) -> Camera:
    across, down = width_px / camera.width_px, height_px / camera.height_px
    return replace(
        camera,
        name=f"{camera.name} at {width_px} x {height_px}" if say_size else camera.name,
        width_px=width_px,
        height_px=height_px,
        focal_length_px=camera.focal_length_px * (across + down) / 2.0,
        focal_length_sd_px=camera.focal_length_sd_px * (across + down) / 2.0,
        principal_col_px=camera.principal_col_px * across,
        principal_row_px=camera.principal_row_px * down,
    )
