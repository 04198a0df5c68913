"""EXIF and XMP as drones write them."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from survey_files import (
    dji_maker_note,
    dji_xmp,
    dms,
    drone_frame,
    exif_block,
    gps,
    image,
    segment,
    write_jpeg,
    xmp_attributes,
)

from geomosaic.errors import FileError
from geomosaic.survey.exif import Exif, exif_from_block, exif_from_gdal
from geomosaic.survey.header import read_header
from geomosaic.survey.jpeg import read_structure
from geomosaic.survey.onboard import (
    onboard_attitude,
    onboard_heights,
    onboard_position,
    platform_of,
    rtk_source,
)
from geomosaic.survey.tagged_place import APART, FINER, SIGNED, tagged_place
from geomosaic.survey.xmp import number, parse_xmp

CAMERA_NS = "http://pix4d.com/camera/1.0"
PARROT_NS = "http://www.parrot.com/drone-parrot/1.0/"


@pytest.mark.parametrize("order", ["<", ">"])
def test_exif_says_place_time_and_lens(order: str) -> None:
    block = exif_block(
        order, Make="Maker ", Model="M1", DateTimeOriginal="2016:06:23 16:31:59", SubSecTimeOriginal="25",
        OffsetTimeOriginal="-05:00", FocalLength=Fraction("3.61"), FocalLengthIn35mmFilm=20,
        FocalPlaneXResolution=Fraction("1000"), FocalPlaneResolutionUnit=3, PixelXDimension=4000,
        **gps(-91.99455988, -46.84260708, -12.75),
    )  # fmt: skip
    exif = exif_from_block(block)
    assert (exif.make, exif.model, exif.width_px) == ("Maker", "M1", 4000)
    assert exif.lon_deg == pytest.approx(-91.99455988, abs=1e-9)
    assert exif.lat_deg == pytest.approx(-46.84260708, abs=1e-9)
    assert exif.altitude_m == -12.75
    assert exif.time_s == 1466717519.25  # 2016-06-23 21:31:59.25 UTC
    assert (exif.focal_length_mm, exif.focal_length_35mm, exif.pixels_per_mm) == (3.61, 20.0, 100.0)
    assert not exif.hemisphere_assumed


@given(st.floats(0.0, 179.999))
def test_degrees_minutes_seconds_add_up(angle: float) -> None:
    degrees, minutes, seconds = dms(angle)
    assert float(degrees + minutes / 60 + seconds / 3600) == pytest.approx(angle, abs=2e-10)


def test_a_receiver_without_fix_gives_no_position() -> None:
    assert exif_from_block(exif_block(**gps(0.0, 0.0))).lon_deg is None
    assert onboard_position(exif_from_block(exif_block(**gps(0.0, 0.0))), {}) is None


def test_missing_hemisphere_is_reported() -> None:
    exif = exif_from_block(exif_block(GPSLatitude=dms(10.5), GPSLongitude=dms(20.25)))
    assert (exif.lat_deg, exif.lon_deg, exif.hemisphere_assumed) == (10.5, 20.25, True)


def test_gdal_keeps_exif_as_text() -> None:
    exif = exif_from_gdal(
        {
            "EXIF_GPSLatitude": "(24) (40) (49.0009)", "EXIF_GPSLatitudeRef": "N",
            "EXIF_GPSLongitude": "(120) (57) (6.1257)",
            "EXIF_GPSLongitudeRef": "E", "EXIF_GPSAltitude": "(186.57)", "EXIF_GPSAltitudeRef": "0x00",
            "EXIF_FocalLength": "(8.8)", "EXIF_FocalLengthIn35mmFilm": "24", "EXIF_Make": "DJI",
            "EXIF_DateTimeOriginal": "2019:04:11 11:01:21",
        }
    )  # fmt: skip
    assert exif.lat_deg == pytest.approx(24.680278027, abs=1e-8)
    assert exif.lon_deg == pytest.approx(120.951701583, abs=1e-8)
    assert (exif.altitude_m, exif.focal_length_mm, exif.focal_length_35mm) == (186.57, 8.8, 24.0)
    assert exif.time_s == 1554980481.0


@given(st.binary(max_size=300))
def test_damaged_exif_is_no_exif(data: bytes) -> None:
    exif = exif_from_block(b"II*\0" + data)
    assert exif.lat_deg is None or abs(exif.lat_deg) <= 90.0


def test_xmp_as_elements_and_attributes_is_the_same() -> None:
    elements = (
        b'junk<?xpacket?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
        b'<r:RDF xmlns:r="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        b'<r:Description xmlns:C="http://pix4d.com/camera/1.0/"><C:Yaw>-12.5</C:Yaw><C:Pitch> 25/2 </C:Pitch>'
        b"<C:Bands><r:Seq><r:li>Red</r:li><r:li>Green</r:li></r:Seq></C:Bands>"
        b"</r:Description></r:RDF></x:xmpmeta>"
    )
    found = parse_xmp(elements)
    assert found is not None
    assert (number(found, "Camera:Yaw"), number(found, "Camera:Pitch"), found["Camera:Bands"]) == (
        -12.5,
        12.5,
        "Red,Green",
    )
    other = parse_xmp(xmp_attributes(CAMERA_NS, "anything", Yaw="-12.5", Pitch="12.5"))
    assert other is not None
    assert (number(other, "Camera:Yaw"), number(other, "Camera:Pitch")) == (-12.5, 12.5)


def test_undeclared_prefixes_are_read_all_the_same() -> None:
    packet = (
        b'<x:xmpmeta><rdf:RDF><rdf:Description drone-dji:GimbalYawDegree="+12.30"/></rdf:RDF></x:xmpmeta>'
    )
    assert parse_xmp(packet) == {"drone-dji:GimbalYawDegree": "+12.30"}


def test_entities_in_xmp_are_refused() -> None:
    bomb = b'<!DOCTYPE x [<!ENTITY a "aaaaaaaa">]>'
    packet = dji_xmp(GimbalYawDegree="1").replace(b"><rdf:RDF", b">&a;<rdf:RDF", 1)
    assert parse_xmp(bomb + packet) is None
    assert parse_xmp(b"no packet at all") == {}
    assert parse_xmp(dji_xmp(GimbalYawDegree="1").replace(b"/></rdf", b"></rdf")) is None


def dji(**values: object) -> dict[str, str]:
    return {f"drone-dji:{k}": str(v) for k, v in values.items()}


def camera(yaw: float, pitch: float, roll: float) -> dict[str, str]:
    return {"Camera:Yaw": str(yaw), "Camera:Pitch": str(pitch), "Camera:Roll": str(roll)}


def test_the_gimbal_counts_and_not_the_aircraft() -> None:
    xmp = dji(
        GimbalYawDegree="+37.0", GimbalPitchDegree="-60.0", GimbalRollDegree="0", FlightYawDegree="91",
        FlightPitchDegree="-8", FlightRollDegree="5",
    )  # fmt: skip
    attitude = onboard_attitude(Exif(), xmp)
    assert attitude.source == "dji-gimbal"
    assert attitude.yaw_deg == pytest.approx(37.0)
    assert attitude.pitch_deg == pytest.approx(30.0)
    assert attitude.roll_deg == pytest.approx(0.0, abs=1e-9)
    assert (attitude.sd_yaw_deg, attitude.sd_tilt_deg) == (3.0, 0.5)


def test_gimbal_roll_of_180_turns_the_heading_and_not_the_camera_up() -> None:
    xmp = dji(GimbalYawDegree="20", GimbalPitchDegree="-90", GimbalRollDegree="180")
    attitude = onboard_attitude(Exif(), xmp)
    assert attitude.yaw_deg == pytest.approx(200.0)
    assert attitude.pitch_deg == pytest.approx(0.0, abs=1e-9)
    assert attitude.roll_deg == pytest.approx(0.0, abs=1e-9)


def test_a_gimbal_of_zeros_was_never_filled() -> None:
    zeros = {f"Gimbal{axis}Degree": "+0.00" for axis in ("Yaw", "Pitch", "Roll")}
    attitude = onboard_attitude(Exif(), dji(**zeros, FlightYawDegree="+19.3", FlightPitchDegree="-2.7"))
    assert (attitude.source, attitude.yaw_deg, attitude.pitch_deg) == ("dji-flight", 19.3, -2.7)
    assert onboard_attitude(Exif(), dji(**zeros)).pitch_deg is None
    assert onboard_attitude(Exif(), dji(**zeros | {"GimbalYawDegree": "0.1"})).source == "dji-gimbal"


@pytest.mark.parametrize("order", ["<", ">"])
def test_djis_maker_note_has_the_gimbal_where_xmp_has_none(order: str) -> None:
    """The first frame of a Phantom 3 whose XMP a program wrote anew: -75.1, 85.3, 0."""
    exif = exif_from_block(exif_block(order, Make="DJI", MakerNote=dji_maker_note(85.3, -75.1, 0.0)))
    for xmp in ({}, {f"drone-dji:Gimbal{axis}Degree": "0" for axis in ("Yaw", "Pitch", "Roll")}):
        found = onboard_attitude(exif, xmp | dji(FlightYawDegree="81.5", FlightPitchDegree="2.1"))
        assert (found.source, found.sd_yaw_deg, found.sd_tilt_deg) == ("dji-gimbal", 3.0, 0.5)
        assert (found.yaw_deg, found.pitch_deg) == (
            pytest.approx(85.3, abs=1e-5),
            pytest.approx(14.9, abs=1e-5),
        )
        assert found.roll_deg == pytest.approx(0.0, abs=1e-9)
    xmp = dji(GimbalYawDegree="20", GimbalPitchDegree="-60", GimbalRollDegree="0")
    assert onboard_attitude(exif, xmp).pitch_deg == pytest.approx(30.0)
    assert onboard_attitude(exif, camera(12, 3, -2)).source == "xmp-camera"
    assert (
        onboard_attitude(exif_from_block(exif_block(MakerNote=dji_maker_note(0, 0, 0))), {}).source == "none"
    )


def test_a_damaged_maker_note_gives_no_angle() -> None:
    whole = dji_maker_note(85.3, -75.1, 0.0)
    long = whole + b"\xff" * 16384
    assert exif_from_block(exif_block(MakerNote=long)).gimbal_deg == pytest.approx((85.3, -75.1, 0.0))
    wrong = [
        *(whole[:cut] for cut in (1, 2, 40, len(whole) - 5)),
        b"\xff\xff" + bytes(16),
        b"[ae_dbg_info:" + bytes(90),
        whole.replace(b"DJI\0", b"SONY"),
        dji_maker_note(85.3, float("nan"), 0.0),
        dji_maker_note(85.3, float("inf"), 0.0),
    ]
    for note in wrong:
        assert exif_from_block(exif_block(Make="DJI", MakerNote=note)).gimbal_deg is None, note[:16]
    block = exif_block(Make="DJI", MakerNote=whole)
    for at in range(block.index(b"\x7c\x92") + 4, block.index(b"\x7c\x92") + 12):
        damaged = exif_from_block(block[:at] + b"\xff" + block[at + 1 :])
        assert damaged.make == "DJI" and damaged.gimbal_deg in (None, exif_from_block(block).gimbal_deg)


def test_flight_attitude_only_where_there_is_no_gimbal() -> None:
    xmp = dji(FlightYawDegree="-91", FlightPitchDegree="-8", FlightRollDegree="5")
    attitude = onboard_attitude(Exif(), xmp)
    assert (attitude.source, attitude.yaw_deg, attitude.pitch_deg, attitude.roll_deg) == (
        "dji-flight",
        269.0,
        -8.0,
        5.0,
    )
    assert attitude.sd_tilt_deg == 5.0


@pytest.mark.parametrize(
    ("xmp", "make", "expected"),
    [
        (camera(12, 3, -2), "MicaSense", ("xmp-camera", 12.0, 3.0, -2.0)),
        (camera(12, 3, -2), "senseFly", ("sensefly", 12.0, 3.0, 2.0)),
        (camera(-12, -85, 0), "Parrot", ("parrot-camera", 348.0, 5.0, 0.0)),
        (
            {f"drone-parrot:Camera{a}Degree": v for a, v in (("Yaw", "7"), ("Pitch", "-80"), ("Roll", "0"))},
            "Parrot",
            ("parrot-camera", 7.0, 10.0, 0.0),
        ),
        (
            {"sensefly:Heading": "181", "sensefly:PitchAngle": "4", "sensefly:RollAngle": "-3"},
            "senseFly",
            ("sensefly", 181.0, 4.0, -3.0),
        ),
        ({"DLS:Yaw": "1.2", "DLS:Pitch": "0.1"}, "MicaSense", ("none", None, None, None)),
    ],
)  # fmt: skip
def test_other_makers(xmp: dict[str, str], make: str, expected: tuple[object, ...]) -> None:
    attitude = onboard_attitude(Exif(make=make), xmp)
    assert attitude.source == expected[0]
    for value, wanted in zip(
        (attitude.yaw_deg, attitude.pitch_deg, attitude.roll_deg), expected[1:], strict=True
    ):
        assert value == (None if wanted is None else pytest.approx(wanted, abs=1e-9))


def test_rtk_tells_its_own_accuracy() -> None:
    exif = Exif(lon_deg=120.0, lat_deg=24.0, altitude_m=50.0)
    fixed = dji(
        RtkFlag="50", RtkStdLon="0.041", RtkStdLat="0.035", RtkStdHgt="0.072", AbsoluteAltitude="+51.5"
    )
    position = onboard_position(exif, fixed)
    assert position is not None
    assert (position.sd_east_m, position.sd_north_m, position.sd_vertical_m) == (0.041, 0.035, 0.072)
    assert position.source == "rtk-fixed"
    assert position.height_ellipsoidal_m == 51.5
    assert not onboard_heights(exif, fixed).datum_unknown
    bare = onboard_position(exif, dji(RtkFlag="50"))
    assert bare is not None
    assert (bare.sd_east_m, bare.sd_north_m, bare.sd_vertical_m) == (0.03, 0.03, 0.05)
    plain = onboard_position(exif, dji(RtkFlag="0", RtkStdLon="0.01", RtkStdLat="0.01", RtkStdHgt="0.01"))
    assert plain is not None
    assert (plain.sd_east_m, plain.sd_vertical_m, plain.source) == (5.0, 15.0, "exif")
    assert onboard_heights(exif, {}).datum_unknown


def test_heights_of_three_kinds_are_kept_apart() -> None:
    heights = onboard_heights(Exif(altitude_m=100.0), {"Camera:AboveGroundAltitude": "62.5"})
    assert (heights.height_m, heights.above_ground_m, heights.above_take_off) == (100.0, 62.5, False)
    heights = onboard_heights(Exif(), dji(RelativeAltitude="+39.80"))
    assert (heights.height_m, heights.above_ground_m, heights.above_take_off) == (None, 39.8, True)
    assert onboard_heights(Exif(), dji(RelativeAltitude="+0.00")).above_ground_m is None


def test_a_jpeg_with_previews_behind_its_end_is_whole(tmp_path: Path) -> None:
    preview = write_jpeg(tmp_path / "preview.jpg", image(64, 48)).read_bytes()
    path = write_jpeg(tmp_path / "a.jpg", image(120, 80), exif_block(Make="DJI"), tail=b"\0" * 100 + preview)
    structure = read_structure(path)
    assert (structure.width_px, structure.height_px, structure.bands, structure.bits) == (120, 80, 3, 8)
    whole = path.read_bytes()
    primary_end = whole.find(b"\xff\xd9") + 2
    path.write_bytes(whole[: primary_end + 50])  # the preview is gone, the image is all there
    assert read_structure(path).width_px == 120
    path.write_bytes(whole[: primary_end - 40])
    with pytest.raises(FileError, match=r"a\.jpg: the JPEG is truncated: its image data don't end; copy it"):
        read_structure(path)


def test_a_thumbnail_in_the_header_is_no_end(tmp_path: Path) -> None:
    thumbnail = write_jpeg(tmp_path / "t.jpg", image(32, 24)).read_bytes()
    path = write_jpeg(tmp_path / "a.jpg", image(120, 80))
    data = path.read_bytes()
    path.write_bytes((data[:2] + segment(0xE3, thumbnail) + data[2:])[:-30])
    with pytest.raises(FileError, match="truncated"):
        read_structure(path)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "the file is empty"),
        (b"hello, I am a text\n" * 9, "is no JPEG file"),
        (b"\xff\xd8\xff\xe1\x00", "truncated in its header"),
        (b"\xff\xd8\x00\x00\x00\x00\x00", "header is damaged"),
    ],
)
def test_what_is_no_jpeg_is_named(tmp_path: Path, content: bytes, problem: str) -> None:
    path = tmp_path / "frame.jpg"
    path.write_bytes(content)
    with pytest.raises(FileError, match=problem):
        read_header(path)


def test_a_frame_header_has_it_all(tmp_path: Path) -> None:
    header = read_header(drone_frame(tmp_path / "DJI_0001.JPG", RtkFlag=50))
    assert (header.width_px, header.height_px, header.bands, header.dtype) == (120, 80, 3, "uint8")
    assert header.exif.lon_deg == pytest.approx(9.1234567, abs=1e-9)
    assert header.xmp is not None
    assert number(header.xmp, "drone-dji:RelativeAltitude") == 80.2


@pytest.mark.parametrize(
    ("exif_at", "xmp_at", "wanted", "by"),
    [
        ((87.0 + 23.0 / 60.0 + 58.0 / 3600.0, 42.0 + 5.0 / 60.0 + 25.0 / 3600.0), (87.39957843, 42.09046032),
         (87.39957843, 42.09046032), FINER),
        ((87.0 + 23.0 / 60.0, 42.0 + 5.0 / 60.0), (87.39957843, 42.09046032), (87.39957843, 42.09046032), FINER),
        ((87.39957843, 42.09046032), (-87.39957843, -42.09046032), (-87.39957843, -42.09046032), SIGNED),
        ((87.39957843, 42.09046032), (87.39957843, -42.09046032), (87.39957843, -42.09046032), SIGNED),
        ((87.0 + 23.0 / 60.0, 42.0 + 5.0 / 60.0), (-87.39957843, 42.09046032), (-87.39957843, 42.09046032),
         SIGNED),
        ((87.39957843, 42.09046032), (87.39957844, 42.09046031), (87.39957843, 42.09046032), ""),
        ((87.39957843, 42.09046032), (87.39157843, 42.09046032), (87.39957843, 42.09046032), APART),
    ],
    ids=["seconds", "minutes", "both signs", "one sign", "minutes and sign", "the same", "elsewhere"],
)  # fmt: skip
def test_the_finer_of_exif_and_xmp_counts_with_the_signs_that_are_stated(
    exif_at: tuple[float, float], xmp_at: tuple[float, float], wanted: tuple[float, float], by: str
) -> None:
    exif = Exif(lon_deg=exif_at[0], lat_deg=exif_at[1])
    xmp = {"drone-dji:GpsLongitude": str(xmp_at[0]), "drone-dji:GpsLatitude": str(xmp_at[1])}
    place = tagged_place(exif, xmp)
    assert place is not None and place.by == by
    assert (place.lon_deg, place.lat_deg) == pytest.approx(wanted, abs=1e-12)
    position = onboard_position(exif, xmp)
    assert position is not None and (position.lon_deg, position.lat_deg) == (place.lon_deg, place.lat_deg)


def test_signs_that_exif_lacks_are_xmps() -> None:
    exif = Exif(lon_deg=87.4, lat_deg=42.1, hemisphere_assumed=True)
    alone = tagged_place(exif, {})
    assert alone is not None and alone.hemisphere_assumed and alone.lon_deg == 87.4
    filled = tagged_place(exif, {"drone-dji:GpsLongitude": "-87.4", "drone-dji:GpsLatitude": "42.1"})
    assert filled is not None and not filled.hemisphere_assumed and filled.lon_deg == -87.4


def test_the_drone_is_known_by_its_serial_number(tmp_path: Path) -> None:
    pixels = np.zeros((8, 8, 3), dtype=np.uint8)
    exif = exif_block(BodySerialNumber="CAM-7", **gps(9.1, 48.7, 412.5))
    write_jpeg(tmp_path / "a.jpg", pixels, exif)
    write_jpeg(tmp_path / "b.jpg", pixels, exif, dji_xmp(DroneSerialNumber="1581F4", CameraSerialNumber="C9"))
    write_jpeg(tmp_path / "c.jpg", pixels, b"", dji_xmp(CameraSerialNumber="C9"))
    headers = [read_header(tmp_path / f"{name}.jpg") for name in "abc"]
    assert [platform_of(h) for h in headers] == ["CAM-7", "1581F4", "C9"]


def test_the_error_that_exif_reports_is_the_positions_deviation() -> None:
    block = exif_block(**gps(9.1, 48.7, 412.5), GPSHPositioningError=Fraction("1.75"))
    position = onboard_position(exif_from_block(block), {})
    assert position is not None and (position.sd_east_m, position.sd_north_m) == (1.75, 1.75)
    finer = onboard_position(exif_from_block(block), {"Camera:GPSXYAccuracy": "0.5"})
    assert finer is not None and finer.sd_east_m == 0.5


STEPS = [1.0, 0.1, 0.01, 0.001]


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("cut", [np.round, np.floor])
def test_a_position_that_a_program_rounded_gives_way_to_the_exact_one(
    step: float, cut: Callable[[float], float]
) -> None:
    """RTK's position in XMP, and its EXIF copy in whole steps of seconds of arc: 30 m to 3 cm."""
    exact = (87.39957843, -42.09046037)
    lon, lat = (float(cut(3600.0 * abs(a) / step)) * step / 3600.0 for a in exact)
    xmp = {"drone-dji:GpsLongitude": str(exact[0]), "drone-dji:GpsLatitude": str(exact[1])}
    place = tagged_place(Exif(lon_deg=lon, lat_deg=-lat), xmp)
    assert place is not None and (place.lon_deg, place.lat_deg) == exact
    assert place.by == (FINER if step == 1.0 else "")


def test_a_rounded_position_farther_off_than_its_step_counts() -> None:
    """Both were taken at other moments: 0.5 seconds apart, in whole tenths."""
    own = (87.0 + 0.3 / 3600.0, 42.0 + 0.7 / 3600.0)
    xmp = {"drone-dji:GpsLongitude": "87.0002222", "drone-dji:GpsLatitude": "42.0003333"}
    place = tagged_place(Exif(lon_deg=own[0], lat_deg=own[1]), xmp)
    assert place is not None and (place.lon_deg, place.lat_deg) == own


@pytest.mark.parametrize(
    ("flag", "source", "sd_m"),
    [("16", "exif", 5.0), ("32", "rtk-float", 0.4), ("34", "rtk-float", 0.4), ("49", "rtk-float", 0.4),
     ("50", "rtk-fixed", 0.4), ("51", "exif", 5.0)],
)  # fmt: skip
def test_every_float_solution_has_the_deviation_that_it_states(flag: str, source: str, sd_m: float) -> None:
    tags = dji(RtkFlag=flag, RtkStdLon="0.4", RtkStdLat="0.4", RtkStdHgt="0.6")
    position = onboard_position(Exif(lon_deg=120.0, lat_deg=24.0), tags)
    assert position is not None and (position.source, position.sd_east_m) == (source, sd_m)
    assert rtk_source(float(flag)) == source


def test_autels_newer_firmware_writes_djis_names() -> None:
    """Under a prefix of its own, whether it declares it or not; other makers' namespaces stay apart."""
    names = {"GimbalYawDegree": "12.5", "GimbalPitchDegree": "-90.0", "AbsoluteAltitude": "+412.5"}
    declared = parse_xmp(xmp_attributes("http://www.autelrobotics.com/drone/1.0/", "drone", **names))
    attributes = " ".join(f'drone:{name}="{value}"' for name, value in names.items())
    undeclared = parse_xmp(
        f"<x:xmpmeta><rdf:RDF><rdf:Description {attributes}/></rdf:RDF></x:xmpmeta>".encode()
    )
    for found in (declared, undeclared):
        assert found is not None
        attitude = onboard_attitude(Exif(), found)
        assert (attitude.source, attitude.yaw_deg) == ("dji-gimbal", pytest.approx(12.5))
        assert onboard_heights(Exif(), found).height_m == 412.5
    other = parse_xmp(xmp_attributes("https://www.skydio.com/drone-skydio/1.0/", "drone-skydio", Yaw="1"))
    assert other is not None and other["drone-skydio:Yaw"] == "1"
