"""A PNG file's chunks, without decoding it: whether they are whole, and the EXIF and XMP in them.

Source: PNG specification, third edition (W3C 2025), sections 5.3 (chunks), 11.3.3 (iTXt) and 11.3.4.5 (eXIf).
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path

from geomosaic.doors.files import SHORT_BYTES

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_XMP = b"XML:com.adobe.xmp\0"


def png_damage(data: bytes) -> str:
    """What is wrong with a PNG's chunks, '' where they are whole: GDAL reads on over most of it."""
    at = len(_SIGNATURE)
    for kind, content, check in _chunks(data):
        if zlib.crc32(kind + content) != check:
            return f"its part at byte {at} is not what its check sum says"
        if kind == b"IEND":
            return ""
        at += 12 + len(content)
    return "its end is missing"


def png_tags(path: Path) -> tuple[bytes, bytes]:
    """The EXIF block and the XMP packet of a PNG file, empty where it has none."""
    exif, xmp = b"", b""
    for kind, content, _ in _chunks(path.read_bytes()):
        if kind == b"eXIf":
            exif = content
        elif kind == b"iTXt" and content.startswith(_XMP):
            xmp = _text(content[len(_XMP) :])
    return exif, xmp


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes, int]]:
    """Type, content and stated check sum of each whole chunk."""
    at = len(_SIGNATURE)
    while (end := at + 12 + int.from_bytes(data[at : at + 4], "big")) <= len(data):
        yield data[at + 4 : at + 8], data[at + 8 : end - 4], int.from_bytes(data[end - 4 : end], "big")
        at = end


def _text(content: bytes) -> bytes:
    """The text of an iTXt chunk after its keyword: flag, method, language, translated keyword, text."""
    packed, text = content[:1] == b"\1", content[2:].partition(b"\0")[2].partition(b"\0")[2]
    if not packed:
        return text
    try:
        return zlib.decompressobj().decompress(text, SHORT_BYTES)
    except zlib.error:
        return b""
