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
from geomosaic.pipeline.registry import installed
from geomosaic.recording import read_recording

KILLED = (("Place frames by POS", "matching.sift", 1.2), ("Match frames with SIFT", "adjustment.solve", 0.2))
"""Behind which line of progress, in which stage, after how many seconds."""


def done(stage: str, line: str) -> bool:
    """Whether a line of progress says that a stage is done."""
    return re.search(rf"\] {re.escape(stage)}: [0-9.]+ s$", line.rstrip()) is not None


def killed(frames: Path, run: Path, after: str, seconds: float) -> list[str]:
    """Starts a mosaic and kills it, `seconds` behind a line of its progress; the lines until then."""
    command = [sys.executable, "-m", "geomosaic.cli.main", "mosaic", str(frames), "-o", str(run)]
    lines = []
    with subprocess.Popen(
        [*command, "--workers", "1"], stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        assert process.stderr is not None
        for line in process.stderr:
            lines.append(line)
            if done(after, line):
                time.sleep(seconds)
                break
        os.killpg(process.pid, signal.SIGKILL)
        lines += list(process.stderr)
    return lines


@pytest.mark.parametrize(("after", "stage", "seconds"), KILLED, ids=[k[1] for k in KILLED])
def test_a_killed_run_says_where_it_was(
    tmp_path: Path,
    tmp_path_factory: pytest.TempPathFactory,
    capsys: pytest.CaptureFixture[str],
    after: str,
    stage: str,
    seconds: float,
) -> None:
    frames = bad_survey(tmp_path_factory) / "frames"
    lines = killed(frames, tmp_path / "run", after, seconds)
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
