"""The camera of each frame: from a camera file, or from what its EXIF and XMP say."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from geomosaic.camera.interior import Camera
from geomosaic.errors import InputError
from geomosaic.survey.accuracy import FOCAL_LENGTH
from geomosaic.survey.header import FrameHeader
from geomosaic.survey.model import Warn
from geomosaic.survey.names import frame_name
from geomosaic.survey.plausible import focal_length_can_be, lens_problem, strange_lenses, warn
from geomosaic.survey.xmp import number

FILM_DIAGONAL_MM: Final = math.hypot(36.0, 24.0)
SENSOR_WIDTHS_MM: Final = {
    "fc300c": 6.17, "fc300s": 6.17, "fc300x": 6.17, "fc330": 6.17, "fc220": 6.17, "fc350": 6.17,
    "fc550": 17.3, "fc6310": 13.2, "fc6310r": 13.2, "fc6310s": 13.2, "fc6510": 13.2, "fc6520": 17.3,
    "l1d-20c": 13.2, "fc3411": 13.2, "l2d-20c": 17.3, "m3e": 17.3, "zenmusep1": 35.9, "s.o.d.a.": 12.75,
    "dsc-wx220": 6.17, "ilce-6000": 23.5, "ilce-7rm2": 35.9,
}  # fmt: skip
"""Width in mm of the whole sensor, which a frame of any shape fills from side to side."""

_MAX_ASPECT_DIFFERENCE: Final = 0.003
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

    Raises: `InputError` naming a frame that doesn't tell its focal length, where no such other does.
    """
    told = [_told(header) for header in headers]
    known, wrong = _among_others(headers, told)
    found: dict[str, Camera] = {}
    names: list[str] = []
    warnings: list[Warn] = []
    for camera, source in known:
        if camera.name not in found:
            text = (
                f"{camera.name}: focal length {camera.focal_length_px:.0f} px "
                f"(sd {camera.focal_length_sd_px:.0f}) from {source}"
            )
            warnings.append(Warn("camera-assumed", "", text))
        elif found[camera.name] != camera:  # the same make and focal length, calibrated otherwise
            same = [n for n, c in found.items() if replace(c, name=camera.name) == camera]
            name = same[0] if same else f"{camera.name} ({len(found) + 1})"
            camera = replace(camera, name=name)
        found.setdefault(camera.name, camera)
        names.append(camera.name)
    if any(wrong):
        files = [h.path.name for h in headers]
        warnings.append(warn("focal-length-absurd", files, np.array([bool(w) for w in wrong]), wrong))
    return CameraChoice(tuple(found.values()), tuple(names), tuple(warnings))


def camera_from_header(header: FrameHeader) -> tuple[Camera, str]:
    """A frame's camera and which source told it, the surest first whose focal length can be.

    DJI's own calibration in the XMP (`DewarpData`); focal length with the focal plane's resolution;
    focal length with the sensor's width from `SENSOR_WIDTHS_MM`; the 35 mm equivalent, which compares
    diagonals (CIPA DCG-001): for frames wider than 3:2 that of a 4:3 sensor they are cut from.

    Raises: `InputError` where none tells a focal length that can be.
    """
    camera, source, wrong = _told(header)
    if camera is None:
        raise _untold(header, wrong)
    return camera, source


def _told(header: FrameHeader) -> tuple[Camera | None, str, str]:
    """The camera that a header tells, by which source, and what it told before that can't be."""
    exif, width, height = header.exif, header.width_px, header.height_px
    mm = exif.focal_length_mm
    zoom = (
        f" {mm:g} mm" if mm else f" {exif.focal_length_35mm:g} mm (35 mm)" if exif.focal_length_35mm else ""
    )
    name = f"{_label(header)} {width} x {height}{zoom}"
    blank = Camera(name, width, height, 1.0, width / 2.0, height / 2.0)
    from_35mm = None
    if exif.focal_length_35mm is not None:
        diagonal = math.hypot(width, height) if width <= 1.55 * height else 1.25 * width
        from_35mm = exif.focal_length_35mm * diagonal / FILM_DIAGONAL_MM
    wrong = ""
    calibrated = _dji_calibration(header, blank)
    if calibrated is not None and (
        from_35mm is None or abs(calibrated.focal_length_px / from_35mm - 1.0) < 0.15
    ):
        wrong = lens_problem(calibrated)
        if not wrong:
            return calibrated, "dji-dewarp", ""
        wrong = "DewarpData"
    sensor = SENSOR_WIDTHS_MM.get(exif.model.lower())
    scale = width / exif.width_px if exif.width_px else 1.0
    focals = {
        "focal-plane": None if mm is None or exif.pixels_per_mm is None else mm * exif.pixels_per_mm * scale,
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


def _label(header: FrameHeader) -> str:
    """Make and model, each word once."""
    return " ".join(dict.fromkeys(f"{header.exif.make} {header.exif.model}".split())) or "camera"


def _among_others(
    headers: Sequence[FrameHeader], told: Sequence[tuple[Camera | None, str, str]]
) -> tuple[list[tuple[Camera, str]], list[str]]:
    """Each frame's camera and source, and what was told instead that can't be, or is '' where all can."""
    kinds: dict[tuple[str, int, int], list[int]] = {}
    for i, header in enumerate(headers):
        kinds.setdefault((_label(header), header.width_px, header.height_px), []).append(i)
    known: list[tuple[Camera, str] | None] = [None if c is None else (c, source) for c, source, _ in told]
    wrong = [w for _, _, w in told]
    for alike in kinds.values():
        having = [(i, c.focal_length_px) for i in alike if (c := told[i][0]) is not None]
        strange = strange_lenses(np.array([focal for _, focal in having]))
        for (i, focal), is_strange in zip(having, strange, strict=True):
            if is_strange:
                known[i], wrong[i] = None, f"a focal length of {focal:.3g} px (from {told[i][1]})"
        usual = Counter(k for i in alike if (k := known[i]) is not None and not wrong[i]).most_common(1)
        for i in alike:
            if wrong[i] and usual:
                known[i] = usual[0][0]
    cameras = []
    for header, camera, problem in zip(headers, known, wrong, strict=True):
        if camera is None:
            raise _untold(header, problem)
        cameras.append(camera)
    return cameras, wrong


def _untold(header: FrameHeader, wrong: str) -> InputError:
    problem = f"{wrong} can't be" if wrong else "the frame doesn't tell its focal length"
    return InputError(problem, file=header.path, mend=_GIVE)


def _dji_calibration(header: FrameHeader, blank: Camera) -> Camera | None:
    """DewarpData: `date;fx,fy,cx,cy,k1,k2,p1,p2,k3`, pixels of the full frame, cx and cy from its middle.

    A frame that was dewarped in the camera (DewarpFlag 1) has no distortion left.
    """
    xmp = header.xmp or {}
    fields = xmp.get("drone-dji:DewarpData", "").rpartition(";")[2].split(",")
    try:
        fx, fy, cx, cy, k1, k2, p1, p2, k3 = (float(f) for f in fields)
    except ValueError:
        return None
    centre = number(xmp, "drone-dji:CalibratedOpticalCenterX")
    full = header.exif.width_px or (2.0 * centre if centre else header.width_px)
    if not all(map(math.isfinite, (fx, fy, cx, cy, k1, k2, p1, p2, k3))) or min(fx, fy) < 100.0:
        return None
    scale = header.width_px / full
    focal = scale * (fx + fy) / 2.0
    camera = replace(
        blank,
        focal_length_px=focal,
        principal_col_px=blank.principal_col_px + scale * cx,
        principal_row_px=blank.principal_row_px + scale * cy,
        focal_length_sd_px=FOCAL_LENGTH["dji-dewarp"].sd_relative * focal,
    )
    if number(xmp, "drone-dji:DewarpFlag") == 1.0:
        return camera
    return replace(camera, k1=k1, k2=k2, k3=k3, p1=p1, p2=p2)


def cameras_from_file(
    headers: Sequence[FrameHeader], cameras: Sequence[Camera], path: Path, wanted: Sequence[str | None]
) -> CameraChoice:
    """The file's camera for each frame, scaled where the frame is a resized whole picture.

    With several cameras in the file: the one that the POS file names (`wanted`), else those whose name
    holds the frame's make and model, else those of the frame's size, else of its shape.

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
        found.setdefault(camera.name, camera)
        names.append(camera.name)
    return CameraChoice(tuple(found.values()), tuple(names), tuple(warnings))


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
            f"several cameras fit frame {frame_name(header.path)} of {size}: {known}",
            file=path,
            mend="name each frame's in the POS file's column 'camera'",
        )
    raise InputError(
        f"no camera for frame {frame_name(header.path)} of {size}: {known}",
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
