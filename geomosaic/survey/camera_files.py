"""Camera files: interior orientation as other programs and people write it."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
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
_TERM: Final = re.compile(r"[bkpst]\d+|t(au)?_?[xy]")
"""Names of terms of a lens: OpenCV's k1 to k6, p1, p2, s1 to s4, tau; affinity and shear as b1, b2."""
_FISHEYE_TERMS: Final = ("k1", "k2", "k3", "k4")
"""Of OpenCV's and OpenSfM's fisheyes; the fourth of `TERMS` is their k4."""
_FIX: Final = "give cameras.json, or YAML with width_px, height_px and focal_length_px"


@dataclass(frozen=True)
class _Entry:
    """What a file says of a camera of this name."""

    name: str
    values: Mapping[str, Any]
    path: Path

    def error(self, problem: str, fix: str = _FIX) -> InputError:
        """problem: what follows the camera's name."""
        return InputError(f"camera '{self.name}'{problem}", file=self.path, fix=fix)

    def number(self, key: str, default: float | None = None) -> float:
        """Raises: `InputError` for what is no finite number, or missing without a default."""
        value = self.values.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            problem = "has no" if value is None else f"has {shown(value)} for"
            raise self.error(f" {problem} {key}", "give it as a number")
        return float(value)

    def rounding(self, key: str) -> float:
        """Half a unit of the last digit of a number, as it is written."""
        return 0.5 * 10.0 ** int(Decimal(str(self.values[key])).as_tuple().exponent)

    def terms(self, known: Sequence[str] = TERMS) -> dict[str, float]:
        """The lens's terms by our names. Raises: `InputError` for one beyond those known that isn't 0."""
        there = (key for key in map(str, self.values) if _TERM.fullmatch(key) and key not in known)
        if more := [key for key in there if self.number(key) != 0.0]:
            problem = f": its lens has {', '.join(more)} other than 0, which isn't handled"
            raise self.error(problem, f"calibrate it with {', '.join(known)} alone")
        return {ours: self.number(its, 0.0) for ours, its in zip(TERMS, known, strict=False)}

    def pair(self, key: str) -> tuple[float, float]:
        """Two numbers above 0."""
        value = self.values.get(key)
        if not isinstance(value, list) or len(value) != 2:
            raise self.error(f": {key} isn't [width, height]")
        sides = replace(self, values={f"{key}[{i}]": v for i, v in enumerate(value)})
        pair = sides.number(f"{key}[0]"), sides.number(f"{key}[1]")
        if min(pair) <= 0.0:
            raise self.error(f": {key} must be above 0")
        return pair


def read_cameras(path: Path) -> tuple[Camera, ...]:
    """The cameras of a file: OpenSfM's or ODM's cameras.json, the cameras of a reconstruction.json, or YAML.

    YAML is either our own plain form (`focal_length_px`), one camera or several by name, or
    orthority's (`focal_len`, `sensor_size`). The file's keys name the cameras.

    Raises: `FileError` if it can't be read or parsed, `InputError` naming what it lacks.
    """
    if path.suffix.lower() == ".json":
        content = read_json(path, TEXT_BYTES, "a camera file", _FIX)
    else:
        content = read_yaml(path, YAML_BYTES, "a camera file", _FIX)
    if isinstance(content, list) and content and isinstance(content[0], dict):  # reconstruction.json
        content = content[0].get("cameras")
    if isinstance(content, dict) and isinstance(content.get("cameras"), dict):
        content = content["cameras"]
    if isinstance(content, dict) and "width_px" in content:
        content = {str(content.get("name") or path.stem): content}
    if not isinstance(content, dict) or not content or not all(isinstance(e, dict) for e in content.values()):
        raise InputError("holds no cameras", file=path, fix=_FIX)
    return tuple(_camera(_Entry(printable(str(name)), e, path)) for name, e in content.items())


def _camera(entry: _Entry) -> Camera:
    readers = {"projection_type": _opensfm, "focal_len": _orthority, "width_px": _plain}
    reader = next((reader for key, reader in readers.items() if key in entry.values), None)
    if reader is None:
        raise entry.error(f" has none of {', '.join(readers)}")
    camera = replace(
        reader(entry),
        readout_s=entry.number("readout_s", 0.0),
        readout_sd_s=0.0 if "readout_s" in entry.values else UNREPORTED_SD_S,
    )
    if camera.width_px < 1 or camera.height_px < 1 or camera.focal_length_px <= 0.0:
        raise entry.error(": size and focal length must be above 0")
    if problem := lens_problem(camera):
        raise entry.error(f": {problem}", f"correct it; {_FIX}")
    return camera


def _opensfm(entry: _Entry) -> Camera:
    """Lengths are parts of the longer side; the principal point is counted from the image's middle."""
    get, projection = entry.number, str(entry.values["projection_type"])
    if projection not in _OPENSFM_MODELS:
        known = f"known: {', '.join(sorted(_OPENSFM_MODELS))}"
        raise entry.error(f": projection '{projection}' isn't handled", known)
    width, height = get("width"), get("height")
    size, kind = max(width, height), _OPENSFM_MODELS[projection]
    given = [key for key in ("focal", "focal_x", "focal_y") if key in entry.values]
    focals = {key: get(key) for key in given or ["focal_x"]}
    least, most = min(focals.values()), max(focals.values())
    if most - least > 0.01 * abs(most):
        problem = f": {' and '.join(f'{k} {v:g}' for k, v in focals.items())} differ by more than 1 %"
        raise entry.error(problem, "calibrate with square pixels, or leave out the wrong one")
    focal_px = size * (least + most) / 2.0
    return Camera(
        name=entry.name,
        width_px=round(width),
        height_px=round(height),
        focal_length_px=focal_px,
        principal_col_px=width / 2.0 + size * get("c_x", 0.0),
        principal_row_px=height / 2.0 + size * get("c_y", 0.0),
        **entry.terms(_FISHEYE_TERMS if kind == "fisheye" else TERMS),
        focal_length_sd_px=focal_px * FOCAL_LENGTH["camera-file"].sd_relative,
        kind=kind,
    )


def _orthority(entry: _Entry) -> Camera:
    """focal_len in the unit of sensor_size, or in parts of the longer side; cx, cy as OpenSfM's."""
    get, kind = entry.number, str(entry.values.get("type", "pinhole"))
    if kind not in _ORTHORITY_MODELS:
        known = f"known: {', '.join(sorted(_ORTHORITY_MODELS))}"
        raise entry.error(f": type '{kind}' isn't handled", known)
    width, height = entry.pair("im_size")
    size, focal_len = max(width, height), get("focal_len")
    if entry.values.get("sensor_size") is None:
        focal = focal_len * size
    else:
        across, down = entry.pair("sensor_size")
        if abs(width / across / (height / down) - 1.0) > 0.01:
            raise entry.error(": sensor_size and im_size differ in shape")
        focal = focal_len * (width / across + height / down) / 2.0
    return Camera(
        name=entry.name,
        width_px=round(width),
        height_px=round(height),
        focal_length_px=focal,
        principal_col_px=width / 2.0 + size * get("cx", 0.0),
        principal_row_px=height / 2.0 + size * get("cy", 0.0),
        **entry.terms(),
        focal_length_sd_px=focal * FOCAL_LENGTH["camera-file"].sd_relative,
        kind="brown",
    )


def _plain(entry: _Entry) -> Camera:
    """Our own: `Camera`'s fields by name; focal_length_mm with pixel_size_um instead of focal_length_px."""
    get, values = entry.number, entry.values
    for key in values:
        if key not in _PLAIN_KEYS:
            raise UnknownNameError("camera key", str(key), _PLAIN_KEYS, file=entry.path)
    kind = values.get("kind", "brown")
    if not isinstance(kind, str) or kind not in LENSES:
        raise UnknownNameError("kind of lens", str(kind), LENSES, file=entry.path)
    focal = _plain_focal_px(entry)
    width, height = get("width_px"), get("height_px")
    focal_sd = get("focal_length_sd_px", abs(focal) * FOCAL_LENGTH["camera-file"].sd_relative)
    if not 0.0 <= focal_sd <= abs(focal):
        problem = f" has {shown(focal_sd)} for focal_length_sd_px"
        raise entry.error(problem, "give a deviation from 0 to the focal length")
    return Camera(
        name=entry.name,
        width_px=round(width),
        height_px=round(height),
        focal_length_px=focal,
        principal_col_px=get("principal_col_px", width / 2.0),
        principal_row_px=get("principal_row_px", height / 2.0),
        **entry.terms(),
        focal_length_sd_px=focal_sd,
        kind=kind,
    )


def _plain_focal_px(entry: _Entry) -> float:
    """The focal length in pixels. Raises: `InputError` where that in mm is another one than the digits of all
    three numbers allow."""
    get, values = entry.number, entry.values
    in_pixels = "focal_length_px" in values
    if "focal_length_mm" not in values or (in_pixels and "pixel_size_um" not in values):
        return get("focal_length_px")
    length_mm, pixel_um = get("focal_length_mm"), get("pixel_size_um")
    if not pixel_um > 0.0:
        raise entry.error(f" has {shown(pixel_um)} for pixel_size_um", "give the side of a pixel")
    focal = 1000.0 * length_mm / pixel_um
    if not in_pixels:
        return focal
    in_px = get("focal_length_px")
    off_um = in_px * entry.rounding("pixel_size_um") + entry.rounding("focal_length_px") * pixel_um
    if abs(in_px * pixel_um - 1000.0 * length_mm) > off_um + 1000.0 * entry.rounding("focal_length_mm"):
        problem = f": focal_length_px is {in_px:g}, but focal_length_mm and pixel_size_um give {focal:.1f}"
        raise entry.error(problem, "leave out the wrong one")
    return in_px
