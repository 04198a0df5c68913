"""`geomosaic fetch`: files of a survey from a web server and an object store, whole or not at all."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from osgeo import gdal
from small_surveys import geomosaic, made_map, mosaic
from web_server import Server

from geomosaic.doors.addresses import parsed, read_addresses
from geomosaic.doors.remote import look
from geomosaic.errors import InputError
from geomosaic.pipeline.fetching import NOTED
from geomosaic_simulate.survey import SimulatedSurvey

JPEG = b"\xff\xd8\xff\xe0"


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    """Three frames and a POS file, at / and in the bucket `flights`."""
    root = tmp_path / "there"
    flight = root / "flights" / "one"
    flight.mkdir(parents=True)
    rng = np.random.default_rng(5)
    for folder in (root, flight):
        for number in range(3):
            (folder / f"F{number}.jpg").write_bytes(JPEG + rng.bytes(50_000 + number))
        (folder / "pos.csv").write_text("frame,lon,lat\nF0.jpg,11.2,48.1\n")
    for path in root.rglob("*.*"):
        os.utime(path, (1_600_000_000, 1_600_000_000))
    monkeypatch.setenv("GDAL_HTTP_RETRY_DELAY", "0.05")
    with Server(root) as serving:
        for name, value in serving.store().items():
            monkeypatch.setenv(name, value)
        yield serving


@pytest.fixture
def here(tmp_path: Path) -> Path:
    return tmp_path / "here"


def fetch(here: Path, *given: object) -> int:
    return geomosaic("fetch", *given, "-o", here)


def refused(capsys: pytest.CaptureFixture[str], here: Path, *given: object) -> str:
    """The one line of a refusal; nothing is half-written."""
    capsys.readouterr()
    assert fetch(here, *given) == 2
    output = capsys.readouterr()
    lines = output.err.splitlines()
    assert lines[-1].startswith("geomosaic: ") and "Traceback" not in output.err
    assert not list(here.glob(".*.part*"))
    return lines[-1].removeprefix("geomosaic: ")


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []


def the_list(server: Server, tmp_path: Path, *files: str) -> Path:
    path = tmp_path / "flight.txt"
    path.write_text("# a flight\n" + "".join(f"{server.url(file)}\n" for file in files) + "\n")
    return path


ALL = ("F0.jpg", "F1.jpg", "F2.jpg", "pos.csv")


def test_a_list_is_fetched_and_again_only_what_changed(server: Server, here: Path, tmp_path: Path) -> None:
    flight = the_list(server, tmp_path, *ALL)
    assert fetch(here, flight) == 0
    assert names(here) == [NOTED, *ALL]
    for name in ALL:
        assert (here / name).read_bytes() == (server.root / name).read_bytes()
    assert server.bodies() == [f"/{name}" for name in ALL]  # each in one request
    server.asked.clear()
    assert fetch(here, flight) == 0 and server.bodies() == []
    (server.root / "F1.jpg").write_bytes(JPEG + bytes(50_001))  # of the same size
    assert fetch(here, flight) == 0 and server.bodies() == ["/F1.jpg"]
    assert (here / "F1.jpg").read_bytes() == (server.root / "F1.jpg").read_bytes()
    (here / "F2.jpg").unlink()
    server.asked.clear()
    assert fetch(here, flight) == 0 and server.bodies() == ["/F2.jpg"]


def test_without_tags_the_time_of_change_tells(server: Server, here: Path, tmp_path: Path) -> None:
    server.tags = False
    flight = the_list(server, tmp_path, *ALL)
    assert fetch(here, flight) == 0
    assert (here / "F0.jpg").stat().st_mtime == 1_600_000_000
    server.asked.clear()
    os.utime(server.root / "F0.jpg", (1_600_000_100, 1_600_000_100))
    assert fetch(here, flight) == 0 and server.bodies() == ["/F0.jpg"]


@pytest.mark.parametrize("stated_s", [0, 250_000_000_000])
def test_a_server_that_tells_no_time_or_an_absurd_one(stated_s: int, server: Server, here: Path) -> None:
    os.utime(server.root / "F0.jpg", (stated_s, stated_s))
    assert fetch(here, server.url("F0.jpg")) == 0
    assert abs((here / "F0.jpg").stat().st_mtime - time.time()) < 60.0
    server.asked.clear()
    assert fetch(here, server.url("F0.jpg")) == 0 and server.bodies() == []


def test_a_folder_of_an_object_store_gives_what_a_survey_holds(
    server: Server, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight = server.root / "flights" / "one"
    (flight / "inner").mkdir()
    for name in ("notes.pdf", ".DS_Store"):
        (flight / name).write_text("not of a survey")
    (flight / "odd %20 &+?#ä.jpg").write_bytes(JPEG + b"keys stand as they are")
    assert fetch(here, "s3://flights/one/") == 0
    assert names(here) == sorted([NOTED, *ALL, "odd %20 &+?#ä.jpg"])
    for name in names(here)[1:]:
        assert (here / name).read_bytes() == (flight / name).read_bytes()
    output = capsys.readouterr().out
    assert "fetched    5 files" in output
    assert "skipped    3, which no survey holds: inner/, .DS_Store, notes.pdf" in output
    server.asked.clear()
    assert fetch(here, "s3://flights/one/") == 0
    assert fetch(here, "s3://flights/one/F0.jpg") == 0  # asked by itself it is the same file
    assert fetch(here, "s3://flights/one/F0.jpg", "s3://flights/one/") == 0
    assert not [path for path in server.bodies() if path.endswith("F1.jpg")]


def test_fetched_frames_give_the_mosaic_of_local_ones(
    server: Server, few_survey: SimulatedSurvey, tmp_path: Path
) -> None:
    bucket = server.root / "bucket"
    bucket.mkdir()
    for path in (*few_survey.frames.glob("*.jpg"), few_survey.camera):
        (bucket / path.name).write_bytes(path.read_bytes())
    assert fetch(tmp_path / "frames", "s3://bucket/") == 0
    fetched = replace(
        few_survey, frames=tmp_path / "frames", camera=tmp_path / "frames" / few_survey.camera.name
    )
    for name, one in (("local", few_survey), ("fetched", fetched)):
        made_map(one, tmp_path / name, matching__sift={"keypoints": 600})
    for result in ("mosaic.tif", "positions.csv"):
        assert (tmp_path / "local" / result).read_bytes() == (tmp_path / "fetched" / result).read_bytes()


def test_whoever_wants_frames_from_a_url_learns_how(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    for url in ("s3://bucket/flight/", "https://example.org/flight"):
        assert mosaic(Path(url), tmp_path / "run") == 2
        assert capsys.readouterr().err.splitlines()[-1] == (
            f"geomosaic: {url.rstrip('/')}: is no file on this machine; "
            "files at URLs are fetched first: geomosaic fetch LIST_OR_URL -o FOLDER"
        )


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("404", "there is no such file; correct the address, or take it out of the list"),
        ("403", "its server refuses it (HTTP 403); check the address and the credentials"),
        ("500", "its server answers with HTTP 500; try again later"),
        ("http://localhost:PORT/F0.jpg", "leads to http://localhost:"),
        ("size 0", "is empty, or its server does not state its size"),
        ("size 20000000000", "has 20.0 GB, more than 16 GiB; is it the right file?"),
    ],
)
def test_what_cannot_be_had_is_named_before_anything_is_written(
    wrong: str, said: str, server: Server, here: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    server.wrong["/F1.jpg"] = wrong
    line = refused(capsys, here, the_list(server, tmp_path, *ALL))
    assert line.startswith(f"{server.url('F1.jpg')}: {said}")
    assert names(here) == []


def test_a_disk_that_is_too_small_is_reported_first(
    server: Server, here: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    many = [f"L{number}.tif" for number in range(1000)]
    server.wrong |= {f"/{name}": "size 15000000000" for name in many}
    line = refused(capsys, here, the_list(server, tmp_path, *many))
    assert line.startswith(f"{here}: 15,000.00 GB are to be fetched, and ")
    assert names(here) == []


@pytest.mark.parametrize(
    ("wrong", "content", "said"),
    [
        ("", b"<!DOCTYPE html><title>Log in</title>", "is a page of the web (HTML), no JPEG; open it"),
        ("", b"\n <Error><Code>Expired</Code></Error>", "is a message of its server, no JPEG; open it"),
        ("breaks off", JPEG + bytes(90_000), "breaks off after 1,000 of 90,004 bytes"),
        ("changes", JPEG + bytes(9_000_000) + b"end", "changes while it is fetched; fetch again once"),
        ("no ranges", JPEG + bytes(40_000_000), "can't be fetched (Range downloading not supported"),
    ],
)
def test_what_goes_wrong_on_the_way_costs_only_that_file(
    wrong: str,
    content: bytes,
    said: str,
    server: Server,
    here: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    whole = (server.root / "F2.jpg").read_bytes()
    (server.root / "F2.jpg").write_bytes(content)
    server.wrong["/F2.jpg"] = wrong
    flight = the_list(server, tmp_path, *ALL)
    line = refused(capsys, here, flight)
    assert line.startswith(f"{server.url('F2.jpg')}: {said}")
    assert "F2.jpg" not in names(here)
    server.wrong.clear()
    (server.root / "F2.jpg").write_bytes(whole)
    kept = set(names(here))
    server.asked.clear()
    assert fetch(here, flight) == 0 and names(here) == [NOTED, *ALL]
    assert set(server.bodies()) == {f"/{name}" for name in ALL} - {f"/{name}" for name in kept}


def test_a_server_that_is_busy_or_leads_on_by_itself_is_asked_again(
    server: Server, here: Path, tmp_path: Path
) -> None:
    server.wrong |= {"/F0.jpg": "busy once", "/F9.jpg": server.url("F1.jpg")}
    assert fetch(here, the_list(server, tmp_path, "F0.jpg", "F9.jpg")) == 0
    assert (here / "F0.jpg").read_bytes() == (server.root / "F0.jpg").read_bytes()
    assert (here / "F9.jpg").read_bytes() == (server.root / "F1.jpg").read_bytes()


def test_a_file_that_breaks_off_is_asked_for_again(server: Server, here: Path) -> None:
    server.wrong["/F0.jpg"] = "breaks off once"
    assert fetch(here, server.url("F0.jpg")) == 0
    assert (here / "F0.jpg").read_bytes() == (server.root / "F0.jpg").read_bytes()


def test_nobody_answers(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(capsys, here, "http://127.0.0.1:1/F0.jpg")
    assert line.startswith("http://127.0.0.1:1/F0.jpg: can't be reached (CURL error: Failed to connect")
    assert not here.exists()


def test_a_folder_that_is_not_there(server: Server, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(capsys, here, "s3://none/flight/")
    assert line.startswith("s3://none/flight/: can't be listed")
    line = refused(capsys, here, server.url("flights/"))
    assert "is a folder, and folders of web servers aren't listed; write a list" in line


def test_what_people_put_or_changed_there_stays(
    server: Server, here: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight = the_list(server, tmp_path, *ALL)
    here.mkdir()
    (here / "F0.jpg").write_text("my own")
    line = refused(capsys, here, flight)
    assert line == (
        f"{here / 'F0.jpg'}: is in the way: it was not fetched; move it elsewhere, or allow it with --overwrite"
    )
    assert names(here) == ["F0.jpg"]
    (here / "F0.jpg").unlink()
    assert fetch(here, flight) == 0
    text = (here / "pos.csv").read_text().replace("48.1", "48.2")
    (here / "pos.csv").write_text(text)  # of the same size
    line = refused(capsys, here, flight)
    assert line.startswith(f"{here / 'pos.csv'}: was changed since it was fetched; move it elsewhere, or")
    assert (here / "pos.csv").read_text() == text
    assert fetch(here, flight, "--overwrite") == 0
    assert (here / "pos.csv").read_bytes() == (server.root / "pos.csv").read_bytes()
    (here / "F1.jpg").unlink()
    (here / "F1.jpg").symlink_to(tmp_path / "victim.jpg")
    assert "is a link" in refused(capsys, here, flight, "--overwrite")
    assert not (tmp_path / "victim.jpg").exists()


@pytest.mark.parametrize(
    "name",
    ["..%2Fa.jpg", "..%5Ca.jpg", "a%00.jpg", "a%0A.jpg", "a%1B[2J.jpg", "%ff.jpg", "a%E2%80%AEgpj.jpg", "a" * 201 + ".jpg"],
)  # fmt: skip
def test_a_name_that_leads_elsewhere_or_cannot_be_shown_is_refused(name: str) -> None:
    with pytest.raises(
        InputError, match="names a file that no file of a survey can be called; rename it there"
    ):
        parsed(f"https://example.org/flight/{name}")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("http://example.org/a.jpg", "unencrypted; write https://, or allow it with --insecure"),
        ("https://me:secret@example.org/a.jpg", "https://example.org/a.jpg: holds credentials; give them"),
        ("https:///a.jpg", "names no host"),
        ("https://[::1/a.jpg", "is no address"),
        ("ftp://example.org/a.jpg", "is no address that is read; give https://, s3://, gs:// or az://"),
        ("file:///etc/passwd.jpg", "is no address that is read"),
        ("s3:///a.jpg", "names no bucket"),
        ("s3://bucket/a\x1b.jpg", "holds what no address can"),
    ],
)
def test_addresses_that_are_refused(text: str, said: str) -> None:
    with pytest.raises(InputError) as error:
        parsed(text)
    assert said in str(error.value) and "secret" not in str(error.value)


def test_addresses_become_names_of_gdal() -> None:
    plain = parsed("https://example.org/my flight/A%20ä.jpg?key=secret&b=1")
    assert plain.name == "A ä.jpg"
    assert plain.vsi == "/vsicurl/https://example.org/my%20flight/A%20%C3%A4.jpg?key=secret&b=1"
    assert "secret" not in plain.text
    assert parsed("gs://bucket/one/A%20.jpg").vsi == "/vsigs/bucket/one/A%20.jpg"
    assert parsed("az://box/one/").name == "" and parsed("az://box/one/").vsi == "/vsiaz/box/one/"
    assert parsed("http://example.org/a.jpg", insecure=True).name == "a.jpg"
    assert parsed("http://[::1]:80/a.jpg").name == parsed("http://localhost/a.jpg").name == "a.jpg"


@pytest.mark.parametrize(
    ("name", "text", "found"),
    [
        ("a.txt", "# flight\n\n s3://b/1,2.jpg \r\nhttps://h/2.jpg", ["s3://b/1,2.jpg", "https://h/2.jpg"]),
        ("a.csv", 'frame,url\n1,"https://h/1,2.jpg"\n2,https://h/2.jpg\n', ["https://h/1,2.jpg", "https://h/2.jpg"]),
        ("a.txt", "https://h/1.jpg\nF2.jpg\n", "line 2 holds no address"),
        ("a.csv", "frame,url\n1,https://h/1.jpg\n2,\n", "line 3 holds no address"),
        ("a.csv", "https://h/1.jpg,https://h/1.tif\n", "line 1 holds several addresses"),
        ("a.csv", "a" * 200_000, "line 1 is no row of a table"),
        ("a.txt", "# nothing\n", "holds no address"),
    ],
)  # fmt: skip
def test_lists(name: str, text: str, found: list[str] | str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(text.encode())
    if isinstance(found, list):
        assert read_addresses(path) == found
        return
    with pytest.raises(InputError, match=found):
        read_addresses(path)


def test_two_files_of_one_name_are_reported_with_both_addresses(
    server: Server, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (server.root / "flights" / "f0.JPG").write_bytes(JPEG)
    two = server.url("F0.jpg"), server.url("flights/f0.JPG")
    line = refused(capsys, here, *two, two[0])
    assert line.startswith(f"{two[1]}: its name is that of {two[0]} too; fetch them into two folders")
    assert fetch(here, two[0], two[0]) == 0


def test_a_signature_in_an_address_is_kept_nowhere(
    server: Server, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fetch(here, server.url("F0.jpg?X-Signature=secret")) == 0
    line = refused(capsys, here, server.url("none.jpg?X-Signature=secret"))
    output = capsys.readouterr()
    assert "secret" not in line + output.out + output.err + (here / NOTED).read_text()


def test_the_bolt_is_shut_for_all_other_names_and_afterwards(server: Server) -> None:
    assert look(parsed(server.url("F0.jpg"))).size_bytes == 50_004
    server.asked.clear()
    for name in ("F0.jpg", "F1.jpg"):
        assert gdal.VSIStatL(f"/vsicurl/{server.url(name)}?again") is None
    assert server.asked == []


def test_notes_of_a_stranger_lead_nowhere(server: Server, here: Path, tmp_path: Path) -> None:
    here.mkdir()
    entry = {"address": 5, "size_bytes": "x", "time_ns": None}
    (here / NOTED).write_text(
        json.dumps({"files": {"../../victim.jpg": entry, "F0.jpg": entry, "F1.jpg": 7}})
    )
    assert fetch(here, the_list(server, tmp_path, *ALL)) == 0
    (here / NOTED).write_text("[1")
    (here / "F0.jpg").unlink()
    assert fetch(here, server.url("F0.jpg")) == 0


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.proof)])
def test_a_stop_leaves_nothing_half_written(
    number: signal.Signals, server: Server, here: Path, tmp_path: Path
) -> None:
    server.wrong["/F2.jpg"] = "hangs"
    flight = the_list(server, tmp_path, *ALL)
    command = [sys.executable, "-m", "geomosaic.cli.main", "fetch", str(flight), "-o", str(here)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    running = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL)
    until = time.monotonic() + 30.0
    while not {"F0.jpg", "F1.jpg", "pos.csv"} <= set(names(here)) or not list(here.glob(".F2*")):
        assert time.monotonic() < until and running.poll() is None
        time.sleep(0.02)
    running.send_signal(number)
    asked = time.monotonic()
    _, err = running.communicate(timeout=10.0)
    assert running.returncode == 128 + number and time.monotonic() - asked < 3.5
    assert err.decode().splitlines()[-1] == "geomosaic: stopped" and b"Traceback" not in err
    assert "F2.jpg" not in names(here)
    server.wrong.clear()
    server.asked.clear()
    assert fetch(here, flight) == 0
    assert names(here) == [NOTED, *ALL] and server.bodies() == ["/F2.jpg"]
