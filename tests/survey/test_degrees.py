"""Longitudes and latitudes with minutes, seconds and letters of directions."""

from __future__ import annotations

from pathlib import Path

import pytest

from geomosaic.errors import InputError
from geomosaic.survey.degrees import degrees_of
from geomosaic.survey.pos import read_pos

SECONDS = 48.0 + 12.0 / 60.0 + 30.5 / 3600.0


@pytest.mark.parametrize(
    "text",
    [
        "48 deg 12' 30.50\" N",
        "48°12'30,5\"",
        "48°12′30.5″N",
        "N 48 12 30.5",
        "48:12:30.5",
        "48d12m30.5s",
        "48º12'30.5''",
    ],
)
def test_minutes_and_seconds(text: str) -> None:
    assert degrees_of(text, "lat") == pytest.approx(SECONDS, abs=1e-9)


def test_signs_letters_and_parts() -> None:
    assert degrees_of("8 30 15 W", "lon") == pytest.approx(-8.5041667, abs=1e-6)
    assert degrees_of("-8 30 15", "lon") == pytest.approx(-8.5041667, abs=1e-6)
    assert degrees_of("0 30 S", "lat") == -0.5
    assert degrees_of("48 12.5", "lat") == pytest.approx(48.208333, abs=1e-6)
    assert degrees_of("8.25 E", "lon") == 8.25


@pytest.mark.parametrize("text", ["48 72 0", "48.5 30", "8 E", "-8 S", "48 m", "Bern", "48 12 61"])
def test_what_is_no_latitude(text: str) -> None:
    assert degrees_of(text, "lat") is None


def test_a_table_that_exiftool_wrote(tmp_path: Path) -> None:
    path = tmp_path / "pos.csv"
    path.write_text(
        "SourceFile,GPSLatitude,GPSLongitude\n"
        'a.jpg,"48 deg 12\' 30.50"" N","8 deg 30\' 15.00"" W"\n'
        "b.jpg,48.2,-8.5\n"
    )
    first, second = read_pos(path).rows
    assert (first.lat_deg, first.lon_deg) == (pytest.approx(SECONDS), pytest.approx(-8.5041667, abs=1e-6))
    assert (second.lat_deg, second.lon_deg) == (48.2, -8.5)


def test_a_height_with_minutes_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "pos.csv"
    path.write_text("frame;lat;lon;height\na.jpg;48;8;500 12\n")
    with pytest.raises(InputError, match="'500 12' is no number for height"):
        read_pos(path)


@pytest.mark.parametrize(
    "text",
    [
        "33 51 30.5 S",
        "33:51:30.5S",
        "33°51'30.5 S",
        "33°51'30.5S",
        "33d51m30.5s S",
        "33 51 30.5 s",
        "33:51:30.5s",
        "S 33 51 30.5",
    ],
)
def test_the_south_is_no_unit_of_seconds(text: str) -> None:
    assert degrees_of(text, "lat") == pytest.approx(-33.8584722, abs=1e-6)
    assert degrees_of(text, "lon") is None


def test_a_small_s_next_to_minutes_in_m_is_a_unit() -> None:
    assert degrees_of("33 d 51 m 30.5 s N", "lat") == pytest.approx(33.8584722, abs=1e-6)
    assert degrees_of("33d51min30.5s", "lon") == pytest.approx(33.8584722, abs=1e-6)
