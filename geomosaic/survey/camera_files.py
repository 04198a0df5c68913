"""Camera files: interior orientation as other programs and people write it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from geomosaic.camera.interior import Camera
from geomosaic.camera.lens import LENSES, TERMS
from geomosaic.doors.files import TEXT_BYTES, printable
from geomosaic.doors.plain import YAML_BYTES, read_json, read_yaml, shown
from geomosaic.errors import InputError, UnknownNameError
from geomosaic.survey.accuracy import FOCAL_LENGTH
from geomosaic.survey.plausible import lens_problem
from geomosaic.survey.shutters import UNREPORTED_SD_S

_OPENSFM_MODELS: Final = {
    **dict.fromkeys(("perspective", "simple_radial", "radial", "brown"), "brown"),
    **dict.fromkeys(("fisheye", "fisheye_opencv"), "fisheye"),
}
_ORTHORITY_MODELS: Final = frozenset({"pinhole", "brown", "opencv"})
_PLAIN_KEYS: Final = (
    "name", "width_px", "height_px", "focal_length_px", "focal_length_mm", "pixel_size_um",
    "principal_col_px", "principal_row_px", "focal_length_sd_px", "readout_s", "kind", *TERMS,
)  # fmt: skip
_FIX: Final = "give cameras.json, or YAML with width_px, height_px and focal_length_px"

Entry = Mapping[str, Any]


def read_cameras(path: Path) -> tuple[Camera, ...]:
    """The cameras of a file: OpenSfM's or ODM's cameras.json, the cameras of a reconstruction.json, or YAML.

    YAML is either our own plain form (`focal_length_px`), one camera or several by name, or
    orthority's (`focal_len`, `sensor_size`). The file's keys name the cameras.

    Raises: `FileError` if it can't be read or parsed, `InputError` naming what it lacks.
    """
    content = _load(path)
    if isinstance(content, list) and content and isinstance(content[0], dict):  # reconstruction.json
        content = content[0].get("cameras")
    if isinstance(content, dict) and isinstance(content.get("cameras"), dict):
        content = content["cameras"]
    if isinstance(content, dict) and "width_px" in content:
        content = {str(content.get("name") or path.stem): content}
    if not isinstance(content, dict) or not content or not all(isinstance(e, dict) for e in content.values()):
        raise InputError("holds no cameras", file=path, fix=_FIX)
    return tuple(_camera(printable(str(name)), entry, path) for name, entry in content.items())


def _load(path: Path) -> Any:
    if path.suffix.lower() == ".json":
        return read_json(path, TEXT_BYTES, "a camera file", _FIX)
    return read_yaml(path, YAML_BYTES, "a camera file", _FIX)


def _camera(name: str, entry: Entry, path: Path) -> Camera:
    readers: dict[str, Callable[[str, Entry, Path], Camera]] = {
        "projection_type": _opensfm,
        "focal_len": _orthority,
        "width_px": _plain,
    }
    for key, reader in readers.items():
        if key in entry:
            camera = replace(
                reader(name, entry, path),
                readout_s=_getter(name, entry, path)("readout_s", 0.0),
                readout_sd_s=0.0 if "readout_s" in entry else UNREPORTED_SD_S,
            )
            break
    else:
        raise InputError(f"camera '{name}' has none of {', '.join(readers)}", file=path, fix=_FIX)
    if camera.width_px < 1 or camera.height_px < 1 or camera.focal_length_px <= 0.0:
        raise InputError(f"camera '{name}': size and focal length must be above 0", file=path, fix=_FIX)
    if problem := lens_problem(camera):
        raise InputError(f"camera '{name}': {problem}", file=path, fix=f"correct it; {_FIX}")
    return camera


def _opensfm(name: str, entry: Entry, path: Path) -> Camera:
    """Lengths are parts of the longer side; the principal point is counted from the image's middle."""
    if str(entry["projection_type"]) not in _OPENSFM_MODELS:
        raise InputError(
            f"camera '{name}': projection '{entry['projection_type']}' isn't handled",
            file=path,
            fix=f"known: {', '.join(sorted(_OPENSFM_MODELS))}",
        )
    get = _getter(name, entry, path)
    width, height = get("width"), get("height")
    size = max(width, height)
    focal = size * _one_focal(name, get("focal") if "focal" in entry else get("focal_x"), entry, get, path)
    kind, terms = _OPENSFM_MODELS[str(entry["projection_type"])], [get(k, 0.0) for k in TERMS]
    if kind == "fisheye":
        terms[3:] = get("k4", 0.0), 0.0
    k1, k2, k3, p1, p2 = terms
    return Camera(
        name=name,
        width_px=round(width),
        height_px=round(height),
        focal_length_px=focal,
        principal_col_px=width / 2.0 + size * get("c_x", 0.0),
        principal_row_px=height / 2.0 + size * get("c_y", 0.0),
        k1=k1,
        k2=k2,
        k3=k3,
        p1=p1,
        p2=p2,
        focal_length_sd_px=focal * FOCAL_LENGTH["camera-file"].sd_relative,
        kind=kind,
    )


def _one_focal(name: str, focal: float, entry: Entry, get: Callable[..., float], path: Path) -> float:
    other = get("focal_y") if "focal_y" in entry else focal
    if abs(other - focal) > 0.01 * focal:
        raise InputError(
            f"camera '{name}': focal_x {focal:g} and focal_y {other:g} differ by more than 1 %",
            file=path,
            fix="calibrate with square pixels",
        )
    return (focal + other) / 2.0


def _orthority(name: str, entry: Entry, path: Path) -> Camera:
    """focal_len in the unit of sensor_size, or in parts of the longer side; cx, cy as OpenSfM's."""
    if str(entry.get("type", "pinhole")) not in _ORTHORITY_MODELS:
        raise InputError(
            f"camera '{name}': type '{entry['type']}' isn't handled",
            file=path,
            fix=f"known: {', '.join(sorted(_ORTHORITY_MODELS))}",
        )
    get = _getter(name, entry, path)
    (width, height), sensor = _pair(name, entry, "im_size", path), entry.get("sensor_size")
    size = max(width, height)
    focal_len = get("focal_len")
    if sensor is None:
        focal = focal_len * size
    else:
        across, down = _pair(name, entry, "sensor_size", path)
        if abs(width / across / (height / down) - 1.0) > 0.01:
            raise InputError(f"camera '{name}': sensor_size and im_size differ in shape", file=path, fix=_FIX)
        focal = focal_len * (width / across + height / down) / 2.0
    return Camera(
        name=name,
        width_px=round(width),
        height_px=round(height),
        focal_length_px=focal,
        principal_col_px=width / 2.0 + size * get("cx", 0.0),
        principal_row_px=height / 2.0 + size * get("cy", 0.0),
        **{k: get(k, 0.0) for k in TERMS},
        focal_length_sd_px=focal * FOCAL_LENGTH["camera-file"].sd_relative,
        kind="brown",
    )


def _plain(name: str, entry: Entry, path: Path) -> Camera:
    """Our own: `Camera`'s fields by name; focal_length_mm with pixel_size_um instead of focal_length_px."""
    for key in entry:
        if key not in _PLAIN_KEYS:
            raise UnknownNameError("camera key", str(key), _PLAIN_KEYS, file=path)
    kind = entry.get("kind", "brown")
    if kind not in LENSES:
        raise UnknownNameError("kind of lens", str(kind), LENSES, file=path)
    get = _getter(name, entry, path)
    if "focal_length_px" in entry or "focal_length_mm" not in entry:
        focal = get("focal_length_px")
    else:
        focal = 1000.0 * get("focal_length_mm") / get("pixel_size_um")
    width, height = get("width_px"), get("height_px")
    focal_sd = get("focal_length_sd_px", abs(focal) * FOCAL_LENGTH["camera-file"].sd_relative)
    if not 0.0 <= focal_sd <= abs(focal):
        problem = f"camera '{name}' has {shown(focal_sd)} for focal_length_sd_px"
        raise InputError(problem, file=path, fix="give a deviation from 0 to the focal length")
    return Camera(
        name=name,
        width_px=round(width),
        height_px=round(height),
        focal_length_px=focal,
        principal_col_px=get("principal_col_px", width / 2.0),
        principal_row_px=get("principal_row_px", height / 2.0),
        **{k: get(k, 0.0) for k in TERMS},
        focal_length_sd_px=focal_sd,
        kind=kind,
    )


def _getter(name: str, entry: Entry, path: Path) -> Callable[..., float]:
    def get(key: str, default: float | None = None) -> float:
        value = entry.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            problem = "has no" if value is None else f"has {shown(value)} for"
            raise InputError(f"camera '{name}' {problem} {key}", file=path, fix="give it as a number")
        return float(value)

    return get


def _pair(name: str, entry: Entry, key: str, path: Path) -> tuple[float, float]:
    value = entry.get(key)
    if not isinstance(value, list) or len(value) != 2:
        raise InputError(f"camera '{name}': {key} isn't [width, height]", file=path, fix=_FIX)
    get = _getter(name, {f"{key}[{i}]": v for i, v in enumerate(value)}, path)
    pair = get(f"{key}[0]"), get(f"{key}[1]")
    if min(pair) <= 0.0:
        raise InputError(f"camera '{name}': {key} must be above 0", file=path, fix=_FIX)
    return pair
