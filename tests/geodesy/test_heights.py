"""Heights above the sea: the EGM96 of the package, names of height datums, and grids that are fetched."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyproj
import pytest
import rasterio
from geoids import egm96_of
from pyproj import CRS
from rasterio.transform import Affine
from small_surveys import geomosaic
from survey_files import survey_folder
from web_server import Server

from geomosaic.errors import InputError
from geomosaic.geodesy import egm96
from geomosaic.geodesy.heights import ellipsoidal_offset_m, ellipsoidal_offsets_m, height_datum
from geomosaic.survey.control import read_control
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.model import Survey
from geomosaic.survey.names import FrameNames
from geomosaic.survey.pos import read_pos
from geomosaic.survey.read import check_survey_files, read_survey

FULL = Path("/usr/share/proj/egm96_15.gtx")
"""PROJ's grid of EGM96, where the system's PROJ has one."""
NGA = (
    (38.6281550, -90.2208450, -31.628), (-14.6212170, -54.9788860, -2.969), (46.8743190, 102.4487290, -43.575),
    (-23.6174460, 133.8747120, 15.871), (38.6254730, -0.0005000, 50.066), (-0.4667440, 0.0023000, 17.329),
)  # fmt: skip
"""Latitude, longitude and undulation of EGM96's spherical harmonics: NGA's OUTPUT.DAT of program F477."""
LON, LAT = 9.1234567, 48.7654321


def test_the_built_in_egm96_agrees_with_the_published_undulations() -> None:
    lat, lon, published = np.array(NGA).T
    assert np.abs(egm96.undulation_m(lon, lat) - published).max() < 0.06


@pytest.mark.skipif(not FULL.is_file(), reason="the system's PROJ has no EGM96")
def test_the_built_in_egm96_is_proj_s_grid_to_5_mm() -> None:
    rng = np.random.default_rng(3)
    lon, lat = rng.uniform(-180.0, 180.0, 20_000), np.degrees(np.arcsin(rng.uniform(-1.0, 1.0, 20_000)))
    pipeline = f"+proj=pipeline +step +proj=vgridshift +grids={FULL} +multiplier=1"
    full = pyproj.Transformer.from_pipeline(pipeline).transform(lon, lat, np.zeros(lon.size))[2]
    assert np.abs(egm96.undulation_m(lon, lat) - full).max() < 0.0051


def test_the_built_in_egm96_closes_at_180_degrees_and_at_the_poles() -> None:
    east, west = (egm96.undulation_m(np.array(lon), np.array(10.1)) for lon in (179.9999999, -180.0))
    assert east == pytest.approx(west, abs=1e-4)
    poles = egm96.undulation_m(np.array([0.0, 123.0, 0.0, 77.0]), np.array([90.0, 90.0, -90.0, -90.0]))
    assert poles == pytest.approx([13.61, 13.61, -29.53, -29.53])


def test_proj_s_grid_counts_where_there_is_one(tmp_path: Path) -> None:
    crs = CRS.from_epsg(5773)
    assert ellipsoidal_offset_m(crs, 11.0, 47.0) == pytest.approx(49.61, abs=0.01)
    with egm96_of(tmp_path):
        assert ellipsoidal_offset_m(crs, 11.0, 47.0) == pytest.approx(40.0, abs=1e-3)
        assert ellipsoidal_offset_m(crs, 30.0, 60.0) == pytest.approx(
            float(egm96.undulation_m(np.array(30.0), np.array(60.0)))
        ), "beyond its edge"


@pytest.mark.parametrize("name", ["EGM96", "egm96", "EPSG:5773"])
def test_names_of_a_height_datum(name: str) -> None:
    assert height_datum(name).to_epsg() == 5773
    assert ellipsoidal_offsets_m(height_datum("ellipsoidal"), np.array([9.0]), np.array([48.0])) == 0.0


@pytest.mark.parametrize("wrong", ["EGM97", "EPSG:32632", "EPSG:32632+5773", "sea"])
def test_other_names_are_refused_before_the_run(wrong: str, tmp_path: Path) -> None:
    inputs = SurveyInputs(survey_folder(tmp_path / "f"), height_datum=wrong)
    with pytest.raises(InputError, match=r"vertical.*give ellipsoidal, EGM96, EGM2008, or the code"):
        check_survey_files(inputs)


def above_sea(survey: Survey) -> float:
    return float(egm96.undulation_m(np.array(LON), np.array(LAT)))


def test_tags_count_from_the_datum_given(tmp_path: Path) -> None:
    folder = survey_folder(tmp_path / "f")
    plain, datum = (read_survey(SurveyInputs(folder, height_datum=d)) for d in (None, "EGM96"))
    raised = [
        (b.position.height_ellipsoidal_m or 0.0) - (a.position.height_ellipsoidal_m or 0.0)
        for a, b in zip(plain.frames, datum.frames, strict=True)
    ]
    assert raised == pytest.approx([above_sea(plain)] * 4, abs=0.01)
    assert "height-datum-unknown" in [w.code for w in plain.warnings]
    assert "height-datum-unknown" not in [w.code for w in datum.warnings]
    assert all(f.position.datum_stated for f in datum.frames)
    same = read_survey(SurveyInputs(folder, height_datum="ellipsoidal"))
    assert same.frames[0].position.height_ellipsoidal_m == plain.frames[0].position.height_ellipsoidal_m
    assert same.frames[0].position.datum_stated


@pytest.mark.parametrize(
    ("column", "datum", "above"),
    [("alt", "EGM96", True), ("alt", "ellipsoidal", False), ("height_ellipsoidal_m", "EGM96", False),
     ("height_orthometric", "EGM96", True), ("height_orthometric", None, True),
     ("height_orthometric", "ellipsoidal", True)],
)  # fmt: skip
def test_pos_and_control_count_from_the_datum_given(
    column: str, datum: str | None, above: bool, tmp_path: Path
) -> None:
    folder = survey_folder(tmp_path / "f")
    pos, gcp = tmp_path / "pos.csv", tmp_path / "gcp.csv"
    names = sorted(p.name for p in folder.iterdir())
    rows = [f"{name},{LON + 2.7e-4 * k},{LAT},500.0" for k, name in enumerate(names)]
    pos.write_text("\n".join([f"frame,lon,lat,{column}", *rows]) + "\n", encoding="utf-8")
    marks = [f"P{k},{LON},{LAT},400.0,{names[0]},{20 + k},30" for k in range(3)]
    gcp.write_text("\n".join([f"name,lon,lat,{column},image,col,row", *marks]) + "\n", encoding="utf-8")
    survey = read_survey(SurveyInputs(folder, pos=pos, gcp=gcp, height_datum=datum))
    raised = above_sea(survey) if above else 0.0
    assert survey.frames[0].position.height_ellipsoidal_m == pytest.approx(500.0 + raised, abs=0.01)
    assert survey.control[0].height_ellipsoidal_m == pytest.approx(400.0 + raised, abs=0.01)
    assumed = {w.code for w in survey.warnings} & {"height-datum-assumed", "geoid-assumed"}
    assert assumed == ({"geoid-assumed"} if column == "height_orthometric" and datum != "EGM96" else set())


def test_a_dem_without_datum_counts_from_the_datum_given(tmp_path: Path) -> None:
    folder, dem = survey_folder(tmp_path / "f"), tmp_path / "dem.tif"
    place = {"crs": "EPSG:4326", "transform": Affine(0.001, 0, 9.0, 0, -0.001, 49.0)}
    with rasterio.open(dem, "w", "GTiff", 300, 300, 1, dtype="float32", **place) as tiff:
        tiff.write(np.full((1, 300, 300), 300.0, np.float32))
    survey = read_survey(SurveyInputs(folder, dem=dem, height_datum="EGM96"))
    assert survey.elevation is not None
    assert survey.elevation.offset_m == pytest.approx(above_sea(survey), abs=0.01)
    assert "dem-datum-assumed" not in [w.code for w in survey.warnings]


@pytest.mark.parametrize(
    ("places", "undulations"),
    [
        ([(179.998, -16.8), (-179.998, -16.8)], [52.117, 52.103]),
        ([(7.0 + k / 25.0, 46.0) for k in range(5)], [51.280, 51.408, 51.536, 51.664, 51.792]),
        ([(9.1, 48.7), (9.1, 48.7), (13.0, 52.0)], [48.625, 48.625, 41.810]),
    ],
)
def test_each_row_of_a_table_has_the_geoid_of_its_place(
    places: list[tuple[float, float]], undulations: list[float], tmp_path: Path
) -> None:
    """On both sides of 180 degrees, along 12 km, and in a list of a whole region."""
    pos, gcp = tmp_path / "pos.csv", tmp_path / "gcp.csv"
    rows = [f"{k}.jpg,{lon},{lat},100" for k, (lon, lat) in enumerate(places)]
    pos.write_text("\n".join(["frame,lon,lat,height_orthometric", *rows]), encoding="utf-8")
    marks = [f"{row},0.jpg,{k},30" for k, row in enumerate(rows)]
    gcp.write_text("\n".join(["name,lon,lat,height,image,col,row", *marks]), encoding="utf-8")
    found = [row.height_ellipsoidal_m for row in read_pos(pos).rows]
    assert found == pytest.approx(np.array(undulations) + 100.0, abs=0.002)
    points = read_control(gcp, FrameNames(["0.jpg"]), datum=height_datum("EGM96")).points
    assert [p.height_ellipsoidal_m for p in points] == pytest.approx(found, abs=1e-9)


def test_proj_s_grid_counts_on_both_sides_of_180_degrees(tmp_path: Path) -> None:
    """A geoid of 30 m about the line, and of no other place."""
    head = struct.pack(">4d2i", -18.0, 179.0, 0.25, 0.25, 9, 9)
    (tmp_path / "egm96_15.gtx").write_bytes(head + np.full(81, 30.0, ">f4").tobytes())
    lon, lat = np.array([179.998, -179.998]), np.array([-16.8, -16.8])
    before = pyproj.datadir.get_data_dir()
    pyproj.datadir.set_data_dir(f"{before}:{tmp_path}")
    try:
        found = ellipsoidal_offsets_m(CRS.from_epsg(5773), lon, lat)
    finally:
        pyproj.datadir.set_data_dir(before)
    assert found == pytest.approx([30.0, 30.0])


def test_a_model_without_its_grid_names_a_step_that_works(tmp_path: Path) -> None:
    folder = survey_folder(tmp_path / "f")
    message = (
        r"'EGM2008 height' is not installed; install it: geomosaic geoid fetch us_nga_egm08_25\.tif; or "
    )
    with pytest.raises(InputError, match=message + "give --height-datum EGM96"):
        read_survey(SurveyInputs(folder, height_datum="EGM2008"))
    assert read_survey(SurveyInputs(folder, height_datum="EGM96")).frames


def grid(path: Path) -> Path:
    """A geoid 20 m below the ellipsoid, as PROJ's collection has them."""
    kind = {"crs": "EPSG:4979", "transform": Affine(1, 0, 5, 0, -1, 52), "dtype": "float32", "count": 1}
    with rasterio.open(path, "w", driver="GTiff", width=9, height=9, **kind) as tiff:
        tiff.write(np.full((1, 9, 9), -20.0, np.float32))
        tiff.update_tags(TYPE="VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL", AREA_OR_POINT="Point")
        tiff.update_tags(1, DESCRIPTION="geoid_undulation", UNITTYPE="metre")
    return path


def fetched(home: Path, *given: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PROJ_USER_WRITABLE_DIRECTORY": str(home)}
    command = [sys.executable, "-m", "geomosaic.cli.main", "geoid", "fetch", *given]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    "by",
    [
        pytest.param("file", marks=pytest.mark.proof),
        "folder",
        "server",
        pytest.param("name", marks=pytest.mark.proof),
    ],
)
def test_a_fetched_grid_is_used(by: str, tmp_path: Path) -> None:
    there, home = tmp_path / "there", tmp_path / "home"
    there.mkdir()
    home.mkdir()
    file = grid(there / ("other.tif" if by == "file" else "us_nga_egm08_25.tif"))
    name = "us_nga_egm08_25.tif" if by == "name" else "EGM2008"
    with Server(there) as server:
        source = {"file": str(file), "server": server.url("")}.get(by, str(there))
        done = fetched(home, name, "--from", source)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[-1] == str(home / "us_nga_egm08_25.tif")
    script = (
        "import sys; from pathlib import Path; from geomosaic.survey.read import read_survey; "
        "from geomosaic.survey.inputs import SurveyInputs; "
        "inputs = SurveyInputs(Path(sys.argv[1]), height_datum='EGM2008'); "
        "print(read_survey(inputs).frames[0].position.height_ellipsoidal_m)"
    )
    folder = survey_folder(tmp_path / "f")
    plain = read_survey(SurveyInputs(folder)).frames[0].position.height_ellipsoidal_m or 0.0
    environment = {**os.environ, "PROJ_USER_WRITABLE_DIRECTORY": str(home)}
    command = [sys.executable, "-c", script, str(folder)]
    found = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert float(found.stdout) == pytest.approx(plain - 20.0, abs=1e-3)
    again = fetched(home, "EGM2008")
    assert (again.returncode, again.stdout) == (0, "installed  EGM2008 is there already\n")


def test_what_is_no_grid_is_refused_and_nothing_stays(tmp_path: Path) -> None:
    page, home = tmp_path / "us_nga_egm08_25.tif", tmp_path / "home"
    page.write_text("no grid", encoding="utf-8")
    home.mkdir()
    done = fetched(home, "EGM2008", "--from", str(page))
    assert done.returncode == 2 and "it is no grid that PROJ reads" in done.stderr
    assert not [*home.iterdir()]
    assert "there is no such file" in fetched(home, "EGM2008", "--from", str(home)).stderr


def test_a_name_without_a_grid_to_fetch_is_refused(capfd: pytest.CaptureFixture[str]) -> None:
    assert geomosaic("geoid", "fetch", "EPSG:5798") == 2
    line = capfd.readouterr().err.strip().splitlines()[-1]
    assert "PROJ knows no grid of 'EGM84 height' that can be fetched; give the file's name" in line
