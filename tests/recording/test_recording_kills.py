"""A run that is killed says where it was: in which stage, how far, since when."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from recorded_survey import bad_survey

from geomosaic.cli.main import main
from geomosaic.errors import CancelledError
from geomosaic.pipeline.recipe import parse_recipe
from geomosaic.pipeline.registry import installed
from geomosaic.pipeline.run_options import RunOptions
from geomosaic.pipeline.runner import run
from geomosaic.pipeline.stage_recorder import StageRecorder, replay_calls
from geomosaic.recording import Recorder, read_recording
from geomosaic.recording.file.heartbeat import EVERY_S
from geomosaic.recording.file.repair import repaired
from geomosaic.recording.file.writer import StageEnd
from geomosaic.recording.inspect.inspection import Inspection
from geomosaic.recording.inspect.worst import faults
from geomosaic_simulate.survey import SimulatedSurvey

KILLED = (("Place frames by POS", "matching.sift"), ("Match frames with SIFT", "adjustment.solve"))
"""Behind which line of progress, in which stage."""


def done(stage: str, line: str) -> bool:
    """Whether a line of progress says that a stage is done."""
    return re.search(rf"\] {re.escape(stage)}: [0-9.]+ s$", line.rstrip()) is not None


def killed(frames: Path, run: Path, after: str) -> list[str]:
    """Starts a mosaic and kills it behind a line of its progress, in matching once its recording says how far
    it is; the lines until then."""
    command = [sys.executable, "-m", "geomosaic.cli.main", "mosaic", str(frames), "-o", str(run)]
    lines = []
    with subprocess.Popen(
        [*command, "--workers", "1"], stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        assert process.stderr is not None
        for line in process.stderr:
            lines.append(line)
            if done(after, line):
                time.sleep(0.2)
                for _ in range(600 if after == KILLED[0][0] else 0):
                    beat = read_recording(run / "run.mcap").progress
                    if beat is not None and beat.text and beat.stage_id == KILLED[0][1]:
                        break
                    time.sleep(0.05)
                break
        os.killpg(process.pid, signal.SIGKILL)
        lines += list(process.stderr)
    return lines


@pytest.mark.proof
@pytest.mark.parametrize(
    ("after", "stage"),
    KILLED,
    ids=[k[1] for k in KILLED],
)
def test_a_killed_run_says_where_it_was(
    tmp_path: Path,
    tmp_path_factory: pytest.TempPathFactory,
    capsys: pytest.CaptureFixture[str],
    after: str,
    stage: str,
) -> None:
    frames = bad_survey(tmp_path_factory) / "frames"
    lines = killed(frames, tmp_path / "run", after)
    assert not (tmp_path / "run" / "run.json").exists()
    assert not any(done(installed().get(stage).display_name, line) for line in lines), "too late"
    capsys.readouterr()
    assert main(["inspect", str(tmp_path / "run"), "--json", "--worst", "5"]) == 0
    found = json.loads(capsys.readouterr().out)
    ended = found["ended"]
    assert (ended["finished"], ended["in_stage"]) == (False, stage) and f"in {stage}" in ended["text"]
    if stage == "matching.sift":
        assert ended["doing"] and 0.0 <= ended["seconds"] < 60.0 and ended["memory_mb"] > 10.0
    assert found["worst"]["faults"][0]["code"] == "run-killed"
    assert main(["inspect", str(tmp_path / "run"), "--repair", str(tmp_path / "whole.mcap")]) == 0
    whole = read_recording(tmp_path / "whole.mcap")
    assert whole.whole and [s.stage_id for s in whole.stages if not s.finished] == [stage]


def test_a_run_that_ends_while_inputs_are_read_leaves_its_recipe(
    few_survey: SimulatedSurvey, tmp_path: Path
) -> None:
    frames = few_survey.frames
    recipe = parse_recipe(
        "name: x\nstages: [survey.read]\n", installed(), [f"survey.read.frames={frames}"], file="x"
    )
    with pytest.raises(CancelledError):
        run(recipe, tmp_path / "run", RunOptions(cancelled=lambda: True))
    left = read_recording(tmp_path / "run" / "run.mcap")
    assert str(frames) in left.recipe_yaml and left.environment["geomosaic"] and not left.stages


def test_how_far_the_reading_of_inputs_was_is_reported(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run.mcap", memory_bytes=lambda: 7_000_000)
    recorder.begin_run("name: x\n", {})
    recorder.progress(3, 20, "reading inputs")
    time.sleep(EVERY_S + 0.3)
    ended = Inspection(read_recording(tmp_path / "run.mcap"), None).ended()
    assert ended["text"].startswith("before its first stage, at 3 of 20 reading inputs, ")
    assert (ended["finished"], ended["in_stage"], ended["memory_mb"]) == (False, None, 7.0)
    recorder.inputs({"survey.read.frames": {}})
    recorder.stage_started("survey.read", 1, {}, {})
    recorder.flush()
    assert Inspection(read_recording(tmp_path / "run.mcap"), None).ended()["text"] == "in survey.read"
    recorder.close()


def test_a_run_killed_between_two_stages_is_not_finished_once_repaired(tmp_path: Path) -> None:
    """Its file is whole then, and its last stage is done; but its recipe has more."""
    recorder = Recorder(tmp_path / "run.mcap")
    recorder.begin_run("name: x\nstages: [survey.read, projection.ground]\n", {}, {})
    recorder.stage_started("survey.read", 1, {}, {})
    recorder.stage_finished("survey.read", StageEnd(seconds=1.0))
    assert repaired(read_recording(tmp_path / "run.mcap"), tmp_path / "whole.mcap") == 2
    recorder.close()
    for name in ("run.mcap", "whole.mcap"):
        whole = read_recording(tmp_path / name)
        ended = Inspection(whole, None).ended()
        assert whole.whole and (ended["finished"], ended["text"]) == (False, "after survey.read")
        assert faults(whole, None, [])[0]["text"] == "the run was killed after survey.read"


def test_what_a_cached_stage_has_not_made_is_reported(tmp_path: Path) -> None:
    """Its cache was filled when images weren't recorded, now they are."""
    with Recorder(tmp_path / "first.mcap", level="summary") as recorder:
        recorder.stage_started("quality.verdict", 1, {}, {})
        stage = StageRecorder(recorder, tmp_path / "calls", "quality.verdict")
        assert not stage.wants("chip")
        stage.close()
    for level, reported in (("normal", 1), ("summary", 0)):
        with Recorder(tmp_path / f"{level}.mcap", level=level) as recorder:
            recorder.stage_started("quality.verdict", 1, {}, {})
            replay_calls(tmp_path / "calls", recorder)
        log = read_recording(tmp_path / f"{level}.mcap").log
        assert len(log) == reported and all("no ChipTies" in line.text for line in log)
    assert not read_recording(tmp_path / "first.mcap").log
