"""Small real files for the survey's tests: JPEG with EXIF and XMP, written byte by byte."""

from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np

ASCII, SHORT, LONG, RATIONAL, BYTE, SIGNED, UNDEFINED, FLOAT = 2, 3, 4, 5, 1, 10, 7, 11
IFD0 = {
    "Make": (0x010F, ASCII), "Model": (0x0110, ASCII), "Orientation": (0x0112, SHORT),
    "NewSubfileType": (0x00FE, LONG), "ImageWidth": (0x0100, LONG), "ImageLength": (0x0101, LONG),
    "BitsPerSample": (0x0102, SHORT), "Compression": (0x0103, SHORT), "Photometric": (0x0106, SHORT),
    "StripOffsets": (0x0111, LONG), "SamplesPerPixel": (0x0115, SHORT), "RowsPerStrip": (0x0116, LONG),
    "StripByteCounts": (0x0117, LONG), "Xmp": (0x02BC, BYTE), "CFARepeatPatternDim": (0x828D, SHORT),
    "CFAPattern": (0x828E, BYTE), "DNGVersion": (0xC612, BYTE), "UniqueCameraModel": (0xC614, ASCII),
    "BlackLevel": (0xC61A, SHORT), "WhiteLevel": (0xC61D, SHORT), "ColorMatrix1": (0xC621, SIGNED),
    "AsShotNeutral": (0xC628, RATIONAL), "CalibrationIlluminant1": (0xC65A, SHORT),
}  # fmt: skip
EXIF = {
    "XmpOfExif": (0x02BC, BYTE), "DateTimeOriginal": (0x9003, ASCII), "OffsetTimeOriginal": (0x9011, ASCII),
    "SubSecTimeOriginal": (0x9291, ASCII), "MakerNote": (0x927C, UNDEFINED),
    "FocalLength": (0x920A, RATIONAL), "PixelXDimension": (0xA002, LONG), "PixelYDimension": (0xA003, LONG),
    "FocalPlaneXResolution": (0xA20E, RATIONAL), "FocalPlaneResolutionUnit": (0xA210, SHORT),
    "DigitalZoomRatio": (0xA404, RATIONAL), "FocalLengthIn35mmFilm": (0xA405, SHORT), "BodySerialNumber": (0xA431, ASCII),
}  # fmt: skip
GPS = {
    "GPSLatitudeRef": (1, ASCII), "GPSLatitude": (2, RATIONAL), "GPSLongitudeRef": (3, ASCII),
    "GPSLongitude": (4, RATIONAL), "GPSAltitudeRef": (5, BYTE), "GPSAltitude": (6, RATIONAL),
    "GPSHPositioningError": (31, RATIONAL),
}  # fmt: skip


def exif_block(order: str = "<", pixels: bytes = b"", **tags: object) -> bytes:
    """A TIFF header with IFD0, Exif and GPS directories, behind the bytes of pixels."""
    rooms = [{n: tags[n] for n in room if n in tags} for room in (IFD0, EXIF, GPS)]
    sizes = [2 + 12 * (len(r) + (2 if i == 0 else 0)) + 4 for i, r in enumerate(rooms)]
    first = 8 + len(pixels)
    starts = [first, first + sizes[0], first + sizes[0] + sizes[1]]
    data_at, data, out = sum(sizes) + first, b"", b""
    for i, (names, tags_of) in enumerate(zip((IFD0, EXIF, GPS), rooms, strict=True)):
        entries = [(*names[n], v) for n, v in tags_of.items()]
        if i == 0:
            entries += [(0x8769, LONG, starts[1]), (0x8825, LONG, starts[2])]
        out += struct.pack(order + "H", len(entries))
        for tag, kind, value in sorted(entries, key=lambda e: e[0]):
            payload, count = _payload(kind, value, order)
            if len(payload) > 4:
                at, data = data_at + len(data), data + payload
                payload = struct.pack(order + "I", at)
            out += struct.pack(order + "HHI", tag, kind, count) + payload.ljust(4, b"\0")
        out += struct.pack(order + "I", 0)
    mark = b"II*\0" if order == "<" else b"MM\0*"
    return mark + struct.pack(order + "I", first) + pixels + out + data


def _payload(kind: int, value: object, order: str) -> tuple[bytes, int]:
    if kind == ASCII:
        text = str(value).encode() + b"\0"
        return text, len(text)
    if kind == UNDEFINED:
        assert isinstance(value, bytes)
        return value, len(value)
    values = value if isinstance(value, tuple) else (value,)
    if kind in (RATIONAL, SIGNED):
        code = "II" if kind == RATIONAL else "ii"
        pairs = [Fraction(v).limit_denominator(10**7) for v in values]
        return b"".join(struct.pack(order + code, p.numerator, p.denominator) for p in pairs), len(pairs)
    code = {SHORT: "H", LONG: "I", BYTE: "B"}[kind]
    return b"".join(struct.pack(order + code, v) for v in values), len(values)


def dji_maker_note(yaw: float, pitch: float, roll: float) -> bytes:
    """A gimbal's angles as DJI's cameras write them into EXIF next to the aircraft's."""
    floats = {6: 2.1, 7: 81.5, 8: 4.2, 9: pitch, 10: yaw, 11: roll}
    entries = [struct.pack("<HHI4s", 1, ASCII, 4, b"DJI\0")]
    entries += [struct.pack("<HHIf", tag, FLOAT, 1, value) for tag, value in floats.items()]
    return struct.pack("<H", len(entries)) + b"".join(entries) + struct.pack("<I", 0)


def dms(degrees: float) -> tuple[Fraction, Fraction, Fraction]:
    """Degrees, minutes and seconds of an angle's size, to 1e-6 seconds."""
    micro = round(abs(degrees) * 3600e6)
    return (
        Fraction(micro // 3600_000_000),
        Fraction(micro // 60_000_000 % 60),
        Fraction(micro % 60_000_000, 10**6),
    )


def gps(lon: float, lat: float, altitude: float | None = None) -> dict[str, object]:
    """GPS tags of a position."""
    tags: dict[str, object] = {
        "GPSLatitudeRef": "S" if lat < 0 else "N", "GPSLatitude": dms(lat),
        "GPSLongitudeRef": "W" if lon < 0 else "E", "GPSLongitude": dms(lon),
    }  # fmt: skip
    if altitude is not None:
        tags |= {"GPSAltitudeRef": int(altitude < 0), "GPSAltitude": Fraction(str(abs(altitude)))}
    return tags


def xmp_attributes(uri: str, prefix: str, **values: object) -> bytes:
    """An XMP packet with properties as attributes, as DJI writes it."""
    attributes = " ".join(f'{prefix}:{k}="{v}"' for k, v in values.items())
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="" xmlns:{prefix}="{uri}" {attributes}/></rdf:RDF></x:xmpmeta>'
    ).encode()


def dji_xmp(**values: object) -> bytes:
    """DJI's packet."""
    return xmp_attributes("http://www.dji.com/drone-dji/1.0/", "drone-dji", **values)


def segment(marker: int, body: bytes) -> bytes:
    """A JPEG segment."""
    return struct.pack(">BBH", 0xFF, marker, len(body) + 2) + body


def image(width: int = 120, height: int = 80, bands: int = 3, seed: int = 1) -> np.ndarray:
    """A smooth image that is alike nowhere."""
    rng = np.random.default_rng(seed)
    small = rng.integers(0, 255, (height // 8 + 2, width // 8 + 2, bands)).astype(np.float32)
    return np.atleast_3d(
        cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC).clip(0, 255)
    ).astype(np.uint8)


def write_jpeg(
    path: Path, pixels: np.ndarray, exif: bytes = b"", xmp: bytes = b"", tail: bytes = b""
) -> Path:
    """A JPEG (from RGB) with EXIF and XMP segments, and bytes behind its end."""
    rgb = pixels[..., ::-1] if pixels.shape[2] == 3 else pixels
    data = cv2.imencode(".jpg", rgb, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    head = b"\xff\xd8"
    if exif:
        head += segment(0xE1, b"Exif\0\0" + exif)
    if xmp:
        head += segment(0xE1, b"http://ns.adobe.com/xap/1.0/\0" + xmp)
    path.write_bytes(head + data[2:] + tail)
    return path


TO_SRGB = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
"""From XYZ: a camera with this matrix has sRGB's primaries."""


def write_dng(path: Path, rgb: np.ndarray, exif: dict[str, object], xmp: bytes = b"", **dng: object) -> Path:
    """A raw image (RGGB in 16 bits, black 256, white 16256) of linear colours from 0 to 1. It is shot under
    light in which grey has the camera values 0.5, 1, 0.8."""
    neutral = (Fraction(1, 2), Fraction(1), Fraction(4, 5))
    rows, cols = rgb.shape[:2]
    raw = 256.0 + 16000.0 * rgb * np.array([float(n) for n in neutral])
    row, col = np.indices((rows, cols)) % 2
    mosaic = np.take_along_axis(raw, (row + col)[..., None], axis=2)[..., 0].round().astype("<u2")
    tags = {
        "NewSubfileType": 0, "ImageWidth": cols, "ImageLength": rows, "BitsPerSample": 16, "Compression": 1,
        "Photometric": 32803, "SamplesPerPixel": 1, "RowsPerStrip": rows, "StripByteCounts": 2 * rows * cols,
        "CFARepeatPatternDim": (2, 2), "CFAPattern": (0, 1, 1, 2), "DNGVersion": (1, 4, 0, 0),
        "UniqueCameraModel": "DJI FC6310", "BlackLevel": 256, "WhiteLevel": 16256,
        "ColorMatrix1": tuple(TO_SRGB.ravel()), "AsShotNeutral": neutral, "CalibrationIlluminant1": 21,
        "Orientation": 1, **exif, **dng,
    }  # fmt: skip
    if xmp:
        tags["Xmp"] = tuple(xmp)
    head = exif_block(**tags, StripOffsets=0)
    head += b"\0" * (len(head) % 2)
    tags["StripOffsets"] = len(head)
    path.write_bytes(exif_block(**tags).ljust(len(head), b"\0") + mosaic.tobytes())
    return path


def drone_frame(
    path: Path,
    lon: float = 9.1234567,
    lat: float = 48.7654321,
    *,
    second: int = 0,
    size: tuple[int, int] = (120, 80),
    **xmp: object,
) -> Path:
    """A frame as a drone writes it: EXIF position, time and focal length, DJI's XMP."""
    exif = exif_block(
        Make="DJI", Model="FC6310", DateTimeOriginal=f"2024:05:17 10:11:{second:02d}",
        FocalLength=Fraction("8.8"),
        FocalLengthIn35mmFilm=24, PixelXDimension=size[0], PixelYDimension=size[1], **gps(lon, lat, 412.5),
    )  # fmt: skip
    values = {
        "AbsoluteAltitude": "+412.50", "RelativeAltitude": "+80.20", "GimbalYawDegree": "+37.00",
        "GimbalPitchDegree": "-90.00", "GimbalRollDegree": "+0.00", "FlightYawDegree": "+41.00",
        "FlightPitchDegree": "-4.00", "FlightRollDegree": "+2.00",
    } | xmp  # fmt: skip
    return write_jpeg(path, image(*size), exif, dji_xmp(**{k: v for k, v in values.items() if v is not None}))


def survey_folder(folder: Path, count: int = 4) -> Path:
    """A folder of frames flying east, 20 m apart."""
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        drone_frame(folder / f"DJI_{i + 1:04d}.JPG", 9.1234567 + i * 2.7e-4, second=i)
    return folder
