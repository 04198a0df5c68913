"""The camera of each frame among those of a camera file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from geomosaic.camera.interior import Camera
from geomosaic.constants import tuned
from geomosaic.errors import InputError
from geomosaic.survey.cameras import CameraChoice, reported_camera, shutter_warnings
from geomosaic.survey.focal_lengths import SAME_SHAPE
from geomosaic.survey.header import FrameHeader
from geomosaic.survey.model import Warn
from geomosaic.survey.shutters import shutter

_UNLIKE_TAGS = tuned(1.5, "ratio", "camera file to tags: less rejects tags 5 % off; more accepts other units")


def cameras_from_file(
    headers: Sequence[FrameHeader], cameras: Sequence[Camera], path: Path, wanted: Sequence[str | None]
) -> CameraChoice:
    """The file's camera for each frame, scaled where the frame is a resized whole image.

    With several cameras in the file, the one that the POS file names (`wanted`) is taken. Otherwise those
    count whose name has the frame's make and model, else those of the frame's size, else of its shape. Where
    the file says nothing of the shutter, the frame's tags and model count.

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
                    f"{camera.name}: of {camera.width_px} x {camera.height_px} pixels, scaled by "
                    f"{scale:.4g} to the frames' size: give another --camera if these were cut"
                )
                warnings.append(Warn("camera-scaled", "", text))
            camera = scaled
        if camera.name not in found:
            warnings += _unlike_tags(header, camera)
            if not camera.readout_s and camera.readout_sd_s:
                reported = shutter(header)
                camera = replace(camera, readout_s=reported.readout_s, readout_sd_s=reported.sd_s)
                warnings += shutter_warnings(header, camera)
        found.setdefault(camera.name, camera)
        names.append(camera.name)
    return CameraChoice(tuple(found.values()), tuple(names), tuple(warnings))


def _unlike_tags(header: FrameHeader, camera: Camera) -> list[Warn]:
    """A word where a camera file's focal length is far from what the frame's own tags say: another unit?"""
    tagged, source, _ = reported_camera(header)
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
            fix="name each frame's in the POS file's column 'camera'",
        )
    raise InputError(
        f"no camera for frame {header.name} of {size}: {known}",
        file=path,
        fix="give --camera FILE of this frame size",
    )


def _same_shape(camera: Camera, header: FrameHeader) -> bool:
    scales = header.width_px / camera.width_px, header.height_px / camera.height_px
    return abs(scales[0] / scales[1] - 1.0) <= SAME_SHAPE


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
