"""The front door as a whole: folders in, a survey or one clear line out."""

from __future__ import annotations

import os
import re
import struct
from html import escape
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
import rasterio.shutil
from pyproj import CRS
from rasterio.transform import Affine
from survey_files import drone_frame, exif_block, gps, image, survey_folder, write_jpeg

from geomosaic.camera.exterior import Pose
from geomosaic.camera.rotation import Rotation
from geomosaic.errors import FileError, InputError
from geomosaic.geodesy.heights import ellipsoidal_offset_m, height_datum_in_metres, vertical_crs
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.survey.control import read_control
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.model import Survey
from geomosaic.survey.names import FrameNames
from geomosaic.survey.pixels import read_pixels
from geomosaic.survey.read import read_survey

UTM = "EPSG:32632"


def codes(survey: Survey) -> list[str]:
    return [w.code for w in survey.warnings]


def geoid(path: Path, undulation_m: float) -> str:
    """A geoid grid of one undulation over Europe, and the PROJ string of a CRS that uses it."""
    head = struct.pack(">4d2i", 40.0, 0.0, 10.0, 10.0, 3, 3)
    path.write_bytes(head + np.full(9, undulation_m, ">f4").tobytes())
    return f"+proj=utm +zone=32 +datum=WGS84 +units=m +geoidgrids={path} +vunits=m +type=crs"


def with_crs(raster: Path, crs: str) -> Path:
    """A raster under another CRS than its own."""
    path = raster.with_suffix(".vrt")
    rasterio.shutil.copy(raster, path, driver="VRT")
    text = path.read_text()
    start, end = text.index("<SRS"), text.index("</SRS>")
    path.write_text(f"{text[:start]}<SRS>{escape(CRS(crs).to_wkt('WKT1_GDAL'))}{text[end:]}")
    return path


def dem(
    path: Path, crs: str | None = UTM, height: float = 330.25, cover_m: float = 500.0, **profile: object
) -> Path:
    """A level DEM around the middle of `survey_folder`'s frames."""
    east, north = MapProjection(UTM).map_from_geodetic(9.1238617, 48.7654321)
    n = int(2 * cover_m / 10)
    options = {
        "driver": "GTiff",
        "dtype": "float32",
        "count": 1,
        "width": n,
        "height": n,
        "crs": crs,
    } | profile
    transform = Affine(10.0, 0.0, float(east) - cover_m, 0.0, -10.0, float(north) + cover_m)
    with rasterio.open(path, "w", transform=transform, **options) as raster:
        raster.write(np.full((1, n, n), height, np.float32))
    return path


def test_a_folder_of_drone_frames(tmp_path: Path) -> None:
    folder = survey_folder(tmp_path / "f", 3)
    drone_frame(folder / "earliest.jpeg", 9.1240, second=0, GimbalYawDegree=None, GimbalPitchDegree=None)
    for stray in (".hidden.jpg", "DJI_0001_mask.tif", "notes.txt", "DJI_0002.MASK.PNG"):
        (folder / stray).write_bytes(b"x")
    (folder / "DJI_0002.MASK.PNG").unlink()
    (folder / "DJI_0001_mask.tif").unlink()
    cv2.imwrite(str(folder / "DJI_0001_mask.tif"), np.ones((80, 120), np.uint8))
    (folder / "inner").mkdir()
    drone_frame(folder / "inner" / "other.jpg")
    seen: list[tuple[int, int, str]] = []
    survey = read_survey(SurveyInputs(folder), progress=lambda *a: seen.append(a))
    assert [f.name for f in survey.frames] == [
        "DJI_0001.JPG",
        "earliest.jpeg",
        "DJI_0002.JPG",
        "DJI_0003.JPG",
    ]
    assert seen[-1] == (4, 4, "reading headers")
    first = survey.frames[0]
    assert first.path == str(folder / "DJI_0001.JPG") and first.valid_mask == str(
        folder / "DJI_0001_mask.tif"
    )
    assert (first.position.height_ellipsoidal_m, first.position.height_above_ground_m) == (412.5, 80.2)
    assert (first.attitude.yaw_deg, first.attitude.source) == (pytest.approx(37.0), "dji-gimbal")
    assert survey.frames[1].attitude.source == "dji-flight"
    assert first.time_s == 1715940660.0
    assert survey.map_crs == UTM
    assert survey.work_frame.lon_deg == pytest.approx((9.1237267 + 9.1239967) / 2, abs=3e-4)
    assert survey.work_frame.height_ellipsoidal_m == pytest.approx(332.3)
    assert survey.camera_of(3).focal_length_px == pytest.approx(80.0)
    assert codes(survey) == [
        "frames-in-folders", "height-datum-unknown", "height-above-take-off", "attitude-of-aircraft",
        "camera-assumed",
    ]  # fmt: skip
    assert next(w for w in survey.warnings if w.code == "attitude-of-aircraft").frame == "earliest.jpeg"
    assert read_survey(SurveyInputs(folder, crs="EPSG:25832")).map_crs == "EPSG:25832"


def test_pos_takes_the_place_of_gps_and_leaves_the_gimbal(tmp_path: Path) -> None:
    folder = survey_folder(tmp_path / "f", 2)
    table = tmp_path / "pos.csv"
    table.write_text(
        "photo,lat,lon,sd_horizontal\nimages\\dji_0002.jpg,48.76545,9.12375,0.02\nDJI_0001,48.76543,9.12346,0.02\n"
    )
    survey = read_survey(SurveyInputs(folder, pos=table))
    first, second = survey.frames
    assert (first.position.lon_deg, second.position.lon_deg) == (9.12346, 9.12375)
    assert (first.position.sd_east_m, first.position.sd_vertical_m) == (0.02, 15.0)
    assert first.position.height_ellipsoidal_m == 412.5
    assert first.position.source == "pos, height from exif"
    assert first.attitude.yaw_deg == pytest.approx(37.0)
    table.write_text(
        "photo,lat,lon,height_ellipsoidal,yaw,pitch,roll\n"
        + "".join(f"DJI_000{i},48.7,9.1,400,5,1,2\n" for i in (1, 2))
    )
    survey = read_survey(SurveyInputs(folder, pos=table))
    assert (survey.frames[0].position.source, survey.frames[0].position.sd_vertical_m) == ("pos", 3.0)
    assert (survey.frames[0].attitude.yaw_deg, survey.frames[0].attitude.sd_yaw_deg) == (5.0, 2.0)
    assert "positions-elsewhere" in codes(survey)
    assert "height-datum-unknown" not in codes(survey)
    table.write_text("photo,lat,lon\nDJI_0001,48.765,9.123\nDJI_0002,48.7,9.1\nDJI_0003,48.765,9.123\n")
    survey = read_survey(SurveyInputs(survey_folder(tmp_path / "g", 3), pos=table))
    assert "pos-far-from-exif" in codes(survey) and "positions-elsewhere" not in codes(survey)


@pytest.mark.parametrize(
    ("order", "said"),
    [
        ([5, 4, 3, 2, 1, 0], r"lie 59\.5 m from those in the frames' tags, and 0\.\d m in reverse order"),
        ([1, 2, 3, 4, 5, 6], r"lie 19\.8 m .*, and 0\.\d m as those of the next frames: check the names"),
        ([-1, 0, 1, 2, 3, 4], r"as those of the frames before"),
        ([0, 1, 2, 3, 4, 5], ""),
        ([0.2, 1.2, 2.2, 3.2, 4.2, 5.2], ""),
        ([3, 0, 5, 1, 4, 2], r"lines may belong to other frames"),
        ([6.5, 7.5, 8.5, 9.5, 10.5, 11.5], ""),
    ],
)
def test_positions_in_another_order_than_the_tags(tmp_path: Path, order: list[float], said: str) -> None:
    folder = survey_folder(tmp_path / "f", 6)
    table = tmp_path / "pos.csv"
    lines = (f"DJI_{i + 1:04d},48.765432,{9.1234567 + k * 2.7e-4}" for i, k in enumerate(order))
    table.write_text("\n".join(["photo,lat,lon", *lines]))
    texts = [
        w.text
        for w in read_survey(SurveyInputs(folder, pos=table)).warnings
        if w.code == "positions-in-other-order"
    ]
    assert [bool(re.search(said, text)) for text in texts] == ([True] if said else [])


def test_tags_that_are_all_alike_say_nothing_of_an_order(tmp_path: Path) -> None:
    folder = tmp_path / "f"
    folder.mkdir()
    for i in range(6):
        drone_frame(folder / f"DJI_{i}.JPG", second=i)
    table = tmp_path / "pos.csv"
    lines = (f"DJI_{i},48.765432,{9.1234567 + i * 2.7e-4}" for i in range(6))
    table.write_text("\n".join(["photo,lat,lon", *lines]))
    assert "positions-in-other-order" not in codes(read_survey(SurveyInputs(folder, pos=table)))


def test_names_are_matched_with_sense(tmp_path: Path) -> None:
    names = FrameNames(["DJI_1.JPG", "dji_2.tif", "A.jpg", "a.jpg", "x.1.tif"])
    assert (
        names.find("dji_1.jpg") == names.find("DJI_1") == names.find("C:\\flight 7\\DJI_1.DNG") == "DJI_1.JPG"
    )
    assert names.find("A.jpg") == "A.jpg"
    assert names.find("x.1") == "x.1.tif"
    assert names.find("DJI_12.JPG") is None
    with pytest.raises(InputError, match=r"'A\.JPG' may be any of A\.jpg, a\.jpg"):
        names.find("A.JPG")
    clock = FrameNames(["14,07,13.171.jpg", "14,07,27.171.jpg", "a_1.jpg", "a-1.jpg"])
    assert clock.find("14:07:27.171.jpg") == clock.find("14_07_27_171") == "14,07,27.171.jpg"
    assert clock.find("a-1.jpg") == "a-1.jpg"
    assert clock.find("140727.171.jpg") is None
    with pytest.raises(InputError, match=r"'a 1\.jpg' may be any of a_1\.jpg, a-1\.jpg"):
        clock.find("a 1.jpg")


POS = "frame,lon,lat\n" + "".join(f"DJI_{i:04d}.JPG,9.123{i},48.7654\n" for i in (1, 2, 3))
HEAD, LINES = POS.split("\n", 1)
STRANGER = r"line 2: 'DJI_0008\.JPG' is no frame in .*f; remove"
SWAPPED = r"longitude and latitude are swapped: the frames' own GPS says 9\.1"
BAD_POS = {
    "names that match no file": (HEAD + "\nDJI_0008.JPG,9,48\nDJI_0009.JPG,9,48\n", STRANGER),
    "a duplicate": (POS + "dji_0002,9,48\n", r"frame DJI_0002\.JPG stands in line 3 and again in line 5"),
    "swapped": ("frame,lat,lon\n" + LINES, SWAPPED),
    "west": (
        POS.replace(",9.", ",-9."),
        r"the longitudes have the wrong sign: .*; west and south are negative",
    ),
    "south": (POS.replace(",48.", ",-48."), r"the latitudes have the wrong sign: .* says 9\.1"),
    "latitude": (POS.replace("48.7654", "95", 1), r"line 2: latitude 95 is outside"),
}


@pytest.mark.parametrize("case", BAD_POS)
def test_pos_files_that_do_not_fit_the_frames(tmp_path: Path, case: str) -> None:
    folder = survey_folder(tmp_path / "f", 3)
    text, message = BAD_POS[case]
    table = tmp_path / "pos.csv"
    table.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_survey(SurveyInputs(folder, pos=table))
    assert str(caught.value).startswith(f"{table}: ")
    assert "\n" not in str(caught.value) and caught.value.exit_code == 2


def test_folders_and_frames_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="there is no such folder; give the folder"):
        read_survey(SurveyInputs(tmp_path / "none"))
    with pytest.raises(InputError, match=r"holds no JPEG, TIFF or PNG frames \(it is empty\)"):
        read_survey(SurveyInputs(tmp_path))
    (tmp_path / "a.arw").write_bytes(b"x")
    with pytest.raises(InputError, match=r"holds no JPEG, TIFF or PNG frames \(1 \.arw\)"):
        read_survey(SurveyInputs(tmp_path))
    text = tmp_path / "b.jpg"
    text.write_text("not an image")
    with pytest.raises(FileError, match=r"b\.jpg: is no JPEG file; take it out of the folder"):
        read_survey(SurveyInputs(tmp_path))
    with pytest.raises(FileError, match="is no folder"):
        read_survey(SurveyInputs(text))


def test_frames_that_lack_what_is_needed(tmp_path: Path) -> None:
    folder = survey_folder(tmp_path / "f", 2)
    bare = write_jpeg(folder / "bare.jpg", image(), exif_block(Make="X", Model="Y", **gps(9.1, 48.7)))
    kept = read_survey(SurveyInputs(folder, leave_out="none"))
    assert [w.code for w in kept.warnings].count("focal-length-assumed") == 1
    assert [(o.name, o.reason) for o in read_survey(SurveyInputs(folder)).left_out] == [
        ("bare.jpg", "the frame doesn't report its focal length")
    ]
    bare.unlink()
    cut = folder / "DJI_0002.JPG"
    cut.write_bytes(cut.read_bytes()[:-200])
    survey = read_survey(SurveyInputs(folder))
    assert [out.name for out in survey.left_out] == ["DJI_0002.JPG"]
    assert "libjpeg says" in survey.left_out[0].reason
    for whole in folder.glob("*.JPG"):
        if whole != cut:
            whole.unlink()
    with pytest.raises(FileError, match=r"DJI_0002\.JPG: the image data are damaged: libjpeg says"):
        read_survey(SurveyInputs(folder))


def test_a_map_crs_must_be_one(tmp_path: Path) -> None:
    folder = survey_folder(tmp_path / "f", 1)
    for with_heights in ("EPSG:25832+7837", "UTM 32N + EGM96 height", "EPSG:25832 + EGM96 height"):
        with pytest.raises(InputError, match="has heights too"):
            read_survey(SurveyInputs(folder, crs=with_heights))
    with pytest.raises(InputError, match="no map projection in metres"):
        read_survey(SurveyInputs(folder, crs="EPSG:4326"))


def test_a_survey_across_the_date_line(tmp_path: Path) -> None:
    for i, lon in enumerate((179.9999, -179.9999, -179.9997)):
        drone_frame(tmp_path / f"{i}.jpg", lon, -17.5, second=i)
    survey = read_survey(SurveyInputs(tmp_path))
    assert survey.work_frame.lon_deg == pytest.approx(-179.9999, abs=1e-9)
    assert survey.map_crs == "EPSG:32701"
    assert "position-far-away" not in codes(survey)


def test_a_position_far_from_all_others_is_reported(tmp_path: Path) -> None:
    folder = survey_folder(tmp_path / "f", 4)
    drone_frame(folder / "stray.jpg", 10.5, second=9)
    warning = next(w for w in read_survey(SurveyInputs(folder)).warnings if w.code == "position-far-away")
    assert warning.frame == "stray.jpg"


def test_a_dem_with_a_vertical_datum_is_lifted_to_the_ellipsoid(tmp_path: Path) -> None:
    folder = survey_folder(tmp_path / "f")
    path = with_crs(dem(tmp_path / "dem.tif"), geoid(tmp_path / "g.gtx", 47.75))
    survey = read_survey(SurveyInputs(folder, dem=path))
    assert survey.elevation is not None
    assert survey.elevation.offset_m == pytest.approx(47.75, abs=1e-4)
    assert survey.elevation.vertical.endswith("offset +47.75 m")
    assert survey.work_frame.height_ellipsoidal_m == pytest.approx(378.0, abs=1e-3)
    given = read_survey(SurveyInputs(folder, dem=path, dem_offset_m=-3.5))
    assert given.elevation is not None
    assert (given.elevation.offset_m, given.elevation.vertical) == (-3.5, "offset -3.5 m as given")


def test_a_dem_with_a_vertical_datum_in_feet(tmp_path: Path) -> None:
    """330.25 US survey feet are 100.66 m; what is added stays in metres."""
    folder, crs = survey_folder(tmp_path / "f"), geoid(tmp_path / "g.gtx", 47.75)
    path = with_crs(dem(tmp_path / "dem.tif"), crs.replace("+vunits=m", "+vunits=us-ft"))
    for offset_m in (None, 47.75):
        survey = read_survey(SurveyInputs(folder, dem=path, dem_offset_m=offset_m))
        assert survey.elevation is not None
        assert survey.elevation.offset_m == pytest.approx(47.75, abs=1e-4)
        assert survey.work_frame.height_ellipsoidal_m == pytest.approx(148.4104, abs=1e-3)


def test_a_dem_without_one_is_taken_as_the_frames_heights_and_reported(tmp_path: Path) -> None:
    folder = survey_folder(tmp_path / "f")
    survey = read_survey(SurveyInputs(folder, dem=dem(folder / "dem.tif")))
    assert len(survey.frames) == 4  # the DEM in the folder is no frame
    assert survey.elevation is not None and survey.elevation.offset_m == 0.0
    assert "dem-datum-assumed" in codes(survey)
    assert survey.work_frame.height_ellipsoidal_m == pytest.approx(330.25)


def test_a_geoid_that_is_not_installed_is_never_guessed(tmp_path: Path) -> None:
    path = with_crs(dem(tmp_path / "dem.tif"), geoid(tmp_path / "g.gtx", 1.0))
    (tmp_path / "g.gtx").unlink()
    message = r"dem\.vrt: the geoid model for .* is not installed; .*--dem-offset METRES, or copy .*g\.gtx"
    with pytest.raises(InputError, match=message):
        read_survey(SurveyInputs(survey_folder(tmp_path / "f"), dem=path))
    assert ellipsoidal_offset_m(CRS("EPSG:4979"), 9.0, 48.0) == 0.0
    assert vertical_crs(CRS(UTM)) is None
    with pytest.raises(InputError, match="counts heights in US survey foot; give the code of one in metres"):
        height_datum_in_metres("EPSG:6360")
    with pytest.raises(InputError, match="are counted down"):
        ellipsoidal_offset_m(CRS("EPSG:5715"), -92.0, 46.0)


def test_dems_that_do_not_serve(tmp_path: Path) -> None:
    folder = survey_folder(tmp_path / "f", 4)  # 60 m from the first to the last
    small = dem(tmp_path / "small.tif", cover_m=20.0)
    with pytest.raises(
        InputError, match=r"small\.tif: the DEM does not cover 2 of 4 frames: \S+ lies 10 m out"
    ):
        read_survey(SurveyInputs(folder, dem=small))
    elsewhere = dem(tmp_path / "else.tif", "EPSG:32633")
    with pytest.raises(
        InputError, match=r"does not cover 4 of 4 frames: \S+ lies 4\d\d\.\d km outside; give a DEM"
    ):
        read_survey(SurveyInputs(folder, dem=elsewhere))
    with pytest.raises(InputError, match=r"bare\.tif: the DEM has no coordinate reference system; assign"):
        read_survey(SurveyInputs(folder, dem=dem(tmp_path / "bare.tif", None)))
    hole = dem(tmp_path / "hole.tif", height=-9999.0, nodata=-9999.0)
    with pytest.raises(InputError, match="has no heights under the frames"):
        read_survey(SurveyInputs(folder, dem=hole))
    (tmp_path / "text.tif").write_text("no raster")
    with pytest.raises(FileError, match=r"text\.tif: is no raster file that can be read; give a DEM"):
        read_survey(SurveyInputs(folder, dem=tmp_path / "text.tif"))
    with pytest.raises(FileError, match=r"none\.tif: there is no such DEM; check --dem"):
        read_survey(SurveyInputs(folder, dem=tmp_path / "none.tif"))


def test_control_points_of_two_kinds(tmp_path: Path) -> None:
    frames = FrameNames(["DJI_0001.JPG", "DJI_0002.JPG"])
    east, north = MapProjection(UTM).map_from_geodetic(9.1238617, 48.7654321)
    odm = tmp_path / "gcp_list.txt"
    odm.write_text(
        f"EPSG:32632\n{east:.4f} {north:.4f} 331.5 60.5 40.25 DJI_0001.JPG gcp1\n"
        f"{east:.4f} {north:.4f} 331.5 20.5 41 dji_0002 gcp1\n"
        f"{east + 10:.4f} {north:.4f} 332 1 2 other.JPG CHK-7\n"
    )
    file = read_control(odm, frames)
    one, two = file.points
    assert (one.name, one.check, two.name, two.check) == ("gcp1", False, "CHK-7", True)
    assert (one.lon_deg, one.lat_deg) == pytest.approx((9.1238617, 48.7654321), abs=1e-9)
    assert one.images == (("DJI_0001.JPG", 60.5, 40.25), ("DJI_0002.JPG", 20.5, 41.0))
    assert (two.images, one.sd_horizontal_m, one.sd_vertical_m) == ((), 0.03, 0.05)
    assert one.sd_assumed and two.sd_assumed
    assert [w.code for w in file.notes] == ["height-datum-assumed"]
    assert file.absent == (("CHK-7", "other.JPG"),)
    table = tmp_path / "points.csv"
    table.write_text(
        "point,lat,lon,height_ellipsoidal_m,type,sd_vertical\n"
        "P1,48.7,9.1,300,check,0.01\nP2,48.8,9.2,301,control,\n"
    )
    points = read_control(table, frames).points
    assert [(p.name, p.check, p.sd_vertical_m) for p in points] == [("P1", True, 0.01), ("P2", False, 0.05)]
    assert [p.sd_assumed for p in points] == [False, True]
    assert read_control(table, frames).notes == ()
    for text, message in (
        ("point,lat,lon,h\nP1,48,9,1\nP1,48,9,2\n", "line 3: point 'P1' stands"),
        ("point,lat,lon,h,type\nP1,48,9,1,maybe\n", "kind 'maybe' is unknown"),
        ("lat,lon,h\n48,9,1\n", "no column for the point's name"),
        ("point,lat,lon,h,image,col\nP1,48,9,1,DJI_0001,5\n", "line 2: no row"),
    ):
        table.write_text(text)
        with pytest.raises(InputError, match=message):
            read_control(table, frames)
    folder = survey_folder(tmp_path / "f", 2)
    assert read_survey(SurveyInputs(folder, gcp=odm)).control == (one, two)


def test_a_control_point_whose_lines_differ_a_little_lies_in_their_mean(tmp_path: Path) -> None:
    frames = FrameNames(["a.jpg", "b.jpg", "c.jpg"])
    east, north = MapProjection(UTM).map_from_geodetic(9.1238617, 48.7654321)
    steady = f"{east + 50:.4f} {north:.4f} 70 1 1 {{}} two\n"
    lines = [(east, 70.0, "a"), (east + 0.3, 70.5, "b"), (east, 70.0, "c")]
    odm = tmp_path / "gcp_list.txt"
    odm.write_text(
        "EPSG:32632\n"
        + "".join(f"{x:.4f} {north:.4f} {h} 60.5 40.25 {f}.jpg one\n" for x, h, f in lines)
        + steady.format("a.jpg")
        + steady.format("b.jpg")
    )
    file = read_control(odm, frames)
    (one, two), warnings = file.points, file.notes
    back = MapProjection(UTM).map_from_geodetic(one.lon_deg, one.lat_deg)
    assert back == pytest.approx((east + 0.1, north), abs=2e-3)
    assert one.height_ellipsoidal_m == pytest.approx(70.0 + 0.5 / 3.0)
    assert one.sd_horizontal_m == pytest.approx((0.03**2 + 0.15**2) ** 0.5, rel=0.01)
    assert one.sd_vertical_m == pytest.approx((0.05**2 + 0.25**2) ** 0.5)
    assert len(one.images) == 3
    assert (two.sd_horizontal_m, two.sd_vertical_m, two.height_ellipsoidal_m) == (0.03, 0.05, 70.0)
    assert [w.code for w in warnings] == ["height-datum-assumed", "control-spread"]
    assert warnings[1].text == (
        "gcp_list.txt: 1 of 2 points (one) have lines that differ, by up to 0.3 m in plan and 0.5 m in height; "
        "their mean is used with a larger standard deviation; correct the lines that are wrong"
    )
    odm.write_text(odm.read_text().replace(" 70.5 ", " 71.5 "))
    with pytest.raises(
        InputError, match=r"line 3: point 'one' stands 1\.5 m from its first line; give each point one"
    ):
        read_control(odm, frames)
    odm.write_text(odm.read_text().replace(" 71.5 ", " 70 ").replace(f"{east + 0.3:.4f}", f"{east + 30:.4f}"))
    with pytest.raises(InputError, match=r"line 3: point 'one' stands 30 m from its first line"):
        read_control(odm, frames)


SHARED = Path(os.environ.get("GEOMOSAIC_SHARED", Path(__file__).parents[3] / "shared")) / "data"
real = pytest.mark.skipif(not SHARED.is_dir(), reason=f"no shared data in {SHARED} (set GEOMOSAIC_SHARED)")


@real
def test_brighton_beach() -> None:
    survey = read_survey(SurveyInputs(SHARED / "brighton_beach" / "images"))
    assert len(survey.frames) == 18 and survey.map_crs == "EPSG:32615"
    first = survey.frames[0]
    assert first.name == "DJI_0018.JPG"
    assert (first.position.lon_deg, first.position.lat_deg) == pytest.approx(
        (-91.99455989, 46.84260708), abs=1e-8
    )
    assert (first.position.height_ellipsoidal_m, first.position.height_above_ground_m) == (198.31, 39.8)
    assert (first.attitude.yaw_deg, first.attitude.pitch_deg) == pytest.approx((45.0, 0.1))
    gsd_m = 39.8 / survey.camera_of(0).focal_length_px
    assert gsd_m == pytest.approx(0.0166, rel=0.03)
    edited = next(w for w in survey.warnings if w.code == "image-edited")
    assert "6 of 18 frames: DJI_0024.JPG" in edited.text
    pixels, valid = read_pixels(first, 8)
    assert pixels.shape == (282, 500, 3) and valid is None
    assert pixels.reshape(-1, 3).mean(axis=0) == pytest.approx([111.0, 128.1, 88.3], abs=0.5)


@real
def test_two_pose_files_of_the_same_frames_agree() -> None:
    data = SHARED / "odm_oblique"
    camera = data / "opensfm" / "reconstruction.json"
    measured = read_survey(SurveyInputs(data / "images", pos=data / "odm_lla_rpy.csv", camera=camera))
    adjusted = read_survey(
        SurveyInputs(data / "images", pos=data / "odm_xyz_opk.csv", pos_crs="EPSG:32651", camera=camera)
    )
    own = read_survey(SurveyInputs(data / "images"))
    for a, b, c in zip(measured.frames, adjusted.frames, own.frames, strict=True):
        assert a.name == b.name == c.name
        turned = np.degrees(np.linalg.norm(_between(a.attitude, b.attitude)))
        assert 0.1 < turned < 3.0
        assert _between(a.attitude, c.attitude) == pytest.approx([0, 0, 0], abs=1e-6)
        metres = measured.work_frame.enu_from_geodetic(b.position.lon_deg, b.position.lat_deg, 0.0)
        metres -= measured.work_frame.enu_from_geodetic(a.position.lon_deg, a.position.lat_deg, 0.0)
        assert np.linalg.norm(metres) < 0.1
    calibrated, table = own.camera_of(0), measured.camera_of(0)
    assert calibrated.focal_length_px == pytest.approx(table.focal_length_px, rel=0.003)
    assert calibrated.principal_row_px - 456 == pytest.approx(table.principal_row_px - 456, abs=1.0)
    assert own.frames[0].position.source == "rtk-fixed"


def _between(a: object, b: object) -> np.ndarray:
    """The small rotation vector between two attitudes, in radians."""
    one, two = (
        Rotation.from_yaw_pitch_roll(*np.radians([x.yaw_deg, x.pitch_deg, x.roll_deg])).matrix for x in (a, b)
    )
    m = one.T @ two
    return np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]) / 2.0


@real
def test_a_frame_of_ngi_lands_on_its_neighbour() -> None:
    """The same patch of ground, found in two frames of two flight lines turned by 180 degrees."""
    data = SHARED / "ngi"
    survey = read_survey(
        SurveyInputs(
            data,
            pos=data / "ngi_xyz_opk.csv",
            camera=data / "ngi_int_param.yaml",
            dem=data / "dem.tif",
            dem_offset_m=0.0,
        )
    )
    assert len(survey.frames) == 4 and survey.elevation is not None
    frames = [survey.frames[0], survey.frames[3]]
    east, north = np.meshgrid(np.arange(-250, 250) * 6.0, np.arange(150, -150, -1) * 6.0)
    middle = np.mean([_enu(survey, f) for f in frames], axis=0)
    east, north = east + middle[0], north + middle[1]
    lonlat = survey.work_frame.geodetic_from_enu(np.stack([east, north, np.zeros_like(east)], axis=-1))
    with rasterio.open(survey.elevation.path) as raster:
        heights, crs, t = raster.read(1), raster.crs.to_wkt(), raster.transform
    xy = MapProjection(crs).map_from_geodetic(lonlat[..., 0], lonlat[..., 1])
    up = heights[((t.f - xy[..., 1]) / -t.e).astype(int), ((xy[..., 0] - t.c) / t.a).astype(int)]
    ground = survey.work_frame.enu_from_geodetic(lonlat[..., 0], lonlat[..., 1], up)
    views = []
    for frame in frames:
        angles = np.radians([frame.attitude.yaw_deg, frame.attitude.pitch_deg, frame.attitude.roll_deg])
        pose = Pose(_enu(survey, frame), Rotation.from_yaw_pitch_roll(*angles))
        at = pose.image_from_ground(survey.camera_of(0), ground).astype(np.float32) - 0.5
        grey = read_pixels(frame)[0].mean(axis=2).astype(np.float32)
        views.append(cv2.remap(grey, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderValue=np.nan))
    assert np.isfinite(views).all()
    window = cv2.createHanningWindow((500, 300), cv2.CV_32F)
    shift_x, shift_y = cv2.phaseCorrelate(*(v - v.mean() for v in views), window)[0]
    assert np.hypot(shift_x, shift_y) * 6.0 < 9.0  # pixels of 6 m on the ground


def _enu(survey: Survey, frame: object) -> np.ndarray:
    p = frame.position
    return survey.work_frame.enu_from_geodetic(p.lon_deg, p.lat_deg, p.height_ellipsoidal_m)
