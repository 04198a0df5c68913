"""Tags and tables that are right but unusual: half filled, edited, of several files in one."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from survey_files import dji_xmp, exif_block, gps, image, segment, write_jpeg, xmp_attributes

from geomosaic.errors import InputError
from geomosaic.survey.column_names import column_of
from geomosaic.survey.control import read_control
from geomosaic.survey.control_table import ALIASES as CONTROL_COLUMNS
from geomosaic.survey.exif import exif_from_block
from geomosaic.survey.exif_tags import tags_from_block
from geomosaic.survey.folder import masks
from geomosaic.survey.header import read_header
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.names import FrameNames
from geomosaic.survey.pixels import _read_mask
from geomosaic.survey.pos import ALIASES, read_pos
from geomosaic.survey.read import read_survey
from geomosaic.survey.xmp import parse_xmp

CREATOR = xmp_attributes("http://ns.adobe.com/xap/1.0/", "xmp", Rating="3", CreatorTool="viewer")


def rows_of(folder: Path, text: str, **options: str):  # type: ignore[no-untyped-def]
    path = folder / "pos.csv"
    path.write_text(text)
    return read_pos(path, **options).rows


def test_the_height_column_that_is_filled_counts(tmp_path: Path) -> None:
    rows = rows_of(tmp_path, "frame,lon,lat,ellipsoidal height,elevation\na.jpg,9,48,,200\nb.jpg,9,48,,201\n")
    assert rows[1].height_ellipsoidal_m - rows[0].height_ellipsoidal_m == pytest.approx(1.0)


def test_a_gimbals_pitch_goes_with_the_aircrafts_heading(tmp_path: Path) -> None:
    (row,) = rows_of(tmp_path, "frame,lon,lat,yaw,gimbal_pitch,roll\na.jpg,9,48,45,-90,3\n")
    assert row.yaw_deg == pytest.approx(45.0)


def test_empty_longitudes_leave_eastings(tmp_path: Path) -> None:
    text = "frame,easting,northing,longitude,latitude\na.jpg,576677,5188320,,\n"
    (row,) = rows_of(tmp_path, text, crs="EPSG:26915")
    assert (row.lon_deg, row.lat_deg) == (pytest.approx(-91.9943, abs=1e-3), pytest.approx(46.8440, abs=1e-3))


@pytest.mark.parametrize("name", ["Longitude (W)", "Latitude [S]"])
def test_columns_that_count_to_the_west_or_south_are_refused(name: str) -> None:
    with pytest.raises(InputError, match="minus sign"):
        column_of(name, ALIASES)
    assert column_of("Longitude (E)", ALIASES)[0] == "lon"


@pytest.mark.parametrize("name", ["Point ID", "GCP Label", "Station"])
def test_usual_names_of_control_points(name: str) -> None:
    assert column_of(name, CONTROL_COLUMNS)[0] == "name"


@pytest.mark.parametrize("together", [True, False])
@pytest.mark.parametrize("drone_first", [True, False])
def test_a_packet_that_a_viewer_added_hides_no_drone(
    tmp_path: Path, together: bool, drone_first: bool
) -> None:
    drone = dji_xmp(GimbalYawDegree="+37.00", RtkFlag="50")
    packets = [drone, CREATOR] if drone_first else [CREATOR, drone]
    found = parse_xmp(b"\n".join(packets))
    assert found is not None and found["drone-dji:GimbalYawDegree"] == "+37.00"
    path = write_jpeg(tmp_path / "a.jpg", image())
    data, name = path.read_bytes(), b"http://ns.adobe.com/xap/1.0/\0"
    parts = [segment(0xE1, name + p) for p in ([b"".join(packets)] if together else packets)]
    path.write_bytes(data[:2] + b"".join(parts) + data[2:])
    xmp = read_header(path).xmp
    assert xmp is not None and xmp["drone-dji:GimbalYawDegree"] == "+37.00"


def test_seconds_that_nobody_knows_keep_the_degrees() -> None:
    block = bytearray(exif_block(**gps(9.5, 48.7)))
    whole = tags_from_block(bytes(block))
    degrees = whole["GPSLatitude"]
    assert isinstance(degrees, tuple)
    at = block.find(np.array([48, 1, 42, 1], "<u4").tobytes()) + 16
    block[at : at + 8] = bytes(8)
    found = exif_from_block(bytes(block))
    assert found.lat_deg == pytest.approx(48.7) and found.lon_deg == pytest.approx(9.5)


def test_a_jpeg_masks_what_it_shows_dark(tmp_path: Path) -> None:
    path = write_jpeg(tmp_path / "DJI_0001.JPG", image(240, 160))
    dark = np.full((160, 240), 255, np.uint8)
    dark[:, :100] = 0
    cv2.imwrite(str(tmp_path / "DJI_0001_mask.JPG"), dark, [cv2.IMWRITE_JPEG_QUALITY, 60])
    found, spoiled = masks([read_header(path)])
    assert not spoiled and found == {"DJI_0001.JPG": str(tmp_path / "DJI_0001_mask.JPG")}
    valid = _read_mask(Path(found["DJI_0001.JPG"]), (160, 240))
    assert (valid[:, :98] == 0).all() and (valid[:, 102:] == 255).all()


@pytest.mark.parametrize("order", [("JPG", "DNG"), ("DNG", "JPG")])
def test_a_table_may_list_raw_images_next_to_the_frames(tmp_path: Path, order: tuple[str, str]) -> None:
    for k in (1, 2):
        write_jpeg(tmp_path / f"DJI_000{k}.JPG", image(seed=k))
    lines = [
        f"DJI_000{k}.{kind},{9 + k * 1e-4},{48 if kind == 'JPG' else 47},500"
        for k in (1, 2)
        for kind in order
    ]
    table = tmp_path / "pos.csv"
    table.write_text("\n".join(["frame,lon,lat,height", *lines]) + "\n")
    survey = read_survey(SurveyInputs(tmp_path, pos=table))
    assert [f.position.lat_deg for f in survey.frames] == [48.0, 48.0]


@pytest.mark.parametrize(
    ("head", "lines"),
    [
        ("frame lon lat height_m", ["a.jpg\t15\t48\t300", "b.jpg 15 48 300", "my c.jpg\t15\t48\t300"]),
        ("frame\tlon\tlat\theight_m", ["a.jpg 15   48 300", "b.jpg\t15\t48\t300", "my c.jpg\t15\t48\t300"]),
        ("frame\tlon\tlat\theight_m", ["a.jpg\t15 48\t300", "b.jpg\t15\t48 300", "my c.jpg\t15\t48\t300"]),
        ("EPSG:4326", ["a.jpg\t15\t48\t300", "b.jpg 15 48 300", "my c.jpg\t15\t48\t300"]),
    ],
    ids=["blanks above", "tabs above", "both in a line", "no names of columns"],
)
def test_lines_of_tabs_and_lines_of_blanks_in_one_table(tmp_path: Path, head: str, lines: list[str]) -> None:
    rows = rows_of(tmp_path, "\n".join([head, *lines]) + "\n")
    assert [row.name for row in rows] == ["a.jpg", "b.jpg", "my c.jpg"]
    assert {(row.lon_deg, row.lat_deg, row.height_ellipsoidal_m) for row in rows} == {(15.0, 48.0, 300.0)}


def test_a_name_with_blanks_between_tabs_stays_whole(tmp_path: Path) -> None:
    """Its height is missing: there are as many words as columns."""
    (row,) = rows_of(tmp_path, "frame\tlon\tlat\theight_m\nmy a.jpg\t15\t48\n")
    assert (row.name, row.lon_deg, row.height_ellipsoidal_m) == ("my a.jpg", 15.0, None)


@pytest.mark.parametrize("tabs_first", [True, False])
def test_marks_of_control_in_lines_of_tabs_and_of_blanks(tmp_path: Path, tabs_first: bool) -> None:
    lines = ["15\t48\t300\t100\t200\ta.jpg\tP", "15 48 300 101 201 b.jpg P"][:: 1 if tabs_first else -1]
    (tmp_path / "gcp.txt").write_text("\n".join(["EPSG:4326", *lines]) + "\n")
    (point,) = read_control(tmp_path / "gcp.txt", FrameNames(["a.jpg", "b.jpg"])).points
    assert {*point.images} == {("a.jpg", 100.0, 200.0), ("b.jpg", 101.0, 201.0)}


@pytest.mark.parametrize("where", ["Xmp", "XmpOfExif"])
def test_xmp_among_the_tags_of_a_jpeg(tmp_path: Path, where: str) -> None:
    """FLIR's thermal cameras write DJI's packet as a tag of the Exif directory."""
    exif = exif_block(Make="DJI", Model="XT2", **{where: tuple(dji_xmp(GimbalPitchDegree="-90.0"))})
    header = read_header(write_jpeg(tmp_path / "a.jpg", image(), exif))
    assert header.xmp is not None
    assert header.xmp["drone-dji:GimbalPitchDegree"] == "-90.0"
