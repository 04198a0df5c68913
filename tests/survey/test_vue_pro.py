"""What FLIR's Vue Pro R writes into its TIFFs: pointers of type 13, and an XMP packet with an unclosed tag."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from geomosaic.survey.focal_lengths import reported_focal_lengths
from geomosaic.survey.header import read_header
from geomosaic.survey.onboard import onboard_attitude, onboard_heights, onboard_position
from geomosaic.survey.xmp import parse_xmp

PACKET = b"""<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?>\r
<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\r
<rdf:Description rdf:about=""\r
xmlns:Camera="http://pix4d.com/camera/1.0/"\r
xmlns:FLIR="http://ns.flir.com/xmp/1.0/"\r
<Camera:BandName>\r\n<rdf:Seq>\r\n<rdf:li>LWIR</rdf:li>\r\n</rdf:Seq>\r\n</Camera:BandName>\r
<Camera:Yaw>0/100</Camera:Yaw>\r\n<Camera:Pitch>0/100</Camera:Pitch>\r\n<Camera:Roll>0/100</Camera:Roll>\r
<FLIR:MAVRelativeAltitude>600080/1000</FLIR:MAVRelativeAltitude>\r
<FLIR:MAVYaw>18083/100</FLIR:MAVYaw>\r\n<FLIR:MAVPitch>171/100</FLIR:MAVPitch>\r
<FLIR:MAVRoll>-1080/100</FLIR:MAVRoll>\r
</rdf:Description>\r\n</rdf:RDF>\r\n<?xpacket end="w"?>"""


def tiff(path: Path) -> Path:
    """640 x 512 pixels of 16 bits, with the directories as the camera writes them."""
    data = bytearray(b"II*\0\0\0\0\0" + np.arange(640 * 512, dtype="<u2").tobytes())

    def put(values: bytes) -> int:
        data.extend(values)
        return len(data) - len(values)

    def ratios(*values: tuple[int, int]) -> int:
        return put(struct.pack(f"<{2 * len(values)}I", *(n for value in values for n in value)))

    def directory(*entries: tuple[int, int, int, int | bytes]) -> int:
        packed = [
            struct.pack("<HHI", *entry[:3])
            + (entry[3] if isinstance(entry[3], bytes) else struct.pack("<I", entry[3]))
            for entry in entries
        ]
        return put(struct.pack("<H", len(entries)) + b"".join(packed) + bytes(4))

    exif = directory((0x920A, 5, 1, ratios((9, 1))))
    gps = directory(
        (1, 2, 2, b"N\0\0\0"), (2, 5, 3, ratios((35, 1), (14, 1), (43979, 1000))), (3, 2, 2, b"E\0\0\0"),
        (4, 5, 3, ratios((129, 1), (8, 1), (31967, 1000))), (5, 1, 1, 0), (6, 5, 1, ratios((97015, 100))),
    )  # fmt: skip
    first = directory(
        (0x100, 3, 1, 640), (0x101, 3, 1, 512), (0x102, 3, 1, 16), (0x103, 3, 1, 1), (0x106, 3, 1, 1),
        (0x10F, 2, 5, put(b"FLIR\0")), (0x110, 2, 18, put(b"Vue Pro R 640 9mm\0")), (0x111, 4, 1, 8),
        (0x115, 3, 1, 1), (0x116, 3, 1, 512), (0x117, 4, 1, 655360), (0x2BC, 1, len(PACKET), put(PACKET)),
        (0x8769, 13, 1, exif), (0x8825, 13, 1, gps),
    )  # fmt: skip
    data[4:8] = struct.pack("<I", first)
    path.write_bytes(data)
    return path


def test_place_lens_and_attitude_are_read(tmp_path: Path) -> None:
    """Angles of the camera that are all 0 were never filled; the aircraft's count."""
    header = read_header(tiff(tmp_path / "20190402_154721.tiff"))
    assert header.xmp is not None
    position = onboard_position(header.exif, header.xmp)
    assert position is not None
    assert (position.lat_deg, position.lon_deg) == pytest.approx((35.2455497, 129.1422131), abs=1e-7)
    assert position.height_ellipsoidal_m == pytest.approx(970.15)
    assert onboard_heights(header.exif, header.xmp).above_ground_m == pytest.approx(600.08)
    attitude = onboard_attitude(header.exif, header.xmp)
    assert (attitude.source, attitude.sd_tilt_deg) == ("mavlink", 5.0)
    assert (attitude.yaw_deg, attitude.pitch_deg, attitude.roll_deg) == pytest.approx((180.83, 1.71, -10.8))
    assert reported_focal_lengths(header).by_source == pytest.approx({"sensor-pitch": 9000.0 / 17.0})


def test_a_packet_that_is_damaged_otherwise_stays_unread() -> None:
    assert parse_xmp(PACKET.replace(b"</FLIR:MAVYaw>", b"")) is None
    sound = PACKET.replace(b'xmp/1.0/"\r', b'xmp/1.0/">\r').replace(b"LWIR", b'a="b" &lt;c')
    assert (parse_xmp(sound) or {})["Camera:BandName"] == 'a="b" <c'
