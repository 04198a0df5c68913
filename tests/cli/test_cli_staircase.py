"""The whole staircase on a tiny simulated survey: equal bytes, resuming after a kill, replaying."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from small_surveys import mosaic
from test_cli_commands import COMMAND, gone

from geomosaic.cli.main import main
from geomosaic.pipeline.recipe import load_recipe
from geomosaic.pipeline.registry import installed
from geomosaic.pipeline.reporter import Silent
from geomosaic.pipeline.run_folder import MARKER
from geomosaic.pipeline.runner import run
from geomosaic.recording.file.reader import read_recording
from geomosaic_simulate.survey import SimulatedSurvey

RECIPE = """name: tiny
stages:
  - {stage: survey.read, params: {frames: frames}}
  - projection.ground
  - placement.pos
  - matching.sift
  - adjustment.solve
  - mosaic.seams
  - mosaic.compose
  - export.cog
  - export.layers
  - export.report
"""


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight frames in one line."""
    folder = tmp_path_factory.mktemp("survey")
    size = ["--width-px", "320", "--height-px", "240", "--ground-pixel-m", "0.2"]
    assert main(["simulate", "frames", str(folder), "--lines", "1", "--frames-per-line", "8", *size]) == 0
    (folder / "tiny.yaml").write_text(RECIPE)
    return folder


def files_of(folder: Path) -> list[str]:
    """Without the marker."""
    return sorted(p.name for p in folder.iterdir() if p.name != MARKER)


@pytest.mark.proof
def test_two_runs_with_fixed_time_record_equal_bytes(few_survey: SimulatedSurvey, tmp_path: Path) -> None:
    for name, workers in (("a", "1"), ("a longer name", "2")):
        out = str(tmp_path / name)
        how = ["--adjust", "least_squares", "--fixed-time", "--workers", workers]
        assert main(["mosaic", str(few_survey.frames), "-o", out, *how]) == 0
    a, b = ((tmp_path / name / "run.mcap").read_bytes() for name in ("a", "a longer name"))
    assert a == b and len(a) > 50_000
    summary = json.loads((tmp_path / "a" / "run.json").read_text())
    assert len(summary["timings_s"]) == 18 and summary["peak_memory_mb"] > 50


@pytest.mark.parametrize(
    ("start", "replayed"),
    [("", 0), pytest.param("mosaic.compose", 10, marks=pytest.mark.proof), ("export.report", 17)],
)
def test_a_replay_without_changes_is_equal(
    few_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], start: str, replayed: int
) -> None:
    out, begin = tmp_path / "again", ["--from", start] if start else []
    capsys.readouterr()
    assert main(["replay", str(few_run), "-o", str(out), *begin, "--workers", "1"]) == 0
    said = capsys.readouterr().err
    assert said.count(": from the recording") == replayed
    assert "from the cache" not in said
    assert main(["diff", str(few_run), str(out)]) == 0
    first, *others = capsys.readouterr().out.splitlines()
    assert first == "the runs are equal" and {line.split(":")[0] for line in others} <= {"time"}
    for name in ("mosaic.tif", "positions.csv"):
        assert (out / name).read_bytes() == (few_run / name).read_bytes()
    if start == "export.report":
        messages = [
            {t.name: t.messages for t in read_recording(folder / "run.mcap").topics.values()}
            | {"/progress": 0}
            for folder in (few_run, out)
        ]
        assert messages[0] == messages[1]


def test_a_replay_with_another_method_names_the_adjustment_and_the_frames(
    few_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change = ["--set", "adjustment.solve.method=chain", "--workers", "1"]
    assert main(["replay", str(few_run), "-o", str(tmp_path / "chain"), *change]) == 0
    capsys.readouterr()
    assert main(["diff", str(few_run), str(tmp_path / "chain"), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["first_stage"] == "adjustment.solve"
    assert found["stages"][0]["params"] == {"method": ["bundle", "chain"]}
    assert found["manifest"] == {}
    assert {w["stage"] for w in found["warnings"]} <= {"quality.verdict"}, "what the chain is worth"
    assert {f["frame"] for f in found["frames"]} == {f"F000{i}.jpg" for i in range(1, 5)}
    moved_m = [f["moved_m"] for f in found["frames"]]
    assert moved_m == sorted(moved_m, reverse=True) and 0.5 < moved_m[0] < 50


class Counts(Silent):
    """How many results each kind of work began with."""

    def __init__(self) -> None:
        self.found: dict[str, tuple[int, int]] = {}

    def progress(self, done: int, total: int, text: str) -> None:
        """The first word of each kind."""
        self.found.setdefault(text, (done, total))


def items(folder: Path) -> dict[Path, int]:
    paths = (folder / "work" / "matching.sift" / "items").glob("*/*")
    return {p: p.stat().st_mtime_ns for p in paths if not p.name.startswith(".")}


@pytest.fixture
def killed(survey: Path, tmp_path: Path) -> Iterator[Path]:
    """The folder of a run killed with SIGKILL among the pairs."""
    folder = tmp_path / "RUN"
    process = subprocess.Popen(
        [*COMMAND, "run", str(survey / "tiny.yaml"), "-o", str(folder), "--workers", "2"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        end = time.monotonic() + 60
        while len(items(folder)) < 8 + 8 + 3:
            assert process.poll() is None and time.monotonic() < end
            time.sleep(0.005)
        process.kill()
        process.wait()
        assert gone(process.pid, 10), "orphans"
        yield folder
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@pytest.mark.proof
def test_a_killed_run_is_readable_and_resumes_where_it_was(killed: Path, survey: Path) -> None:
    recording = read_recording(killed / "run.mcap")
    assert [s.stage_id for s in recording.stages if s.finished] == [
        "survey.read", "projection.ground", "placement.pos",
    ]  # fmt: skip
    assert not recording.whole and recording.recipe_yaml.startswith("name: tiny")
    assert not (killed / "run.json").exists()
    before = items(killed)
    counts = Counts()
    summary = run(load_recipe(survey / "tiny.yaml", installed()), killed, reporter=counts)
    assert counts.found["keypoints"] == (8, 8)
    done, total = counts.found["pairs"]
    assert 3 <= done < total and done == len(before) - 8 - 8
    assert summary["cached_stages"] == ["survey.read", "projection.ground", "placement.pos"]
    assert summary["frames"]["total"] == 8 and read_recording(killed / "run.mcap").whole
    after = items(killed)
    assert len(before.items() - after.items()) == 8, "all but decoded frames is there, untouched"
    assert files_of(killed) == [
        "layers.gpkg", "mosaic.tif", "positions.csv", "report.html",
        "run.json", "run.mcap", "run.unfinished.mcap", "sources.tif", "work",
    ]  # fmt: skip


def test_pos_crs_and_ground_height_reach_their_stages(
    few_survey: SimulatedSurvey, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["mosaic", str(few_survey.frames), "-o", str(tmp_path / "r"), "--ground-height", "9999"]) == 2
    assert "--ground-height 9999" in capsys.readouterr().err
    pos = tmp_path / "pos.csv"
    rows = [f"F000{i}.jpg,{499_000 + 20 * i},5600000,200" for i in range(1, 5)]
    pos.write_text("\n".join(["frame,x,y,height_ellipsoidal_m", *rows]))
    arguments = [
        "mosaic",
        str(few_survey.frames),
        "-o",
        str(tmp_path / "r"),
        "--pos",
        str(pos),
        "--workers",
        "1",
    ]
    assert main(arguments) == 2
    assert "--pos-crs" in capsys.readouterr().err
    code = main([*arguments, "--pos-crs", "EPSG:32632", "--ground-height", "120.5", "--adjust", "none"])
    said = capsys.readouterr()
    assert code == 0, said.err
    stages = read_recording(tmp_path / "r" / "run.mcap").stages
    assert stages[0].params["pos_crs"] == "EPSG:32632" and stages[1].params["height_m"] == 120.5
    summary = json.loads((tmp_path / "r" / "run.json").read_text())
    assert summary["mosaic"]["crs"] == "EPSG:32632"


def test_a_run_ends_with_how_well_the_frames_agree_and_how_true_the_map_is(
    few_survey: SimulatedSurvey, few_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(few_run, tmp_path / "r")
    files = ("--pos", few_survey.pos, "--camera", few_survey.camera)
    assert mosaic(few_survey.frames, tmp_path / "r", *files, "--reference", few_survey.ortho) == 0
    said = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    metrics = json.loads((tmp_path / "r" / "run.json").read_text())["metrics"]
    agreement = re.fullmatch(r"(\d\.\d\d) px mean reprojection error", said["agreement"])
    assert agreement and float(agreement[1]) == pytest.approx(
        metrics["adjustment"]["reprojection_mean_px"], abs=0.006
    )
    accuracy = re.fullmatch(
        r"([\d.]+) m RMSE, 90 % within ([\d.]+) m, at (\d+) places of the reference", said["reference"]
    )
    quality = metrics["quality"]
    wanted = [quality["absolute_rmse_m"], quality["ce90_m"], quality["measured"]]
    assert accuracy and [float(x) for x in accuracy.groups()] == pytest.approx(wanted, rel=0.01)
    assert mosaic(few_survey.frames, tmp_path / "r", *files, "--adjust", "error_sharing") == 0
    assert not {"agreement", "reference"} & {s.split()[0] for s in capsys.readouterr().out.splitlines()}


def test_the_front_door_needs_no_numpy() -> None:
    code = "import sys, geomosaic.cli.app; print([m for m in ('numpy', 'cv2', 'osgeo') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_workers_are_made_ready_before_anything_heavy_is_imported() -> None:
    code = (
        "import sys, geomosaic.pipeline.worker_process as e\n"
        "from geomosaic.requests.mosaic_request import MosaicRequest as Request\n"
        "e.prepare_workers = lambda modules: print(*modules, 'numpy' in sys.modules)\n"
        "Request(frames='x', workers=2).prepare(['survey.read', 'matching.sift', 'no.such'])\n"
        "Request(frames='x', workers=1).prepare(['survey.read'])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["geomosaic.stages.matching_sift", "geomosaic.stages.survey_read", "False"]
