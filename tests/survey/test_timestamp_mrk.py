"""DJI's Timestamp.MRK as a file of positions."""

from __future__ import annotations

from pathlib import Path

import pytest

from geomosaic.errors import InputError
from geomosaic.survey.folder import project_files
from geomosaic.survey.names import FrameNames
from geomosaic.survey.pos import read_pos
from geomosaic.survey.pos_row import PosFile

LINES = (
    "1\t376539.199123\t[2226]\t   12,N\t   -3,E\t  223,V\t-42.09046032,Lat\t87.39957843,Lon\t618.123,Ellh\t"
    "0.012345, 0.030432, 0.045678\t50,Q\n"
    "2\t376541.199123\t[2226]\t   14,N\t   -5,E\t  221,V\t-42.09046132,Lat\t87.39967843,Lon\t618.223,Ellh\t"
    "0.900000, 0.800000, 1.700000\t34,Q\n"
    "3\t376543.199123\t[2226]\t    0,N\t    0,E\t    0,V\t0.00000000,Lat\t0.00000000,Lon\t0.000,Ellh\t"
    "0.000000, 0.000000, 0.000000\t0,Q\n"
)


def read(folder: Path, text: str, *names: str) -> PosFile:
    path = folder / "DJI_202308141235_001_Timestamp.MRK"
    path.write_text(text)
    return read_pos(path, frames=FrameNames(names))


def test_each_exposure_is_a_frames_position(tmp_path: Path) -> None:
    """The numbers in the names count, of all cameras that took the exposure; the order of lines does not."""
    names = [f"DJI_20230814123501_{n:04d}_{kind}.JPG" for n in (3, 2, 1) for kind in "VT"]
    found = read(tmp_path, LINES, *names)
    assert [r.name for r in found.rows] == [
        "DJI_20230814123501_0001_T.JPG", "DJI_20230814123501_0001_V.JPG",
        "DJI_20230814123501_0002_T.JPG", "DJI_20230814123501_0002_V.JPG",
    ]  # fmt: skip
    first, _, float_fix, _ = found.rows
    assert (first.lon_deg, first.lat_deg, first.height_ellipsoidal_m) == (87.39957843, -42.09046032, 618.123)
    assert (first.sd_east_m, first.sd_north_m, first.sd_vertical_m) == (0.030432, 0.02, 0.045678)
    assert (float_fix.sd_east_m, float_fix.sd_north_m, float_fix.sd_vertical_m) == (0.8, 0.9, 1.7)
    assert found.datum_stated and first.yaw_deg is None
    (warning,) = found.warnings
    assert warning.code == "pos-no-fix" and "1 exposures" in warning.text


def test_renamed_frames_go_by_their_order(tmp_path: Path) -> None:
    found = read(tmp_path, LINES, "field c.jpg", "field a.jpg", "field b.jpg")
    assert [(r.name, r.line) for r in found.rows] == [("field a.jpg", 1), ("field b.jpg", 2)]


def test_other_frames_and_other_files_are_named_errors(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="3 exposures, and the names"):
        read(tmp_path, LINES, "a.jpg", "b.jpg")
    with pytest.raises(InputError, match="don't match"):
        read(tmp_path, LINES, *(f"DJI_2023081{day}_{n:04d}_V.JPG" for day in (4, 5) for n in (1, 2, 3)))
    with pytest.raises(InputError, match="line 2 is no exposure"):
        read(tmp_path, LINES.splitlines(keepends=True)[0] + "frame,lat,lon\n", "a.jpg", "b.jpg")
    with pytest.raises(InputError, match="line 1: 142"):
        read(tmp_path, LINES.replace("-42.09046032", "142.09"), *(f"{n}.jpg" for n in (1, 2, 3)))


def test_the_drones_file_next_to_the_frames_is_found(tmp_path: Path) -> None:
    for name in ("1.jpg", "2.jpg", "3.jpg"):
        (tmp_path / name).touch()
    read(tmp_path, LINES, "1.jpg", "2.jpg", "3.jpg")
    assert project_files(tmp_path)["pos"].name.endswith("Timestamp.MRK")
    (tmp_path / "7.jpg").touch()
    assert "pos" not in project_files(tmp_path), "of another flight"
    (tmp_path / "geo.txt").write_text("EPSG:4326\n")
    assert project_files(tmp_path)["pos"].name == "geo.txt"


@pytest.mark.parametrize("name", ["DJI_20240611103000_{:04d}_V_Solar2.JPG", "DJI_20240611_{:04d} (1).JPG"])
def test_a_digit_behind_the_number_is_none_of_it(tmp_path: Path, name: str) -> None:
    found = read(tmp_path, LINES, *(name.format(n) for n in (3, 1, 2)))
    assert [(r.name, r.line) for r in found.rows] == [(name.format(1), 1), (name.format(2), 2)]


def test_all_float_solutions_state_their_deviations(tmp_path: Path) -> None:
    """Qualities 32 to 49 are floating point solutions: DJI Matrice 4 Series, User Manual."""
    text = LINES.replace("\t34,Q", "\t48,Q")
    row = read(tmp_path, text, "1.jpg", "2.jpg", "3.jpg").rows[1]
    assert (row.sd_east_m, row.sd_north_m, row.sd_vertical_m) == (0.8, 0.9, 1.7)
