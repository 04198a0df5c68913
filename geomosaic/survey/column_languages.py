"""Names of columns in other languages than English."""

from __future__ import annotations

import re
import unicodedata
from typing import Final


def plain(name: str) -> str:
    """A name without capitals, accents, blanks and signs: words of any script, joined by underscores."""
    flat = unicodedata.normalize("NFKD", name.casefold().replace("ł", "l").replace("ø", "o"))
    flat = "".join(sign for sign in flat if not unicodedata.combining(sign))
    return re.sub(r"[\W_]+", "_", flat).strip("_")


_ENGLISH: Final = {
    "image": (
        # German, Dutch
        "Bild", "Bildname", "Bilddatei", "Dateiname", "Foto", "Fotoname", "Beeld", "Bestandsnaam",
        # French, Spanish, Portuguese, Italian
        "Nom de l'image", "Nom image", "Fichier", "Nom du fichier", "Imagen", "Nombre de imagen", "Archivo",
        "Nombre de archivo", "Imagem", "Nome da imagem", "Arquivo", "Immagine", "Nome immagine", "Nome file",
        # Polish, Czech, Russian, Turkish
        "Zdjęcie", "Nazwa zdjęcia", "Nazwa pliku", "Plik", "Snímek", "Soubor", "Снимок", "Фото", "Файл",
        "Имя файла", "Имя снимка", "Resim", "Dosya", "Görüntü",
        # Chinese, Japanese, Korean
        "照片", "照片名", "照片名称", "影像", "影像名", "图像", "图片", "文件名", "像片号",
        "画像", "画像名", "写真", "写真名", "ファイル名", "사진", "이미지", "파일명",
    ),
    "name": ("Naam", "Nom", "Nombre", "Nome", "Nazwa", "Název", "Имя", "Ad", "名称", "名前", "이름"),
    "point": (
        "Punkt", "Punktname", "Punktnummer", "Punktnr", "Punt", "Puntnummer", "Nom du point", "Matricule",
        "Punto", "Nombre del punto", "Ponto", "Nome do ponto", "Nome punto", "Nazwa punktu", "Numer punktu",
        "Bod", "Číslo bodu", "Точка", "Имя точки", "Номер точки", "Nokta", "Nokta adı", "点号", "点名",
        "点名称", "控制点", "点番号", "기준점", "점번호",
    ),
    "longitude": (
        "Länge", "Längengrad", "Geogr. Länge", "Geographische Länge", "Lengtegraad", "Lengte", "Longitud",
        "Longitudine", "Długość", "Długość geograficzna", "Zeměpisná délka", "Долгота", "Boylam", "经度",
        "経度", "경도",
    ),
    "latitude": (
        "Breite", "Breitengrad", "Geogr. Breite", "Geographische Breite", "Breedtegraad", "Breedte",
        "Latitud", "Latitudine", "Szerokość", "Szerokość geograficzna", "Zeměpisná šířka", "Широта", "Enlem",
        "纬度", "緯度", "위도",
    ),
    "easting": (
        "Rechtswert", "Ost", "Ostwert", "Oost", "Est", "Coordonnée est", "Este", "Coordenada este", "Leste",
        "Coordenada leste", "Coordinata est", "Wschód", "Východ", "Восток", "Doğu", "东坐标", "东", "東",
    ),
    "northing": (
        "Hochwert", "Nord", "Nordwert", "Noord", "Coordonnée nord", "Norte", "Coordenada norte",
        "Coordinata nord", "Północ", "Sever", "Север", "Kuzey", "北坐标", "北",
    ),
    "height": (
        "Höhe", "Hoogte", "Hauteur", "Altura", "Cota", "Elevación", "Altitud", "Elevação", "Quota",
        "Altezza", "Altitudine", "Wysokość", "Výška", "Высота", "Yükseklik", "Kot", "高程", "高度", "高",
        "标高", "標高", "고도", "높이",
    ),
    "height_ellipsoidal": (
        "Ellipsoidische Höhe", "Höhe ellipsoidisch", "Hauteur ellipsoïdale", "Hauteur ellipsoidale",
        "Altura elipsoidal", "Altitude elipsoidal", "Quota ellissoidica", "Altezza ellissoidica",
        "Wysokość elipsoidalna", "大地高", "椭球高", "楕円体高", "타원체고",
    ),
    "height_orthometric": (
        "Höhe über NHN", "Höhe NHN", "NHN-Höhe", "Orthometrische Höhe", "Altitude orthométrique",
        "Altitude NGF", "Altura ortométrica", "Cota ortométrica", "Altitude ortométrica",
        "Quota ortometrica", "Wysokość ortometryczna", "海拔", "海拔高", "正常高", "정표고",
    ),
    "yaw": (
        "Gier", "Gierwinkel", "Lacet", "Guiñada", "Guinada", "Imbardata", "Odchylenie", "Рыскание", "Курс",
        "航向角", "偏航角", "航向", "ヨー",
    ),
    "pitch": (
        "Nick", "Nickwinkel", "Tangage", "Cabeceo", "Arfagem", "Beccheggio", "Pochylenie", "Тангаж",
        "俯仰角", "俯仰", "ピッチ",
    ),
    "roll": (
        "Roll", "Rollwinkel", "Roulis", "Alabeo", "Rolagem", "Rollio", "Przechylenie", "Крен", "横滚角",
        "翻滚角", "滚转角", "横滚", "ロール",
    ),
}  # fmt: skip
ENGLISH: Final = {plain(name): english for english, names in _ENGLISH.items() for name in names}
"""English name by that of another language."""
DEGREES: Final = frozenset(
    map(plain, ("Grad", "degrés", "grados", "graus", "gradi", "stopnie", "град", "градусы", "度"))
)
"""Degrees in other languages. `grad` next to an English name is a gon."""
METRES: Final = frozenset(map(plain, ("Meter", "mètres", "metros", "metri", "metry", "м", "米", "メートル")))
_DIRECTIONS: Final = {
    "N": (
        "N", "North", "Nord", "Noord", "Norte", "Północ", "Sever", "Север", "Kuzey", "北", "北纬", "北緯",
        "북", "북위",
    ),
    "S": (
        "S", "South", "Süd", "Zuid", "Sud", "Sur", "Sul", "Południe", "Jih", "Юг", "Güney", "南", "南纬",
        "南緯", "남", "남위",
    ),
    "E": (
        "E", "East", "Ost", "Oost", "Est", "Este", "Leste", "Wschód", "Východ", "Восток", "Doğu", "东", "東",
        "东经", "東経", "동", "동경",
    ),
    "W": (
        "W", "West", "Ouest", "Oeste", "Ovest", "Zachód", "Západ", "Запад", "Batı", "西", "西经", "西経",
        "서", "서경",
    ),
}  # fmt: skip
DIRECTIONS: Final = {plain(word): letter for letter, words in _DIRECTIONS.items() for word in words}
"""English letter of a direction by its word. The letter O is missing: it is German east and French west."""
_CODE_PAGES: Final = ("latin-1", "gb18030", "cp1251", "cp1250", "cp1254", "shift_jis", "euc_kr")
"""Encodings of tables that spreadsheets write where Windows has no Unicode set."""


def in_unicode(content: bytes) -> bytes:
    """A table in UTF-8, if one of these code pages gives its header more known names than Latin-1 does."""
    try:
        content.decode("utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8")
    except UnicodeDecodeError:
        header = next((line for line in content.splitlines() if line.strip()), b"")
        counts = [_known_names(header, page) for page in _CODE_PAGES]
        if max(counts) > counts[0]:
            page = _CODE_PAGES[counts.index(max(counts))]
            return content.decode(page, "replace").encode()
    return content


def _known_names(header: bytes, page: str) -> int:
    """How many names of a header are known in other languages."""
    try:
        text = header.decode(page)
    except UnicodeDecodeError:
        return -1
    return sum(plain(re.sub(r"[\[(].*", "", name)) in ENGLISH for name in re.split(r"[;,\t]", text))
