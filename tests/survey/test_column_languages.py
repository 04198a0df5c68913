"""Tables whose columns are named in other languages than English."""

from __future__ import annotations

from pathlib import Path

import pytest

from geomosaic.errors import InputError
from geomosaic.survey.column_languages import ENGLISH
from geomosaic.survey.column_names import column_of
from geomosaic.survey.control import read_control
from geomosaic.survey.control_table import ALIASES as CONTROL_COLUMNS
from geomosaic.survey.names import FrameNames
from geomosaic.survey.pos import ALIASES, read_pos

HEADERS = [
    "Bildname;Breite [°];Länge [°];Höhe [m];Gierwinkel [Grad]",
    "Nom de l'image;Latitude;Longitude;Hauteur ellipsoïdale (mètres);Lacet (degrés)",
    "Imagen;Latitud;Longitud;Altura elipsoidal (metros);Guiñada (grados)",
    "Nazwa pliku;Szerokość geograficzna;Długość geograficzna;Wysokość;Odchylenie",
    "Имя файла;Широта;Долгота;Высота (м);Курс (град)",
    "照片名;纬度;经度;大地高(米);航向角(度)",
    "ファイル名;緯度;経度;楕円体高;ヨー",
]


@pytest.mark.parametrize("header", HEADERS)
def test_positions(tmp_path: Path, header: str) -> None:
    path = tmp_path / "pos.csv"
    path.write_text(f"{header}\nb.jpg;47,5;8,25;512,5;33\n", encoding="utf-8")
    (row,) = read_pos(path).rows
    assert (row.name, row.lon_deg, row.lat_deg, row.yaw_deg) == ("b.jpg", 8.25, 47.5, pytest.approx(33.0))


def test_control_points_of_a_table_that_a_spreadsheet_wrote(tmp_path: Path) -> None:
    path = tmp_path / "passpunkte.csv"
    path.write_bytes("Punktnr;Rechtswert;Hochwert;Höhe\nP7;576677,25;5188320,5;214,1\n".encode("cp1252"))
    (point,) = read_control(path, FrameNames(()), crs="EPSG:26915").points
    assert point.name == "P7"
    assert point.lat_deg == pytest.approx(46.8440, abs=1e-3)


@pytest.mark.parametrize(
    ("page", "header"),
    [
        ("gb18030", "照片名,纬度,经度,高程(米)"),
        ("cp1251", "Имя файла;Широта;Долгота;Высота (м)"),
        ("cp1250", "Nazwa zdjęcia;Szerokość;Długość;Wysokość"),
        ("shift_jis", "写真名,緯度,経度,標高"),
        ("euc_kr", "사진,위도,경도,고도"),
    ],
)
def test_code_pages_of_spreadsheets(tmp_path: Path, page: str, header: str) -> None:
    path = tmp_path / "pos.csv"
    line = "b.jpg;47.5;8.25;512.5".replace(";", ";" if ";" in header else ",")
    path.write_bytes(f"{header}\n{line}\n".encode(page))
    (row,) = read_pos(path).rows
    assert (row.name, row.lon_deg, row.lat_deg) == ("b.jpg", 8.25, 47.5)


def test_degrees_of_a_german_name_are_no_gons() -> None:
    assert column_of("Gier [Grad]", ALIASES) == ("yaw", "deg")
    assert column_of("yaw [grad]", ALIASES) == ("yaw", "grad")


def test_english_names_keep_their_meaning() -> None:
    for aliases in (ALIASES, CONTROL_COLUMNS):
        for column, names in aliases.items():
            for name in names:
                assert column_of(name, aliases)[0] == column
    assert {*ENGLISH.values()} <= {
        name for names in (*ALIASES.values(), *CONTROL_COLUMNS.values()) for name in names
    }


SIDES = [
    ("S", "W"), ("South", "West"), ("Süd", "West"), ("Zuid", "West"), ("Sud", "Ouest"), ("Sur", "Oeste"),
    ("Sul", "Oeste"), ("Sud", "Ovest"), ("Południe", "Zachód"), ("Jih", "Západ"), ("Юг", "Запад"),
    ("Güney", "Batı"), ("南", "西"), ("남", "서"), ("s", "w"), ("SUD", "OUEST"),
    ("N", "E"), ("North", "East"), ("Nord", "Ost"), ("Noord", "Oost"), ("Norte", "Este"), ("Norte", "Leste"),
    ("Nord", "Est"), ("Północ", "Wschód"), ("Sever", "Východ"), ("Север", "Восток"), ("Kuzey", "Doğu"),
    ("北", "東"), ("북", "동"), ("", ""),
]  # fmt: skip


@pytest.mark.parametrize(("lat", "lon"), SIDES)
def test_directions(tmp_path: Path, lat: str, lon: str) -> None:
    """The first sixteen are south and west."""
    path = tmp_path / "pos.csv"
    head = "name;GPSLatitude;GPSLatitudeRef;GPSLongitude;GPSLongitudeRef"
    path.write_text(f"{head}\na.jpg;33.5;{lat};8.25;{lon}\n", encoding="utf-8")
    (row,) = read_pos(path).rows
    sign = -1.0 if SIDES.index((lat, lon)) < 16 else 1.0
    assert (row.lat_deg, row.lon_deg) == (sign * 33.5, sign * 8.25)


@pytest.mark.parametrize(
    ("lat", "lon", "named"),
    [("N", "O", "'O'"), ("down", "E", "'down'"), ("E", "E", "'E'"), ("N", "S", "'S'")],
)
def test_directions_that_are_not_known_are_refused(tmp_path: Path, lat: str, lon: str, named: str) -> None:
    """O is east in German and west in French."""
    path = tmp_path / "pos.csv"
    path.write_text(f"name,lat,lat_ref,lon,lon_ref\na.jpg,33.5,N,8.25,E\nb.jpg,33.5,{lat},8.25,{lon}\n")
    with pytest.raises(InputError, match=f"line 3: {named} is no known direction for l.*write [NE] or [SW]"):
        read_pos(path)
