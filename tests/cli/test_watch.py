"""A folder that is watched while frames are copied into it comes out as one that was there from the start."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from small_surveys import mosaic, small_survey

from geomosaic.cli.main import main

LIMIT_S = 120
METHOD = ("--adjust", "least_squares")


def _wait_for(page: Path, text: str, process: subprocess.Popen[str]) -> str:
    end = time.monotonic() + LIMIT_S
    while time.monotonic() < end and process.poll() is None:
        if page.is_file() and text in (shown := page.read_text(encoding="utf-8")):
            return shown
        time.sleep(0.2)
    raise AssertionError(f"no preview of {text}: {process.communicate(timeout=5)}")


@pytest.mark.proof
def test_previews_while_frames_arrive_and_then_the_mosaic_of_one_go(tmp_path: Path) -> None:
    survey = small_survey(tmp_path / "simulated", lines=1, frames_per_line=5, width_px=320, height_px=240)
    frames = sorted(survey.frames.glob("*.jpg"))
    card, run = tmp_path / "card", tmp_path / "run"
    card.mkdir()
    command = [sys.executable, "-m", "geomosaic.cli.main", "watch", card, "-o", run, "--after", "4", *METHOD]
    source = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    watching = subprocess.Popen(
        [*map(str, command), "--workers", "1"],
        env=os.environ | {"PYTHONPATH": source},
        text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    try:
        for frame in frames[:3]:
            shutil.copy(frame, card)
        assert "data:image/webp" in _wait_for(run / "preview.html", "3 frames", watching)
        cut = frames[3].read_bytes()
        (card / frames[3].name).write_bytes(cut[: len(cut) // 2])
        time.sleep(0.3)
        for frame in frames[3:]:
            shutil.copy(frame, card)
        _wait_for(run / "preview.html", f"{len(frames)} frames", watching)
        out, err = watching.communicate(timeout=LIMIT_S)
    finally:
        watching.kill()
    assert watching.returncode == 0, err
    assert out.count("preview ") >= 2
    assert (run / "report.html").exists()
    assert mosaic(card, tmp_path / "one", *METHOD) == 0
    for product in ("mosaic.tif", "accuracy.tif", "positions.csv"):
        assert (run / product).read_bytes() == (tmp_path / "one" / product).read_bytes(), product


def test_a_folder_that_is_not_there_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["watch", str(tmp_path / "none"), "-o", str(tmp_path / "run")]) == 2
    assert "give the folder that holds the frames" in capsys.readouterr().err


def test_ctrl_c_during_a_preview_ends_it_at_once(tmp_path: Path) -> None:
    survey = small_survey(tmp_path / "simulated", lines=1, frames_per_line=3, width_px=320, height_px=240)
    command = [sys.executable, "-m", "geomosaic.cli.main", "watch", survey.frames, "-o", tmp_path / "run"]
    watching = subprocess.Popen(
        [*map(str, command), "--workers", "1"], text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    try:
        end = time.monotonic() + LIMIT_S
        while not (tmp_path / "run" / "work" / "survey.read").is_dir() and time.monotonic() < end:
            time.sleep(0.02)
        watching.send_signal(signal.SIGINT)
        out, err = watching.communicate(timeout=LIMIT_S)
    finally:
        watching.kill()
    assert (watching.returncode, out, err) == (130, "", "geomosaic: stopped\n")


def test_a_fault_that_does_not_pass_ends_the_watch(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two frames that would bear one name: it waited for ever, without a word."""
    survey = small_survey(tmp_path / "simulated", lines=1, frames_per_line=2, width_px=320, height_px=240)
    (frame, *_) = sorted(survey.frames.glob("*.jpg"))
    for folder in ("a/b", "a_b", "c"):
        (tmp_path / "card" / folder).mkdir(parents=True)
    for name in ("a/b/x.jpg", "a_b/x.jpg", "c/b_x.jpg", "c/x.jpg"):
        shutil.copy(frame, tmp_path / "card" / name)
    assert main(["watch", str(tmp_path / "card"), "-o", str(tmp_path / "run"), "--after", "1"]) == 2
    assert "its name looks like that of another frame; rename one of them" in capsys.readouterr().err
