"""`geomosaic push`: a run's results in an object store, run.json last."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from small_surveys import geomosaic
from web_server import Server


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    """A store with an empty bucket `maps`."""
    (tmp_path / "there" / "maps").mkdir(parents=True)
    with Server(tmp_path / "there") as serving:
        for name, value in serving.store().items():
            monkeypatch.setenv(name, value)
        yield serving


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A finished run: a mosaic, tiles, its cache, and a file of the user's that the marker does not list."""
    folder = tmp_path / "run"
    for name in ("mosaic.tif", "tiles/1/0.png", "work/hashes.json", "notes.txt", "run.json"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)
    made = ["mosaic.tif", "tiles", "work/hashes.json", "run.json"]
    (folder / ".geomosaic.json").write_text(json.dumps({"files": made}))
    return folder


def test_a_run_goes_there_without_its_cache_and_run_json_last(server: Server, run: Path) -> None:
    assert geomosaic("push", run, "s3://maps/north/") == 0
    there = server.root / "maps" / "north"
    assert sorted(p.relative_to(there).as_posix() for p in there.rglob("*") if p.is_file()) == [
        "mosaic.tif", "run.json", "tiles/1/0.png"
    ]  # fmt: skip
    assert (there / "mosaic.tif").read_text() == "mosaic.tif"
    assert [path for method, path in server.asked if method == "PUT"][-1] == "/maps/north/run.json"


def refused(capsys: pytest.CaptureFixture[str], run: Path, to: str) -> str:
    capsys.readouterr()
    assert geomosaic("push", run, to) == 2
    return capsys.readouterr().err.splitlines()[-1]


def test_what_a_store_refuses_or_loses_is_one_line(
    server: Server, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    server.wrong["/maps/north/mosaic.tif"] = "refuses"
    said = refused(capsys, run, "s3://maps/north/")
    assert "s3://maps/north/mosaic.tif: can't be written" in said and "the right to write there" in said
    server.wrong["/maps/north/mosaic.tif"] = "loses"
    said = refused(capsys, run, "s3://maps/north/")
    assert "s3://maps/north/mosaic.tif: arrived with another size; push again" in said
    assert not (server.root / "maps" / "north" / "run.json").exists()


def test_a_push_over_an_earlier_one_that_breaks_off_leaves_no_whole_run(
    server: Server, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Old files next to new ones looked whole by the run.json of the earlier push."""
    assert geomosaic("push", run, "s3://maps/north/") == 0
    server.wrong["/maps/north/tiles/1/0.png"] = "refuses"
    assert "0.png: can't be written" in refused(capsys, run, "s3://maps/north/")
    assert not (server.root / "maps" / "north" / "run.json").exists()
    server.wrong.clear()
    assert geomosaic("push", run, "s3://maps/north/") == 0
    assert (server.root / "maps" / "north" / "run.json").read_text() == "run.json"


def test_what_is_no_store_or_no_run_is_refused(
    server: Server, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "is no folder of an object store" in refused(capsys, run, "s3://maps/north")
    assert "is a folder, and folders of web servers" in refused(capsys, run, "https://example.org/maps/")
    (run / "run.json").unlink()
    assert "holds no finished run" in refused(capsys, run, "s3://maps/north/")
    shutil.rmtree(run)
    assert "holds no finished run" in refused(capsys, run, "s3://maps/north/")
