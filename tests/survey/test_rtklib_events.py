"""RTKLIB's and Emlid Studio's events as positions of frames."""

from __future__ import annotations

from pathlib import Path

import pytest

from geomosaic.errors import InputError
from geomosaic.survey.names import FrameNames
from geomosaic.survey.pos import read_pos
from geomosaic.survey.pos_row import PosFile

HEADER = """% program   : RTKLIB EX 2.5.0 Emlid
% inp file  : raw_202306181011_RINEX_3_03\\raw.23O
% out height : ellipsoidal
% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)
%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)
"""
EVENTS = """2023/06/18 08:11:31.364   47.123456789   -1.123456789   612.1234   1  17   0.0250   0.0140   0.0402  0.0
2023/06/18 08:11:33.365   47.123556789   -1.123456789   612.2234   2  16   0.1250   0.1140   0.2402  0.0
2023/06/18 08:11:35.366   47.123656789   -1.123456789   612.3234   5   9   2.1250   2.1140   4.2402  0.0
"""


def read(folder: Path, text: str, *names: str) -> PosFile:
    path = folder / "flight_events.pos"
    path.write_text(text, encoding="utf-8")
    return read_pos(path, frames=FrameNames(names))


def test_the_nth_event_is_the_nth_frames(tmp_path: Path) -> None:
    found = read(tmp_path, HEADER + EVENTS, "DSC10.JPG", "DSC9.JPG", "DSC11.JPG")
    assert [row.name for row in found.rows] == ["DSC9.JPG", "DSC10.JPG", "DSC11.JPG"]
    first, second, third = found.rows
    assert (first.lon_deg, first.lat_deg, first.height_ellipsoidal_m) == (
        -1.123456789,
        47.123456789,
        612.1234,
    )
    assert (first.sd_east_m, first.sd_north_m, first.sd_vertical_m) == pytest.approx(
        (0.02, 0.025, 0.0402), abs=0.01
    )
    assert second.sd_north_m is not None and third.sd_north_m is not None
    assert 0.1 < second.sd_north_m < third.sd_north_m
    assert found.datum_stated


def test_captures_of_a_rig_count_where_they_are_as_many_as_the_events(tmp_path: Path) -> None:
    path = tmp_path / "flight_events.pos"
    path.write_text(HEADER + EVENTS, encoding="utf-8")
    rig = [("a_R.tif", "a_N.tif"), ("c_R.tif", "c_N.tif"), ("b_R.tif", "b_N.tif")]
    of_rig = read_pos(path, frames=FrameNames([n for names in rig for n in names], rig))
    found = [(row.name, row.height_ellipsoidal_m) for row in of_rig.rows]
    assert found[:3] == [("a_R.tif", 612.1234), ("a_N.tif", 612.1234), ("c_R.tif", 612.2234)]
    assert len(found) == 6
    alike = FrameNames(["b.jpg", "a.jpg", "c.jpg"], [("b.jpg", "a.jpg", "c.jpg")])
    assert [row.name for row in read_pos(path, frames=alike).rows] == ["b.jpg", "a.jpg", "c.jpg"]


def test_heights_above_the_sea_state_no_datum(tmp_path: Path) -> None:
    geodetic = HEADER.replace("out height : ellipsoidal", "out height : geodetic")
    assert not read(tmp_path, geodetic + EVENTS, "a1.jpg", "a2.jpg", "a3.jpg").datum_stated


def test_other_counts_and_other_columns_are_named_errors(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has 3 events, and there are 2 frames"):
        read(tmp_path, HEADER + EVENTS, "a1.jpg", "a2.jpg")
    with pytest.raises(InputError, match=r"names no latitude\(deg\)"):
        read(
            tmp_path, HEADER.replace("latitude(deg)", "latitude(d'\")") + EVENTS, "a1.jpg", "a2.jpg", "a3.jpg"
        )
    with pytest.raises(InputError, match="line 8 is no event"):
        read(tmp_path, HEADER + EVENTS.replace("47.123656789", "forty"), "a1.jpg", "a2.jpg", "a3.jpg")


@pytest.mark.parametrize(("old", "new"), [("   1  17", " nan  17"), ("   1  17", " inf  17")])
def test_a_quality_that_is_no_number_is_a_named_error(tmp_path: Path, old: str, new: str) -> None:
    with pytest.raises(InputError, match="line 6"):
        read(tmp_path, HEADER + EVENTS.replace(old, new), "a.jpg", "b.jpg", "c.jpg")


def test_an_event_at_zero_is_a_named_error(tmp_path: Path) -> None:
    text = HEADER + EVENTS.replace("47.123456789   -1.123456789", "0.000000000    0.000000000")
    with pytest.raises(InputError, match="line 6"):
        read(tmp_path, text, "a.jpg", "b.jpg", "c.jpg")
