"""The structure of a JPEG file, without decoding it: size, EXIF and XMP segments, wholeness."""

from __future__ import annotations

import mmap
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from geomosaic.errors import FileError

_EXIF: Final = b"Exif\x00\x00"
_XMP: Final = b"http://ns.adobe.com/xap/1.0/\x00"
_EOI: Final = b"\xff\xd9"
_TRUNCATED: Final = "copy it again from the camera, or take it out of the folder"


@dataclass(frozen=True)
class JpegStructure:
    """What the segments before the image data say; exif and xmp are raw bytes, empty where absent.

    data_start: offset of the coded data; restart_blocks: coded
    blocks between restart markers, 0 without any; size_at: offset of height and width in the header;
    block_px: width and height that one coded block of all bands covers.
    """

    width_px: int
    height_px: int
    bands: int
    bits: int
    exif: bytes
    xmp: bytes
    data_start: int
    progressive: bool
    restart_blocks: int
    size_at: int
    block_px: tuple[int, int]


def read_structure(path: Path, whole: bool = True) -> JpegStructure:
    """Walk a JPEG's segments; and check that its image data end, if it must be whole.

    Raises: `FileError` when the file is no JPEG, or can't hold an image of the size it states,
    or stops before the end of the image.
    """
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return parse_structure(data, path, whole)
    except FileError:
        raise
    except (OSError, ValueError) as error:  # mmap of an empty file is a ValueError
        empty = path.is_file() and path.stat().st_size == 0
        problem = "the file is empty" if empty else f"can't be read ({error})"
        raise FileError(problem, file=path, fix=_TRUNCATED) from error


def parse_structure(data: bytes | mmap.mmap, path: Path, whole: bool = True) -> JpegStructure:
    """As `read_structure`, of a file's bytes; path is for the message only.

    Image data contain no end marker (0xFF is followed by a stuffed 0 in them), and come after all thumbnails
    in the header. Previews appended to the file (MPF, as DJI's) come after the primary image's own end
    marker. So an image ends at the first end marker after the start of its data. MPF's own lengths are wrong
    in files whose header was enlarged afterwards.
    """
    if bytes(data[:2]) != b"\xff\xd8":
        raise FileError("is no JPEG file", file=path, fix="take it out of the folder")
    at, size, exif, xmp = 2, None, b"", b""
    size_at, progressive, restart, sampling = 0, False, 0, b""
    while True:
        head = bytes(data[at : at + 4])
        if len(head) < 4:
            raise FileError("the JPEG is truncated in its header", file=path, fix=_TRUNCATED)
        if head[0] != 0xFF:
            raise FileError("the JPEG's header is damaged", file=path, fix=_TRUNCATED)
        marker = head[1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if marker == 0x01 or marker in range(0xD0, 0xD8):  # they stand alone (ITU-T T.81, table B.1)
            at += 2
            continue
        body = bytes(data[at + 4 : at + 2 + int.from_bytes(head[2:4], "big")])
        if marker == 0xDA:
            break
        # each fourth from 0xC4 on is no frame's header; each fourth from 0xC2 on is of one in scans
        if marker in {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC} and len(body) >= 6:
            size_at, progressive, sampling = at + 5, marker % 4 == 2, body[7::3]
            size = (body[0], int.from_bytes(body[1:3], "big"), int.from_bytes(body[3:5], "big"), body[5])
        elif marker == 0xDD and len(body) >= 2:
            restart = int.from_bytes(body[:2], "big")
        elif marker == 0xE1 and body.startswith(_EXIF):
            exif = exif or body[len(_EXIF) :]
        elif marker == 0xE1 and body.startswith(_XMP):
            xmp += body[len(_XMP) :]
        at += 2 + int.from_bytes(head[2:4], "big")
    if size is None or 0 in size:
        raise FileError("the JPEG's header states no size", file=path, fix=_TRUNCATED)
    bits, height, width, bands = size
    start = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    if (len(data) - start) * 8 < -(-width // 8) * -(-height // 8):  # a block of 8 x 8 takes at least a bit
        raise FileError(
            f"{len(data) - start:,} bytes can't hold {width} x {height} pixels", file=path, fix=_TRUNCATED
        )
    if whole and data.rfind(_EOI, max(at, len(data) - 65536)) < 0 and data.rfind(_EOI, at) < 0:
        raise FileError("the JPEG is truncated: its image data don't end", file=path, fix=_TRUNCATED)
    across, down = (max((s >> 4 for s in sampling), default=1), max((s & 15 for s in sampling), default=1))
    block_px = (8, 8) if bands == 1 else (8 * across, 8 * down)
    return JpegStructure(
        width, height, bands, bits, exif, xmp, start, progressive, restart, size_at, block_px
    )
