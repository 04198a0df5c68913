"""Tables as other programs write them: names of columns, repeated marks, and frames whose numbers begin anew."""

from __future__ import annotations

from pathlib import Path

import pytest
from survey_files import drone_frame, survey_folder

from geomosaic.errors import InputError
from geomosaic.survey.column_names import column_of, columns_of
from geomosaic.survey.control import ControlFile, read_control
from geomosaic.survey.control_table import ALIASES as CONTROL_ALIASES
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.names import FrameNames
from geomosaic.survey.pos import ALIASES, read_pos
from geomosaic.survey.pos_row import PosFile
from geomosaic.survey.read import read_survey


def pos(folder: Path, text: str) -> PosFile:
    path = folder / "pos.csv"
    path.write_text(text, encoding="utf-8")
    return read_pos(path)


def control(folder: Path, text: str) -> ControlFile:
    path = folder / "gcp.txt"
    path.write_text(text, encoding="utf-8")
    return read_control(path, FrameNames(["a.jpg", "b.jpg"]))


@pytest.mark.parametrize(
    ("name", "column", "unit"),
    [
        ("Latitude (WGS84)", "lat", ""), ("Easting (X)", "x", ""), ("Altitude (AMSL) [m]", "height_orthometric", "m"),
        ("Altitude (m) MSL", "height_orthometric", "m"), ("MSL Height [m]", "height_orthometric", "m"),
        ("X/Easting", "x", ""), ("longitude/X", "lon", ""), ("geo_z", "height", ""), ("Accuracy_X_(m)", "sd_e", "m"),
        ("sd_e [mm]", "sd_e", "mm"),
    ],
)  # fmt: skip
def test_words_in_brackets_belong_to_the_name_or_say_nothing(name: str, column: str, unit: str) -> None:
    assert column_of(name, ALIASES) == (column, unit)


def test_an_angle_has_no_unit_of_length() -> None:
    """`lat_m` is minutes: as metres the frames would lie off Africa."""
    with pytest.raises(InputError, match="'lat_m' is an angle in 'm'"):
        column_of("lat_m", ALIASES)


def test_of_two_columns_of_names_one_counts() -> None:
    path = Path("x.csv")
    assert columns_of(["photo", "filename"], ALIASES, path) == [(None, ""), ("frame", "")]
    assert columns_of(["id", "name"], CONTROL_ALIASES, path) == [(None, ""), ("name", "")]
    with pytest.raises(InputError, match="two columns for height"):
        columns_of(["frame", "alt", "elev"], ALIASES, path)


def test_sensefly_geoinfo_counts_from_the_ellipsoid(tmp_path: Path) -> None:
    """It has heights above the sea too, without their geoid."""
    names = "fileName latitude longitude altitude_amsl altitude_wgs84 heading pitch roll".replace(" ", "\t")
    rows = [f"IMG_{k}.JPG 37.54 {139.0 + k} 216.6 255.8 149.4 2.0 4.0".replace(" ", "\t") for k in range(3)]
    found = pos(tmp_path, "#Rev: sensefly/geoinfo/2\n" + "\n".join([names, *rows]) + "\n")
    assert [row.height_ellipsoidal_m for row in found.rows] == [255.8] * 3
    assert not [note for note in found.warnings if note.code in ("geoid-assumed", "pos-columns-ignored")]


def test_metashapes_reference_states_its_system(tmp_path: Path) -> None:
    wkt = 'GEOGCS["WGS 84",DATUM["D",SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],'
    wkt += 'UNIT["degree",0.01745329251994328],AUTHORITY["EPSG","4326"]]'
    head = "#Label,X/Longitude,Y/Latitude,Z/Altitude\n"
    (row,) = pos(tmp_path, f"# CoordinateSystem: {wkt}\n{head}a.jpg,9.5,48.25,410\n").rows
    assert (row.lon_deg, row.lat_deg, row.height_ellipsoidal_m) == (9.5, 48.25, 410.0)


def test_data_may_be_separated_as_the_header_is_not(tmp_path: Path) -> None:
    (row,) = pos(tmp_path, "# PhotoID, lon, lat, height_ellipsoidal\na.jpg\t9.5\t48.25\t410\n").rows
    assert (row.name, row.lon_deg, row.lat_deg) == ("a.jpg", 9.5, 48.25)


def test_what_a_table_tells_excel_is_no_line_of_it(tmp_path: Path) -> None:
    (row,) = pos(tmp_path, "sep=;\nname;lon;lat\na.jpg;9,5;48,25\n").rows
    assert (row.lon_deg, row.lat_deg) == (9.5, 48.25)


def test_a_column_of_the_hemisphere_gives_the_sign(tmp_path: Path) -> None:
    """As exiftool writes it: unsigned degrees next to `South` and `W`."""
    head = "SourceFile,GPSLatitudeRef,GPSLatitude,GPSLongitudeRef,GPSLongitude\n"
    south, north = pos(tmp_path, head + "a.jpg,South,48.25,W,9.5\nb.jpg,N,48.25,E,9.5\n").rows
    assert (south.lon_deg, south.lat_deg, north.lon_deg, north.lat_deg) == (-9.5, -48.25, 9.5, 48.25)


def test_a_comment_that_names_some_columns_is_no_header_of_a_geo_txt(tmp_path: Path) -> None:
    path = tmp_path / "geo.txt"
    path.write_text("EPSG:4326\n# image lon lat alt\na.jpg 9.5 48.25 410 10 0 0 0.02 0.03\n")
    (row,) = read_pos(path).rows
    assert (row.lon_deg, row.lat_deg, row.yaw_deg, row.sd_vertical_m) == (9.5, 48.25, 10.0, 0.03)


def test_empty_headings_do_not_hide_omega_phi_and_kappa(tmp_path: Path) -> None:
    table = "name,lon,lat,omega,phi,kappa,yaw,pitch,roll\na.jpg,9.5,48.25,0,0,-90,,,\n"
    (row,) = pos(tmp_path, table).rows
    assert row.yaw_deg == pytest.approx(90.0) and row.attitude_source == "pos-omega-phi-kappa"


def test_a_header_in_an_unknown_language_names_the_english_words(tmp_path: Path) -> None:
    with pytest.raises(InputError) as error:
        pos(tmp_path, "Kuva;Leveysaste;Pituusaste\na.jpg;48,25;9,5\n")
    assert "name the columns in English, such as frame,lon,lat,height" in error.value.fix


def test_a_mark_that_stands_twice_counts_once(tmp_path: Path) -> None:
    """One that counted twice made the adjustment's equations singular."""
    line = "9.5 48.25 410 100 200 a.jpg P1\n"
    twice = control(tmp_path, "EPSG:4326\n" + 2 * line + line.replace("a.jpg", "b.jpg"))
    (point,) = twice.points
    assert point.images == (("a.jpg", 100.0, 200.0), ("b.jpg", 100.0, 200.0))
    assert "control-mark-repeated" not in {w.code for w in twice.notes}
    differing = control(tmp_path, "EPSG:4326\n" + line + line.replace("100 200", "104 203"))
    assert differing.points[0].images == (("a.jpg", 102.0, 201.5),)
    (text,) = (w.text for w in differing.notes if w.code == "control-mark-repeated")
    assert "P1 in a.jpg, 5 px" in text


def test_columns_of_control_that_are_not_known_are_named(tmp_path: Path) -> None:
    notes = control(tmp_path, "name,lon,lat,level,enabled\nP1,9.5,48.25,410,1\n").notes
    assert "columns not used: level, enabled" in next(
        w.text for w in notes if w.code == "control-columns-ignored"
    )


def test_events_go_by_the_time_where_a_counter_begins_anew(tmp_path: Path) -> None:
    """DJI_0999 is followed by DJI_0001."""
    folder, names = tmp_path / "flight", ("DJI_0998", "DJI_0999", "DJI_0001", "DJI_0002")
    folder.mkdir()
    for i, name in enumerate(names):
        drone_frame(folder / f"{name}.JPG", 9.1234567 + i * 2.7e-4, second=2 * i)
    events, exposures = tmp_path / "flight_events.pos", tmp_path / "flight_Timestamp.MRK"
    events.write_text(
        "%  GPST latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m)\n"
        + "".join(f"2024/05/17 10:11:0{2 * i} 48.7654321 {9.1234567 + i * 2.7e-4:.7f} 460 1 9 .01 .01 .02\n"
                  for i in range(4))
    )  # fmt: skip
    exposures.write_text(
        "".join(f"{i + 1} 37653{i}.1 [2226] 0,N 0,E 0,V 48.7654321,Lat {9.1234567 + i * 2.7e-4:.7f},Lon 460,Ellh "
                "0.01, 0.01, 0.02 50,Q\n" for i in range(4))
    )  # fmt: skip
    for file in (events, exposures):
        survey = read_survey(SurveyInputs(folder, pos=file))
        assert [f.name.removesuffix(".JPG") for f in survey.frames] == list(names)
        lon = [f.position.lon_deg for f in survey.frames]
        assert lon == pytest.approx([9.1234567 + i * 2.7e-4 for i in range(4)], abs=1e-9)


@pytest.mark.parametrize(("height", "named"), [(412.5 / 0.3048, True), (460.0, False), (900.0, False)])
def test_heights_that_are_feet_by_the_tags_are_named(tmp_path: Path, height: float, named: bool) -> None:
    folder = survey_folder(tmp_path / "f", 3)
    rows = "".join(f"DJI_000{i + 1}.JPG,{9.1234567 + i * 2.7e-4},48.7654321,{height}\n" for i in range(3))
    (tmp_path / "pos.csv").write_text("name,lon,lat,altitude\n" + rows)
    survey = read_survey(SurveyInputs(folder, pos=tmp_path / "pos.csv"))
    texts = [w.text for w in survey.warnings if w.code == "heights-elsewhere"]
    assert bool(texts) == named and all("name the column height_ft" in text for text in texts)


def test_a_system_that_metashape_misspells_is_that_of_its_code(tmp_path: Path) -> None:
    """Its CH1903+ / LV95 has a parameter that PROJ doesn't know. Truth: EPSG:2056's own false origin."""
    wkt = (
        'PROJCS["CH1903+ / LV95",GEOGCS["CH1903+",DATUM["CH1903+",SPHEROID["Bessel 1841",6377397.155,'
        '299.1528128,AUTHORITY["EPSG","7004"]],TOWGS84[674.374,15.056,405.346,0,0,0,0],'
        'AUTHORITY["EPSG","6150"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],'
        'UNIT["degree",0.01745329251994328,AUTHORITY["EPSG","9102"]],AUTHORITY["EPSG","4150"]],'
        'PROJECTION["Oblique_Mercator",AUTHORITY["EPSG","9815"]],'
        'PARAMETER["latitude_of_center",46.95240555555561],PARAMETER["longitude_of_center",7.439583333333329],'
        'PARAMETER["azimuth",90],PARAMETER["recitified_grid_angle",90],PARAMETER["scale_factor",1],'
        'PARAMETER["false_easting",2600000],PARAMETER["false_northing",1200000],'
        'UNIT["metre",1,AUTHORITY["EPSG","9001"]],AUTHORITY["EPSG","2056"]]'
    )
    head = "#Label,X/Easting,Y/Northing,Z/Altitude,Yaw,Pitch,Roll\n"
    (row,) = pos(tmp_path, f"# CoordinateSystem: {wkt}\n{head}a.jpg,2600000,1200000,560,0,0,0\n").rows
    assert (row.lon_deg, row.lat_deg) == pytest.approx((7.438632, 46.951083), abs=1e-6)
