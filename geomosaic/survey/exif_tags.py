"""The tags of an EXIF block (CIPA DC-008, TIFF 6.0) that report camera, place and time."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from mmap import mmap
from typing import Final

import numpy as np

from geomosaic.constants import sourced, tuned

Tags = dict[str, str | tuple[float, ...]]
"""EXIF tags by their standard names (`GPSLatitude`), text or numbers."""

Block = bytes | mmap
"""The bytes of an EXIF segment, or of a whole TIFF file."""

_TAGS: Final[Mapping[str, Mapping[int, str]]] = {
    "": {
        0x010F: "Make", 0x0110: "Model", 0x0132: "DateTime", 0x8769: "Exif", 0x8825: "GPS",
        0xC61A: "BlackLevel",
    },
    "Exif": {
        0x829A: "ExposureTime", 0x829D: "FNumber", 0x8827: "PhotographicSensitivity", 0x8833: "ISOSpeed",
        0x9003: "DateTimeOriginal", 0x9004: "DateTimeDigitized", 0x9010: "OffsetTime",
        0x9011: "OffsetTimeOriginal", 0x9012: "OffsetTimeDigitized", 0x9290: "SubSecTime",
        0x9291: "SubSecTimeOriginal", 0x9292: "SubSecTimeDigitized", 0x920A: "FocalLength",
        0xA002: "PixelXDimension", 0xA003: "PixelYDimension", 0xA20E: "FocalPlaneXResolution",
        0xA210: "FocalPlaneResolutionUnit", 0xA404: "DigitalZoomRatio", 0xA405: "FocalLengthIn35mmFilm",
        0xA431: "BodySerialNumber",
    },
    "GPS": {
        1: "GPSLatitudeRef", 2: "GPSLatitude", 3: "GPSLongitudeRef", 4: "GPSLongitude",
        5: "GPSAltitudeRef", 6: "GPSAltitude", 31: "GPSHPositioningError",
    },
}  # fmt: skip
"""Names of wanted tags by directory, that of the main one empty: CIPA DC-008 (EXIF), section 4.6; Adobe DNG
1.4 for BlackLevel."""
_ANYWHERE: Final[Mapping[int, str]] = {0x010F: "Make", 0x0110: "Model", 0x0132: "DateTime"}
"""Of the main directory, that some programs write into that of Exif: rpicam-apps of Raspberry Pi."""
_MAKER_NOTE = sourced(0x927C, "tag", "the maker's own data", "CIPA DC-008 (EXIF), section 4.6.5")
_DJI: Final[Mapping[int, str]] = {
    0x0001: "Maker", 0x0009: "GimbalPitchDegree", 0x000A: "GimbalYawDegree", 0x000B: "GimbalRollDegree",
}  # fmt: skip
"""Of DJI's maker note, named as in its XMP, whose values they have: ExifTool, DJI tags."""
_KINDS: Final[Mapping[int, tuple[str, ...]]] = {
    1: ("u1",), 2: ("S1",), 3: ("u2",), 4: ("u4",), 5: ("u4", "u4"), 7: ("u1",), 8: ("i2",), 9: ("i4",),
    10: ("i4", "i4"), 11: ("f4",), 12: ("f8",), 13: ("u4",),
}  # fmt: skip
"""Numpy's types by field type, of a ratio both numbers'; others are skipped: TIFF 6.0 (Adobe 1992), section
2. Pointers may be of type 13, as in FLIR's Vue Pro R: Adobe PageMaker 6.0 TIFF Technical Notes (1995)."""
LONGEST_BYTES = tuned(1000, "bytes", "of a value, a camera's name: a damaged length says up to 4 GB")


def tags_from_block(block: Block) -> Tags:
    """The tags of use here, without those that are damaged; empty where the block is no EXIF.

    Four directories are read, each once: no loop of pointers, no count and no length makes it long.
    """
    order = _byte_order(block)
    if not order:
        return {}
    tags = _directory(block, struct.unpack_from(f"{order}I", block, 4)[0], order, _TAGS[""])
    for pointer in ("Exif", "GPS"):
        at = tags.pop(pointer, None)
        if isinstance(at, tuple) and len(at) == 1 and at[0] >= 0.0:
            tags = _directory(block, int(at[0]), order, {**_ANYWHERE, **_TAGS[pointer]}) | tags
            if pointer == "Exif":
                tags |= _dji_tags(block, int(at[0]), order)
    return tags


def _dji_tags(block: Block, at: int, order: str) -> Tags:
    """The gimbal's angles (degrees) of DJI's maker note in the directory at a place, empty without them.

    The note is a directory in little-endian order, whatever the block's is. Its values are read from their
    entries, so that programs which moved it did no harm.
    """
    for entry, number, kind, count in _entries(block, at, order):
        if number == _MAKER_NOTE and kind == 7:
            start = struct.unpack_from(f"{order}I", block, entry + 8)[0]
            tags = _directory(bytes(block[start : start + min(count, LONGEST_BYTES)]), 0, "<", _DJI)
            return tags if tags.pop("Maker", "") == "DJI\x00" else {}
    return {}


def xmp_from_block(block: Block, most_bytes: int) -> bytes:
    """The XMP packet of a TIFF's main directory, else of its Exif one, where FLIR's cameras have it. It is
    empty without one or where it is longer than most_bytes."""
    order = _byte_order(block)
    if not order:
        return b""
    directories = [struct.unpack_from(f"{order}I", block, 4)[0]]
    for at in directories:
        for entry, number, kind, count in _entries(block, at, order):
            start = struct.unpack_from(f"{order}I", block, entry + 8)[0]
            if number == 700 and kind in (1, 7) and count <= most_bytes:  # Adobe XMP, part 3, TIFF
                return bytes(block[start : start + count])
            if _TAGS[""].get(number) == "Exif" and len(directories) == 1:
                directories.append(start)
    return b""


def _byte_order(block: Block) -> str:
    """Of a TIFF's numbers as struct has it, '' for what is none."""
    return {b"II*\x00": "<", b"MM\x00*": ">"}.get(bytes(block[:4]), "") if len(block) >= 8 else ""


def _entries(block: Block, at: int, order: str) -> Iterator[tuple[int, int, int, int]]:
    """Place, number, type and count of each entry of the directory at a place."""
    if at + 2 <= len(block):
        count = min(struct.unpack_from(f"{order}H", block, at)[0], (len(block) - at - 2) // 12)
        for entry in range(at + 2, at + 2 + 12 * count, 12):
            yield entry, *struct.unpack_from(f"{order}HHI", block, entry)


def _directory(block: Block, at: int, order: str, names: Mapping[int, str]) -> Tags:
    found: Tags = {}
    for entry, number, kind, count in _entries(block, at, order):
        name = names.get(number)
        if name is None or name in found or kind not in _KINDS:  # a tag stands once: the first counts
            continue
        size = count * sum(np.dtype(part).itemsize for part in _KINDS[kind])
        start = entry + 8 if size <= 4 else struct.unpack_from(f"{order}I", block, entry + 8)[0]
        if 0 < size <= LONGEST_BYTES and start + size <= len(block):
            value = _value(bytes(block[start : start + size]), kind, order)
            if value is not None:
                found[name] = value
    return found


def _value(data: bytes, kind: int, order: str) -> str | tuple[float, ...] | None:
    if kind == 2:
        try:
            return data.decode()
        except UnicodeDecodeError:
            return data.decode("latin-1")
    parts = np.frombuffer(data, dtype=f"{order}{_KINDS[kind][0]}").astype(np.float64)
    numbers, *below = parts.reshape(-1, len(_KINDS[kind])).T
    for divisor in below:
        if len(divisor) == 3 and divisor[2] == numbers[2] == 0.0:
            divisor[2] = 1.0  # seconds of degrees or hours that nobody knows
        if (divisor == 0.0).any():
            return None
        numbers = numbers / divisor
    return tuple(numbers.tolist())
