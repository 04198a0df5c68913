"""Detects frames with missing pixels while they are decoded.

JPEG is decoded by libjpeg-turbo itself (simplejpeg), which says what it met. OpenCV, which gives the same
pixels, decodes what is left of a damaged one without a word, and takes half as long again.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import simplejpeg
from rasterio.windows import Window

from geomosaic.arrays import Bytes
from geomosaic.constants import sourced, tuned
from geomosaic.doors.at_hand import at_hand
from geomosaic.doors.camera_formats import camera_format, camera_image, decoded_camera_image
from geomosaic.doors.raster import FRAME, Raster, open_raster, reading
from geomosaic.errors import FileError
from geomosaic.survey.header import JPEG_SUFFIXES
from geomosaic.survey.jpeg import JpegStructure, parse_structure
from geomosaic.survey.png import png_damage
from geomosaic.survey.small import QUARTER

_LEAST_LOOKED_AT_PX = tuned(32, "half-size px", "of a checked image: smaller ones show no detail")
_EOI: Final = b"\xff\xd9"
_JFIF: Final = b"JFIF\0"
_JFIF_WITHIN = sourced(1 << 18, "bytes", "before its JFIF segment", "ITU-T T.81, B.1.1.4: 65,535 a segment")
_MOST_SCANS = tuned(200, "scans", "of a JPEG, usually 10: thousands in a small file would take hours")
_RUN_BYTES = tuned(64, "bytes", "equal in a row, for lost disk blocks: fewer occur by chance; more miss some")
_RUN: Final = re.compile(rb"(.)\1{%d,}" % (_RUN_BYTES - 1), re.DOTALL)
_RESTART: Final = re.compile(rb"\xff[\xd0-\xd7]")
_CONTEXT_ROWS = sourced(16, "rows", "left off above damage: less leaves its colour in", "ITU-T T.81, A.2.3")
_TAIL = tuned(
    np.random.default_rng(1).integers(0, 254, 4096, dtype=np.uint8).tobytes(),
    "bytes",
    "put where data are lost: rows that change lie below the damage; no 0xFF, so none is a marker",
)


@dataclass(frozen=True)
class FrameAppearance:
    """What a frame looks like: 24 x 32 grey pixels, and the logarithm of how much fine detail it has against
    its coarse one."""

    small: Bytes
    detail: float


@dataclass(frozen=True)
class Wholeness:
    """damage: what the decoder said, '' where the frame is whole.

    whole_rows: of a damaged frame, how many rows from the top are surely whole; 0 where that isn't known.
    look: of a whole frame; None of pixels without contrast, and of files other than JPEG.
    """

    damage: str
    whole_rows: int
    look: FrameAppearance | None = None


def wholeness(path: str) -> Wholeness:
    """Decodes a frame and listens to the decoder. Raises: as `looked_at`."""
    return looked_at(path)[0]


def looked_at(path: str) -> tuple[Wholeness, Bytes | None]:
    """Damage detected while a frame is decoded, and the pixels (rows, cols, bands) of a whole JPEG at half
    its size, which come with it.

    Raises: `FileError` if it can't be opened at all.
    """
    file = Path(path)
    if file.suffix.lower() in JPEG_SUFFIXES:
        try:
            data = at_hand(file).read_bytes()
        except OSError as error:
            raise FileError(f"can't be read ({error.strerror})", file=file, fix=FRAME.fix) from error
        return _of_jpeg(data, parse_structure(data, file, whole=False))
    return _of_raster(file) if camera_format(file) is None else _of_camera_image(file), None


def _of_jpeg(data: bytes, structure: JpegStructure) -> tuple[Wholeness, Bytes | None]:
    end = data.find(_EOI, structure.data_start)  # files may have more after the image
    if data.count(b"\xff\xda", structure.data_start, end if end > 0 else None) > _MOST_SCANS:
        return Wholeness(f"it has more than {_MOST_SCANS} scans", 0), None
    said, pixels = _decoded_whole(data, structure.bands)
    if "extraneous" in said:  # cameras may pad the data in front of the end marker
        end = data.find(_EOI, structure.data_start)
        said, pixels = _decoded_whole(data[:end].rstrip(b"\0\xff") + data[end:], structure.bands)
    if pixels is None:
        return Wholeness(f"libjpeg says '{said}'", _whole_rows(data, structure)), None
    return Wholeness("", structure.height_px, _look(pixels)), pixels


def _look(pixels: Bytes) -> FrameAppearance | None:
    """Of a JPEG, decoded at half its size."""
    if min(pixels.shape[:2]) < _LEAST_LOOKED_AT_PX:
        return None
    grey: Any = pixels[..., 0] if pixels.shape[2] == 1 else cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    coarse = coarsened(grey, QUARTER)
    enough = coarse if min(coarse.shape) >= _LEAST_LOOKED_AT_PX else grey
    small = np.asarray(cv2.resize(enough, (32, 24), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    fine, rough = (float(cv2.meanStdDev(cv2.Laplacian(g, cv2.CV_16S))[1][0, 0]) for g in (grey, coarse))
    return FrameAppearance(small, 2.0 * float(np.log(fine / rough))) if min(fine, rough) > 0.0 else None


def coarsened(pixels: Bytes, side: int) -> Bytes:
    """Means of side x side pixels; what is left over at the right and below is left away."""
    rows, cols = (n // side for n in pixels.shape[:2])
    whole = pixels[: rows * side, : cols * side]
    return np.asarray(cv2.resize(whole, (cols, rows), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _decoded_whole(data: bytes, bands: int, reduction: int = 2) -> tuple[str, Bytes | None]:
    """What libjpeg says first of a JPEG's data, nothing where they are whole; and these' pixels."""
    try:
        return "", decoded(data, bands, reduction, strict=True)
    except (ValueError, MemoryError) as error:
        return " ".join(str(error).split()) or "no more than that it can't be decoded", None


def decoded(data: bytes, bands: int, reduction: int = 1, *, strict: bool = False) -> Bytes:
    """A JPEG's pixels (rows, cols, bands), of a damaged one whatever stands in them.

    Args: bands: 1, or 3 for red, green, blue; reduction: 1, 2, 4 or 8.
    Raises: `ValueError` if there are none, or, if strict, with the first thing that isn't right.
    """
    at = data.find(_JFIF, 0, _JFIF_WITHIN)
    if at >= 0:  # an odd version would be all that is said, strict or not
        data = b"".join((data[:at], b"JFIX\0", data[at + len(_JFIF) :]))
    height, width = simplejpeg.decode_jpeg_header(data, strict=strict)[:2]
    rows, cols = -(-height // reduction), -(-width // reduction)
    colours = "GRAY" if bands == 1 else "RGB"
    return np.asarray(simplejpeg.decode_jpeg(data, colours, min_height=rows, min_width=cols, strict=strict))


def _whole_rows(data: bytes, jpeg: JpegStructure) -> int:
    """Rows above the damage: from restart markers, or from where bytes are missing or all alike."""
    if jpeg.progressive:  # each scan goes over the whole image
        return 0
    start = jpeg.data_start
    end = data.find(_EOI, start)
    coded = data[start : end if end >= 0 else len(data)]
    if jpeg.restart_blocks:
        return _rows_of_intervals(data, coded, jpeg)
    run = _RUN.search(coded)
    if run is None and end >= 0:
        return 0
    cut = data[: start + (run.start() if run is not None else len(coded) - 2)]
    try:
        one, other = (decoded(cut + tail + _EOI, 1) for tail in (b"", _TAIL))
    except ValueError:
        return 0
    differ = (one != other).any(axis=(1, 2))
    rows = int(differ.argmax()) if differ.any() else 0
    return max(0, rows // jpeg.block_px[1] * jpeg.block_px[1] - _CONTEXT_ROWS)


def _rows_of_intervals(data: bytes, coded: bytes, jpeg: JpegStructure) -> int:
    """Whole rows before the first stretch between restart markers that doesn't decode by itself."""
    width, height = jpeg.block_px
    across = -(-jpeg.width_px // width)
    header = bytearray(data[: jpeg.data_start])
    size_at = jpeg.size_at
    header[size_at : size_at + 4] = height.to_bytes(2, "big") + min(
        jpeg.restart_blocks * width, 65535
    ).to_bytes(2, "big")
    for i, (part, marker) in enumerate(_intervals(coded)):
        if _decoded_whole(bytes(header) + part + _EOI, 1, 8)[0] or marker not in (None, i % 8):
            return max(0, i * jpeg.restart_blocks // across * height - _CONTEXT_ROWS)
    return 0


def _intervals(coded: bytes) -> Iterator[tuple[bytes, int | None]]:
    """The data between restart markers, with the marker that ends each."""
    at = 0
    for found in _RESTART.finditer(coded):
        yield coded[at : found.start()], found.group()[1] - 0xD0
        at = found.end()
    yield coded[at:], None


def _of_camera_image(path: Path) -> Wholeness:
    """Of a DNG or HEIC, whose decoders don't say where the damage is."""
    stated = camera_image(path)
    try:
        decoded_camera_image(path, (stated.width_px, stated.height_px))
    except FileError as error:
        return Wholeness(error.problem, 0)
    return Wholeness("", stated.height_px)


def _of_raster(path: Path) -> Wholeness:
    with open_raster(path, FRAME) as tiff:
        if tiff.driver == "PNG":
            said = png_damage(at_hand(path).read_bytes())
            return Wholeness(said, 0 if said else tiff.height)
        if tiff.compression is None:  # any bytes are pixels
            return Wholeness("", tiff.height)
        rows = max(256, int(tiff.block_shapes[0][0]))
        for top in range(0, tiff.height, rows):
            if said := _unreadable(tiff, path, Window(0, top, tiff.width, min(rows, tiff.height - top))):
                return Wholeness(said, top)
    return Wholeness("", tiff.height)


def _unreadable(tiff: Raster, path: Path, window: Window) -> str:
    try:
        with reading(path):
            tiff.read(window=window)
    except FileError as error:
        cause: Any = error.__cause__
        return f"GDAL says '{' '.join(str(cause.__cause__ or cause).split())}'"
    return ""
