"""What a private recording leaves out of texts: folders however they are written, places and map systems."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from small_surveys import geomosaic, mosaic, summary

from geomosaic.recording import read_recording
from geomosaic.recording.file.privacy import Privacy
from geomosaic.recording.file.writer import Recorder, StageEnd
from geomosaic_simulate.survey import SimulatedSurvey

WKT = 'PROJCS["Amersfoort / RD New", UNIT["metre", 1]]'


@pytest.mark.parametrize(
    ("text", "left"),
    [
        ("IMG_1.tif=/home/alice/My Secret/panel.csv", "IMG_1.tif=panel.csv"),
        ("/mnt/My Data/Secret Client/dem.tif", "dem.tif"),
        ("file:///home/alice/x y/f.jpg", "f.jpg"),
        ("//server/share/client/f.tif", "f.tif"),
        ("../alice/client/f.jpg", "f.jpg"),
        ("see C:\\Users\\a b\\f.jpg", "see f.jpg"),
        ("/data/客户甲/7号/frames", "frames"),
        ("3 m/s, 0.5 / 3 px and https://x.org/a/b", "3 m/s, 0.5 / 3 px and https://x.org/a/b"),
    ],
)
def test_folders(text: str, left: str) -> None:
    assert Privacy([Path("/data/客户甲/7号")]).text(text) == left


@pytest.mark.parametrize(
    "text",
    [
        *("epsg:32632", "WGS 84 / UTM zone 32N", "urn:ogc:def:crs:EPSG::32632", "+proj=utm +zone=32"),
        *("EPSG:25832+7837", "ETRF2000-PL / CS92"),
    ],
)
def test_map_systems(text: str) -> None:
    """Those that the run names as well, by whatever name."""
    private = Privacy(systems=["EPSG:2180", "ETRF2000-PL / CS92"], places=True)
    assert private.text(f"in {text}, it") == "in its map system, it"
    assert Privacy().text(text) == text


def test_places_in_messages() -> None:
    text = (
        "the frames (7.621, -45.032 deg) lie 345 km outside (12 to 18, 0 to 84 deg); turned by 3 deg (3 deg)"
    )
    left = "the frames (its place) lie 345 km outside (its place); turned by 3 deg (3 deg)"
    assert Privacy(places=True).text(text) == left
    assert Privacy().text(text) == text


@pytest.mark.parametrize("named", [{"crs": WKT}, {"frames": "/home/jörg/Müller GmbH/frames"}])
def test_parameters_stay_readable(tmp_path: Path, named: dict[str, str]) -> None:
    """JSON within a message: escapes hid folders, and its quotes passed for some."""
    path = tmp_path / "run.mcap"
    with Recorder(path, privacy=Privacy([Path("/home/jörg/Müller GmbH")])) as recorder:
        recorder.begin_run("stages: []\n", {}, {})
        recorder.stage_started("a", 1, named, {})
        recorder.metric("found", {'field "7" Ä.jpg': 1})
        recorder.stage_finished("a", StageEnd(seconds=0.0, notes={"metrics": {"found": 1}}))
    recording = read_recording(path)
    assert not recording.problem
    (stage,) = recording.stages
    assert stage.params == {key: text.removeprefix("/home/jörg/Müller GmbH/") for key, text in named.items()}
    assert recording.metrics["found"] == {'field "7" Ä.jpg': 1}


def test_its_frames_are_found_by_content(few_survey: SimulatedSurvey, tmp_path: Path) -> None:
    """The recording names them without their folder; a replay made a coarse map of thumbnails."""
    frames = shutil.copytree(few_survey.frames, tmp_path / "frames")
    assert mosaic(frames, tmp_path / "run", "--adjust", "least_squares", "--private") == 0
    frames.rename(tmp_path / "elsewhere")
    replay = ["replay", tmp_path / "run", "-o", tmp_path / "again", "--frames", tmp_path / "elsewhere"]
    assert geomosaic(*replay, "--from", "mosaic.compose", "--workers", 1) == 0
    assert not [w for w in summary(tmp_path / "again")["warnings"] if w["code"] == "frames-gone"]
    assert summary(tmp_path / "again")["mosaic"] == summary(tmp_path / "run")["mosaic"]
