"""Control points marked by clicks in a real browser: the files agree with the truth, and a reload loses nothing."""

from __future__ import annotations

import json
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Page, browser
from small_surveys import mosaic, summary
from target_survey import TargetSurvey, target_survey

from geomosaic.errors import InputError
from geomosaic.marking.marked_points import LIST, TABLE, read_points
from geomosaic.marking.oriented_frames import OrientedFrames, frames_by_tags, frames_of_run
from geomosaic.marking.page_server import PageServer
from geomosaic.marking.predicted_places import predicted_places
from geomosaic.marking.session import MarkingSession
from geomosaic.pipeline.reporter import Silent
from geomosaic.requests.mosaic_request import MosaicRequest
from geomosaic.survey.control import read_control
from geomosaic.survey.names import FrameNames

ROOT = Path(__file__).parents[2]
CHIP = "document.querySelector('#frames [aria-current=true]')"
FEW = ("--set", "matching.sift.keypoints=700", "-q")
SAVED = "document.querySelector('#status').textContent === 'Saved'"


@pytest.fixture(scope="module")
def window(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> TargetSurvey:
    return target_survey(tmp_path_factory.mktemp("flight"))


@pytest.fixture(scope="module")
def oriented(survey: TargetSurvey) -> OrientedFrames:
    return frames_by_tags(MosaicRequest(frames=survey.frames, camera=survey.camera, workers=1), Silent())


@contextmanager
def served(survey: TargetSurvey, oriented: OrientedFrames, folder: Path) -> Iterator[PageServer]:
    """As a start of the command does it: with the marks that the folder has."""
    points, _ = read_points(survey.rover, folder, oriented)
    with PageServer(MarkingSession(oriented, points, folder)) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def press(window: Page, key: str) -> None:
    text = {"text": key} if len(key) == 1 else {"text": "\r"} if key == "Enter" else {}
    window.send("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
    window.send("Input.dispatchKeyEvent", type="keyUp", key=key)


def present(window: Page, server: PageServer) -> tuple[int, dict[str, Any]]:
    """The chosen point, and its entry of the frame that is shown."""
    point = window.run("[...document.querySelectorAll('.point')].findIndex(p => p.ariaCurrent === 'true')")
    name = window.run(f"{CHIP}.firstChild.textContent")
    names = [frame.name for frame in server.session.frames.frames]
    entries = server.session.state()["points"][point]["frames"]
    return point, next(of for of in entries if names[of["frame"]] == name)


def truth(survey: TargetSurvey, server: PageServer, point: int, entry: dict[str, Any]) -> np.ndarray:
    names = [frame.name for frame in server.session.frames.frames]
    return np.array(survey.truth[server.session.points[point].name][names[entry["frame"]]])


def click_target(window: Page, survey: TargetSurvey, server: PageServer) -> None:
    """The mouse on the target in the frame that was just opened: at full size about the predicted place."""
    point, entry = present(window, server)
    box = "document.querySelector('#frame').getBoundingClientRect()"
    middle = np.array(window.run(f"(b => [b.left + b.width / 2, b.top + b.height / 2])({box})"))
    at = middle + truth(survey, server, point, entry) - entry["predicted"]
    window.run("document.querySelector('#status').textContent = ''")
    for kind in ("mousePressed", "mouseReleased"):
        where = {"x": float(at[0]), "y": float(at[1])}
        window.send("Input.dispatchMouseEvent", type=kind, **where, button="left", clickCount=1)
    window.until(SAVED)


def marks_off_px(survey: TargetSurvey, server: PageServer, file: Path) -> list[float]:
    """Of each mark in a file its distance from the truth."""
    points = read_control(file, FrameNames(f.name for f in server.session.frames.frames)).points
    return [
        float(np.hypot(*np.subtract(at, survey.truth[p.name.removeprefix("CHK-")][image])))
        if p.name.removeprefix("CHK-") in survey.truth
        else float(np.hypot(*np.subtract(at, survey.truth[p.name][image])))
        for p in points
        for image, *at in p.images
    ]


def test_marks_are_clicked_saved_and_there_after_a_reload(
    window: Page, survey: TargetSurvey, oriented: OrientedFrames, tmp_path: Path
) -> None:
    with served(survey, oriented, tmp_path) as server:
        window.open(server.url, 1280, 800)
        window.until("document.querySelectorAll('.point').length === 6")
        most = max(range(6), key=lambda k: len(survey.truth[server.session.points[k].name]))
        window.click(f".point:nth-child({most + 1}) .name", 0.2)
        shown = len(server.session.state()["points"][most]["frames"])
        for number in range(min(shown, 3)):
            window.until(f"{CHIP} && !document.querySelector('#mark').disabled")
            click_target(window, survey, server)
            window.until(f"document.querySelectorAll('#frames .marked').length === {number + 1}")
            press(window, "n")
        for file in (TABLE, LIST):
            off = marks_off_px(survey, server, tmp_path / file)
            assert len(off) == min(shown, 3) and max(off) < 1.0

        press(window, "p")
        window.until(f"{CHIP}.className.includes('marked')")
        press(window, "r")
        window.until(SAVED)
        window.click(f".point:nth-child({most + 1}) .kind")
        window.until(f"document.querySelector('.point:nth-child({most + 1}) .kind').textContent === 'check'")
        assert all(url.startswith(server.url) for url in window.requests if not url.startswith("data:"))
        before = server.session.points

        window.open(server.url, 1280, 800)
        window.until("document.querySelectorAll('.point').length === 6")
        assert window.run("document.querySelector('#count').textContent").startswith(
            f"{min(shown, 3)} marks, 1 of 6"
        )
        assert not window.errors
        refused = server.url.replace(server.token, "x" * len(server.token))
    with served(survey, oriented, tmp_path) as again:
        assert again.session.points == before and before[most].check
        window.open(refused.replace(refused.split("/")[2], again.hosts[0]), 1280, 800)
        assert "open the address" in window.run("document.body.textContent")


def test_a_phone_marks_the_middle_and_zooms_with_two_fingers(
    window: Page, survey: TargetSurvey, oriented: OrientedFrames, tmp_path: Path
) -> None:
    with served(survey, oriented, tmp_path) as server:
        window.open(server.url, 390, 800)
        window.send("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
        window.until("document.querySelectorAll('.point').length === 6")
        assert window.run("document.documentElement.scrollWidth") <= 390
        press(window, "j")
        window.until(f"{CHIP} !== null")
        box = "document.querySelector('#frame').getBoundingClientRect()"
        x, y = window.run(f"(b => [b.left + b.width / 2, b.top + b.height / 2])({box})")
        point, entry = present(window, server)
        goal = truth(survey, server, point, entry)
        fingers(window, (x, y), (x, y) - (goal - entry["predicted"]))
        window.click("#mark")
        window.until(SAVED)
        marked = server.session.points[point].images[0][1:]
        assert np.hypot(*(goal - marked)) < 1.0

        fingers(window, (x - 30, y), (x - 90, y), (x + 30, y), (x + 90, y))
        window.run("document.querySelector('#status').textContent = ''")
        fingers(window, (x + 60, y), (x + 60, y))
        window.until(SAVED)
        moved = server.session.points[point].images[0][1:]
        assert moved[0] - marked[0] == pytest.approx(20.0, abs=1.5)
        window.send("Emulation.setTouchEmulationEnabled", enabled=False)
        assert not window.errors


def fingers(window: Page, *places: Any) -> None:
    """One finger from the first place to the second; a second one from the third to the fourth."""
    starts, ends = places[::2], places[1::2]
    for part, kind in ((0.0, "touchStart"), (0.5, "touchMove"), (1.0, "touchMove")):
        at = [np.array(a) + part * (np.array(b) - a) for a, b in zip(starts, ends, strict=True)]
        points = [{"x": float(p[0]), "y": float(p[1]), "id": i} for i, p in enumerate(at)]
        if kind == "touchStart" or np.any(np.subtract(starts, ends)):
            window.send("Input.dispatchTouchEvent", type=kind, touchPoints=points)
    window.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])


@pytest.mark.proof
def test_a_mosaic_takes_the_marks(survey: TargetSurvey, oriented: OrientedFrames, tmp_path: Path) -> None:
    with served(survey, oriented, tmp_path) as server:
        names = [frame.name for frame in oriented.frames]
        for k, point in enumerate(server.session.points):
            for name, at in survey.truth[point.name].items():
                server.session.mark(k, names.index(name), at, refine=True)
    assert (
        mosaic(survey.frames, tmp_path / "run", "--camera", survey.camera, "--gcp", tmp_path / TABLE, *FEW)
        == 0
    )
    found = summary(tmp_path / "run")["metrics"]["adjustment"]
    assert found["control"]["n"] == 4 and found["check"]["n"] == 2
    assert found["check"]["rmse_horizontal_m"] < 0.1

    adjusted = frames_of_run(survey.frames, tmp_path / "run")
    points, _ = read_points(survey.rover, tmp_path / "none", adjusted)
    places = predicted_places(adjusted, points).image_px
    off = [
        np.hypot(*(places[names.index(name), k] - at))
        for k, point in enumerate(points)
        for name, at in survey.truth[point.name].items()
    ]
    assert np.median(off) < 1.0
    with pytest.raises(InputError, match="none of the run's frames is in this folder"):
        frames_of_run(ROOT / "docs" / "img", tmp_path / "run")


def test_the_command_serves_saves_and_ends(survey: TargetSurvey, tmp_path: Path) -> None:
    """The next command has the options that were given."""
    command = [sys.executable, "-m", "geomosaic.cli.main", "control", survey.frames, "--points", survey.rover]
    given = [
        "--height-datum",
        "ellipsoidal",
        "--camera",
        shutil.copy(survey.camera, tmp_path / "a camera.json"),
    ]
    given = [str(text) for text in (*given, "--ground-height", 500.5)]
    command += [*given, "-o", tmp_path / "marks", "-q"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        word, url = process.stdout.readline().split()
        body = json.dumps({"point": 0, "frame": 0, "at": [5, 5], "refine": False}).encode()
        request = urllib.request.Request(f"{url}mark", body, {"Content-Type": "application/json"})
        with urllib.request.urlopen(request, timeout=60) as answer:
            assert word == "open" and json.load(answer)["points"]
        process.send_signal(signal.SIGINT)
        said = process.stdout.read()
    assert process.returncode == 130
    (line,) = (line for line in said.splitlines() if line.startswith("next "))
    after = ["geomosaic", "mosaic", str(survey.frames), "--gcp", str(tmp_path / "marks" / TABLE), *given]
    assert shlex.split(line)[1:] == after
    assert "F0001.jpg,5.000,5.000" in (tmp_path / "marks" / TABLE).read_text()


@pytest.mark.proof
def test_a_run_without_positions_predicts_by_three_marked_points(tmp_path: Path) -> None:
    unplaced = target_survey(tmp_path / "unplaced", pos_in="csv")
    assert mosaic(unplaced.frames, tmp_path / "run", "--camera", unplaced.camera, *FEW) == 0
    frames = frames_of_run(unplaced.frames, tmp_path / "run")
    assert not frames.on_earth
    points, _ = read_points(unplaced.rover, tmp_path / "none", frames)
    by_sight = sorted(range(6), key=lambda k: len(unplaced.truth[points[k].name]))
    session = MarkingSession(frames, points, tmp_path / "marks")
    names = [frame.name for frame in frames.frames]
    for k in by_sight[-3:]:
        for name, at in [*unplaced.truth[points[k].name].items()][:3]:
            session.mark(k, names.index(name), at)
    places = predicted_places(frames, session.points).image_px
    off = [
        np.hypot(*(places[names.index(name), k] - at))
        for k in by_sight[:3]
        for name, at in unplaced.truth[points[k].name].items()
    ]
    assert np.median(off) < 30.0
