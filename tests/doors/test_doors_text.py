"""Texts, tags and names of strangers: one clear line within a budget of time, size and depth."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import struct
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from pyproj import CRS
from small_surveys import mosaic

from geomosaic.camera.rpc import parse_rpc
from geomosaic.doors.files import printable, read_bytes, read_text
from geomosaic.doors.plain import plain_json, plain_yaml, read_json, read_yaml
from geomosaic.errors import FileError, GeomosaicError, InputError
from geomosaic.geodesy.mapcrs import outside_area_m
from geomosaic.survey.camera_files import read_cameras
from geomosaic.survey.control import read_control
from geomosaic.survey.exif import exif_from_block, exif_from_gdal
from geomosaic.survey.folder import frame_files
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.names import FrameNames, natural_key
from geomosaic.survey.pos import read_pos
from geomosaic.survey.read import read_survey
from geomosaic.survey.strip_companions import read_rpc
from geomosaic.survey.strip_model import read_model
from geomosaic.survey.strips import read_geometry
from geomosaic.survey.xmp import number, parse_xmp
from geomosaic_simulate.survey import SimulatedSurvey


def seconds(call: Callable[[], object]) -> float:
    """This process's own time: the machine may be busy."""
    start = time.process_time()
    call()
    return time.process_time() - start


@pytest.fixture
def flight(few_survey: SimulatedSurvey, tmp_path: Path) -> Path:
    """A copy of four frames in two lines that a test may spoil."""
    return shutil.copytree(few_survey.frames.parent, tmp_path / "flight")


READERS: dict[str, Callable[[Path], object]] = {
    "bytes": lambda p: read_bytes(p, 1 << 16, "a file", "see the docs"),
    "text": lambda p: read_text(p, 1 << 16, "a file", "see the docs"),
    "yaml": lambda p: read_yaml(p, 1 << 16, "a file", "see the docs"),
    "json": lambda p: read_json(p, 1 << 16, "a file", "see the docs"),
    "pos": read_pos,
    "control": lambda p: read_control(p, FrameNames(["a.jpg"])),
    "camera": read_cameras,
    "geometry": read_geometry,
    "model": read_model,
    "rpc": read_rpc,
}


@pytest.mark.parametrize("read", READERS.values(), ids=READERS)
@pytest.mark.parametrize("kind", ["pipe", "folder", "device", "socket", "made up", "empty", "missing"])
def test_what_is_no_file_is_refused_at_once(
    tmp_path: Path, read: Callable[[Path], object], kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    import socket

    path = tmp_path / "odd"
    says = "is no regular file but a (pipe|folder|device|socket)"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "socket":
        monkeypatch.chdir(tmp_path)  # a socket's path is short
        with socket.socket(socket.AF_UNIX) as made:
            made.bind("odd")
    elif kind == "made up":
        path.symlink_to("/proc/self/status")
        says = "changes while it is read; copy what it gives to a file first"
    elif kind == "empty":
        path.touch()
        says = "is empty|is no RPC"
    else:
        says = "there is no such file"
    with pytest.raises(FileError, match=says) as caught:
        read(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_a_file_over_its_budget_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "large"
    with path.open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(FileError, match="too large for a file: more than 1 MB; is it the right file"):
        read_bytes(path, 1 << 20, "a file", "")
    path.write_bytes(b"x" * 1000)
    assert len(read_bytes(path, 1000, "a file", "")) == 1000


def test_a_pipe_as_pos_says_what_to_do(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    read, write = os.pipe()
    os.write(write, (flight / "pos.csv").read_bytes())
    os.close(write)
    assert mosaic(flight / "frames", flight / "run", "--pos", f"/dev/fd/{read}") == 2
    os.close(read)
    err = capsys.readouterr().err
    assert "is no regular file but a pipe; write what it gives to a file first" in err
    assert not (flight / "run").exists()


BAD_YAML = {
    "a: !!bool foo": "line 1: tags",
    "a: !!int ''": "line 1: tags",
    f"a: 1\nb: {'9' * 401}": "line 2: too large a number",
    "a: 2020-13-45": "'2020-13-45' can't be read",
    "a: =": "tag",
    "? [a]\n: 1": "a key is a list or a mapping",
    "a: &x [1]\nb: *x": "anchors and aliases",
    "a: &x 1": "anchors and aliases",
    "<<: {a: 1}": "merge keys",
    "a: 1\na: 2": "line 2: 'a' is given twice",
    "[" * 60_000: "more than 32 levels",
    "- " * 20_000: "more than 32 levels",
    "\n".join(f"k{i}: 1" for i in range(70_000)): "more than 10000 keys and values",
    "a: [": "expected the node content",
    "--- 1\n--- 2": "another document",
    "a: \x1b": "special characters",
    "a: \ud800": "is no valid YAML",
}


@pytest.mark.parametrize("text", BAD_YAML, ids=[t[:12].encode("unicode_escape").decode() for t in BAD_YAML])
def test_odd_yaml_is_one_line(text: str) -> None:
    def load() -> None:
        with pytest.raises(FileError) as caught:
            plain_yaml(text, "f.yaml", "see the docs")
        reported = str(caught.value)
        assert (
            reported.startswith("f.yaml: is no valid YAML")
            and BAD_YAML[text] in reported
            and len(reported) < 250
        )
        assert reported.isprintable() and reported.endswith("; see the docs")

    assert seconds(load) < 10.0


BAD_JSON = {
    b"{": "Expecting property name",
    b"[" * 100_000: "too many levels",
    b'{"a": 1, "a": 2}': "'a' is given twice",
    b'{"a": NaN}': "NaN is no number",
    b"9" * 401: "too large a number",
    b"[[]," * 3_000_000: "too many values",
    b"\xff{": "no text in UTF-8",
}


@pytest.mark.parametrize("content", BAD_JSON, ids=[str(t[:8]) for t in BAD_JSON])
def test_odd_json_is_one_line(content: bytes) -> None:
    with pytest.raises(FileError, match=BAD_JSON[content]) as caught:
        plain_json(content, "f.json", "see the docs")
    assert str(caught.value).startswith("f.json: is no valid JSON: ")


def test_plain_yaml_and_json_are_as_ever() -> None:
    wanted = {"a": [1, 2.5, True, None, "x"], "b": {"c": "d"}, "e": -7}
    assert plain_yaml("a: [1, 2.5, true, ~, x]\nb: {c: d}\ne: -7", "f", "") == wanted
    assert plain_json(json.dumps(wanted).encode(), "f", "") == wanted
    assert plain_yaml(b"\xef\xbb\xbfa: 'no'", "f", "") == {"a": "no"}


@pytest.mark.parametrize(
    "name", ["camera.yaml", "cameras.json", "recipe.yaml", "geometry.yaml", "model.yaml"]
)
def test_mutated_plain_files_are_refused_in_one_line_or_read(tmp_path: Path, name: str) -> None:
    """Bytes changed, doubled, cut out and put in at random: never anything but a `GeomosaicError`."""
    from geomosaic.pipeline.recipe import load_recipe
    from geomosaic.pipeline.registry import installed

    start = {
        "camera.yaml": b"name: a\nwidth_px: 100\nheight_px: 80\nfocal_length_px: 90.5\nk1: -0.01\n",
        "cameras.json": b'{"a": {"projection_type": "brown", "width": 100, "height": 80, "focal_x": 0.9, '
        b'"focal_y": 0.9, "c_x": 0.01, "c_y": 0.0, "k1": 0.1, "k2": 0, "p1": 0, "p2": 0, "k3": 0}}',
        "recipe.yaml": b"name: x\nseed: 1\nstages:\n  - stage: survey.read\n    params: {frames: a}\n"
        b"  - projection.ground\n",
        "geometry.yaml": b"line_rate_hz: 1000.0\nccds:\n  - {path: a.tif, row: 1}\n  - {row: 2}\noverlap_px: 9\n",
        "model.yaml": b"line_rate_hz: 1000.0\norbit: o.csv\nattitude: a.csv\nlooks:\n"
        b"  - {forward_tan: [0, 0, 0], right_tan: [0, 1e-5, 0]}\n",
    }[name]
    read: Callable[[Path], object] = {
        "recipe.yaml": lambda p: load_recipe(p, installed()),
        "geometry.yaml": read_geometry,
        "model.yaml": read_model,
    }.get(name, read_cameras)
    odd = [
        b"!!bool ",
        b"&a ",
        b"*a",
        b"<<: ",
        b"9" * 401,
        b"[",
        b"{",
        b"\x00",
        b"\xff",
        b"NaN",
        b"1e999",
        b"'",
    ]
    dice = random.Random(9)
    path = tmp_path / name
    for _ in range(150):
        data = bytearray(start)
        for _ in range(dice.randint(1, 3)):
            at = dice.randrange(len(data))
            match dice.randrange(4):
                case 0:
                    data[at] = dice.randrange(256)
                case 1:
                    data[at:at] = dice.choice(odd)
                case 2:
                    del data[at : at + dice.randint(1, 20)]
                case _:
                    data[at:at] = data[at : at + dice.randint(1, 40)]
            data = data or bytearray(b" ")
        path.write_bytes(data)
        try:
            read(path)
        except GeomosaicError as error:
            assert "\n" not in str(error) and len(str(error)) < 800


@pytest.mark.parametrize("kind", ["pos", "projected", "opk", "control"])
def test_mutated_tables_are_refused_in_one_line_or_read(tmp_path: Path, kind: str) -> None:
    starts = {
        "pos": "frame,lon_deg,lat_deg,height_ellipsoidal_m,gimbal_yaw,gimbal_pitch,gimbal_roll,sd_e,sd_n\n",
        "projected": "EPSG:32632\n",
        "opk": "frame;x;y;z;omega_rad;phi_rad;kappa_rad;sd_horizontal\n",
        "control": "name,lon,lat,height_ellipsoidal,image,col,row,kind\n",
    }
    rows = {
        "pos": "a.jpg,9.1,47.2,500.5,10,-90,0,0.1,0.2\nb.jpg,9.11,47.2,,,-89,1,0,0\n",
        "projected": "a.jpg 500000 5200000 500 1 2 3 0.1 0.2\nb.jpg 500010 5200000 500\n",
        "opk": "a.jpg;500000,5;5200000;500;0.1;0.2;0.3;1\nb.jpg;500100;5200000;500;0.1;0.2;0.3;1\n",
        "control": "p1,9.1,47.2,500,a.jpg,10,20,check\np1,9.1,47.2,500,b.jpg,10,20,check\np2,9.1,47.3,4,,,,\n",
    }
    start = (starts[kind] + rows[kind]).encode()
    odd = [
        b"1" * 500,
        b"1e999",
        b"nan",
        b"\xff",
        b"\x00",
        b"\n\n",
        b'"',
        b";",
        b"EPSG:27700",
        b"-",
        b"\xe2\x80\xae",
    ]
    dice = random.Random(4)
    path = tmp_path / "t.csv"
    for _ in range(150):
        data = bytearray(start)
        for _ in range(dice.randint(1, 3)):
            at = dice.randrange(len(data))
            if dice.random() < 0.5:
                data[at] = dice.randrange(256)
            else:
                data[at : at + dice.randint(0, 5)] = dice.choice(odd)
        path.write_bytes(data)
        try:
            if kind == "control":
                read_control(path, FrameNames(["a.jpg", "b.jpg"]))
            else:
                read_pos(path, crs="EPSG:32632")
        except GeomosaicError as error:
            assert "\n" not in str(error)


def test_a_hundred_thousand_lines_of_pos_take_seconds(tmp_path: Path) -> None:
    count = 20_000
    header = "frame,x,y,z,gimbal_yaw,gimbal_pitch,gimbal_roll,sd_horizontal\n"
    path = tmp_path / "pos.csv"
    path.write_text(
        header + "".join(f"{i}.jpg,{5e5 + i},5.2e6,500.25,{i % 360},-90,0,0.03\n" for i in range(count))
    )
    files = []
    assert seconds(lambda: files.append(read_pos(path, crs="EPSG:32632"))) < 4.0
    row = files[0].rows[-1]
    assert (len(files[0].rows), row.name, row.line) == (count, "19999.jpg", 20_001)
    assert row.yaw_deg == pytest.approx(199.0) and row.pitch_deg == pytest.approx(0.0, abs=1e-9)
    assert (
        row.roll_deg == pytest.approx(0.0, abs=1e-9) and row.sd_north_m == 0.03 and row.sd_vertical_m is None
    )


def test_budgets_of_tables(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text("frame,lon,lat\n" + "a.jpg,9,47\n" * 200_000)
    with pytest.raises(InputError, match="200,001 lines, more than 200,000 lines of frames"):
        read_pos(path)
    path.write_text("frame,lon,lat," + ",".join(f"c{i}" for i in range(600)) + "\na.jpg,9,47\n")
    with pytest.raises(InputError, match="line 1 names 603 columns; give at most 500"):
        read_pos(path)
    path.write_text("frame,lon,lat\na.jpg,9," + "4" * 30_000 + "\n")
    with pytest.raises(InputError, match="line 2 has 30,008 characters"):
        read_pos(path)
    path.write_text("name,lon,lat,h_ell\n" + "".join(f"p{i},9,47,5\n" for i in range(20_001)))
    with pytest.raises(InputError, match="has 20,001 points, more than 20,000"):
        read_control(path, FrameNames(["a.jpg"]))


@pytest.mark.parametrize("digits", [10_000, 19_000])
def test_a_number_that_never_ends_is_judged_at_once(tmp_path: Path, digits: int) -> None:
    path = tmp_path / "t.csv"
    path.write_text("frame,lon,lat\n" + f"a.jpg,9,4{'7' * digits}x\n" * 30)

    def read() -> None:
        with pytest.raises(InputError, match=r"line 2: '4777.*is no number for lat"):
            read_pos(path)

    assert seconds(read) < 2.0


def test_a_point_in_ten_thousands_of_images_is_one_point(tmp_path: Path) -> None:
    path = tmp_path / "gcp.csv"
    path.write_text(
        "name,lon,lat,h_ell,image,col,row\n" + "".join(f"p,9,47,5,{i}.jpg,1,2\n" for i in range(30_000))
    )
    names = FrameNames(f"{i}.jpg" for i in range(30_000))
    found = []
    assert seconds(lambda: found.append(read_control(path, names))) < 4.0
    points = found[0].points
    assert len(points) == 1 and points[0].images[29_999] == ("29999.jpg", 1.0, 2.0)


PACKET = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    b"<rdf:Description %s</rdf:Description></rdf:RDF></x:xmpmeta>"
)
XMP_BOMBS = {
    "openings": (b"<x:xmpmeta " * 100_000, {}),
    "lists": (b"<rdf:RDF " * 100_000, {}),
    "one word": (b"<" + b"w" * (1 << 20), {}),
    "prefixes": (PACKET % (b">" + b"".join(b"<p%d:a/>" % i for i in range(60_000))), None),
    "undeclared": (PACKET % (b">" + b"".join(b"<p%d:a/>" % i for i in range(5_000))), None),
    "depth": (PACKET % (b">" + b"<a>" * 9_000 + b"</a>" * 9_000), {":a": ""}),
    "elements": (PACKET % (b">" + b"<a/>" * 30_000), None),
    "long namespace": (PACKET % (b'xmlns:q="' + b"u" * 500_000 + b'">' + b"<q:a/>" * 1000), None),
    "entities": (b"<x:xmpmeta><!DOCTYPE a [<!ENTITY b 'c'>]>&b;</x:xmpmeta>", None),
}


@pytest.mark.parametrize("bomb", XMP_BOMBS)
def test_no_xmp_takes_long(bomb: str) -> None:
    data, wanted = XMP_BOMBS[bomb]
    found = []
    assert seconds(lambda: found.append(parse_xmp(data))) < 2.0
    assert found[0] == wanted


def test_numbers_of_xmp() -> None:
    assert number({"a": "+12.5"}, "a") == 12.5 and number({"a": "25/2"}, "a") == 12.5
    for text in ("1/0", "1" * 100_000, "1/" + "0" * 60, "1e999", "--1", "", "٣"):
        assert number({"a": text}, "a") is None
    assert seconds(lambda: number({"a": "1" * 1_000_000 + "x"}, "a")) < 0.5


def exif_block(entries: list[tuple[int, int, int, int]], behind: bytes = b"") -> bytes:
    """A little-endian TIFF of one directory at byte 8: number, type, count, value."""
    head = b"II*\0" + struct.pack("<IH", 8, len(entries) & 0xFFFF)
    return head + b"".join(struct.pack("<HHII", *entry) for entry in entries) + b"\0\0\0\0" + behind


EXIF_BOMBS = {
    "text of 4 GB": exif_block([(0x10F, 2, 0xFFFFFFFF, 0)]),
    "rationals of 32 GB": exif_block([(0x8769, 5, 0xFFFFFFFF, 8)]),
    "itself as Exif": exif_block([(0x8769, 4, 1, 8)]),
    "65,535 times itself": exif_block([(0x8769, 4, 1, 8)] * 65_535),
    # each of a thousand directories has 65,535 entries and names the next one, twelve bytes on
    "overlapping directories": b"II*\0\x08\0\0\0"
    + (struct.pack("<H", 0xFFFF) + b"\x0f\x01\x02\0\x01\0\0\0ab") * 70_000
    + b"".join(struct.pack("<I", 8 + 12 * i) + b"\xff" * 8 for i in range(1000)),
    "nothing behind": b"II*\0\xff\xff\xff\xff",
    "unknown types": exif_block([(0x110, kind, 1, 8) for kind in range(0, 65_535, 97)]),
    "Exif at no place": exif_block(
        [(0x8769, 2, 4, 0x41414141), (0x8825, 11, 1, 0x7FC00000), (0x8825, 9, 1, 0xFFFFFFFF)]
    ),
}


@pytest.mark.parametrize("bomb", EXIF_BOMBS)
def test_no_exif_takes_long(bomb: str) -> None:
    assert seconds(lambda: exif_from_block(EXIF_BOMBS[bomb])) < 1.0


def test_rationals_over_nothing_and_clocks_that_were_never_set_say_nothing() -> None:
    gps = exif_block([(1, 2, 2, 0x4E), (2, 5, 3, 200), (3, 2, 2, 0x45), (4, 5, 3, 200)])
    block = exif_block([(0x132, 2, 20, 26), (0x8825, 4, 1, 60)], b"0000:00:00 00:00:00\0".ljust(100, b"\0"))
    assert exif_from_block(block[:60] + gps[8:]).time_s is None
    for below, wanted in ((0, None), (2, 2.5)):
        over = exif_block([(0x920A, 5, 1, 44)], struct.pack("<II", 5, below))
        assert exif_from_block(exif_block([(0x8769, 4, 1, 26)], over[8:])).focal_length_mm == wanted
    assert exif_from_block(exif_block([(0x132, 2, 20, 26)], b"0001:01:01 00:00:00\0")).time_s is None
    assert exif_from_gdal({"EXIF_FocalLength": "(+-)", "EXIF_GPSAltitude": "(1e999)"}).focal_length_mm is None
    time = {"EXIF_DateTimeOriginal": "2024:05:06 07:08:10", "EXIF_SubSecTime_Original": "75"}
    of_gdal = exif_from_gdal({**time, "EXIF_ISOSpeedRatings": "200"})
    assert of_gdal.iso == 200.0 and of_gdal.time_s is not None and of_gdal.time_s % 1.0 == 0.75


def test_a_camera_named_in_the_directory_of_exif() -> None:
    """As rpicam-apps of Raspberry Pi does; the main directory's counts where both name one."""
    its = exif_block([(0x10F, 2, 4, 0x414141), (0x110, 2, 4, 0x424242), (0x829A, 5, 1, 80)])
    alone = exif_block([(0x8769, 4, 1, 26)], its[8:])
    assert (exif_from_block(alone).make, exif_from_block(alone).model) == ("AAA", "BBB")
    both = exif_block([(0x10F, 2, 4, 0x434343), (0x8769, 4, 1, 38)], its[8:])
    assert (exif_from_block(both).make, exif_from_block(both).model) == ("CCC", "BBB")


def test_a_frame_with_a_bomb_of_tags_is_read_at_once(flight: Path) -> None:
    frame = sorted((flight / "frames").iterdir())[0]
    plain = frame.read_bytes()
    tags = b"http://ns.adobe.com/xap/1.0/\0" + b"<x:xmpmeta " * 5_900
    frame.write_bytes(plain[:2] + b"\xff\xe1" + struct.pack(">H", len(tags) + 2) + tags + plain[2:])
    survey = read_survey(
        SurveyInputs(flight / "frames", pos=flight / "pos.csv", camera=flight / "cameras.json")
    )
    assert len(survey.frames) == 4


def test_mutated_tags_never_raise() -> None:
    block = exif_block(
        [(0x10F, 2, 4, 0x414141), (0x132, 2, 20, 50), (0x8769, 4, 1, 8)], b"2024:01:02 03:04:05\0" * 3
    )
    packet = PACKET % b'drone-dji:GimbalYawDegree="+12.5" drone-dji:RtkFlag="50"><a:b>1/2</a:b>'
    dice = random.Random(5)
    for _ in range(400):
        for start, read in ((block, exif_from_block), (packet, parse_xmp)):
            data = bytearray(start)
            for _ in range(dice.randint(1, 4)):
                data[dice.randrange(len(data))] = dice.randrange(256)
            read(bytes(data))


def test_an_rpc_with_an_empty_value_is_one_line() -> None:
    with pytest.raises(InputError, match="the RPC holds what is no number"):
        parse_rpc("LINE_OFF:\n")


def test_names_and_texts_are_shown_without_controls() -> None:
    assert printable("a\x1bb\u202ec\ud800\ufffe.jpg\n") == "a%1Bb%202Ec%D800%FFFE.jpg%0A"
    assert printable("Zürich 東京 \u200d.jpg") == "Zürich 東京 \u200d.jpg"
    assert natural_key("1²2") < natural_key("10²2")


def test_odd_names_go_through_to_valid_results(flight: Path) -> None:
    import html.parser
    import sqlite3
    from xml.etree import ElementTree

    frames, pos = flight / "frames", flight / "pos.csv"
    first = sorted(frames.iterdir())[0]
    odd = "a\x1b<&\u202e\x07.jpg"
    first.rename(frames / odd)
    pos.write_text(pos.read_text().replace(first.name, odd))
    run = flight / "run"
    given = ("--pos", pos, "--camera", flight / "cameras.json", "--adjust", "least_squares")
    assert mosaic(frames, run, *given) == 0
    page = (run / "report.html").read_text()
    html.parser.HTMLParser().feed(page)
    for svg in re.sub(r"(?s)<script.*?</script>", "", page).split("<svg")[1:]:
        ElementTree.fromstring("<svg" + svg.split("</svg>")[0] + "</svg>")
    with sqlite3.connect(run / "layers.gpkg") as database:
        names = {row[0] for row in database.execute("SELECT frame FROM frames")}
    assert "a%1B<&%202E%07.jpg" in names
    assert json.loads((run / "run.json").read_text())["frames"]["total"] == 4
    for file in ("report.html", "positions.csv"):
        assert not {"\x1b", "\x07", "\u202e"} & set((run / file).read_text())


@pytest.mark.parametrize("name", [b"a\xff.jpg", b"a\xff.txt"])
def test_a_name_that_is_no_utf_8_is_refused_at_the_start(
    flight: Path, name: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    (frame, *_) = sorted((flight / "frames").iterdir())
    Path(os.fsdecode(os.fsencode(frame.parent) + b"/" + name)).write_bytes(frame.read_bytes())
    assert mosaic(frame.parent, flight / "run", "--pos", flight / "pos.csv") == 2
    end = name.decode("utf-8", "backslashreplace")
    assert f"{end}: its name is not in UTF-8; rename it" in capsys.readouterr().err
    assert not (flight / "run").exists()


def test_names_that_read_alike_are_refused(tmp_path: Path) -> None:
    for name in ("a\x1b.jpg", "a%1B.jpg"):
        (tmp_path / name).touch()
    with pytest.raises(InputError, match=r"a%1B\.jpg: its name looks like that of another frame; rename one"):
        frame_files(tmp_path)


@pytest.mark.parametrize("kind", ["grey", "16 bits"])
def test_an_odd_frame_is_named_before_anything_is_done(
    flight: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    frame = sorted((flight / "frames").iterdir())[2]
    pixels = cv2.imread(str(frame))
    if kind == "grey":
        cv2.imwrite(str(frame), pixels[..., 0])
        says = f"{frame.name}: has 1 band of uint8, 3 other frames have 3 bands of uint8; convert it, or take it out"
    else:
        name = frame.stem
        frame.unlink()
        frame = frame.with_suffix(".tif")
        cv2.imwrite(str(frame), pixels.astype(np.uint16))
        says = f"{name}.tif: has 3 bands of uint16, 3 other frames have 3 bands of uint8"
    keep = ("--pos", flight / "pos.csv", "--set", "survey.read.leave_out=none")
    assert mosaic(flight / "frames", flight / "run", *keep) == 2
    assert says in capsys.readouterr().err


def test_how_far_a_point_lies_outside_a_crs() -> None:
    utm_32 = CRS.from_epsg(32632)  # 6 to 12 degrees east, the equator to 84 degrees north
    assert outside_area_m(utm_32, 9.0, 47.0) == 0.0 and outside_area_m(utm_32, 12.0, 0.0) == 0.0
    assert outside_area_m(utm_32, 13.0, 0.0) == pytest.approx(111_320.0, abs=1.0)
    assert outside_area_m(utm_32, 5.0, 0.0) == pytest.approx(111_320.0, abs=1.0)
    assert outside_area_m(utm_32, 9.0, -1.0) == pytest.approx(110_574.0, abs=1.0)
    assert outside_area_m(CRS.from_proj4("+proj=utm +zone=32 +type=crs"), 100.0, 47.0) == 0.0
    fiji = CRS.from_epsg(3460)  # across the 180th meridian
    assert outside_area_m(fiji, 179.0, -17.0) == 0.0 and outside_area_m(fiji, -179.0, -17.0) == 0.0
    assert outside_area_m(fiji, 0.0, -17.0) > 1e7


def test_a_crs_of_another_continent(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ("--pos", flight / "pos.csv", "--camera", flight / "cameras.json")
    assert mosaic(flight / "frames", flight / "run", *given, "--crs", "EPSG:32616") == 2
    err = capsys.readouterr().err
    assert (
        "the frames (11.300, 48.100 deg) lie" in err
        and "km outside the area of WGS 84 / UTM zone 16N (" in err
    )
    survey = read_survey(SurveyInputs(flight / "frames", pos=given[1], camera=given[3], crs="EPSG:32633"))
    assert [w.code for w in survey.warnings if w.code == "crs-outside-area"] == ["crs-outside-area"]
    survey = read_survey(SurveyInputs(flight / "frames", pos=given[1], camera=given[3], crs="EPSG:25832"))
    assert "crs-outside-area" not in {w.code for w in survey.warnings}
    pos = flight / "xy.csv"
    pos.write_text("frame,x,y,h_ell\na.jpg,4000000,3000000,500\n")
    with pytest.raises(InputError, match=r"xy\.csv: the positions .* outside the area of OSGB36"):
        read_pos(pos, crs="EPSG:27700")


def test_frames_of_one_and_the_same_position_are_reported(flight: Path) -> None:
    pos = flight / "pos.csv"
    names = [frame.name for frame in sorted((flight / "frames").iterdir())]
    pos.write_text("frame,lon,lat,h_ell\n" + "".join(f"{n},11.3,48.1,570\n" for n in names))
    survey = read_survey(SurveyInputs(flight / "frames", pos=pos, camera=flight / "cameras.json"))
    assert [w.frame for w in survey.warnings if w.code == "positions-all-alike"] == [""]
