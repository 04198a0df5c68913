"""A reference system in a table's first line also holds for columns of longitude and latitude.

Truth is PROJ's own: coordinates of known places by EPSG code.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS, Transformer

from geomosaic.errors import InputError
from geomosaic.geodesy.crs_names import stated_crs
from geomosaic.survey.control import read_control
from geomosaic.survey.names import FrameNames
from geomosaic.survey.pos import read_pos
from geomosaic.survey.pos_row import PosFile

LONDON = (-0.1276, 51.5072)


def pos(folder: Path, text: str, crs: str | None = None) -> PosFile:
    (folder / "pos.txt").write_text(text)
    return read_pos(folder / "pos.txt", crs=crs)


def at(code: str) -> tuple[float, float]:
    x, y = Transformer.from_crs("EPSG:4326", code, always_xy=True).transform(*LONDON)
    return float(x), float(y)


@pytest.mark.parametrize("head", ["EPSG:32630", "WGS84 UTM 30N", "# EPSG:32630"])
def test_eastings_in_columns_of_longitude_are_read_as_such(tmp_path: Path, head: str) -> None:
    east, north = at("EPSG:32630")
    row = f"{head}\n{{}},lon,lat,height_m\n{{}},{east:.4f},{north:.4f},70\n"
    (frame,) = pos(tmp_path, row.format("frame", "a.jpg")).rows
    (tmp_path / "gcp.txt").write_text(row.format("name", "P"))
    (point,) = read_control(tmp_path / "gcp.txt", FrameNames(["a.jpg"])).points
    for found in (frame, point):
        assert (found.lon_deg, found.lat_deg) == pytest.approx(LONDON, abs=1e-8)
        assert found.height_ellipsoidal_m == 70.0


def test_degrees_of_another_datum_are_its(tmp_path: Path) -> None:
    """The British datum of 1936 lies 100 m off."""
    lon, lat = at("EPSG:4277")
    table = f"frame,lon,lat\na.jpg,{lon:.9f},{lat:.9f}\n"
    for file in (pos(tmp_path, f"EPSG:4277\n{table}"), pos(tmp_path, table, crs="EPSG:4277")):
        assert (file.rows[0].lon_deg, file.rows[0].lat_deg) == pytest.approx(LONDON, abs=1e-7)
    assert abs(lon - LONDON[0]) > 1e-3


@pytest.mark.parametrize("code", ["EPSG:4326+5773", "EPSG:32630+5773"])
def test_heights_count_from_the_datum_of_the_first_line(tmp_path: Path, code: str) -> None:
    """Also where only x and y are in that system, and the table has both. The geoid (EGM96) lies 46 m above
    the ellipsoid there."""
    east, north = at("EPSG:32630")
    both = (",x,y", f",{east:.3f},{north:.3f}") if "32630" in code else ("", "")
    text = f"{code}\nframe,lon,lat,height_m{both[0]}\na.jpg,{LONDON[0]},{LONDON[1]},70{both[1]}\n"
    file = pos(tmp_path, text)
    assert file.rows[0].height_ellipsoidal_m == pytest.approx(116.0, abs=1.0)
    assert file.datum_stated and not file.warnings
    (row,) = pos(tmp_path, text.replace(code, "EPSG:4979")).rows if "4326" in code else file.rows
    assert "4326" not in code or row.height_ellipsoidal_m == 70.0


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("EPSG:32632+EGM96 height", "EPSG:32632+5773"),
        ("EPSG:32632 + egm96", "EPSG:32632+5773"),
        ("# EPSG:25832+DHHN2016 height", "EPSG:25832+7837"),
        ("WGS 84 / UTM zone 33N (EPSG:32633) + EGM2008 height", "EPSG:32633+3855"),
        ("EPSG:32633 (WGS 84 / UTM zone 33N) + EPSG:5773 (EGM96 height)", "EPSG:32633+5773"),
        ("WGS 84 / UTM zone 33N+EPSG:5773", "EPSG:32633+5773"),
        ("urn:ogc:def:crs,crs:EPSG::32632,crs:EPSG::5773", "EPSG:32632+5773"),
        ("CH1903+ / LV95 (EPSG:2056) + LN02 height", "EPSG:2056+5728"),
        ("EPSG:2056 (CH1903+ / LV95)", "EPSG:2056"),
        ("+init=epsg:32632 +no_defs", "EPSG:32632"),
    ],
)
def test_heights_named_with_a_code_are_read(text: str, code: str) -> None:
    found = stated_crs(text)
    assert found is not None
    (crs,), expected = found.meant(found.groups[0]), CRS(code)
    assert crs.is_compound == expected.is_compound
    parts = zip(crs.sub_crs_list or [crs], expected.sub_crs_list or [expected], strict=True)
    assert all(part.to_authority() == meant.to_authority() for part, meant in parts)


@pytest.mark.parametrize(
    "text", ["EPSG:32632+EGM97 height", "EPSG:32632 + sea", "EPSG:32632+", "EPSG:32632+32633"]
)
def test_heights_of_an_unknown_datum_are_refused(text: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"pos\.txt: line 1: .*PROJ knows"):
        pos(tmp_path, f"{text}\nframe,x,y,height_m\na.jpg,500000,5300000,70\n")


def test_degrees_under_a_map_projection_are_refused(tmp_path: Path) -> None:
    table = "frame,lon,lat\na.jpg,-0.1276,51.5072\n"
    with pytest.raises(
        InputError, match=r"pos\.txt: line 1 states the map projection 'EPSG:32630', and long"
    ):
        pos(tmp_path, f"EPSG:32630\n{table}")
    (row,) = pos(tmp_path, table, crs="EPSG:32630").rows  # which may be meant for the control points
    assert np.allclose((row.lon_deg, row.lat_deg), LONDON)


@pytest.mark.parametrize(("line", "given"), [("EPSG:32630+5773\n", None), ("", "EPSG:32630+5773")])
def test_heights_of_a_table_with_both_places_count_from_the_stated_datum(
    tmp_path: Path, line: str, given: str | None
) -> None:
    """In the first line, or by --pos-crs."""
    east, north = at("EPSG:32630")
    columns, row = "lon,lat,height_m,x,y", f"{LONDON[0]},{LONDON[1]},70,{east:.3f},{north:.3f}"
    file = pos(tmp_path, f"{line}frame,{columns}\na.jpg,{row}\n", crs=given)
    assert file.rows[0].height_ellipsoidal_m == pytest.approx(116.0, abs=1.0)
    assert file.datum_stated and not file.warnings
    (tmp_path / "gcp.txt").write_text(f"{line}name,{columns},image,col,row\nP,{row},a.jpg,1,2\n")
    (point,) = read_control(tmp_path / "gcp.txt", FrameNames(["a.jpg"]), crs=given).points
    assert point.height_ellipsoidal_m == pytest.approx(116.0, abs=1.0)
