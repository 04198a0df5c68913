"""A frame's header: size, bands, type and metadata, read without decoding pixels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Final

import numpy as np
from rasterio.enums import ColorInterp

from geomosaic.constants import sourced, tuned
from geomosaic.doors.camera_formats import camera_format, camera_image
from geomosaic.doors.files import SHORT_BYTES
from geomosaic.doors.raster import FRAME, Raster, open_raster, reading
from geomosaic.errors import FileError, InputError
from geomosaic.survey.exif import Exif, exif_from_block, exif_from_gdal
from geomosaic.survey.exif_tags import xmp_from_block
from geomosaic.survey.jpeg import read_structure
from geomosaic.survey.names import frame_name
from geomosaic.survey.png import png_tags
from geomosaic.survey.xmp import Xmp, parse_xmp

JPEG_SUFFIXES: Final = frozenset({".jpg", ".jpeg"})
TIFF_SUFFIXES: Final = frozenset({".tif", ".tiff"})
PNG_SUFFIXES: Final = frozenset({".png"})
DTYPES: Final = frozenset({"uint8", "uint16", "int16", "float32"})
MOST_SIDE_PX = sourced(32_766, "px", "of a frame: cv2.remap fails beyond", "OpenCV, remap: less than 32,767")
_MOST_BYTES = tuned(4 << 30, "bytes", "of a decoded frame: the largest have 3.6e9; more fills the memory")
_MOST_RATIO = sourced(4000, "ratio", "pixels to file: more is a damaged header", "LZW: 4096; DEFLATE: 1032")
_SMALL_BYTES = tuned(64 << 20, "bytes", "of pixels that any file may state: images of one colour pack well")
_MOST_LOOKED_AT = tuned(4096, "blocks", "of a TIFF that GDAL locates: fewer miss damage; more are slow")


@dataclass(frozen=True)
class FrameHeader:
    """What a frame's file says before its pixels. bands are without an alpha band; xmp None: unreadable.

    called: the frame's name where its file's alone would be another's too.
    """

    path: Path
    width_px: int
    height_px: int
    bands: int
    dtype: str
    nodata: float | None
    exif: Exif
    xmp: Xmp | None
    called: str = ""

    @property
    def name(self) -> str:
        """What the frame is called everywhere."""
        return self.called or frame_name(self.path)


def read_header(path: Path) -> FrameHeader:
    """Header of a JPEG, TIFF, PNG, DNG or HEIC frame.

    Raises: `FileError` when the file isn't what its name says, or can't hold the pixels it states;
    `InputError` when its pixels are of a kind that isn't handled.
    """
    if path.suffix.lower() in JPEG_SUFFIXES:
        header = _jpeg_header(path)
    else:
        header = _raster_header(path) if camera_format(path) is None else _camera_header(path)
    size = f"{header.width_px} x {header.height_px} pixels"
    needed = header.width_px * header.height_px * header.bands * _bytes_of(header.dtype)
    if max(header.width_px, header.height_px) > MOST_SIDE_PX or needed > _MOST_BYTES:
        fix = f"a frame has at most {MOST_SIDE_PX:,} px a side and {_MOST_BYTES >> 30} GB of pixels"
        raise FileError(f"{size} in {header.bands} bands are too many", file=path, fix=fix)
    if header.dtype not in DTYPES:
        raise InputError(
            f"pixels of type {header.dtype} aren't handled",
            file=path,
            fix=f"convert the frame to one of {', '.join(sorted(DTYPES))}",
        )
    return header


def _jpeg_header(path: Path) -> FrameHeader:
    jpeg = read_structure(path, whole=False)
    if jpeg.bits != 8:
        raise InputError(f"a JPEG of {jpeg.bits} bits isn't handled", file=path, fix="convert it to TIFF")
    exif = exif_from_block(jpeg.exif) if jpeg.exif else Exif()
    xmp = jpeg.xmp or xmp_from_block(jpeg.exif, SHORT_BYTES)  # FLIR's cameras have it among their tags
    bands = 1 if jpeg.bands == 1 else 3
    return FrameHeader(path, jpeg.width_px, jpeg.height_px, bands, "uint8", None, exif, parse_xmp(xmp))


def _camera_header(path: Path) -> FrameHeader:
    image = camera_image(path)
    _check_packing(path, (image.width_px, image.height_px), [image.dtype] * image.bands)
    xmp = image.xmp
    exif = exif_from_block(image.exif) if image.exif else Exif()
    if not image.exif and not xmp:
        with _mapped(path) as block:  # a DNG is a TIFF
            exif, xmp = exif_from_block(block), xmp_from_block(block, SHORT_BYTES)
    size = image.width_px, image.height_px
    return FrameHeader(path, *size, image.bands, image.dtype, None, exif, parse_xmp(xmp))


def _raster_header(path: Path) -> FrameHeader:
    with open_raster(path, FRAME) as tiff, reading(path, FRAME.problem, FRAME.fix):
        _check_packing(path, (tiff.width, tiff.height), tiff.dtypes)
        if tiff.driver == "GTiff":
            check_blocks(tiff, path, FRAME.fix)
        if ColorInterp.palette in tiff.colorinterp:
            raise InputError(
                "has a palette: its numbers are no colours", file=path, fix="convert it to RGB or grey"
            )
        alpha = [i for i in tiff.colorinterp if i == ColorInterp.alpha]
        bands = tiff.count - len(alpha)
        dtypes = {str(d) for d in tiff.dtypes}
        if len(dtypes) != 1 or bands < 1:
            raise InputError("has bands of several types", file=path, fix="convert them to one type")
        items = {**tiff.tags(), **tiff.tags(ns="EXIF")}
        exif, packet = _tags(tiff, path)
        if not exif.make and exif.lon_deg is None and exif.focal_length_mm is None:
            exif = exif_from_gdal({k: v for k, v in items.items() if k.startswith("EXIF_")})
        return FrameHeader(
            path, tiff.width, tiff.height, bands, dtypes.pop(), tiff.nodata, exif, parse_xmp(packet)
        )


def _tags(raster: Raster, path: Path) -> tuple[Exif, bytes]:
    """EXIF's facts and the XMP packet."""
    if raster.driver == "PNG":
        exif, packet = png_tags(path)
        return exif_from_block(exif), packet
    with _mapped(path) as block:
        return exif_from_block(block), "".join(raster.tags(ns="xml:XMP").values()).encode()


@contextmanager
def _mapped(path: Path) -> Iterator[mmap]:
    """A whole file without reading it: a TIFF's directories may lie anywhere, often behind its pixels."""
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        yield data


def _bytes_of(kind: str) -> int:
    """Bytes of a pixel in one band, of types that numpy lacks those of its longest number."""
    return np.dtype(kind if kind in np.sctypeDict else np.float64).itemsize


def _check_packing(path: Path, size_px: tuple[int, int], dtypes: Sequence[str]) -> None:
    """`FileError` where so few bytes can't be an image of such a size."""
    size, (width, height) = path.stat().st_size, size_px
    unpacked = width * height * sum(_bytes_of(kind) for kind in dtypes)
    if unpacked > max(_SMALL_BYTES, _MOST_RATIO * size):
        problem = f"{size:,} bytes can't hold {width} x {height} pixels in {len(dtypes)} bands"
        raise FileError(problem, file=path, fix=FRAME.fix)


def check_blocks(tiff: Raster, path: Path, fix: str) -> None:
    """Every strip or tile is there, lies within the file, and isn't larger than its pixels.

    Of more than some thousands an even share is looked at. Raises: `FileError`.
    """
    size = path.stat().st_size
    rows, cols = tiff.block_shapes[0]
    across, down = -(-tiff.width // cols), -(-tiff.height // rows)
    by_band = tiff.interleaving is not None and tiff.interleaving.name == "band"
    most = max(2, _MOST_LOOKED_AT // (tiff.count if by_band else 1))
    bits = int(tiff.tags(1, ns="IMAGE_STRUCTURE").get("NBITS", 8 * _bytes_of(tiff.dtypes[0])))
    largest = rows * -(-cols * bits * (1 if by_band else tiff.count) // 8)
    for band in tiff.indexes if by_band else (1,):
        for i in np.unique(np.linspace(0, across * down - 1, min(across * down, most)).astype(np.int64)):
            y, x = divmod(int(i), across)
            start = int(tiff.get_tag_item(f"BLOCK_OFFSET_{x}_{y}", "TIFF", bidx=band) or 0)
            length = int(tiff.get_tag_item(f"BLOCK_SIZE_{x}_{y}", "TIFF", bidx=band) or 0)
            if start + length > size:
                raise FileError("the TIFF is truncated: its image data don't end", file=path, fix=fix)
            if not (start and length) and tiff.nodata is None:
                raise FileError("a part of the TIFF's image data is missing", file=path, fix=fix)
            if tiff.compression is None and length > largest:
                problem = f"the TIFF's header is damaged: {length:,} bytes for {largest:,} bytes of pixels"
                raise FileError(problem, file=path, fix=fix)


def mask_size_error(mask: Path, size_px: tuple[int, int], frame_px: tuple[int, int]) -> FileError:
    """Of a mask whose columns and rows aren't its frame's."""
    (wide, high), (width, height) = size_px, frame_px
    problem = f"the mask has {wide} x {high} pixels, its frame {width} x {height}"
    return FileError(problem, file=mask, fix="make a mask of the frame's size")
