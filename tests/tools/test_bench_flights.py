"""The bench of flights: its sheets, its figures, and results that are merged by name."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from small_surveys import small_survey

from geomosaic.errors import FileError
from tools.bench.bench_flights import main
from tools.bench.bench_flights_sheet import read_flights, read_sheet


@pytest.mark.proof
def test_flights_of_a_folder_are_run_and_their_results_merged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A survey of six frames with check points succeeds; a folder without frames is a failure with its message."""
    data = tmp_path / "data"
    small_survey(data / "six", frames_per_line=3, width_px=320, height_px=240, control_points=6)
    (data / "empty").mkdir()
    (data / "bad.yaml").write_text("frames: empty\n")
    (data / "gone.yaml").write_text("frames: nowhere\n")
    (data / "good.yaml").write_text(
        "frames: six/frames\noptions: {pos: six/pos.csv, set: [adjustment.solve.model=given]}\n"
        "check_points: six/gcp_list.txt\nexpect: {tied_share: 1, seams_px: 1, parts: 1, megapixels: 4}\n"
    )
    words = [
        str(data),
        "--results",
        str(tmp_path / "flights"),
        "--out",
        str(tmp_path / "out"),
        "--workers",
        "1",
    ]
    assert main([*words, "--only", "bad", "gone"]) == 1
    assert "skipped: gone" in capsys.readouterr().out
    assert main([*words, "--only", "good", "--seed", "3"]) == 0
    page = (tmp_path / "out" / "crops.html").read_text()
    assert "<h2>good good</h2>" in page and 2 <= page.count("data:image/jpeg") <= 20

    flights = json.loads((tmp_path / "flights.json").read_text())["flights"]
    assert list(flights) == ["bad", "good"]
    bad, good = flights["bad"], flights["good"]
    assert bad["exit_code"] == 2 and "empty" in bad["failed"] and bad["seed"] == 0
    assert good["exit_code"] == 0 and good["missed"] == [] and good["seed"] == 3
    assert good["frames"]["tied"] == 6 and good["parts"] == 1
    assert good["seams_px"] <= good["seams_95_px"] < 1.0
    assert good["check"]["n"] == 6 and good["check"]["rmse_horizontal_m"] < 1.0
    assert good["stages_s"]["mosaic.compose"] > 0.0 and good["peak_mb"] > 50
    assert good["command"].startswith("geomosaic mosaic six/frames --pos six/pos.csv --set")
    table = (tmp_path / "flights.md").read_text()
    assert "| good | 0 | 6 of 6 |" in table and "| bad | 2 | - |" in table

    (data / "good.yaml").write_text(
        "frames: six/frames\noptions: {adjust: least_squares}\nexpect: {seams_px: 0.00001}\n"
    )
    assert main([*words, "--only", "good"]) == 1
    assert "seams_px" in json.loads((tmp_path / "flights.json").read_text())["flights"]["good"]["missed"][0]


def test_without_the_folder_the_bench_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path / "nowhere")]) == 0
    assert "skipped" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("frames: a\nframe: b\n", "frame'"),
        ("known: a\n", "frames"),
        ("frames: 3\n", "frames"),
        ("frames: a\noptions: {gpc: b.txt}\n", "gpc"),
        ("frames: a\noptions: {output: /tmp}\n", "output"),
        ("frames: a\nexpect: {seams: 1}\n", "seams"),
        ("frames: a\nexpect: {parts: one}\n", "parts"),
        ("frames: !!python/object:os.system a\n", "tags"),
        ("- a\n", "mapping"),
    ],
)
def test_a_sheet_is_read_strictly(tmp_path: Path, text: str, named: str) -> None:
    """What is not in the schema is an error that names the sheet and the key."""
    path = tmp_path / "one.yaml"
    path.write_text(text)
    with pytest.raises(FileError, match=named) as caught:
        read_sheet(path)
    assert "one.yaml" in str(caught.value)
    assert main([str(tmp_path)]) == 2


def test_a_flight_that_is_not_there_is_named(tmp_path: Path) -> None:
    (tmp_path / "one.yaml").write_text("frames: a\n")
    with pytest.raises(FileError, match="two"):
        read_flights(tmp_path, ["two"])
