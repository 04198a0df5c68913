"""Control files as people deliver them: headers, orders, heights, names of images, deviations.

Truth is PROJ's own: coordinates are those of known places by EPSG code.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from geoids import egm96_of, undulation_m
from pyproj import CRS, Transformer
from survey_files import exif_block, gps, image, write_jpeg

from geomosaic.errors import InputError
from geomosaic.export.references import write_odm_control
from geomosaic.geodesy.crs_names import AmbiguousCrsError, stated_crs
from geomosaic.geodesy.mapcrs import map_crs
from geomosaic.survey.control import read_control
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.model import ControlPoint, Warn
from geomosaic.survey.names import FrameNames
from geomosaic.survey.places import NOWHERE
from geomosaic.survey.pos import read_pos
from geomosaic.survey.read import check_survey_files, read_survey

FRAMES = ("a.jpg", "IMG_4881.JPG", "DSC 0001.JPG", "DSC 0001 b.JPG")
BORUSZYN = (16.6362, 52.7760)
DELFT = (4.3571, 52.0116)
LONDON = (-0.1276, 51.5072)
PARIS = (2.3522, 48.8566)
URUMQI = (87.4012, 42.0913)
SAN_FRANCISCO = (-122.4194, 37.7749)
ROME = (12.4964, 41.9028)
Read = Callable[..., tuple[tuple[ControlPoint, ...], list[Warn]]]


def xy(code: str, place: tuple[float, float]) -> tuple[float, float]:
    """Easting and northing, or longitude and latitude, of a place."""
    east, north = Transformer.from_crs("EPSG:4326", code, always_xy=True).transform(*place)
    return float(east), float(north)


@pytest.fixture
def read(tmp_path: Path) -> Read:
    def reader(
        content: str | bytes, near: tuple[float, float] | None = None, names: tuple[str, ...] = FRAMES
    ):
        path = tmp_path / "gcp_list.txt"
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        frames = NOWHERE if near is None else np.array([near, (near[0] + 1e-3, near[1])])
        file = read_control(path, FrameNames(names), frames)
        return file.points, list(file.notes)

    return reader


def measured(header: str, code: str, place: tuple[float, float], order: int = 1) -> str:
    """A list of one point."""
    x, y = xy(code, place)[::order]
    return f"{header}\n{x:.4f} {y:.4f} 70.5 12.5 20.25 a.jpg P1\n"


HEADERS = [
    ("EPSG:2180", "EPSG:2180", BORUSZYN, False),
    ("2180", "EPSG:2180", BORUSZYN, False),
    ("epsg 2180", "EPSG:2180", BORUSZYN, False),
    ("# EPSG:2180", "EPSG:2180", BORUSZYN, False),
    ("urn:ogc:def:crs:EPSG::2180", "EPSG:2180", BORUSZYN, False),
    ("PUWG1992", "EPSG:2180", BORUSZYN, True),
    ("PUWG 1992", "EPSG:2180", BORUSZYN, True),
    ("PL-1992", "EPSG:2180", BORUSZYN, True),
    ("ETRS89 / Poland CS92", "EPSG:2180", BORUSZYN, True),
    ("PL-2000", "EPSG:2176", (15.21, 52.776), True),
    ("+proj=utm +zone=33 +datum=WGS84 +units=m +no_defs\t", "EPSG:32633", BORUSZYN, False),
    (CRS("EPSG:2180").to_wkt("WKT1_GDAL"), "EPSG:2180", BORUSZYN, False),
    (CRS("EPSG:2180").to_wkt("WKT2_2019"), "EPSG:2180", BORUSZYN, False),
    (CRS("EPSG:2180").to_wkt("WKT1_ESRI", pretty=True), "EPSG:2180", BORUSZYN, False),
    ("WGS84", "EPSG:4326", BORUSZYN, False),
    ("WGS84 UTM 33N", "EPSG:32633", BORUSZYN, False),
    ("UTM 33 north", "EPSG:32633", BORUSZYN, True),
    ("WGS84 UTM 45T", "EPSG:32645", URUMQI, True),
    ("UTM 45T", "EPSG:32645", URUMQI, True),
    ("ETRS89 UTM 33U", "EPSG:25833", BORUSZYN, True),
    ("UTM zone 23K", "EPSG:32723", (-43.2, -22.9), True),
    ("OSGB36", "EPSG:27700", LONDON, True),
    ("British National Grid", "EPSG:27700", LONDON, True),
    ("RD New", "EPSG:28992", DELFT, True),
    ("Amersfoort / RD New", "EPSG:28992", DELFT, False),
    ("Lambert-93", "EPSG:2154", PARIS, True),
    ("lambert93", "EPSG:2154", PARIS, True),
]


@pytest.mark.parametrize(("header", "code", "place", "named"), HEADERS, ids=[h[0][:20] for h in HEADERS])
def test_headers_as_found(
    read: Read, header: str, code: str, place: tuple[float, float], named: bool
) -> None:
    (point,), notes = read(measured(header, code, place))
    assert (point.lon_deg, point.lat_deg) == pytest.approx(place, abs=2e-8)
    assert point.images == (("a.jpg", 12.5, 20.25),) and point.height_ellipsoidal_m == 70.5
    taken = [w.text for w in notes if w.code == "crs-by-name"]
    assert taken == [t for t in taken if f"is taken as {code} (" in t] and len(taken) == named


@pytest.mark.parametrize(
    ("header", "near"),
    [("PUWG1993", r"did you mean EPSG:2180 \(ETRF2000-PL / CS92\)"), ("Britsh National Grid", "EPSG:27700"),
     ("the western field", "gcp_list.txt: line 1: 'the western field'"), ("EPSG:99999", "that PROJ knows"),
     ("UTM 34O", "EPSG:"), ("EPSG:4978", "Geocentric")],
)  # fmt: skip
def test_unknown_systems_are_refused_with_the_nearest(read: Read, header: str, near: str) -> None:
    with pytest.raises(InputError, match=near) as caught:
        read(f"{header}\n634676 485344 112 1115 1184 a.jpg\n")
    assert "--gcp" in str(caught.value) and caught.value.exit_code == 2


@pytest.mark.proof
def test_a_name_of_two_systems_goes_by_the_frames_or_asks(read: Read) -> None:
    """S is the southern hemisphere, unless the frames lie in the band S. A zone alone has two halves; Rome's
    easting is 2,313,181 m in the eastern zone of Gauss and Boaga, and off the western one's area."""
    point = read(measured("WGS84 UTM 10S", "EPSG:32610", SAN_FRANCISCO), SAN_FRANCISCO)[0][0]
    assert (point.lon_deg, point.lat_deg) == pytest.approx(SAN_FRANCISCO, abs=1e-8)
    assert read(measured("WGS84 UTM 10S", "EPSG:32610", SAN_FRANCISCO))[0][0].lat_deg < 0.0
    bare = measured("UTM 10", "EPSG:32610", SAN_FRANCISCO)
    with pytest.raises(AmbiguousCrsError, match=r"may be any of EPSG:32710 .*, EPSG:32610 .*--gcp"):
        read(bare)
    assert read(bare, SAN_FRANCISCO)[0][0].lat_deg == pytest.approx(SAN_FRANCISCO[1], abs=1e-8)
    metres = measured("WGS84", "EPSG:32610", SAN_FRANCISCO)
    point, notes = read(metres, SAN_FRANCISCO)
    assert point[0].lon_deg == pytest.approx(SAN_FRANCISCO[0], abs=1e-8)
    assert "taken as EPSG:32610" in notes[0].text
    with pytest.raises(AmbiguousCrsError, match=r"and \d+ more"):
        read(metres)
    for header, code in (("Gauss-Boaga", "EPSG:3004"), ("Monte Mario", "EPSG:3004")):
        (point,), notes = read(measured(header, code, ROME), ROME)
        assert (point.lon_deg, point.lat_deg) == pytest.approx(ROME, abs=2e-7)


def test_before_frames_are_read_a_name_of_two_systems_passes(tmp_path: Path) -> None:
    """The check of the files alone; the frames' positions then tell which half of zone 33 it is."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for i in range(2):
        tags = exif_block(
            DateTimeOriginal=f"2024:05:01 10:00:0{i}", Make="T", Model="C",
            FocalLength=5, FocalLengthIn35mmFilm=28, **gps(BORUSZYN[0] + i * 1e-4, BORUSZYN[1], 120.0),
        )  # fmt: skip
        write_jpeg(folder / f"{'ab'[i]}.jpg", image(seed=i), tags)
    gcp = tmp_path / "list.txt"
    gcp.write_text(measured("UTM 33", "EPSG:32633", BORUSZYN))
    check_survey_files(SurveyInputs(folder, gcp=gcp, crs="UTM 33"))
    survey = read_survey(SurveyInputs(folder, gcp=gcp, crs="UTM 33"))
    assert survey.control[0].lat_deg == pytest.approx(BORUSZYN[1], abs=1e-8)
    assert survey.map_crs == "EPSG:32633"
    named = [w.text for w in survey.warnings if w.code == "crs-by-name"]
    assert [t.split(" is taken")[0] for t in named] == ["--crs 'UTM 33'", "list.txt: 'UTM 33'"]
    gcp.write_text(measured("EPSG:4326", "EPSG:4326", BORUSZYN, order=-1))
    survey = read_survey(SurveyInputs(folder, gcp=gcp, crs="PUWG1992"))
    assert (survey.control[0].lon_deg, survey.control[0].lat_deg) == pytest.approx(BORUSZYN, abs=1e-4)
    assert survey.map_crs == "EPSG:2180"
    assert [w.text for w in survey.warnings if w.code == "xy-exchanged"] == [
        "list.txt: x is read as northing and y as easting: as they are written, the positions would lie "
        "far from the frames in WGS 84; nothing to do if that CRS is right"
    ]


def test_easting_comes_first_unless_that_is_elsewhere(read: Read) -> None:
    """Boruszyn's 340607.768 548220.879: in Poland in both orders. In UTM the other order is nowhere."""
    text = "EPSG:2180\n340607.768 548220.879 70.8 149 162 a.jpg\n"
    truth = Transformer.from_crs("EPSG:2180", "EPSG:4326", always_xy=True).transform(340607.768, 548220.879)
    (point,), notes = read(text)
    assert (point.lon_deg, point.lat_deg) == pytest.approx(truth, abs=1e-9)
    assert (point.lon_deg, point.lat_deg) == pytest.approx((16.636244, 52.776038), abs=1e-6)
    assert [w.code for w in notes] == ["height-datum-assumed"]
    turned = measured("EPSG:2180", "EPSG:2180", BORUSZYN, order=-1)
    assert read(turned)[0][0].lon_deg == pytest.approx(19.7, abs=0.1)
    (point,), notes = read(turned, BORUSZYN)
    assert (point.lon_deg, point.lat_deg) == pytest.approx(BORUSZYN, abs=1e-8)
    assert [w.code for w in notes] == ["xy-exchanged", "height-datum-assumed"]
    (point,), notes = read(measured("EPSG:32633", "EPSG:32633", BORUSZYN, order=-1))
    assert (point.lon_deg, point.lat_deg) == pytest.approx(BORUSZYN, abs=1e-8)
    assert "outside the area of WGS 84 / UTM zone 33N" in notes[0].text


@pytest.mark.parametrize("unknown", ["NaN", "nan", "-", "NULL"])
def test_points_without_a_height_determine_the_plan(read: Read, unknown: str) -> None:
    lines = ["340607.768 548220.879 {h} 1 2 a.jpg A", "340644.813 548180.885 71.5 3 4 a.jpg B",
             "340607.768 548220.879 {h} 5 6 img_4881 A", "340594.082 548098.123 73.5 3 4 a.jpg C"]  # fmt: skip
    points, notes = read("EPSG:2180\n" + "\n".join(lines).format(h=unknown))
    assert [p.plan_only for p in points] == [True, False, False]
    assert [p.height_ellipsoidal_m for p in points] == [72.5, 71.5, 73.5]
    assert points[0].sd_vertical_m > 1e4 and points[1].sd_vertical_m == 0.05
    warning_found = [w.text for w in notes if w.code == "control-plan-only"]
    assert warning_found == [
        "gcp_list.txt: 1 of 3 points (A) have no height, so the points place the map in plan only; "
        "give heights to place it in height too"
    ]
    points, notes = read("EPSG:2180\n" + "\n".join(lines[::2]).format(h=unknown))
    assert [(p.plan_only, p.height_ellipsoidal_m, len(p.images)) for p in points] == [(True, 0.0, 2)]
    assert [w.code for w in notes] == ["control-plan-only"]


def test_a_height_of_one_line_counts_for_the_point(read: Read) -> None:
    text = "EPSG:2180;\n340607.768;548220.879;;1;2;a.jpg;A\n340607.768;548220.879;71.5;1;2;img_4881.jpg;A\n"
    (point,), _ = read(text)
    assert (point.plan_only, point.height_ellipsoidal_m, len(point.images)) == (False, 71.5, 2)


def test_a_vertical_datum_in_the_header_counts(read: Read, tmp_path: Path) -> None:
    place = (11.3, 47.4)
    x, y = xy("EPSG:32632", place)
    for header in ("EPSG:32632+5773", "WGS84 UTM 32N + EGM96", "UTM 32T + EGM96 height"):
        with egm96_of(tmp_path):
            (point,), notes = read(f"{header}\n{x:.4f} {y:.4f} 512.0 1 2 a.jpg P\n")
        raised = float(undulation_m(np.array(place[0]), np.array(place[1])))
        assert point.height_ellipsoidal_m == pytest.approx(512.0 + raised, abs=1e-3)
        assert "height-datum-assumed" not in [w.code for w in notes]


def test_names_with_blanks_without_extension_and_unknown_ones(read: Read, tmp_path: Path) -> None:
    text = (
        "EPSG:2180\n"
        "340607.768 548220.879 70.8 1 2 DSC 0001.JPG p1\n"
        "340607.768 548220.879 70.8 3 4 dsc 0001 b p1\n"
        "340607.768 548220.879 70.8 5 6 folder/img_4881 p1\n"
        "340644.813 548180.885 70.0 7 8 DSC 0009.JPG p2\n"
        "340644.813 548180.885 70.0 9 10 DSC 0001 b.jpg p2 checked twice\n"
    )
    one, two = read(text)[0]
    assert one.images == (
        ("DSC 0001.JPG", 1.0, 2.0), ("DSC 0001 b.JPG", 3.0, 4.0), ("IMG_4881.JPG", 5.0, 6.0)
    )  # fmt: skip
    assert (one.name, two.name) == ("p1", "p2")
    assert two.images == (("DSC 0001 b.JPG", 9.0, 10.0),)
    assert read_control(tmp_path / "gcp_list.txt", FrameNames(FRAMES)).absent == (("p2", "DSC 0009.JPG"),)
    table = "name x y z col row image\np1 340607.768 548220.879 70.8 1 2 DSC 0001.JPG\n"
    assert read(f"EPSG:2180\n{table}")[0][0].images == (("DSC 0001.JPG", 1.0, 2.0),)
    with pytest.raises(InputError, match=r"'x' may be any of x\.jpg, x\.tif"):
        read("EPSG:2180\n340607.768 548220.879 70.8 1 2 x p1\n", names=("x.jpg", "x.tif"))


PLAIN = "EPSG:2180\n340607.768 548220.879 70.8 12.5 20.25 a.jpg P1\n340644.813 548180.885 70.2 1 2 a.jpg P2\n"
COMMAS = PLAIN.replace(".jpg", "@").replace(".", ",").replace("@", ".jpg")
LAYOUTS = {
    "BOM": b"\xef\xbb\xbf" + PLAIN.encode(),
    "UTF-16": PLAIN.encode("utf-16"),
    "Windows line ends": PLAIN.replace("\n", "\r\n"),
    "tabs": PLAIN.replace(" ", "\t"),
    "semicolons": PLAIN.replace(" ", ";"),
    "commas": PLAIN.replace(" ", ","),
    "commas and blanks": PLAIN.replace(" ", ", "),
    "decimal commas": COMMAS,
    "decimal commas, semicolons": COMMAS.replace(" ", ";"),
    "comments": "# measured by hand\n\n" + PLAIN.replace("\n3406", "\n# next\n3406"),
    "comment of columns": PLAIN.replace("2180\n", "2180\n# x y z px py image name\n"),
    "named columns": PLAIN.replace("2180\n", "2180\nEasting Northing Elevation im_x im_y image_name gcp_name\n"),
    "y before x": "EPSG:2180\nname;y;x;z;image;col;row\n"
    "P1;548220.879;340607.768;70.8;a.jpg;12.5;20.25\nP2;548180.885;340644.813;70.2;a.jpg;1;2\n",
}  # fmt: skip


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts(read: Read, layout: str) -> None:
    plain = read(PLAIN)[0]
    assert read(LAYOUTS[layout])[0] == plain
    assert [p.name for p in plain] == ["P1", "P2"] and plain[0].images == (("a.jpg", 12.5, 20.25),)


def test_points_without_a_height_are_written_without(read: Read, tmp_path: Path) -> None:
    points = read("EPSG:2180\n340607.768 548220.879 NaN 1 2 a.jpg A\n340644.8 548180.8 71.5 1 2 a.jpg B\n")[0]
    write_odm_control(tmp_path / "out.txt", points, "EPSG:2180")
    written = (tmp_path / "out.txt").read_text()
    assert [line.split()[2] for line in written.splitlines()[1:]] == ["NaN", "71.5000"]
    assert [p.plan_only for p in read(written)[0]] == [True, False]


def test_lists_without_images(read: Read) -> None:
    points, _ = read("EPSG:4326\ngcp01\t-119.879992097\t34.4082988202\t7.5\ngcp02\t-119.87995\t34.40834\t8\n")
    assert [(p.name, p.lon_deg, p.lat_deg, p.height_ellipsoidal_m, p.images) for p in points] == [
        ("gcp01", -119.879992097, 34.4082988202, 7.5, ()), ("gcp02", -119.87995, 34.40834, 8.0, ())
    ]  # fmt: skip
    (point,), notes = read("point name,latitude,longitude\ncop-target1,34.4082988202,-119.879992097\n")
    assert (point.lon_deg, point.lat_deg, point.plan_only) == (-119.879992097, 34.4082988202, True)
    assert [w.code for w in notes] == ["control-plan-only"]


@pytest.mark.parametrize("separator", [",", " ", "\t"])
def test_a_surveyors_list_of_number_northing_easting_height_description(read: Read, separator: str) -> None:
    rows = (
        ("1", "5400010.123", "509000.456", "412.30", "GCP CROSS"),
        ("12", "5400110.123", "509030.456", "412.90", "NAIL"),
    )
    points, notes = read("EPSG:32632\n" + "".join(f"{separator.join(row)}\n" for row in rows))
    assert [(p.name, p.height_ellipsoidal_m, p.images) for p in points] == [
        ("1", 412.3, ()),
        ("12", 412.9, ()),
    ]
    assert xy("EPSG:32632", (points[0].lon_deg, points[0].lat_deg)) == pytest.approx(
        (509000.456, 5400010.123)
    )
    assert "xy-exchanged" in [w.code for w in notes]


@pytest.mark.parametrize(
    ("columns", "values", "sd_m"),
    [
        ("sd", "2.5", (2.5, 2.5)),
        ("sd_horizontal,sd_vertical", "0.012,0.02", (0.012, 0.02)),
        ("Accuracy_X/Y_(m),Accuracy_Z_(m)", "0.012,0.02", (0.012, 0.02)),
        ("Horizontal accuracy [m],Vertical accuracy [m]", "0.012,0.02", (0.012, 0.02)),
        ("Easting RMS,Northing RMS,Elevation RMS,Lateral RMS", "0.03,0.04,0.06,0.05", (0.05, 0.06)),
        ("sdn(m),sde(m),sdu(m)", "0.03,0.04,0.06", (0.00125**0.5, 0.06)),
        ("sd_horizontal", "3", (3.0, 0.05)),
        ("sd,sd_vertical", "2.5,", (2.5, 2.5)),
    ],
)
def test_stated_deviations_are_used(read: Read, columns: str, values: str, sd_m: tuple[float, float]) -> None:
    (stated, silent), _ = read(f"name,lon,lat,h,{columns}\nP,9.1,48.7,300,{values}\nQ,9.2,48.8,301\n")
    assert (stated.sd_horizontal_m, stated.sd_vertical_m) == pytest.approx(sd_m)
    assert (silent.sd_horizontal_m, silent.sd_vertical_m) == (0.03, 0.05)
    assert (stated.sd_assumed, silent.sd_assumed) == (False, True)


@pytest.mark.parametrize(
    ("named", "prj", "given", "taken"),
    [
        ("", "", "EPSG:32632", "EPSG:32632"),
        ("", "", "EPSG:32633", "EPSG:32633"),
        ("EPSG:32633\n", "", "EPSG:32632", "EPSG:32633"),
        ("", "EPSG:32633", "EPSG:32632", "EPSG:32633"),
    ],
)
@pytest.mark.parametrize("place", [ROME, (9.2, 44.9)])
def test_a_file_without_a_system_is_in_that_of_pos_crs(
    tmp_path: Path, named: str, prj: str, given: str, taken: str, place: tuple[float, float]
) -> None:
    path = tmp_path / "points.csv"
    x, y = xy(taken, place)
    path.write_text(f"{named}name,x,y,height,image,col,row\np,{x:.4f},{y:.4f},31.5,a.jpg,80.5,60.25\n")
    if prj:
        path.with_suffix(".prj").write_text(prj)
    inputs = SurveyInputs(tmp_path, gcp=path, pos_crs=given)
    file = inputs.control(FrameNames(FRAMES), np.array([place, (place[0] + 1e-3, place[1])]))
    assert file is not None
    (point,) = file.points
    assert (point.lon_deg, point.lat_deg, point.height_ellipsoidal_m) == pytest.approx(
        (*place, 31.5), abs=1e-8
    )
    assert point.images == (("a.jpg", 80.5, 60.25),)


def test_pos_files_name_their_system_too(tmp_path: Path) -> None:
    path = tmp_path / "geo.txt"
    x, y = xy("EPSG:2180", BORUSZYN)
    path.write_text(f"PUWG1992\na.jpg {x:.4f} {y:.4f} 120\n")
    file = read_pos(path)
    assert (file.rows[0].lon_deg, file.rows[0].lat_deg) == pytest.approx(BORUSZYN, abs=1e-8)
    assert "geo.txt: 'PUWG1992' is taken as EPSG:2180" in file.warnings[0].text
    path.write_text(f"PUWG1992\nDSC 0001.JPG {x:.4f} {y:.4f} 120\n")
    assert read_pos(path, frames=FrameNames(FRAMES)).rows[0].name == "DSC 0001.JPG"
    path.write_text(f"frame,x,y,z\na.jpg,{x:.4f},{y:.4f},120\n")
    row = read_pos(path, crs="ETRS89 / Poland CS92").rows[0]
    assert (row.lon_deg, row.lat_deg) == pytest.approx(BORUSZYN, abs=1e-8)
    with pytest.raises(InputError, match=r"did you mean EPSG:2180 .*--pos-crs"):
        read_pos(path, crs="PUWG1993")
    path.write_text("Puwg1993\na.jpg 1 2 3\n")
    with pytest.raises(InputError, match=r"line 1: 'Puwg1993' .*EPSG:2180 .*--pos-crs"):
        read_pos(path)


def test_the_maps_system_by_name() -> None:
    assert map_crs("PUWG1992").to_epsg() == 2180
    assert map_crs("OSGB36").to_epsg() == 27700, "the projected one"
    assert map_crs("Lambert-93").to_epsg() == 2154, "its later versions are the same to the centimetre"
    assert map_crs("Gauss-Boaga", ROME).to_epsg() in (3003, 3004)
    with pytest.raises(AmbiguousCrsError, match=r"may be any of EPSG:3003 .*, EPSG:3004"):
        map_crs("Gauss-Boaga")
    assert stated_crs("no such thing") is None


def test_an_unknown_kind_is_refused_in_any_line_of_a_point(read: Read) -> None:
    head = "EPSG:4326\nname,lon,lat,height,image,col,row,type\n"
    first, second = "P,9.5,48.5,410,a.jpg,1,2,{}\n", "P,9.5,48.5,410,IMG_4881.JPG,1,2,{}\n"
    for known in ("", "GCP", "3D GCP"):
        with pytest.raises(
            InputError, match=r"gcp_list\.txt: line 4: kind 'Pole' is unknown; write control or"
        ):
            read(head + first.format(known) + second.format("Pole"))
    with pytest.raises(InputError, match="line 4: point 'P' is for check here and for control in line 3"):
        read(head + first.format("control") + second.format("check"))
    for kinds in (("", "check"), ("check", "")):
        (point,), _ = read(head + first.format(kinds[0]) + second.format(kinds[1]))
        assert point.check


@pytest.mark.parametrize(
    ("names", "at"),
    [
        ("lon,lat,height_ellipsoidal,image,x_px,y_px", (5.5, 6.5)),
        ("lon,lat,height_ellipsoidal,image,X [pixel],Y [pixel]", (5.5, 6.5)),
        ("lon,lat,height_ellipsoidal,image,col,row,x_px,y_px", (5.5, 6.5)),
    ],
)
def test_x_and_y_in_pixels_are_marks(read: Read, names: str, at: tuple[float, float]) -> None:
    """Unless the table has col and row, which count."""
    more = ",80,90" if "col" in names else ""
    (point,), _ = read(f"name,{names}\nP,9.1,48.7,412,a.jpg,5.5,6.5{more}\n")
    assert (point.lon_deg, point.images) == (9.1, (("a.jpg", *at),))


def test_blanks_in_the_name_of_an_image_that_is_not_here_under_a_header(read: Read) -> None:
    (point,), _ = read("name lon lat height image col row\nP 9.1 48.7 412 old img 7.JPG 1 2\n")
    assert (point.name, point.lat_deg, point.images) == ("P", 48.7, ())
