"""A survey replayed with its frames elsewhere, under other names, or without them."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from small_surveys import mosaic

from geomosaic.cli.main import main
from geomosaic.recording import read_recording
from geomosaic.recording.inspect.summary import summary
from geomosaic_simulate.survey import SimulatedSurvey


@pytest.fixture(scope="module")
def survey(few_survey: SimulatedSurvey, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run whose frames are away: in frames-away."""
    survey = tmp_path_factory.mktemp("survey")
    frames = shutil.copytree(few_survey.frames, survey / "frames")
    assert mosaic(frames, survey / "run", "--adjust", "least_squares") == 0
    frames.rename(survey / "frames-away")
    return survey


def replay(survey: Path, out: Path, *arguments: object) -> int:
    return main(["replay", str(survey / "run"), "-o", str(out), "--workers", "1", *map(str, arguments)])


def positions(run: Path) -> list[dict[str, str]]:
    with (run / "positions.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_without_frames_all_is_made_but_what_takes_their_pixels(
    survey: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert replay(survey, out, "--from", "mosaic.tones") == 0
    said = capsys.readouterr().out
    assert "left out   quality.verdict" in said and "thumbnails" in said
    assert positions(out) == positions(survey / "run")
    for name in ("layers.gpkg", "report.html", "mosaic.tif", "run.mcap"):
        assert (out / name).is_file()
    with rasterio.open(out / "mosaic.tif") as made, rasterio.open(survey / "run" / "mosaic.tif") as full:
        assert made.crs == full.crs and made.transform.a > 3.0 * full.transform.a
        area = [(d.dataset_mask() > 0).sum() * d.transform.a**2 for d in (made, full)]
        assert area[0] == pytest.approx(area[1], rel=0.1)
        low, high = made.read(masked=True).min(), made.read(masked=True).max()
        assert high - low > 40, "no picture"
    warned = [w for w in json.loads((out / "run.json").read_text())["warnings"] if w["code"] == "frames-gone"]
    assert len(warned) == 1 and "quality.verdict" in warned[0]["text"]
    recording = read_recording(out / "run.mcap")
    assert summary(recording)["altered"] == []
    assert [line.text for line in recording.warnings if "frames-gone" in line.text] == [
        f"frames-gone: {warned[0]['text']}"
    ]


def test_the_adjustment_is_replayed_and_nothing_before_it(
    survey: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    arguments = ["--from", "adjustment.solve", "--set", "adjustment.solve.method=chain"]
    assert replay(survey, out, *arguments, "--until", "export.layers") == 0
    assert len(positions(out)) == len(positions(survey / "run")) and not (out / "report.html").exists()
    assert positions(out) != positions(survey / "run")
    assert replay(survey, tmp_path / "other", "--from", "matching.sift") == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert "the frames are gone, and matching.sift takes their pixels" in said and "--frames" in said


@pytest.mark.proof
def test_frames_are_found_elsewhere_by_content(
    survey: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Under other names, in folders of folders; the mosaic is the same to the byte, and the runs are equal."""
    found = tmp_path / "found" / "card" / "deep"
    found.mkdir(parents=True)
    for i, frame in enumerate(sorted((survey / "frames-away").iterdir())):
        shutil.copyfile(frame, found / f"picture-{len(found.parts) * 100 - i}.jpg")
    (found.parent / "notes.txt").write_text("nothing of theirs")
    options = ["--from", "mosaic.tones", "--frames", tmp_path / "found"]
    assert replay(survey, tmp_path / "one", *options) == 0
    mosaics = [folder / "mosaic.tif" for folder in (survey / "run", tmp_path / "one")]
    assert mosaics[0].read_bytes() == mosaics[1].read_bytes()
    capsys.readouterr()
    code = main(["diff", str(survey / "run"), str(tmp_path / "one"), "--json"])
    difference: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert code == 0, {k: v for k, v in difference.items() if v}
    assert list(difference["elsewhere"]) == ["survey.read.frames"]
    (entry,) = read_recording(tmp_path / "one" / "run.mcap").manifest.values()
    assert entry["path"] == str(found) and sorted(entry["files"]) == sorted(p.name for p in found.iterdir())


def test_a_frame_that_is_not_the_recorded_one_is_not_taken(
    survey: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = tmp_path / "found"
    shutil.copytree(survey / "frames-away", found)
    cv2.imwrite(str(found / "F0002.jpg"), np.full((240, 320, 3), (0, 0, 255), np.uint8))
    assert replay(survey, tmp_path / "out", "--from", "mosaic.tones", "--frames", found) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert "1 of 4 files" in said and "F0002.jpg" in said
    assert not (tmp_path / "out").exists()
