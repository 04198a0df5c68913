"""`geomosaic diff` of surveys: what came of it first, the worst first; folders' names don't count."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from recorded_survey import bad_survey

from geomosaic.cli.main import main

RECIPE = """name: to the adjustment
stages:
  - {stage: survey.read, params: {frames: FRAMES}}
  - matching.flying_height
  - projection.ground
  - placement.pos
  - {stage: matching.sift, params: {keypoints: 800}}
  - adjustment.solve
"""
FRAMES = ("F0001.jpg", "F0002.jpg", "F0007.jpg", "F0008.jpg")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders a and b with the same frames, the same names of files and the same recipe, and c, whose solve is
    another one; each with its RUN."""
    survey, folder = bad_survey(tmp_path_factory), tmp_path_factory.mktemp("runs")
    for name in ("a", "b"):
        (folder / name / "FRAMES").mkdir(parents=True)
        for frame in FRAMES:
            shutil.copy2(survey / "frames" / frame, folder / name / "FRAMES" / frame)
        (folder / name / "recipe.yaml").write_text(RECIPE)
        run = ["run", str(folder / name / "recipe.yaml"), "-o", str(folder / name / "RUN"), "--workers", "1"]
        assert main([*run, "--fixed-time"]) == 0
    again = ["-o", str(folder / "c" / "RUN"), "--workers", "1", "--set", "adjustment.solve.method=chain"]
    assert main(["replay", str(folder / "a" / "RUN"), *again]) == 0
    return folder


def difference(capsys: pytest.CaptureFixture[str], a: Path, b: Path, *more: str) -> tuple[int, Any]:
    capsys.readouterr()
    code = main(["diff", str(a / "RUN"), str(b / "RUN"), "--json", *more])
    return code, json.loads(capsys.readouterr().out)


def test_the_same_survey_in_another_folder_is_the_same(
    runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, found = difference(capsys, runs / "a", runs / "b")
    assert code == 0 and found["equal"]
    assert found["elsewhere"] == {
        "survey.read.frames": [str(runs / "a" / "FRAMES"), str(runs / "b" / "FRAMES")]
    }
    assert not any(found[k] for k in ("frames", "pairs", "figures", "recipe", "stages", "fingerprints"))


def test_a_frame_that_changed_is_named_though_the_folder_is_another(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its hash stands in the manifest."""
    shutil.copytree(runs / "b", tmp_path / "d", ignore=shutil.ignore_patterns("work", "RUN"))
    frame = tmp_path / "d" / "FRAMES" / FRAMES[1]
    cv2.imwrite(str(frame), np.full((300, 400, 3), 90, np.uint8))
    (tmp_path / "d" / "recipe.yaml").write_text(RECIPE.split("  - matching.flying")[0])
    run = ["run", str(tmp_path / "d" / "recipe.yaml"), "-o", str(tmp_path / "d" / "RUN"), "--workers", "1"]
    assert main([*run, "--fixed-time", "--set", "survey.read.leave_out=none"]) in (0, 2)
    code, found = difference(capsys, runs / "a", tmp_path / "d")
    assert code == 1 and list(found["manifest"]) == [f"survey.read.frames.{FRAMES[1]}"]


def test_consequences_come_first_and_the_worst_of_them_first(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, found = difference(capsys, runs / "a", runs / "c", "--png", str(tmp_path / "moves.png"))
    assert code == 1 and found["first_stage"] == "adjustment.solve"
    moved = [f["moved_m"] for f in found["frames"]]
    assert len(moved) == 4 and moved == sorted(moved, reverse=True) and moved[0] > 0.01
    worst = found["frames"][0]
    length = np.linalg.norm([worst[f"d_{axis}_m"] for axis in ("east", "north", "up")])
    assert worst["moved_m"] == pytest.approx(length)
    rms = [abs(p["rms_m"][1] - p["rms_m"][0]) for p in found["pairs"] if "rms_m" in p]
    assert rms and rms == sorted(rms, reverse=True)
    assert list(found)[:5] == ["equal", "paths", "first_stage", "frames", "offsets"]
    assert list(found)[-1] == "fingerprints"
    assert found["stages"] == [{"stage": "adjustment.solve", "params": {"method": ["bundle", "chain"]}}]
    assert main(["diff", str(runs / "a" / "RUN"), str(runs / "c" / "RUN")]) == 1
    out = capsys.readouterr().out
    places = [
        out.index(t)
        for t in (worst["frame"], "pairs with other residuals", "method", "fingerprints differ of")
    ]
    assert places == sorted(places) and f"{worst['moved_m']:.3f}" in out
    image = cv2.imread(str(tmp_path / "moves.png"))
    assert image is not None
    red = (image[..., 2] > 180) & (image[..., 1] < 90)
    assert red.sum() > 100, "no arrow"
