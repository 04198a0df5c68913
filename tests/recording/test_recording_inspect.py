"""`geomosaic inspect` of a survey with known faults: what is wrong, how sure, how to fix it."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from recorded_survey import bad_survey, planted
from recording_scene import written

from geomosaic.cli.main import main
from geomosaic.quality.ranking import worst_pairs
from geomosaic.recording import Recorder, read_recording
from geomosaic.recording.file.writer import StageEnd
from geomosaic.recording.inspect.canvas import RED, Canvas
from geomosaic.recording.inspect.inspection import Inspection
from geomosaic.recording.inspect.worst import worst_frames
from geomosaic.recording.replay.recorded_solve import solved_of
from geomosaic.recording.rerun import list_view


@pytest.fixture(autouse=True)
def _a_hundred_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)


@pytest.fixture
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bad_survey(tmp_path_factory)


def as_json(capsys: pytest.CaptureFixture[str], *arguments: object) -> Any:
    capsys.readouterr()
    assert main(["inspect", *map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def as_text(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    capsys.readouterr()
    assert main(["inspect", *map(str, arguments)]) == 0
    return capsys.readouterr().out


def test_the_worst_are_the_planted_faults_and_no_others(
    survey: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    worst = as_json(capsys, survey / "run", "--worst", 50)["worst"]
    accused = sorted((f["code"], name) for f in worst["faults"] for name in f["frames"])
    assert accused == planted(survey) and len(accused) == 3
    for fault in (f for f in worst["faults"] if f["frames"]):
        word = "sure" if fault["probability"] >= 0.99 else "likely"
        assert fault["sure"].startswith(f"{word}: ") and fault["probability"] > 0.9 and fault["fix"]
    text = as_text(capsys, survey / "run", "--worst", 50)
    for fault in worst["faults"]:
        assert fault["text"] in text and fault["sure"] in text and fault["fix"] in text


def test_a_frame_has_its_given_and_found_pose_and_its_pairs(
    survey: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (name,) = (frame for code, frame in planted(survey) if code == "position-wrong")
    frame = as_json(capsys, survey / "run", "--frame", name.removesuffix(".jpg"))["frame"]
    truth = json.loads((survey / "truth" / "truth.json").read_text())
    (true,) = (f for f in truth["frames"] if f["frame"] == name)
    off_m = [-e for e in true["position_error_m"][:2]]
    assert frame["moved_m"][:2] == pytest.approx(off_m, abs=3.0)
    assert frame["found"]["easting_m"] - frame["given"]["easting_m"] == pytest.approx(off_m[0], abs=4.0)
    assert frame["found"]["yaw_deg"] == pytest.approx(true["true_yaw_pitch_roll_deg"][0] % 360.0, abs=2.0)
    assert 0.0 < frame["found"]["sd_kappa_deg"] < frame["given"]["sd_kappa_deg"]
    assert frame["pairs_tied"] == sum(p["tied"] for p in frame["pairs"]) > 3
    assert 0.0 < frame["rms_px"] < 0.3 and 0.0 < frame["share_down_weighted"] < 0.5
    text = as_text(capsys, survey / "run", "--frame", name)
    for value in (frame["moved_m"][0], frame["found"]["yaw_deg"], frame["given"]["easting_m"]):
        assert f"{value:.2f}" in text
    assert str(frame["tie_points"]) in text and f"{frame['rms_px']:.3f}" in text


def test_a_pair_tells_what_is_left_or_why_it_is_not_tied(
    survey: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    worst = as_json(capsys, survey / "run", "--worst", 500)["worst"]
    assert len(worst["pairs"]) == worst["pairs_tied"] and len(worst["untied"]) == worst["pairs_untied"] > 0
    left = [p["rms_m"] for p in worst["pairs"]]
    assert left == sorted(left, reverse=True)
    tied, untied = worst["pairs"][0], worst["untied"][0]
    pair = as_json(capsys, survey / "run", "--pair", tied["right"], tied["left"])["pair"]
    assert pair["median_m"] <= pair["p90_m"] <= pair["max_m"] and pair["rms_px"] == tied["rms_px"]
    assert pair["down_weighted"] == round(pair["share_down_weighted"] * pair["in_solve"])
    assert f"{pair['median_m']:.3f} m" in as_text(
        capsys, survey / "run", "--pair", tied["left"], tied["right"]
    )
    pair = as_json(capsys, survey / "run", "--pair", untied["left"], untied["right"])["pair"]
    assert pair["tied"] is False and pair["why_not"]
    assert main(["inspect", str(survey / "run"), "--pair", "F0001", "F0001"]) == 2
    assert "were not compared" in capsys.readouterr().err


def test_a_stage_tells_its_parameters_figures_and_log(
    survey: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stage = as_json(capsys, survey / "run", "--stage", "adjustment.solve")["stage"]
    assert stage["params"]["method"] == "bundle" and stage["finished"]
    assert stage["metrics"]["adjustment"]["tracks"] > 100 and stage["outputs"]["adjusted"]["bytes"] > 1000
    assert [i["iteration"] for i in stage["iterations"]] == list(range(len(stage["iterations"])))
    text = as_text(capsys, survey / "run", "--stage", "adjustment.solve")
    assert f"adjustment.tracks = {stage['metrics']['adjustment']['tracks']}" in text
    assert main(["inspect", str(survey / "run"), "--stage", "adjustment.solv"]) == 2
    assert "did you mean 'adjustment.solve'?" in capsys.readouterr().err


def test_view_and_inspect_name_the_same_frames_and_pairs(survey: Path) -> None:
    shown = read_recording(survey / "run" / "run.mcap", with_images=True)
    inspected = Inspection(shown, solved_of(shown))
    frames, pairs = shown.table("frames.adjusted"), shown.table("pairs.adjusted")
    assert [frames.row[k] for k in list_view.worst_frames(shown)] == [
        f["frame"] for f in worst_frames(inspected.frames)
    ]
    ranked = [(pairs.row[k], pairs.other[k]) for k in worst_pairs(pairs.column("rms_m"))]
    worst = inspected.worst(len(ranked))["pairs"]
    assert ranked == [(p["left"], p["right"]) for p in worst]


@pytest.mark.parametrize("what", [[], ["--frame", "F0003"], ["--pair", "F0002", "F0003"]], ids=str)
def test_pictures_are_drawn(survey: Path, tmp_path: Path, what: list[str]) -> None:
    png = tmp_path / "out.png"
    assert main(["inspect", str(survey / "run"), *what, "--png", str(png)]) == 0
    image = cv2.imread(str(png))
    assert image is not None and min(image.shape[:2]) > 300
    green = (image[..., 1] > image[..., 0].astype(int) + 40) & (
        image[..., 1] > image[..., 2].astype(int) + 40
    )
    assert green.sum() > 100, "no tie"


def test_a_killed_run_tells_where_it_was_and_is_made_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recorder = Recorder(tmp_path / "run.mcap")
    recorder.begin_run("name: x\n", {"geomosaic": "1"}, {})
    recorder.stage_started("survey.read", 1, {}, {})
    recorder.stage_finished("survey.read", StageEnd(seconds=1.0))
    recorder.stage_started("matching.sift", 1, {}, {})
    recorder.log("info", "half way", stage="matching.sift")
    recorder.flush()
    ended = as_json(capsys, tmp_path / "run.mcap")["ended"]
    assert (ended["finished"], ended["in_stage"]) == (False, "matching.sift")
    assert "half way" in ended["last_words"]
    text = as_text(capsys, tmp_path / "run.mcap")
    assert "not whole" in text and "the run ended in matching.sift" in text and "run-killed" in text
    assert main(["inspect", str(tmp_path / "run.mcap"), "--repair", str(tmp_path / "whole.mcap")]) == 0
    before, after = (read_recording(tmp_path / name) for name in ("run.mcap", "whole.mcap"))
    assert after.whole and not before.whole
    assert (after.stages, after.log, after.recipe_yaml) == (before.stages, before.log, before.recipe_yaml)
    assert main(["inspect", str(tmp_path / "run.mcap"), "--repair", str(tmp_path / "whole.mcap")]) == 2
    assert "is there already" in capsys.readouterr().err
    recorder.close()


def test_a_repaired_recording_holds_all_that_was_whole(tmp_path: Path) -> None:
    source = written(tmp_path / "run.mcap")
    data = source.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) * 2 // 3])
    assert main(["inspect", str(cut), "--repair", str(tmp_path / "whole.mcap")]) == 0
    kept, whole = read_recording(cut), read_recording(tmp_path / "whole.mcap")
    assert {n: t.messages for n, t in kept.topics.items()} == {n: t.messages for n, t in whole.topics.items()}
    assert whole.whole and whole.environment == kept.environment


def test_a_survey_that_cannot_be_read_leaves_the_rest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its artefact is random bytes."""
    path = written(tmp_path / "run.mcap")
    assert "whole artefact" in as_json(capsys, path)["unreadable"]
    assert "its frames can't be read" in as_text(capsys, path)
    assert main(["inspect", str(path), "--frame", "DJI_0001"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_recording_without_artefacts_answers_from_its_tables(
    survey: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What level `summary` leaves of the same run."""
    whole, few = survey / "run" / "run.mcap", tmp_path / "run.mcap"
    with whole.open("rb") as file, few.open("wb") as target:
        reader, writer = make_reader(file), Writer(target)
        writer.start(reader.get_header().profile)
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if schema.name in ("geomosaic.Artefact", "foxglove.CompressedImage"):
                continue
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "protobuf", number)
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence
            )
        writer.finish()
    of_all, of_few = (as_json(capsys, path, "--worst", 50)["worst"] for path in (whole, few))
    for key in ("pairs_tied", "pairs_untied", "frames_by_status"):
        assert of_few[key] == of_all[key]
    accused = sorted((f["code"], name) for f in of_few["faults"] for name in f["frames"])
    assert accused == planted(survey)
    (name,) = (frame for code, frame in accused if code == "position-wrong")
    one, other = (as_json(capsys, path, "--frame", name)["frame"] for path in (whole, few))
    for key in ("moved_m", "tie_points", "share_down_weighted", "pairs_tied"):
        assert other[key] == pytest.approx(one[key])
    assert f"{one['moved_m'][0]:.2f} m east" in as_text(capsys, few, "--frame", name)
    assert main(["inspect", str(few), "--png", str(tmp_path / "x.png")]) == 0


def test_tables_of_a_thousand_frames_are_read_in_one_pass(tmp_path: Path) -> None:
    """2,000 frames with 20,000 pairs took 3 s where every frame looked through all pairs."""
    names = [f"F{i:04d}.jpg" for i in range(2000)]
    lefts, rights = (
        [names[(i + step) % 2000] for i in range(2000) for step in steps] for steps in (_LEFT, _RIGHT)
    )
    with Recorder(tmp_path / "run.mcap", level="summary") as recorder:
        recorder.begin_run("name: x\n", {}, {})
        recorder.stage_started("adjustment.solve", 1, {}, {})
        recorder.table("frames.adjusted", names, {"tie_points": 7.0}, notes=["tied"] * 2000)
        recorder.table("pairs.adjusted", lefts, {"rms_m": 0.1, "tie_points": 3.0}, rights)
    recording = read_recording(tmp_path / "run.mcap")
    started = time.process_time()
    answers = Inspection(recording, None)
    assert time.process_time() - started < 1.0
    assert {f["pairs_tied"] for f in answers.frames} == {20} and len(answers.pairs) == 20_000


_LEFT, _RIGHT = (0,) * 10, range(1, 11)


def test_a_label_at_the_right_edge_is_drawn_whole() -> None:
    ends = np.array([[0.0, 0.0], [100.0, 0.0]])
    inked = []
    for at in ends:
        canvas = Canvas(ends, 900)
        canvas.label(at, "F0016.jpg 4.441 m", RED)
        inked.append(int((canvas.image != 255).any(axis=2).sum()))
    assert inked[0] == inked[1] > 300
