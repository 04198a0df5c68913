"""Raw images (DNG) and HEIC of cameras, by the extras `raw` and `heic`: what files state, and pixels."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bytes
from geomosaic.doors.at_hand import at_hand
from geomosaic.errors import FileError, InputError

_AGAIN: Final = "copy it again from the camera, or take it out of the folder"


@dataclass(frozen=True)
class CameraFormat:
    """A format, its file suffixes, the module that reads it and the extra that installs this.

    convert: what to do without it.
    """

    name: str
    suffixes: frozenset[str]
    module: str
    extra: str
    convert: str

    def check(self, folder: Path) -> None:
        """`InputError` where the module is not installed."""
        if find_spec(self.module) is None:
            raise InputError(
                f"holds {self.name} frames, and {self.module}, which reads them, is not installed",
                file=folder,
                fix=f"pip install 'geomosaic-ortho[{self.extra}]', or {self.convert}",
            )


DNG: Final = CameraFormat(
    "DNG",
    frozenset({".dng"}),
    "rawpy",
    "raw",
    "convert them to JPEG or TIFF with their tags (exiftool -tagsFromFile RAW JPEG)",
)
HEIC: Final = CameraFormat(
    "HEIC",
    frozenset({".heic", ".heif"}),
    "pillow_heif",
    "heic",
    "convert them to JPEG (heif-convert FILE.heic FILE.jpg)",
)
CAMERA_FORMATS: Final = (DNG, HEIC)


@dataclass(frozen=True)
class CameraImage:
    """What a file states before its pixels, bands without alpha. exif and xmp are bytes, empty where the
    format keeps them elsewhere."""

    width_px: int
    height_px: int
    bands: int
    dtype: str
    exif: bytes = b""
    xmp: bytes = b""


def camera_format(path: Path) -> CameraFormat | None:
    """The format of a file by its suffix, None where it is another."""
    return next((one for one in CAMERA_FORMATS if path.suffix.lower() in one.suffixes), None)


def camera_image(path: Path) -> CameraImage:
    """What a DNG or HEIC file states. Raises: `FileError` where it is damaged or none."""
    if path.suffix.lower() in HEIC.suffixes:
        with _heic(path) as image:
            width, height = image.size
            bands = 1 if image.mode.startswith("L") else 3
            dtype = "uint16" if ";16" in image.mode else "uint8"
            exif, xmp = (bytes(image.info.get(name) or b"") for name in ("exif", "xmp"))
            return CameraImage(width, height, bands, dtype, exif.removeprefix(b"Exif\0\0"), xmp)
    with _raw(path) as raw:
        bands = 1 if raw.num_colors == 1 else 3
        return CameraImage(raw.sizes.width, raw.sizes.height, bands, "uint16")


def decoded_camera_image(path: Path, size: tuple[int, int]) -> tuple[NDArray[Any], Bytes | None]:
    """Pixels (rows, cols, bands), and 255 where valid if the file has an alpha band.

    A DNG gives linear values in 16 bits and sRGB's primaries, with the file's white balance and no other
    brightening; its orientation is ignored.

    Args: size: width and height that were stated; nothing larger is decoded.
    Raises: `FileError` where it can't be decoded, or has another size.
    """
    if path.suffix.lower() in HEIC.suffixes:
        with _heic(path) as image:
            _check_size(path, image.size, size)
            pixels = np.atleast_3d(np.asarray(image))
            alpha = pixels[..., -1] if pixels.shape[2] in (2, 4) else None
            pixels = np.ascontiguousarray(pixels[..., : pixels.shape[2] - (alpha is not None)])
        valid = None if alpha is None or alpha.all() else np.where(alpha > 0, np.uint8(255), np.uint8(0))
    else:
        with _raw(path) as raw:
            _check_size(path, (raw.sizes.width, raw.sizes.height), size)
            pixels = raw.postprocess(
                use_camera_wb=True, user_flip=0, output_bps=16, gamma=(1.0, 1.0), no_auto_bright=True,
                adjust_maximum_thr=0.0,  # else the brightest pixel sets each frame's scale
            )  # fmt: skip
            pixels, valid = np.atleast_3d(pixels), None
    _check_size(path, (pixels.shape[1], pixels.shape[0]), size)
    return pixels, valid


def _check_size(path: Path, found: tuple[int, int], stated: tuple[int, int]) -> None:
    if found != stated:
        problem = f"its pixels are {found[0]} x {found[1]}, its header states {stated[0]} x {stated[1]}"
        raise FileError(problem, file=path, fix=_AGAIN)


@contextmanager
def _raw(path: Path) -> Iterator[Any]:
    import rawpy

    try:
        with rawpy.RawPy() as raw:
            raw.open_file(str(at_hand(path)))
            raw.set_unpack_params()
            yield raw
    except (rawpy.LibRawError, ValueError, MemoryError) as error:
        raise FileError(f"the DNG can't be decoded ({_said(error)})", file=path, fix=_AGAIN) from error


@contextmanager
def _heic(path: Path) -> Iterator[Any]:
    import pillow_heif

    try:
        yield pillow_heif.open_heif(at_hand(path), convert_hdr_to_8bit=False)
    except FileError:
        raise
    except (ValueError, OSError, EOFError, RuntimeError, SyntaxError, MemoryError) as error:
        raise FileError(f"the HEIC can't be decoded ({_said(error)})", file=path, fix=_AGAIN) from error


def _said(error: BaseException) -> str:
    text = error.args[0] if error.args else type(error).__name__
    return " ".join((text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text)).split())
