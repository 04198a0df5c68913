"""POS files in their many shapes."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from survey_files import image, write_jpeg

from geomosaic.camera.rotation import Rotation
from geomosaic.errors import InputError, UnknownNameError
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.survey.column_names import ANGLES, column_of
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.names import FrameNames
from geomosaic.survey.pos import ALIASES, read_pos
from geomosaic.survey.pos_row import PosFile
from geomosaic.survey.read import check_survey_files


def pos(tmp_path: Path, text: str | bytes, name: str = "pos.csv", **options: str) -> PosFile:
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_pos(path, **options)


def codes(file: PosFile) -> set[str]:
    return {w.code for w in file.warnings}


def test_named_columns_in_any_order_with_units(tmp_path: Path) -> None:
    file = pos(
        tmp_path,
        "Roll (deg);Latitude [decimal degrees];Image Name;Longitude;height_ellipsoidal_m;pitch_rad;"
        "Heading [gon];sd_horizontal_m;AGL (ft)\n"
        "-1,5;48,765;a.jpg;9,125;512,25;0,1;100;0,04;328\n",
    )
    row = file.rows[0]
    assert (row.name, row.lon_deg, row.lat_deg, row.height_ellipsoidal_m) == ("a.jpg", 9.125, 48.765, 512.25)
    assert (row.yaw_deg, row.roll_deg, row.sd_north_m) == (90.0, -1.5, 0.04)
    assert row.pitch_deg == pytest.approx(math.degrees(0.1))
    assert row.height_above_ground_m == pytest.approx(99.9744)
    assert codes(file) == {"pos-attitude-convention"}


@pytest.mark.parametrize(
    "names", ["lat,lon,gps_height", "gps_lat,gps_lon,gps_alt", "GPSLatitude,GPSLongitude,GPSAltitude"]
)
def test_columns_of_a_gps_log(tmp_path: Path, names: str) -> None:
    """Their height has no stated datum."""
    file = pos(tmp_path, f"image_name,{names}\nIMG_1403,54.5121362,-2.7520125,344.17\n")
    row = file.rows[0]
    assert (row.lat_deg, row.lon_deg, row.height_ellipsoidal_m) == (54.5121362, -2.7520125, 344.17)
    assert codes(file) == {"height-datum-assumed"} and not file.datum_stated


@pytest.mark.parametrize("mark", [b"\xef\xbb\xbf", b""])
@pytest.mark.parametrize("separator", [",", ";", "\t", "  "])
def test_marks_separators_comments_and_blank_lines(tmp_path: Path, mark: bytes, separator: str) -> None:
    lines = ["frame,lat,lon,z", "# the first", "a.jpg,48.5,9.25,510", "", '"b.jpg",48.25,9.5,511']
    file = pos(tmp_path, mark + "\r\n".join(lines).replace(",", separator).encode())
    assert [(r.name, r.lat_deg, r.lon_deg, r.height_ellipsoidal_m) for r in file.rows] == [
        ("a.jpg", 48.5, 9.25, 510.0),
        ("b.jpg", 48.25, 9.5, 511.0),
    ]
    assert [r.line for r in file.rows] == [3, 5]
    assert codes(file) == {"height-datum-assumed"}


def test_utf_16_from_a_spreadsheet(tmp_path: Path) -> None:
    file = pos(tmp_path, "frame\tlat\tlon\na.jpg\t48.5\t9.25\n".encode("utf-16"))
    assert (file.rows[0].name, file.rows[0].height_ellipsoidal_m, file.rows[0].yaw_deg) == (
        "a.jpg",
        None,
        None,
    )


def test_geo_txt_of_opendronemap(tmp_path: Path) -> None:
    file = pos(
        tmp_path,
        "WGS84 UTM 15N\nDJI_0028.JPG 576700.25 5188000.5 198.609 35.5 -88 0.5 0.02 0.04 label\n"
        "DJI_0029.JPG 576710 5188010\n",
        name="geo.txt",
    )
    a, b = file.rows
    assert MapProjection("EPSG:32615").map_from_geodetic(a.lon_deg, a.lat_deg) == pytest.approx(
        [576700.25, 5188000.5]
    )
    assert (a.height_ellipsoidal_m, a.sd_east_m, a.sd_vertical_m) == (198.609, 0.02, 0.04)
    assert a.pitch_deg == pytest.approx(2.0, abs=0.01)  # gimbal: nadir is -90
    assert a.yaw_deg == pytest.approx(36.0, abs=0.01)  # a gimbal's roll at the nadir turns the heading
    assert (b.name, b.height_ellipsoidal_m, b.yaw_deg) == ("DJI_0029.JPG", None, None)


def test_geo_txt_with_zero_angles_has_none(tmp_path: Path) -> None:
    file = pos(tmp_path, "EPSG:4326\na.jpg -91.994 46.8425 198.6 0 0 0 0.1 0.2\n", name="geo.txt")
    assert (file.rows[0].lon_deg, file.rows[0].lat_deg) == pytest.approx((-91.994, 46.8425), abs=1e-12)
    assert (file.rows[0].yaw_deg, file.rows[0].pitch_deg) == (None, None)
    assert "pos-attitude-empty" in codes(file)


@pytest.mark.parametrize(
    "angles", ["yaw,pitch,roll", "gimbal_yaw,gimbal_pitch,gimbal_roll", "omega,phi,kappa"]
)
def test_angles_of_zeros_in_all_rows_are_unknown(tmp_path: Path, angles: str) -> None:
    header = f"frame,lon,lat,{angles}\n"
    empty = pos(tmp_path, header + "a,9,48,0,0,0\nb,9.1,48,0.0,0,0\n")
    assert {(row.yaw_deg, row.pitch_deg) for row in empty.rows} == {(None, None)}
    assert "pos-attitude-empty" in codes(empty)
    filled = pos(tmp_path, header + "a,9,48,0,0,0\nb,9.1,48,0,0,2\n")
    assert None not in {row.pitch_deg for row in filled.rows}
    assert "pos-attitude-empty" not in codes(filled)


def test_a_simulated_survey_about_0_0_is_in_degrees(tmp_path: Path) -> None:
    """As radians its frames would lie in the same sea."""
    row = pos(tmp_path, "EPSG:4326\na.jpg 0.0002243587 -0.0002258707 -0.2299\n").rows[0]
    assert (row.lon_deg, row.lat_deg) == (0.0002243587, -0.0002258707)


def test_pix4d_with_and_without_header(tmp_path: Path) -> None:
    header = (
        "imagename,latitude [decimal degrees],longitude [decimal degrees],altitude [meter],"
        "accuracy horizontal [meter],accuracy vertical [meter]\n"
    )
    line = "IMG_3165.JPG,46.2345612,6.5611445,539.931,0.5,0.75\n"
    for text in (
        header + line,
        "#imagename,latitude,longitude,altitude,Accuracy Horz,Accuracy Vert\n" + line,
        line,
    ):
        row = pos(tmp_path, text).rows[0]
        assert (row.name, row.lat_deg, row.lon_deg) == ("IMG_3165.JPG", 46.2345612, 6.5611445)
        assert (row.height_ellipsoidal_m, row.sd_east_m, row.sd_vertical_m) == (539.931, 0.5, 0.75)
    assert "pos-header-assumed" in codes(pos(tmp_path, line))


def test_the_first_line_counts_before_pos_crs(tmp_path: Path) -> None:
    """A word says so where both are given and differ."""
    text = "EPSG:32632\na.jpg 691000 5335000 500\nb.jpg 691050 5335000 500\n"
    same = pos(tmp_path, text, "geo.txt", crs="EPSG:32632")
    other = pos(tmp_path, text, "geo.txt", crs="EPSG:32633")
    assert same.rows[0].lon_deg == other.rows[0].lon_deg
    assert "pos-crs-unused" in codes(other) - codes(same)


def test_pix4ds_angles_without_a_header_count_from_the_utm_grid(tmp_path: Path) -> None:
    text = "b.JPG,60.0,11.5,500,4.0,-2.5,-30\na.JPG,60.1,11.5,500,0,0,90\n"
    row = pos(tmp_path, text).rows[0]
    tilted = Rotation.from_omega_phi_kappa(*np.radians([4.0, -2.5, -30.0])).yaw_pitch_roll()
    assert (row.name, row.lat_deg, row.lon_deg, row.sd_vertical_m) == ("b.JPG", 60.0, 11.5, None)
    # UTM 32 at 11.5 E, 60 N: grid north lies atan(tan 2.5 deg sin 60 deg) = 2.166 deg east of true north.
    assert row.yaw_deg == pytest.approx(math.degrees(tilted[0]) + 2.166, abs=2e-3)
    assert (row.pitch_deg, row.roll_deg) == pytest.approx(np.degrees(tilted[1:]), abs=1e-6)
    with_accuracy = text.replace("-30\n", "-30,0.02,0.03\n").replace("90\n", "90,0.02,0.03\n")
    again = pos(tmp_path, with_accuracy).rows[0]
    assert (again.yaw_deg, again.sd_east_m, again.sd_vertical_m) == (row.yaw_deg, 0.02, 0.03)


def test_angles_without_a_header_that_do_not_look_down_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no header line"):
        pos(tmp_path, "b.JPG,60.0,11.5,500,270.0,1.5,-3\na.JPG,60.1,11.5,500,90,0,0\n")


def test_omega_phi_kappa_of_a_grid_are_turned_to_true_north(tmp_path: Path) -> None:
    easting, northing = MapProjection("EPSG:32632").map_from_geodetic(11.5, 60.0)
    file = pos(
        tmp_path,
        f"filename,x,y,z,omega,phi,kappa\na,{easting:.4f},{northing:.4f},5000,0,0,-30\n",
        crs="EPSG:32632",
    )
    convergence = math.degrees(math.atan(math.tan(math.radians(2.5)) * math.sin(math.radians(60.0))))
    assert file.rows[0].yaw_deg == pytest.approx(30.0 + convergence, abs=1e-3)
    assert convergence == pytest.approx(2.166, abs=1e-3)


def test_omega_phi_kappa_keep_their_signs(tmp_path: Path) -> None:
    row = pos(tmp_path, "frame,lon,lat,omega,phi,kappa\na,9,48,4.0,-2.5,-70\n").rows[0]
    assert row.yaw_deg is not None and row.pitch_deg is not None and row.roll_deg is not None
    back = Rotation.from_yaw_pitch_roll(
        *np.radians([row.yaw_deg, row.pitch_deg, row.roll_deg])
    ).omega_phi_kappa()
    assert np.degrees(back) == pytest.approx([4.0, -2.5, -70.0])
    view = Rotation.from_yaw_pitch_roll(*np.radians([row.yaw_deg, row.pitch_deg, row.roll_deg])).matrix @ [
        0,
        0,
        -1,
    ]
    assert view[0] > 0.04 and view[1] > 0.06  # phi < 0 looks east, omega > 0 looks north


def test_phi_first_or_omega_first(tmp_path: Path) -> None:
    text = "frame,lon,lat,phi,omega,kappa\na,9,48,3.0,0,-120\n"
    sine = math.sin(math.radians(3.0))
    # X is north and Y west: phi > 0 looks north. X is east, Y north: phi > 0 looks west.
    for convention, view in (("phi-omega-kappa", (0.0, sine)), ("auto", (-sine, 0.0))):
        row = pos(tmp_path, text, attitude_convention=convention).rows[0]
        assert row.yaw_deg == pytest.approx(120.0, abs=0.1)
        body = np.radians([row.yaw_deg, row.pitch_deg, row.roll_deg])
        looks = Rotation.from_yaw_pitch_roll(*body).matrix @ [0.0, 0.0, -1.0]
        assert looks[:2] == pytest.approx(view, abs=1e-12)


@pytest.mark.parametrize(
    ("pitch", "convention", "expected"),
    [
        (2.0, "auto", 2.0),
        (-88.0, "auto", 2.0),
        (-45.5, "auto", 44.5),
        (-44.0, "auto", -44.0),
        (-88.0, "body", -88.0),
    ],
)
def test_pitch_is_a_bodys_or_a_gimbals(
    tmp_path: Path, pitch: float, convention: str, expected: float
) -> None:
    file = pos(
        tmp_path, f"frame,lon,lat,yaw,pitch,roll\na,9,48,10,{pitch},0\n", attitude_convention=convention
    )
    assert file.rows[0].pitch_deg == pytest.approx(expected)
    assert ("pos-attitude-convention" in codes(file)) == (convention == "auto")


def test_gimbal_columns_decide_by_themselves(tmp_path: Path) -> None:
    file = pos(tmp_path, "frame,lon,lat,gimbal_yaw,gimbal_pitch,gimbal_roll\na,9,48,10,-20,0\n")
    assert file.rows[0].pitch_deg == pytest.approx(70.0)
    assert codes(file) == set()


def test_our_own_positions_are_read_back(tmp_path: Path) -> None:
    header = (
        "frame,status,lon_deg,lat_deg,height_ellipsoidal_m,easting_m,northing_m,yaw_deg,pitch_deg,roll_deg,"
        "omega_deg,phi_deg,kappa_deg,sd_e_m,sd_n_m,sd_u_m,sd_omega_deg,sd_phi_deg,sd_kappa_deg,"
        "moved_m,turned_deg\n"
    )
    line = (
        "a.jpg,tied,9.1,48.7,512.5,507000.1,5394000.2,350.5,-85,3,9,9,9,0.03,0.04,0.06,0.3,0.4,0.7,1.2,0.1\n"
    )
    file = pos(tmp_path, header + line)
    row = file.rows[0]
    assert (row.lon_deg, row.lat_deg, row.height_ellipsoidal_m) == (9.1, 48.7, 512.5)
    assert (row.yaw_deg, row.pitch_deg, row.roll_deg) == (350.5, 5.0, 3.0)
    assert (row.sd_east_m, row.sd_north_m) == (0.03, 0.04)
    assert (row.sd_vertical_m, row.sd_yaw_deg) == (0.06, 0.7)
    assert row.sd_tilt_deg == pytest.approx(math.sqrt((0.3**2 + 0.4**2) / 2))
    assert codes(file) == set()


BAD = {
    "no latitude": ("frame,lon,height\na,9,5\n", r"no column for the latitude \(found: frame, lon, height\)"),
    "no name": ("lon,lat,h\n9,48,5\n", r"no column for the frame's name"),
    "no easting": ("frame,y,z\na,9,5\n", r"no column for the easting"),
    "latitude 95": ("frame,lon,lat\na,9,48\nb,9.1,95\n", r"line 3: latitude 95 is outside -90 to 90"),
    "longitude 200": ("frame,lon,lat\na,200,48\n", r"line 2: longitude 200 is outside -180 to 180"),
    "swapped": ("frame,lon,lat\na,24.7,120.9\nb,24.8,121\n", r"longitude and latitude are swapped \(line 2"),
    "radians": ("frame,lon,lat\na,0.197211,0.839502\nb,0.197214,0.839504\n", r"look like radians \(line 2: 0.197211, 0.83"),
    "a word": ("frame,lon,lat\na,9,north\n", r"line 2: 'north' is no number for lat"),
    "infinite": ("frame,lon,lat,z\na,9,48,inf\n", r"line 2: 'inf' is no number for height"),
    "huge": ("frame,lon,lat,z\na,9,48,1e999\n", r"'1e999' is no number"),
    "nan position": ("frame,lon,lat\na,9,nan\n", r"line 2: no lat; fill it in"),
    "minutes": ("frame,lon,lat\na,9,48°72'\n", r"is no number for lat; write decimal numbers"),
    "decimal commas": ("frame,lon,lat\na,9,5,48,7\n", r"line 2 has 5 fields under 3 columns; with decimal"),
    "no crs": ("frame,x,y\na,500000,5400000\n", r"no coordinate reference system; .*--pos-crs, such as EPSG:n"),
    "unit": ("frame,lon,lat,z [furlong]\na,9,48,1\n", r"unknown unit 'furlong'"),
    "two columns": ("frame,lon,lat,latitude\na,9,48,48\n", r"two columns for lat"),
    "no header": ("a,9,48,500,1,2,3,4\n", r"has no header line that names the columns; put one first: frame,"),
    "no rows": ("frame,lon,lat\n", r"has a header and no lines"),
    "empty": ("\n\n", r"the POS file is empty"),
    "negative sigma": ("frame,lon,lat,sd_vertical\na,9,48,-1\n", r"line 2: a standard deviation of -1"),
    "binary": (b"frame,lon,lat\n\x00\x01\x02", r"is no text file"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_pos_files_are_one_line_naming_file_and_fix(tmp_path: Path, case: str) -> None:
    text, message = BAD[case]
    with pytest.raises(InputError, match=message) as caught:
        pos(tmp_path, text)
    assert str(caught.value).startswith(f"{tmp_path / 'pos.csv'}: ")
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 2
    assert caught.value.fix


def test_unknown_convention_and_missing_columns(tmp_path: Path) -> None:
    text = "frame,lon,lat,yaw,pitch,roll\na,9,48,1,2,3\n"
    with pytest.raises(UnknownNameError, match="did you mean 'gimbal'"):
        pos(tmp_path, text, attitude_convention="gimball")
    with pytest.raises(InputError, match="has no columns omega, phi and kappa"):
        pos(tmp_path, text, attitude_convention="omega-phi-kappa")
    with pytest.raises(InputError, match="no such file"):
        read_pos(tmp_path / "none.csv")
    write_jpeg(tmp_path / "a.jpg", image(64, 48, seed=1))
    with pytest.raises(InputError, match="--attitude has an effect only on angles of a POS file; add --pos"):
        check_survey_files(SurveyInputs(tmp_path, attitude_convention="gimbal"))


def test_ignored_columns_are_reported(tmp_path: Path) -> None:
    file = pos(tmp_path, "frame,lon,lat,wind\na,9,48,7\n")
    assert file.warnings[0].text.startswith("pos.csv: columns not used: wind; name ")


@given(st.sampled_from(sorted(ALIASES)), st.data())
def test_every_alias_means_its_column(column: str, data: st.DataObject) -> None:
    alias = data.draw(st.sampled_from(ALIASES[column]))
    units = ["{} (deg)", "{}_deg"] if column in ANGLES else ["{} [m]", "{} (deg)", "{}_m"]
    shape = data.draw(st.sampled_from(["{}", " {} ", *units]))
    name = shape.format(data.draw(st.sampled_from([alias, alias.upper(), alias.replace("_", " ")])))
    assert column_of(name, ALIASES)[0] == column


def test_no_name_means_two_columns() -> None:
    names = [alias for aliases in ALIASES.values() for alias in aliases]
    assert len(names) == len(set(names))


def test_the_guide_lists_every_alias() -> None:
    guide = (Path(__file__).parents[2] / "docs" / "inputs.md").read_text()
    for column, names in ALIASES.items():
        line = next(line for line in guide.splitlines() if line.startswith(f"| {column} |"))
        assert line.endswith(f"| {', '.join(f'`{name}`' for name in names)} |")


def test_paths_of_a_server_are_no_comments(tmp_path: Path) -> None:
    path = tmp_path / "pos.csv"
    path.write_text(
        "// of the flight in May\n//a comment\n////////\nname,lon,lat\n"
        "//server/share/a.jpg,9.1,48.7\n//nas/b.jpg,9.2,48.8\n// c.jpg,9.3,48.9\n"
    )
    assert [row.name for row in read_pos(path).rows] == ["//server/share/a.jpg", "//nas/b.jpg"]


@pytest.mark.parametrize(
    "head", ["EPSG:4326\n", "", "frame lat lon height\n", "lat lon frame height\n"], ids=len
)
def test_names_with_blanks_of_frames_that_are_not_here(tmp_path: Path, head: str) -> None:
    """In geo.txt, in Pix4D's table and under a header: the line is one without a frame."""
    lines = ["old img 0009.JPG {0} {1} 412", "a.jpg {0} {1} 412"]
    if head.startswith("lat"):
        lines = ["{0} {1} old img 0009.JPG 412", "{0} {1} a.jpg 412"]
    place = ("9.1", "48.7") if head.startswith("EPSG") else ("48.7", "9.1")
    path = tmp_path / "geo.txt"
    path.write_text(head + "\n".join(line.format(*place) for line in lines) + "\n")
    rows = read_pos(path, frames=FrameNames(["a.jpg"])).rows
    assert [(r.name, r.lon_deg, r.lat_deg, r.height_ellipsoidal_m) for r in rows] == [
        ("old img 0009.JPG", 9.1, 48.7, 412.0), ("a.jpg", 9.1, 48.7, 412.0)
    ]  # fmt: skip


def test_a_label_before_a_path_is_not_joined_with_it(tmp_path: Path) -> None:
    path = tmp_path / "pos.txt"
    path.write_text("frame lat lon height source\nIMG_1 48.7 9.1 412 raw/IMG_1.jpg\n")
    (row,) = read_pos(path).rows
    assert (row.name, row.lat_deg) == ("IMG_1", 48.7)
