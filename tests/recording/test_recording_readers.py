"""Readers that share no code with the writer: JavaScript's reference reader and Rerun's in Rust."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from recording_scene import FRAMES, POSITIONS_M, RECIPE, written

from geomosaic.errors import FileError, GeomosaicError, OutputError
from geomosaic.quality.ranking import RESIDUAL, badness
from geomosaic.recording import Recorder, Recording, read_recording
from geomosaic.recording.file.chips import Chip
from geomosaic.recording.file.thumbnail import decoded, thumbnail
from geomosaic.recording.inspect.plan import by_badness, frame_colours, frame_labels, names_apart
from geomosaic.recording.rerun import viewer
from geomosaic.recording.rerun.block_view import camera_lines
from geomosaic.recording.rerun.list_view import frame_text, worst_frames

_SCRIPT = Path(__file__).parents[1] / "node" / "read_mcap.mjs"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("readers") / "run.mcap")


def by_node(script: Path, recording: Path, packages: str, seconds: float = 60.0) -> Any:
    """What a script prints of a recording; needs node and its packages in tests/node or $MCAP_MODULES."""
    node = shutil.which("node")
    folder = Path(os.environ.get("MCAP_MODULES", script.parent))
    if node is None:
        pytest.skip("node isn't installed")
    if not all((folder / "node_modules" / name).is_dir() for name in packages.split()):
        pytest.skip(f"npm install {packages} in tests/node")
    environment = {**os.environ, "MCAP_MODULES": f"{folder}/"}
    done = subprocess.run(
        [node, str(script), str(recording)], capture_output=True, text=True, timeout=seconds, env=environment
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_messages_of_foxgloves_schemas_hold_to_its_own_json_schemas(scene: Path) -> None:
    packages = "@mcap/core @mcap/support protobufjs @foxglove/schemas ajv"
    found = by_node(_SCRIPT.with_name("check_foxglove.mjs"), scene, packages)
    assert {topic: why for topic, (_, why) in found.items() if why} == {}
    topics = read_recording(scene).topics
    foxglove = {name: t.messages for name, t in topics.items() if t.schema.startswith("foxglove.")}
    assert {topic: count for topic, (count, _) in found.items()} == foxglove and len(foxglove) >= 4


def test_foxgloves_app_opens_it_and_finds_no_problem(scene: Path) -> None:
    """The last build that was open, in Chromium."""
    if shutil.which("chromium") is None:
        pytest.skip("Chromium isn't installed")
    packages = "@foxglove/studio-base react react-dom puppeteer-core"
    found = by_node(_SCRIPT.with_name("foxglove_studio.mjs"), scene, packages, 180.0)
    assert (found["problems"], found["errors"], found["asked"]) == ([], [], [])
    topics = read_recording(scene).topics
    shown = {name: topics[name].messages for name in found["topics"]}
    assert found["topics"] == shown and {"/stages", "/log", "/location/observed"} <= shown.keys()


def test_the_javascript_reader_finds_the_same(scene: Path) -> None:
    found = by_node(_SCRIPT, scene, "@mcap/core @mcap/support protobufjs")
    assert found["profile"] == "geomosaic" and found["attachments"]["recipe.yaml"] == RECIPE
    assert found["metadata"]["geomosaic"]["format"] == "1"
    recording = read_recording(scene)
    assert found["counts"] == {name: topic.messages for name, topic in recording.topics.items()}
    assert found["artefactBytes"] == 2_300_001
    offsets = found["first"]["/offsets/adjustment.solve"]
    assert (
        offsets["left"] == list(FRAMES[:2]) and offsets["east_m"][0] == 3.0 and offsets["north_m"][0] == -4.0
    )
    assert offsets["largest_misalignment_m"] == 5.0
    assert found["first"]["/location/observed"]["longitude"] == -91.25
    table = found["first"]["/tables/pairs.adjusted"]
    assert (table["row"], table["other"], table["column"]) == (
        [FRAMES[0]],
        [FRAMES[1]],
        ["rms_m", "tie_points"],
    )
    assert table["value"] == [0.05, 2.0] and table["stage_id"] == "adjustment.solve"
    assert found["first"]["/metrics"]["number"] == 0.5 and found["first"]["/metrics"]["json"] == "0.5"
    step = found["first"]["/iterations/adjustment.solve"]
    assert (step["cost"], step["cost_unit"], step["step_m"]) == (25.0, "m", 1.5)
    assert found["first"]["/outlines/adjusted"]["vertices"] == [3, 4]
    ties = found["first"]["/chips/ties"]
    assert (ties["side_px"], ties["left_x_px"], len(ties["weight"])) == (400, [200.0], 1)


@pytest.fixture
def rerun_reader() -> type:
    chunk = pytest.importorskip("rerun.chunk", reason="Rerun isn't installed")
    return chunk.McapReader  # type: ignore[no-any-return]


def test_reruns_own_reader_finds_the_same(scene: Path, rerun_reader: type) -> None:
    rows: Counter[str] = Counter()
    components: dict[str, set[str]] = {}
    for chunk in rerun_reader(scene).stream():
        if not chunk.is_static:
            rows[chunk.entity_path] += chunk.num_rows
            components.setdefault(chunk.entity_path, set()).update(chunk.to_record_batch().schema.names)
    assert rows == {name: topic.messages for name, topic in read_recording(scene).topics.items()}
    assert "EncodedImage:blob" in components["/frames"]
    assert "GeoPoints:positions" in components["/location/observed"]
    assert {"Transform3D:translation", "Transform3D:child_frame"} <= components["/tf"]
    assert "Pinhole:image_from_camera" in components["/cameras/FC_220"]
    assert "Points3D:positions" in components["/points/ties"]
    assert "TextLog:text" in components["/log"]
    assert "geomosaic.TiePoints:message" in components["/tie_points"]


def test_reruns_own_reader_recovers_a_cut_file(scene: Path, rerun_reader: type, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(scene.read_bytes()[:-3000])
    recovered = rerun_reader(path, recover=True).info()
    ours = sum(topic.messages for topic in read_recording(path).topics.values())
    assert recovered.summary_source == "reconstructed" and recovered.message_count >= ours > 10


def test_the_view_is_a_sound_rrd_that_shows_what_was_reported_on_any_timeline(
    scene: Path, tmp_path: Path
) -> None:
    pytest.importorskip("rerun", reason="Rerun isn't installed")
    from rerun.chunk import RrdReader

    from geomosaic.recording.rerun.view import write_rrd

    path = tmp_path / "out.rrd"
    write_rrd(read_recording(scene), path)
    assert [p.name for p in tmp_path.iterdir()] == ["out.rrd"]
    still: dict[str, int] = {}
    picked: Counter[str] = Counter()
    for chunk in RrdReader(path).stream():
        if chunk.is_static:
            still[chunk.entity_path] = chunk.num_rows
        else:
            assert "pick" in chunk.timeline_names
            picked[chunk.entity_path] += chunk.num_rows
    for entity in (
        "/block/cameras",
        "/block/ties",
        "/plan/footprints_adjusted",
        "/lists/pairs",
        "/lists/said",
        "/stages_drawn/bars",
    ):
        assert still[entity] == 1, entity
    assert {"/steps_drawn/cost", "/steps_drawn/axes"} <= still.keys()
    assert picked["/worst_pair/image"] == 1 and picked["/worst_pair/kept"] == 1 and picked["/log"] == 2
    assert not [e for e in (*still, *picked) if "Geo" in e or e.startswith("/map")], "no map, so no network"


def test_a_camera_is_drawn_where_it_is_and_looks_down(scene: Path) -> None:
    shown = read_recording(scene)
    lines = camera_lines(shown)
    assert [line[2].tolist() for line in lines] == POSITIONS_M.tolist()
    corners = lines[0][[0, 1, 3, 4]]
    assert (corners[:, 2] < 100.0).all() and np.ptp(corners[:, 2]) < 1e-9, "a nadir image is level"
    assert shown.clouds["ties"].shape == (3, 3)


def test_a_view_takes_no_more_than_a_recording_can_hold(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        recorder.stage_started("survey.read", 1, {}, {})
        for k in range(20):
            recorder.image("/images/large", f"{k}.jpg", bytes(8 * 2**20))
    assert path.stat().st_size < 100_000
    with pytest.raises(FileError, match="its figures and images take more than"):
        read_recording(path, with_images=True)


def test_tie_points_of_unequal_lengths_are_left_out(tmp_path: Path) -> None:
    path, jpeg = tmp_path / "run.mcap", b"jpeg"
    with Recorder(path) as recorder:
        recorder.stage_started("quality.verdict", 1, {}, {})
        none = np.zeros((0, 2))
        recorder.chip(0, "a", "b", Chip(jpeg, 400, (0, 0), (0, 0), 0, none, none, none, np.ones(3)))
        recorder.chip(1, "a", "c", Chip(jpeg, 400, (0, 0), (0, 0), 0, none, none, none, np.ones(0)))
    assert [ties.rank for _, ties in read_recording(path, with_images=True).chips] == [1]


def recorded(recorder: Recorder, path: Path) -> Recording:
    """Two frames, of which one moved far and has a wrong heading."""
    with recorder:
        recorder.begin_run("", {}, {})
        recorder.stage_started("adjustment.solve", 1, {}, {})
        columns = {"east_m": [0, 9, 20.0], "north_m": [0, 0, 1.0], "yaw_deg": [10.0, 350.0, 10.0]}
        columns |= {"sd_e_m": [2.0] * 3, "sd_n_m": [1.0] * 3}
        recorder.table("frames.placed", ["a.jpg", "b|.jpg", "c.jpg"], columns)
        found = columns | {"east_m": [1, 70, 21.0], "yaw_deg": [10.0, 200.0, 11.0]}
        moved = {"moved_e_m": [1, 61.0, 1.0], "moved_n_m": [0, 0, 0.0]}
        status = ["tied", "tied", "placed"]
        recorder.table("frames.adjusted", ["a.jpg", "b|.jpg", "c.jpg"], found | moved, notes=status)
        recorder.table("pairs.tried", ["a.jpg"], {"inliers": [3]}, ["c.jpg"], ["too few agree: 3 of 9, 16"])
        recorder.log("warning", "its position was off", frame="b|.jpg")
    return read_recording(path, with_images=True)


def test_the_plan_names_what_is_odd(tmp_path: Path) -> None:
    reported = recorded(Recorder(tmp_path / "run.mcap"), tmp_path / "run.mcap")
    placed, adjusted = reported.table("frames.placed"), reported.table("frames.adjusted")
    assert frame_labels(placed, adjusted) == ["a", "b| 61 m, heading 150 deg off", "c placed"]
    assert frame_labels(placed, adjusted, {"b|.jpg"})[1] == "b| 61 m, image turned"
    assert worst_frames(reported) == [2, 1, 0]
    text = frame_text(reported, 1, ["its position was off"])
    assert "| east_m | 9.00 | 70.00 |" in text and "b\\|.jpg" in text and "- its position was off" in text
    assert by_badness(np.array([0.0, 1.0, np.nan])).tolist()[:2] == [[60, 200, 80], [255, 60, 60]]
    assert frame_colours(placed, adjusted).tolist()[1:] == [[255, 60, 60]] * 2


def test_a_survey_that_is_bad_everywhere_is_red_everywhere(tmp_path: Path) -> None:
    """All frames 60 m off, all pairs by 4 ground pixels: relative to the median nothing stands out."""
    names = [f"{k}.jpg" for k in range(9)]
    with Recorder(tmp_path / "run.mcap") as recorder:
        recorder.stage_started("adjustment.solve", 1, {}, {})
        placed = {"east_m": np.arange(9.0), "north_m": 0.0, "yaw_deg": 0.0, "sd_e_m": 5.0, "sd_n_m": 5.0}
        recorder.table("frames.placed", names, placed)
        recorder.table(
            "frames.adjusted", names, placed | {"moved_e_m": 60.0, "moved_n_m": 0.0}, notes=["tied"] * 9
        )
    recording_read = read_recording(tmp_path / "run.mcap", with_images=True)
    placed, adjusted = recording_read.table("frames.placed"), recording_read.table("frames.adjusted")
    assert {tuple(c) for c in frame_colours(placed, adjusted).tolist()} == {(255, 60, 60)}
    assert all("60 m" in label for label in frame_labels(placed, adjusted))
    bad = badness(np.array([0.0, 0.5, 1.0, 2.0, 3.0, 4.0, np.nan]), RESIDUAL.good, RESIDUAL.bad)
    np.testing.assert_array_equal(bad, [0.0, 0.25, 0.5, 0.75, 1.0, 1.0, np.nan])


def test_names_on_the_plan_do_not_lie_on_one_another() -> None:
    """A thousand frames: odd ones are named first, the rest where there is room."""
    at = np.stack(np.meshgrid(np.arange(40.0), np.arange(25.0)), axis=-1).reshape(-1, 2) * 10.0
    labels = [f"F{k:04d}" for k in range(1000)]
    far = np.zeros(1000)
    for k in (7, 8, 500):
        labels[k], far[k] = f"F{k:04d} 60 m", 12.0 + k
    shown, places = names_apart(at, np.array([400.0, 250.0]), labels, far)
    assert shown[0] == 500 and 8 in shown and 7 in shown, "7 lies next to 8, which moved farther: below it"
    apart_pt = (places - at[shown]) * 2.4
    assert apart_pt[shown.index(7)] == pytest.approx([0.0, 24.0])
    assert np.delete(apart_pt, shown.index(7), axis=0) == pytest.approx(0.0, abs=1e-9)
    assert 50 < len(shown) < 400
    boxes = np.array(
        [[*(place * 2.4), 7.5 * len(labels[k]), 24.0] for k, place in zip(shown, places, strict=True)]
    )
    for i, (x, y, wide, high) in enumerate(boxes):
        across, down = np.abs(boxes[i + 1 :, :2] - [x, y]).T
        assert not ((across < (boxes[i + 1 :, 2] + wide) / 2.0) & (down < high)).any()


def test_of_many_frames_the_worst_have_large_thumbnails_and_the_others_small_ones(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="Rerun isn't installed")
    from rerun.chunk import RrdReader

    from geomosaic.recording.rerun.view import write_rrd

    names = [f"{k}.jpg" for k in range(300)]
    rng = np.random.default_rng(2)
    image = rng.integers(0, 255, (192, 256, 3), dtype=np.uint8)
    with Recorder(tmp_path / "run.mcap") as recorder:
        recorder.stage_started("survey.read", 1, {}, {})
        for name in names[:-1]:
            recorder.image("/frames", name, thumbnail(image))
        moved = {"moved_e_m": np.arange(300.0)[::-1], "moved_n_m": 0.0}
        recorder.table(
            "frames.adjusted", names, {"east_m": 0.0, "north_m": 0.0} | moved, notes=["tied"] * 300
        )
    write_rrd(read_recording(tmp_path / "run.mcap"), tmp_path / "run.rrd")
    sides: list[int] = []
    for chunk in RrdReader(tmp_path / "run.rrd").stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == "/picked_frame" and "EncodedImage:blob" in batch.schema.names:
            for row in batch.column("EncodedImage:blob").to_pylist():
                if row:
                    shown = decoded(bytes(row[0]))
                    assert shown is not None
                    sides.append(max(shown.shape))
    assert sorted(sides) == [160] * 99 + [256] * 200


def test_a_screenshot_is_asked_for_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine doesn't paint within Rerun's 15 s, which was a fault of the program."""
    asked: list[str] = []
    busy = [2]

    class Client:
        @staticmethod
        def connect(url: str) -> Client:
            return Client()

        def get_state(self) -> None:
            pass

        def save_screenshot(self, path: str) -> None:
            asked.append(path)
            if len(asked) <= busy[0]:
                raise TimeoutError("Deadline expired before operation could complete")

    monkeypatch.setitem(sys.modules, "rerun.experimental", SimpleNamespace(ViewerClient=Client))
    monkeypatch.setattr(viewer, "_viewer", lambda *_: nullcontext(SimpleNamespace(poll=lambda: None)))
    viewer.screenshot(tmp_path / "a.rrd", tmp_path / "a.png", 0.0)
    assert len(asked) == 3
    busy[0] = 99
    with pytest.raises(OutputError, match="no screenshot"):
        viewer.screenshot(tmp_path / "a.rrd", tmp_path / "a.png", 0.0)
    ended = iter((None, 1))  # without a Vulkan driver it ends once it paints
    monkeypatch.setattr(viewer, "_viewer", lambda *_: nullcontext(SimpleNamespace(poll=lambda: next(ended))))
    with pytest.raises(GeomosaicError, match="install mesa-vulkan-drivers"):
        viewer.screenshot(tmp_path / "a.rrd", tmp_path / "a.png", 0.0)
