"""Control, positions and elevation models in feet, as surveys of the United States have them.

Truth is PROJ's own: State Plane coordinates of a known place by EPSG code.
"""

import struct
from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer

from geomosaic.errors import InputError
from geomosaic.survey.column_names import column_of
from geomosaic.survey.control import read_control
from geomosaic.survey.model import ControlPoint
from geomosaic.survey.names import FrameNames
from geomosaic.survey.pos import read_pos

NEW_YORK_EAST = "EPSG:2260"
"""NAD83, US survey feet."""
MICHIGAN = "EPSG:2253"
"""NAD83, international feet."""
PLACES = {NEW_YORK_EAST: (-74.5, 42.0), MICHIGAN: (-84.4, 43.0)}
FOOT_M = {NEW_YORK_EAST: 1200.0 / 3937.0, MICHIGAN: 0.3048}


def control(tmp_path: Path, text: str) -> tuple[ControlPoint, list[str]]:
    """The only point of a file, and what was assumed."""
    path = tmp_path / "gcp_list.txt"
    path.write_text(text)
    file = read_control(path, FrameNames(("a.jpg",)))
    (point,) = file.points
    return point, [note.code for note in file.notes]


def feet(code: str) -> tuple[float, float]:
    """Easting and northing of a State Plane's place."""
    east, north = Transformer.from_crs("EPSG:4326", code, always_xy=True).transform(*PLACES[code])
    return float(east), float(north)


@pytest.mark.parametrize("code", PLACES)
def test_heights_count_as_x_and_y_do(code: str, tmp_path: Path) -> None:
    """Taken as metres they tilt the block (OpenDroneMap's issue 1932)."""
    x, y = feet(code)
    point, notes = control(tmp_path, f"{code}\n{x:.3f} {y:.3f} 820.21 1 2 a.jpg P\n")
    assert (point.lon_deg, point.lat_deg) == pytest.approx(PLACES[code], abs=1e-8)
    assert point.height_ellipsoidal_m == pytest.approx(820.21 * FOOT_M[code], abs=1e-9)
    assert notes == ["datum-shift-unsure", "height-unit-assumed", "height-datum-assumed"]


@pytest.mark.parametrize("code", PLACES)
@pytest.mark.parametrize(
    ("names", "per_metre"),
    [
        ("easting_{0},northing_{0},height_m", 1.0),
        ("Easting ({0}),Northing ({0}),Elevation (ft)", 0.3048),
        ("Easting [{0}],Northing [{0}],Elevation [US survey feet]", 1200.0 / 3937.0),
    ],
)
@pytest.mark.parametrize("unit", ["ft", "m", "ftUS"])
def test_a_unit_that_is_stated_counts(
    code: str, names: str, per_metre: float, unit: str, tmp_path: Path
) -> None:
    """Feet of x and y are those of the system: 2 ppm of 300 km are 0.6 m."""
    x, y = np.array(feet(code)) * (FOOT_M[code] if unit == "m" else 1.0)
    head = f"name,{names.format(unit)},image,col,row"
    point, notes = control(tmp_path, f"{code}\n{head}\nP,{x:.6f},{y:.6f},500,a.jpg,1,2\n")
    assert (point.lon_deg, point.lat_deg) == pytest.approx(PLACES[code], abs=1e-8)
    assert point.height_ellipsoidal_m == pytest.approx(500.0 * per_metre, abs=1e-9)
    assert "height-unit-assumed" not in notes


def test_feet_of_a_vertical_datum(tmp_path: Path) -> None:
    """The geoid lies 30 m below the ellipsoid: 820.21 US survey feet above it are 220 m above that."""
    grid = tmp_path / "low.gtx"
    grid.write_bytes(struct.pack(">4d2i", 30.0, -90.0, 10.0, 10.0, 3, 3) + np.full(9, -30.0, ">f4").tobytes())
    system = f"+proj=utm +zone=18 +datum=WGS84 +units=m +geoidgrids={grid} +vunits=us-ft +type=crs"
    x, y = Transformer.from_crs("EPSG:4326", "EPSG:32618", always_xy=True).transform(*PLACES[NEW_YORK_EAST])
    point, notes = control(tmp_path, f"{system}\n{x:.3f} {y:.3f} 820.21 1 2 a.jpg P\n")
    assert point.height_ellipsoidal_m == pytest.approx(820.21 * 1200.0 / 3937.0 - 30.0, abs=1e-3)
    assert notes == []


def test_positions_in_feet(tmp_path: Path) -> None:
    x, y = feet(NEW_YORK_EAST)
    path = tmp_path / "pos.csv"
    path.write_text(f"frame,x,y,z\na.jpg,{x:.3f},{y:.3f},1000\n")
    file = read_pos(path, crs=NEW_YORK_EAST)
    (row,) = file.rows
    assert row.height_ellipsoidal_m == pytest.approx(1000.0 * 1200.0 / 3937.0)
    assert "height-unit-assumed" in {w.code for w in file.warnings}


def test_units_at_the_end_of_a_name() -> None:
    aliases = {"height": ("height",)}
    assert [column_of(n, aliases) for n in ("height_us_ft", "Height [ft]", "height", "depth_m")] == [
        ("height", "us_ft"),
        ("height", "ft"),
        ("height", ""),
        (None, ""),
    ]
    with pytest.raises(InputError, match="unknown unit 'ell'"):
        column_of("height (ell)", aliases)


NEW_YORK = (-73.97, 40.78)
STATED_OR_GIVEN = [("EPSG:2263\n", None), ("", "EPSG:2263")]
"""Long Island in US survey feet, in the first line or by --pos-crs."""


@pytest.mark.parametrize(("line", "given"), STATED_OR_GIVEN)
def test_heights_next_to_longitude_and_latitude_count_as_x_and_y(
    line: str, given: str | None, tmp_path: Path
) -> None:
    """A table that has both places: 400 US survey feet are 121.92 m."""
    x, y = Transformer.from_crs("EPSG:4326", "EPSG:2263", always_xy=True).transform(*NEW_YORK)
    path = tmp_path / "gcp.csv"
    path.write_text(
        f"{line}name,easting,northing,elevation,longitude,latitude,image,col,row\n"
        f"P,{x:.3f},{y:.3f},400,{NEW_YORK[0]},{NEW_YORK[1]},a.jpg,1,2\n"
    )
    file = read_control(path, FrameNames(("a.jpg",)), crs=given)
    assert file.points[0].height_ellipsoidal_m == pytest.approx(121.92024, abs=1e-5)
    assert "height-unit-assumed" in {note.code for note in file.notes}


def test_all_heights_and_deviations_without_a_unit_count_as_x_and_y(tmp_path: Path) -> None:
    x, y = feet(MICHIGAN)
    path = tmp_path / "pos.csv"
    path.write_text(f"frame,x,y,z,agl,sd_e,sd_n,sd_z\na.jpg,{x:.3f},{y:.3f},1000,400,0.1,0.1,0.2\n")
    file = read_pos(path, crs=MICHIGAN)
    (row,) = file.rows
    assert row.height_above_ground_m == pytest.approx(121.92)
    assert (row.sd_east_m, row.sd_north_m) == pytest.approx((0.03048, 0.03048))
    assert row.sd_vertical_m == pytest.approx(0.06096)
    (text,) = [w.text for w in file.warnings if w.code == "height-unit-assumed"]
    assert "height, height_above_ground, sd_vertical" in text and "foot" in text
    path.write_text(f"frame,x,y,z_m,agl_m,sd_e_m,sd_n_m,sd_z_m\na.jpg,{x:.3f},{y:.3f},1000,400,1,1,2\n")
    file = read_pos(path, crs=MICHIGAN)
    (row,) = file.rows
    assert (row.height_ellipsoidal_m, row.height_above_ground_m) == (1000.0, 400.0)
    assert (row.sd_east_m, row.sd_vertical_m) == (1.0, 2.0)
    assert "height-unit-assumed" not in {w.code for w in file.warnings}


def test_deviations_of_control_in_feet(tmp_path: Path) -> None:
    x, y = feet(MICHIGAN)
    point, _ = control(
        tmp_path, f"{MICHIGAN}\nname,x,y,z,sd,image,col,row\nP,{x:.3f},{y:.3f},820.21,0.1,a.jpg,1,2\n"
    )
    assert (point.sd_horizontal_m, point.sd_vertical_m) == pytest.approx((0.03048, 0.03048))
