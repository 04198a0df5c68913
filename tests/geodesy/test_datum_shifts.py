"""Maps of other datums: one operation for a whole survey, its accuracy named, and grids that better it.

Truth are the EPSG dataset's parameters and accuracies. German places were computed by Helmert's formula and
Krueger's series.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
from pyproj import CRS, Geod
from rasterio.transform import Affine
from survey_files import drone_frame, survey_folder

from geomosaic.errors import InputError
from geomosaic.geodesy.mapcrs import MapProjection, one_operation
from geomosaic.survey.control import read_control
from geomosaic.survey.datum_shift import check_shift
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.names import FrameNames
from geomosaic.survey.read import read_survey
from geomosaic.survey.zone import zone_of

GAUSS_KRUGER = "EPSG:31468"
"""German datum of 1937: south of 50.2 degrees PROJ shifts it by other parameters than north of it."""
BORDERS = {GAUSS_KRUGER: (11.5, 50.2), "EPSG:26715": (-93.0, 49.05)}


def texts(code: str, place: tuple[float, float]) -> list[str]:
    return [w.text for w in check_shift(CRS(code), *place, "--crs")]


@pytest.mark.parametrize("code", BORDERS)
def test_a_map_has_no_tear_where_proj_changes_its_operation(code: str) -> None:
    """Steps of 228 m to the north are as long on the map, to its scale of 0.9996 or 1."""
    lon, lat = BORDERS[code]
    lonlat = np.column_stack([np.full(40, lon), np.linspace(lat - 0.04, lat + 0.04, 40)])
    steps_m = Geod(ellps="WGS84").line_lengths(*lonlat.T)
    torn = np.linalg.norm(np.diff(MapProjection(code).map_from_geodetic(*lonlat.T), axis=0), axis=1)
    assert np.ptp(torn - steps_m) > 0.9
    one = one_operation(code, lonlat)
    east_north = MapProjection(one).map_from_geodetic(*lonlat.T)
    assert np.ptp(np.linalg.norm(np.diff(east_north, axis=0), axis=1) - steps_m) < 0.001
    assert MapProjection(one).geodetic_from_map(*east_north.T) == pytest.approx(lonlat, abs=1e-8)
    assert CRS(one) == CRS(code) and CRS(one).to_authority() == tuple(code.split(":"))
    assert one_operation(one, lonlat) == one


def test_the_operation_is_that_of_the_middle() -> None:
    """22 m north of the border by the parameters of the south, EPSG:1777, and the other way round."""
    south, north = (
        one_operation(GAUSS_KRUGER, np.array([[11.5, 50.2 + off], [11.5, 50.2002 + off]]))
        for off in (-0.01, 0.01)
    )
    for name, lat, at in (
        (south, 50.19, (4464399.5005, 5561658.5750)),
        (south, 50.21, (4464414.3975, 5563883.2198)),
        (north, 50.21, (4464414.9136, 5563882.2612)),
    ):
        assert MapProjection(name).map_from_geodetic(11.5, lat) == pytest.approx(at, abs=1e-3)
    assert MapProjection(north).map_from_geodetic(11.5, 50.19) == pytest.approx(
        (4464400.0211, 5561657.6071), abs=1e-3
    )


def test_workers_take_the_same_operation() -> None:
    """A process that knows nothing but the name computes the same bits."""
    one = one_operation(GAUSS_KRUGER, np.array([[11.5, 50.19], [11.5, 50.205]]))
    here = MapProjection(one).map_from_geodetic([11.5, 11.6], [50.19, 50.25])
    script = (
        "import pickle, sys; projection = pickle.loads(bytes.fromhex(sys.argv[1])); "
        "print(projection.map_from_geodetic([11.5, 11.6], [50.19, 50.25]).tobytes().hex())"
    )
    command = [sys.executable, "-c", script, pickle.dumps(MapProjection(one)).hex()]
    there = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert there.strip() == here.tobytes().hex()


@pytest.mark.parametrize("code", ["EPSG:27700", "EPSG:25832", "EPSG:2334"])
def test_a_map_inside_one_operation_keeps_its_code(code: str) -> None:
    place = {"EPSG:27700": (-1.0, 52.0), "EPSG:25832": (9.0, 48.0), "EPSG:2334": (118.0, 36.0)}[code]
    assert one_operation(code, np.array([place, place]) + [[0.0, 0.0], [0.05, 0.05]]) == code


@pytest.mark.parametrize(
    ("code", "place", "datum"),
    [("EPSG:2334", (118.0, 36.0), "Xian 1980"), ("EPSG:2414", (118.0, 36.0), "Beijing 1954"),
     ("+proj=tmerc +lon_0=9 +ellps=bessel +units=m +type=crs", (9.0, 48.0), "Bessel 1841"),
     ("EPSG:3828", (121.0, 24.0), "Taiwan Datum 1967")],
)  # fmt: skip
def test_a_shift_that_proj_does_not_know_is_named(code: str, place: tuple[float, float], datum: str) -> None:
    (text,) = texts(code, place)
    assert text.startswith("--crs: PROJ knows no shift between WGS 84 and ") and datum in text
    assert "unchanged" in text and "give files and --crs in one system" in text


@pytest.mark.parametrize(
    ("code", "place", "accuracy", "grid"),
    [("EPSG:27700", (-1.0, 52.0), "2 m", "uk_os_OSTN15_NTv2_OSGBtoETRS.tif"),
     (GAUSS_KRUGER, (11.5, 50.1), "3 m", "de_adv_BETA2007.tif"),
     ("EPSG:26715", (-93.0, 49.05), "7 m", "ca_nrc_ntv2_0.tif"),
     ("EPSG:26915", (-93.0, 45.0), "4 m", "us_noaa_mnhpgn.tif"),
     ("EPSG:3003", (10.0, 44.0), "4 m", "")],
)  # fmt: skip
def test_a_coarse_shift_is_named_with_its_accuracy_and_the_missing_grid(
    code: str, place: tuple[float, float], accuracy: str, grid: str
) -> None:
    (text,) = texts(code, place)
    assert f"is accurate to {accuracy}, which stated deviations do not include; " in text
    assert (f"install the grid of a better one: geomosaic geoid fetch {grid}, or give" in text) == bool(grid)


@pytest.mark.parametrize(
    ("code", "place"),
    [("EPSG:32632", (9.0, 48.0)), ("EPSG:25832", (9.0, 48.0)), ("EPSG:4547", (114.0, 30.0)),
     ("EPSG:2961", (-64.0, 45.0)), ("EPSG:6344", (-93.0, 45.0)), ("EPSG:9988", (9.0, 48.0)),
     ("EPSG:2056", (8.0, 47.0)), ("EPSG:4326", (9.0, 48.0)), ("+proj=utm +zone=32 +ellps=GRS80", (9.0, 48.0))],
)  # fmt: skip
def test_datums_that_are_meant_to_agree_are_not_named(code: str, place: tuple[float, float]) -> None:
    """CGCS2000, NAD83(CSRS), NAD83(2011), ITRF2020: PROJ shifts by nothing, or knows no shift."""
    assert texts(code, place) == []


def test_a_table_in_another_datum_is_named_and_lies_on_its_own_map(tmp_path: Path) -> None:
    """Control across the border: on a map in its own system its coordinates come out as they went in."""
    for i, lat in enumerate((50.1995, 50.1998, 50.2003)):
        drone_frame(tmp_path / f"{i}.jpg", 11.5, lat, second=i)
    given = np.array([[4464407.0, 5562720.0], [4464407.0, 5562800.0], [4464407.0, 5562830.0]])
    rows = "".join(f"P{k},{x},{y},{k}.jpg,20,30\n" for k, (x, y) in enumerate(given))
    gcp = tmp_path / "gcp.csv"
    gcp.write_text(f"{GAUSS_KRUGER}\nname,x,y,image,col,row\n{rows}", encoding="utf-8")
    survey = read_survey(SurveyInputs(tmp_path, gcp=gcp, crs=GAUSS_KRUGER))
    on_map = MapProjection(survey.map_crs).map_from_geodetic(
        [p.lon_deg for p in survey.control], [p.lat_deg for p in survey.control]
    )
    assert on_map == pytest.approx(given, abs=1e-3)
    unsure = [w.text for w in survey.warnings if w.code == "datum-shift-unsure"]
    assert [text.partition(":")[0] for text in unsure] == ["--crs", "gcp.csv"]
    assert "which stated deviations do not include" in unsure[1]
    file = read_control(gcp, FrameNames(["0.jpg", "1.jpg", "2.jpg"]))
    assert "datum-shift-unsure" in [note.code for note in file.notes]


def test_a_fetched_grid_of_a_datum_is_used_and_ends_the_warning(tmp_path: Path) -> None:
    """A made-up grid under the name of the German one: 3.6 arc seconds south, 7.2 west to reach WGS 84."""
    home, there = tmp_path / "home", tmp_path / "de_adv_BETA2007.tif"
    home.mkdir()
    kind = {"crs": "EPSG:4314", "transform": Affine(1, 0, 5, 0, -1, 56), "dtype": "float32", "count": 2}
    with rasterio.open(there, "w", driver="GTiff", width=12, height=11, **kind) as tiff:
        tiff.write(np.stack([np.full((11, 12), off, np.float32) for off in (-3.6, -7.2)]))
        tiff.update_tags(TYPE="HORIZONTAL_OFFSET", AREA_OR_POINT="Point")
        for band, axis in enumerate(("latitude", "longitude"), start=1):
            tiff.update_tags(band, DESCRIPTION=f"{axis}_offset", UNITTYPE="arc-second")
            tiff.set_band_description(band, f"{axis}_offset")
            tiff.set_band_unit(band, "arc-second")
        tiff.update_tags(2, positive_value="east")
    environment = {**os.environ, "PROJ_USER_WRITABLE_DIRECTORY": str(home)}
    command = [sys.executable, "-m", "geomosaic.cli.main", "geoid", "fetch", there.name, "--from", str(there)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    script = (
        "from pyproj import CRS; from geomosaic.survey.datum_shift import check_shift; "
        "from geomosaic.geodesy.mapcrs import MapProjection; "
        "print(*MapProjection('EPSG:4314').map_from_geodetic(11.5, 50.19).tolist(), "
        f"check_shift(CRS('{GAUSS_KRUGER}'), 11.5, 50.19, ''))"
    )
    found = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    lon, lat, warned = found.stdout.split(maxsplit=2)
    assert (float(lon), float(lat)) == pytest.approx((11.502, 50.191), abs=1e-8)
    assert warned.strip() == "[]"


@pytest.mark.parametrize(
    ("crs", "scale"),
    [("EPSG:3857", "1.519"), ("EPSG:4087", "1.514"), ("EPSG:6933", "1.312")],
)
def test_a_map_out_of_scale_is_named_with_a_better_one(crs: str, scale: str, tmp_path: Path) -> None:
    """At 48.765 degrees Mercator's meridian is a / (M cos B) = 1.5187, a plate carree's parallel 1.5141."""
    survey = read_survey(SurveyInputs(survey_folder(tmp_path), crs=crs))
    (text,) = [w.text for w in survey.warnings if w.code == "crs-out-of-scale"]
    assert f"'{crs}': lengths and pixels on the map are {scale} times those on the ground" in text
    assert text.endswith("such as EPSG:32632")


@pytest.mark.parametrize("crs", ["auto", "EPSG:25832", "EPSG:32633", "EPSG:31467", "EPSG:3035"])
def test_a_map_true_to_a_hundredth_is_not_named(crs: str, tmp_path: Path) -> None:
    survey = read_survey(SurveyInputs(survey_folder(tmp_path), crs=crs))
    assert "crs-out-of-scale" not in [w.code for w in survey.warnings]


def test_a_map_without_coordinates_for_the_frames_is_refused(tmp_path: Path) -> None:
    """An orthographic view of the other side of the Earth."""
    far = "+proj=ortho +lat_0=-48 +lon_0=-168.7 +units=m"
    with pytest.raises(InputError, match=r"^--crs '\+proj=ortho.*no coordinates for the frames.*EPSG:32632"):
        read_survey(SurveyInputs(survey_folder(tmp_path), crs=far))


def test_the_proposed_zone_is_that_of_frames_on_both_sides_of_180_degrees() -> None:
    assert zone_of([(179.994, -16.8), (-179.998, -16.8)]) == "EPSG:32760"
    assert zone_of([(179.998, -16.8), (-179.994, -16.8)]) == "EPSG:32701"


def test_a_stranger_s_remark_moves_no_map() -> None:
    """A remark counts only where it is an operation that PROJ itself knows between the systems."""
    plain = CRS.from_user_input(GAUSS_KRUGER)
    remark = "proj=pipeline step proj=affine xoff=1000 step proj=utm zone=32"
    crs = CRS.from_json_dict({**plain.to_json_dict(), "remarks": remark}).to_wkt()
    assert "xoff=1000" in crs
    moved, own = (MapProjection(c).map_from_geodetic(12.0, 49.0) for c in (crs, plain.to_string()))
    assert moved == pytest.approx(own, abs=1e-3)
