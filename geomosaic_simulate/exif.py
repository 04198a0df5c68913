"""EXIF (CIPA DC-008) and XMP segments of a JPEG, written from scratch: little-endian TIFF, two sub-IFDs."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from fractions import Fraction
from typing import Final
from xml.sax.saxutils import quoteattr

from geomosaic.errors import InputError

_SIZES: Final = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 7: 1}
_XMP_HEADER: Final = b"http://ns.adobe.com/xap/1.0/\0"
_NAMESPACES: Final = {
    "drone-dji": "http://www.dji.com/drone-dji/1.0/",
    "Camera": "http://pix4d.com/camera/1.0/",
    "MicaSense": "http://micasense.com/MicaSense/1.0/",
    "DLS": "http://micasense.com/DLS/1.0/",
}


@dataclass(frozen=True)
class ExifTag:
    """One IFD entry: TIFF type (1 byte, 2 ASCII, 3 short, 4 long, 5 rational, 7 undefined) and its bytes."""

    number: int
    kind: int
    data: bytes


def ascii_tag(number: int, text: str) -> ExifTag:
    return ExifTag(number, 2, text.encode("ascii") + b"\0")


def short_tag(number: int, value: int) -> ExifTag:
    return ExifTag(number, 3, struct.pack("<H", value))


def long_tag(number: int, value: int) -> ExifTag:
    return ExifTag(number, 4, struct.pack("<I", value))


def rational_tag(number: int, *values: Fraction) -> ExifTag:
    """Unsigned rationals; numerator and denominator must fit 32 bits."""
    return ExifTag(number, 5, b"".join(struct.pack("<II", v.numerator, v.denominator) for v in values))


def _ifd(tags: list[ExifTag], offset: int) -> bytes:
    """An IFD that starts at a byte offset of the TIFF, its long values behind it."""
    tags = sorted(tags, key=lambda t: t.number)
    behind = offset + 2 + 12 * len(tags) + 4
    entries, values = b"", b""
    for t in tags:
        entries += struct.pack("<HHI", t.number, t.kind, len(t.data) // _SIZES[t.kind])
        if len(t.data) <= 4:
            entries += t.data.ljust(4, b"\0")
        else:
            entries += struct.pack("<I", behind + len(values))
            values += t.data + b"\0" * (len(t.data) % 2)
    return struct.pack("<H", len(tags)) + entries + b"\0\0\0\0" + values


def tiff_bytes(main: list[ExifTag], exif: list[ExifTag], gps: list[ExifTag]) -> bytes:
    """A TIFF header with IFD0, the Exif IFD and (where it has tags) the GPS IFD."""

    def head(exif_at: int, gps_at: int) -> bytes:
        pointers = [long_tag(0x8769, exif_at), *([long_tag(0x8825, gps_at)] if gps else [])]
        return _ifd([*main, *pointers], 8)

    exif_at = 8 + len(head(0, 0))
    exif_ifd = _ifd(exif, exif_at)
    gps_at = exif_at + len(exif_ifd)
    return b"II*\0\x08\0\0\0" + head(exif_at, gps_at) + exif_ifd + (_ifd(gps, gps_at) if gps else b"")


def sexagesimal(degrees: float) -> tuple[Fraction, Fraction, Fraction]:
    """Degrees, minutes, seconds of an absolute angle; seconds to 1e-6 (0.03 mm on the ground)."""
    micro = round(abs(degrees) * 3600e6)
    minutes, seconds = divmod(micro, 60_000_000)
    return Fraction(minutes // 60), Fraction(minutes % 60), Fraction(seconds, 1_000_000)


def camera_tags(
    time_s: float,
    make: str,
    model: str,
    size_px: tuple[int, int],
    focal_mm: float,
    pixels_per_mm: Fraction,
    focal_35mm: int,
    exposure_s: Fraction,
) -> tuple[list[ExifTag], list[ExifTag]]:
    """IFD0 and Exif IFD of an image: who took it, when (UTC), its size and focal length.

    pixels_per_mm goes into FocalPlaneXResolution and YResolution with unit 4 (millimetre).
    """
    when = datetime.fromtimestamp(time_s, UTC)
    stamp = when.strftime("%Y:%m:%d %H:%M:%S")
    main = [
        ascii_tag(0x010F, make),
        ascii_tag(0x0110, model),
        short_tag(0x0112, 1),
        rational_tag(0x011A, Fraction(72)),
        rational_tag(0x011B, Fraction(72)),
        short_tag(0x0128, 2),
        ascii_tag(0x0131, "geomosaic simulate"),
        ascii_tag(0x0132, stamp),
        short_tag(0x0213, 1),
    ]
    exif = [
        rational_tag(0x829A, exposure_s),
        rational_tag(0x829D, Fraction(28, 10)),
        short_tag(0x8827, 100),
        ExifTag(0x9000, 7, b"0230"),
        ascii_tag(0x9003, stamp),
        ascii_tag(0x9004, stamp),
        ascii_tag(0x9011, "+00:00"),
        ascii_tag(0x9291, f"{when.microsecond // 1000:03d}"),
        rational_tag(0x920A, Fraction(round(focal_mm * 1000), 1000)),
        long_tag(0xA002, size_px[0]),
        long_tag(0xA003, size_px[1]),
        rational_tag(0xA20E, pixels_per_mm),
        rational_tag(0xA20F, pixels_per_mm),
        short_tag(0xA210, 4),
        short_tag(0xA405, focal_35mm),
    ]
    return main, exif


def gps_tags(time_s: float, lon_deg: float, lat_deg: float, height_m: float | None) -> list[ExifTag]:
    """The GPS IFD; a height to the millimetre, or none."""
    when = datetime.fromtimestamp(time_s, UTC)
    clock = Fraction(when.second * 1000 + when.microsecond // 1000, 1000)
    tags = [
        ExifTag(0, 1, bytes([2, 3, 0, 0])),
        ascii_tag(1, "N" if lat_deg >= 0.0 else "S"),
        rational_tag(2, *sexagesimal(lat_deg)),
        ascii_tag(3, "E" if lon_deg >= 0.0 else "W"),
        rational_tag(4, *sexagesimal(lon_deg)),
        rational_tag(7, Fraction(when.hour), Fraction(when.minute), clock),
        ascii_tag(0x12, "WGS-84"),
        ascii_tag(0x1D, when.strftime("%Y:%m:%d")),
    ]
    if height_m is not None:
        tags.append(ExifTag(5, 1, bytes([height_m < 0.0])))
        tags.append(rational_tag(6, Fraction(round(abs(height_m) * 1000), 1000)))
    return tags


def xmp_packet(values: Mapping[str, str]) -> bytes:
    """An XMP packet of attributes by their names, such as `Camera:BandName`."""
    used = sorted({name.partition(":")[0] for name in values}, reverse=True)
    spaces = " ".join(f'xmlns:{prefix}="{_NAMESPACES[prefix]}"' for prefix in used)
    attributes = "\n".join(f"   {name}={quoteattr(value)}" for name, value in values.items())
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">\n'
        ' <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
        f'  <rdf:Description rdf:about="DJI Meta Data" {spaces}\n{attributes}/>\n'
        ' </rdf:RDF>\n</x:xmpmeta>\n<?xpacket end="w"?>'
    ).encode()


def with_segments(jpeg: bytes, tiff: bytes, xmp: bytes | None) -> bytes:
    """The JPEG with its Exif (and XMP) APP1 segments in place of the JFIF segment."""
    if jpeg[:4] != b"\xff\xd8\xff\xe0":
        raise InputError("is no JPEG that EXIF can be added to", fix="give a JFIF file")
    rest = jpeg[4 + struct.unpack(">H", jpeg[4:6])[0] :]
    segments = [b"Exif\0\0" + tiff, *([_XMP_HEADER + xmp] if xmp else [])]
    return b"\xff\xd8" + b"".join(b"\xff\xe1" + struct.pack(">H", len(s) + 2) + s for s in segments) + rest
