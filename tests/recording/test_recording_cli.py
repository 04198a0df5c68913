"""`geomosaic inspect` and `diff`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from recording_scene import FRAMES, written

from geomosaic.cli.main import main
from geomosaic.recording import Recorder
from geomosaic.recording.file.writer import StageEnd


@pytest.fixture(autouse=True)
def _a_hundred_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever terminal the tests are run from."""
    monkeypatch.delenv("COLUMNS", raising=False)


def output(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main([str(a) for a in arguments])
    said = capsys.readouterr()
    return code, said.out, said.err


def as_json(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, Any]:
    code, out, _ = output(capsys, *arguments, "--json")
    return code, json.loads(out)


def test_inspect_names_stages_rounds_warnings_and_topics(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path / "run.mcap")
    code, short = as_json(capsys, "inspect", path)
    assert code == 0 and short["whole"] is True
    assert [(s["id"], s["version"], s["finished"]) for s in short["stages"]] == [
        ("survey.read", 1, True),
        ("adjustment.solve", 2, True),
    ]
    assert [r["largest_misalignment_m"] for r in short["rounds"]] == [5.0, 2.5, 1.25]
    assert short["rounds"][0]["worst_pair"] == list(FRAMES[:2])
    assert short["artefacts"] == [
        {
            "stage": "survey.read",
            "name": "survey",
            "type": "geomosaic.survey.model:Survey",
            "fingerprint": "ab" * 20,
            "bytes": 2_300_001,
            "whole": True,
        }
    ]
    code, out, _ = output(capsys, "inspect", tmp_path)
    assert code == 0
    for text in (
        ": whole",
        "error_sharing",
        "5.000",
        f"{FRAMES[2]}: turned",
        "geomosaic.TiePoints",
        "2300 kB",
    ):
        assert text in out


def test_inspect_of_a_cut_file_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path / "run.mcap")
    path.write_bytes(path.read_bytes()[:-100])
    code, out, _ = output(capsys, "inspect", path)
    assert code == 0 and "not whole: it was cut off" in out


def test_a_hostile_text_reaches_no_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Recorder(tmp_path / "run.mcap") as recorder:
        recorder.begin_run("", {"geomosaic": "\x1b[31m1"}, {})
        recorder.stage_started("evil[bold]\x1b]0;x\x07", 1, {"a": "\x1b[2J[/nothing]"}, {})
        recorder.log("error", "\x1b[2J[red]boom\nnext", frame="\u202egpj.exe")
    code, out, _ = output(capsys, "inspect", tmp_path)
    assert code == 0
    assert "\x1b" not in out and "\x07" not in out and "\u202e" not in out
    assert "[red]boom next" in out and "evil[bold]" in out and "[/nothing]" in out


def test_equal_recordings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = written(tmp_path / "a.mcap"), written(tmp_path / "b.mcap")
    code, out, _ = output(capsys, "diff", a, b)
    assert (code, out.strip()) == (0, "the runs are equal")


def test_diff_names_the_first_stage_parameters_fingerprints_and_frames(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = written(tmp_path / "a.mcap"), written(tmp_path / "b.mcap", method="chain", rounds=4, warn=False)
    code, found = as_json(capsys, "diff", a, b)
    assert code == 1 and found["equal"] is False
    assert found["first_stage"] == "adjustment.solve"
    assert found["stages"] == [
        {
            "stage": "adjustment.solve",
            "params": {"method": ["error_sharing", "chain"]},
        }
    ]
    outputs = {"adjusted": [f"{13:040x}", f"{5:040x}"]}
    assert found["fingerprints"] == [{"stage": "adjustment.solve", "outputs": outputs}]
    assert list(found)[-1] == "fingerprints"
    (offsets,) = found["offsets"]
    assert offsets["rounds"] == [3, 4]
    assert offsets["frames"] == [
        {"frame": FRAMES[0], "d_east_m": 0.5, "d_north_m": -0.25},
        {"frame": FRAMES[1], "d_east_m": -0.125, "d_north_m": 0.125},
    ]
    assert offsets["largest_m"] == pytest.approx(0.5590169943749475)
    assert found["warnings"][0]["only_in"] == "a" and found["warnings"][0]["frame"] == FRAMES[2]
    code, out, _ = output(capsys, "diff", a, b)
    assert code == 1
    for text in ("first stage that differs: adjustment.solve", "params method", "chain", "+0.500 m east"):
        assert text in out


def test_the_environment_is_listed_but_does_not_count(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, version in (("a", "2.4.6"), ("b", "2.5.0")):
        with Recorder(tmp_path / f"{name}.mcap") as recorder:
            recorder.begin_run("name: x\n", {"numpy": version}, {})
            recorder.stage_started("toy.one", 1, {}, {})
            recorder.stage_finished(
                "toy.one", StageEnd(seconds=1.0 if name == "a" else 2.0, cached=name == "b")
            )
    code, found = as_json(capsys, "diff", tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert code == 0 and found["environment"] == {"numpy": ["2.4.6", "2.5.0"]}


def test_a_stage_more_and_a_changed_input_count(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, ids in (("a", ["t.one", "t.three"]), ("b", ["t.one", "t.two", "t.three"])):
        with Recorder(tmp_path / f"{name}.mcap") as recorder:
            recorder.begin_run("name: x\n", {}, {"frames": {"1.jpg": name}})
            for id in ids:
                recorder.stage_started(id, 1, {}, {})
                recorder.stage_finished(id, StageEnd())
    code, found = as_json(capsys, "diff", tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert code == 1
    assert found["stages"] == [{"stage": "t.two", "only_in": "b"}]
    assert found["manifest"] == {"frames.1.jpg": ["a", "b"]}


@pytest.mark.parametrize("command", [["inspect"], ["view"], ["replay", "-o", "out"]])
def test_no_recording_is_one_line_and_exit_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: list[str]
) -> None:
    path = tmp_path / "run.mcap"
    path.write_text("not a recording")
    code, out, err = output(capsys, command[0], path, *command[1:])
    assert code == 2 and out == "" and err.count("\n") == 1
    assert str(path) in err and "give the run.mcap of a run folder" in err


def test_tables_fit_a_hundred_columns_and_cut_no_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with Recorder(tmp_path / "run.mcap") as recorder:
        recorder.begin_run("name: x\n", {"geomosaic": "1"}, {})
        params = {"frames": "/a/folder/with/a/long/name/" + 9 * "x", "pos": None, "ratio": 0.8}
        recorder.stage_started("survey.read", 1, params | {f"parameter_{i}": i for i in range(9)}, {})
        recorder.log("warning", "word " * 40)
        recorder.stage_finished(
            "survey.read",
            StageEnd(outputs={"survey": "ab" * 20, "more": "cd" * 20}, seconds=1.5, cached=True),
        )
    code, out, _ = output(capsys, "inspect", tmp_path)
    lines = out.splitlines()
    assert code == 0 and "warning: " + "word " * 39 + "word" in out
    assert max(len(line) for line in lines if not line.startswith(("warning", str(tmp_path)))) <= 100
    at = next(i for i, line in enumerate(lines) if line.startswith(" survey.read"))
    assert lines[at].split()[:4] == ["survey.read", "1", "reused", "1.50"]
    assert "survey abababab, not recorded" in lines[at] and "\u2026" not in out
    assert (lines[at] + lines[at + 1]).count("x") == 9
    assert "parameter_8=8" in out and "pos" not in out


@pytest.mark.parametrize("what", ["folder", "empty", "proc"])
def test_what_is_no_recording_is_one_line(
    what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.mcap"
    if what == "proc":
        path.symlink_to("/proc/self/mem")
    elif what == "empty":
        path.touch()
    else:
        (path / "run.mcap").mkdir(parents=True)
    assert main(["inspect", str(path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
