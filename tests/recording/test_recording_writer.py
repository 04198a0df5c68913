"""What is written, as other readers see it."""

from __future__ import annotations

import io
import itertools
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import NonSeekingReader, make_reader
from mcap_protobuf.decoder import DecoderFactory
from recording_scene import (
    ARTEFACT,
    CAMERA,
    FRAMES,
    POINTS_M,
    POSITIONS_M,
    RECIPE,
    ROTATIONS,
    record,
    written,
)
from scipy.spatial.transform import Rotation as Turn

from geomosaic.camera.exterior import Pose
from geomosaic.camera.rotation import Rotation
from geomosaic.errors import InputError, OutputError
from geomosaic.recording import (
    Recorder,
    artefact_data,
    messages,
    read_recording,
    stage_messages,
    thumbnail,
)
from geomosaic.recording.file.run_kinds import Progress
from geomosaic.recording.file.writer import StageEnd


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("scene") / "run.mcap")


def decoded(path: Path, topic: str) -> list:
    """Messages of a topic, decoded by mcap's own reader from the file's own schemas, CRCs checked."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return [m.decoded_message for m in reader.iter_decoded_messages([topic], log_time_order=False)]


def test_every_message_is_read_by_mcaps_own_reader_with_all_crcs(scene: Path) -> None:
    with scene.open("rb") as file:
        reader = NonSeekingReader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        found = list(reader.iter_decoded_messages(log_time_order=False))
    assert len(found) == 4 + 1 + 3 + 6 + 3 + 2 + 3 + 1 + 1 + 6 + 3 + 2 * 3 + 1
    assert {channel.message_encoding for _, channel, _, _ in found} == {"protobuf"}
    with scene.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        names = [a.name for a in reader.iter_attachments()]
        recipe = next(a.data for a in reader.iter_attachments())
        metadata = [(m.name, m.metadata["format"]) for m in reader.iter_metadata()]
        chunks = reader.get_summary().chunk_indexes  # type: ignore[union-attr]
    assert names == ["recipe.yaml", "environment.json", "manifest.json"] and recipe.decode() == RECIPE
    assert metadata == [("geomosaic", "1")]
    assert {c.compression for c in chunks} == {"zstd"}


def test_recipe_environment_and_manifest_stand_before_the_first_chunk(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run.mcap")
    recorder.begin_run(RECIPE, {"numpy": "2"}, {"frames": {}})
    recording = read_recording(tmp_path / "run.mcap")
    assert recording.recipe_yaml == RECIPE
    assert recording.environment == {"numpy": "2"} and recording.manifest == {"frames": {}}
    recorder.close()


def test_values_of_foxgloves_messages(scene: Path) -> None:
    fix = decoded(scene, "/location/observed")[1]
    assert (fix.frame_id, fix.longitude, fix.latitude, fix.altitude) == (FRAMES[1], -91.249, 46.5005, 251.5)
    assert list(fix.position_covariance) == [2.25, 0, 0, 0, 4.0, 0, 0, 0, 9.0]
    assert fix.color.a == 1.0 and fix.position_covariance_type == 2
    unsure = decoded(scene, "/location/tied")[0]
    assert unsure.position_covariance_type == 0 and list(unsure.position_covariance) == [0.0] * 9
    camera = decoded(scene, "/tables/camera.FC_220")[0]
    known = dict(zip(camera.column, camera.value, strict=True))
    assert (known["principal_col_px"], known["principal_row_px"], known["k1"]) == (2001.5, 1499.25, -0.011)
    assert (list(camera.row), list(camera.note)) == ([CAMERA.name], ["brown"])
    image = cv2.imdecode(np.frombuffer(decoded(scene, "/frames")[0].data, np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(image.mean(axis=(0, 1)) - [60, 30, 200]).max() < 3, "blue, green, red"
    footprints = json.loads(decoded(scene, "/map/footprints")[0].geojson)
    assert footprints["features"][0]["geometry"]["coordinates"][0][2] == [-91.249, 46.501]


def test_values_of_our_own_messages_from_the_schema_in_the_file(scene: Path) -> None:
    first = decoded(scene, "/offsets/adjustment.solve")[1]
    assert (first.stage, first.round, list(first.left), list(first.right)) == (
        "adjustment.solve",
        1,
        list(FRAMES[:2]),
        list(FRAMES[1:]),
    )
    assert (first.east_m[0], first.north_m[0]) == (1.5, -2.0) and np.isnan(first.east_m[1])
    assert first.largest_misalignment_m == 2.5 and first.rms_misalignment_m == 2.5
    assert list(first.move_east_m) == [0.5, -0.5, 0.0]
    ties = decoded(scene, "/tie_points")[0]
    assert list(ties.left_col_px) == [100.5, 300.0] and list(ties.right_row_px) == [20.25, 220.75]
    assert np.allclose(ties.residual_north_m, [-0.03, 0.04])
    begun, ended = decoded(scene, "/stages")[2:]
    assert json.loads(begun.params_json) == {"method": "error_sharing", "epsilon_px": 10.0}
    assert (begun.version, begun.stage_index, begun.inputs[0].name) == (2, 1, "survey")
    assert ended.finished and not ended.HasField("seconds"), "no durations with fixed times"


def test_schemas_stand_alone_in_a_fresh_pool(scene: Path) -> None:
    with scene.open("rb") as file:
        schemas = make_reader(file).get_summary().schemas.values()  # type: ignore[union-attr]
    assert {s.name for s in schemas} >= {
        "geomosaic.StageEvent",
        "geomosaic.TiePoints",
        "foxglove.LocationFix",
    }
    for schema in schemas:
        pool = descriptor_pool.DescriptorPool()
        for file_proto in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
            pool.Add(file_proto)
        message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))()


def test_equal_runs_with_fixed_times_are_equal_bytes(tmp_path: Path) -> None:
    a, b = written(tmp_path / "a.mcap"), written(tmp_path / "b.mcap")
    assert a.read_bytes() == b.read_bytes()
    assert a.read_bytes() != written(tmp_path / "c.mcap", rounds=4).read_bytes()


def test_clock_times_rise_strictly_and_frames_have_the_time_of_their_exposure(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap", level="full") as recorder:
        record(recorder)
    with (tmp_path / "run.mcap").open("rb") as file:
        found = [(c.topic, m) for _, c, m in make_reader(file).iter_messages(log_time_order=False)]
    assert [m.sequence for _, m in found] == list(range(len(found)))
    now = [m.log_time for _, m in found]
    assert now[0] > 1.6e18 and all(a < b for a, b in itertools.pairwise(now))
    exposed = {topic for topic, m in found if m.publish_time < 1.6e18}
    assert all(m.log_time == m.publish_time for topic, m in found if topic not in exposed)
    camera = f"/cameras/{CAMERA.name.replace(' ', '_')}"
    assert exposed == {"/frames", "/location/observed", "/tf", camera, "/points/ties"}
    recording = read_recording(tmp_path / "run.mcap")
    assert [s.seconds for s in recording.stages] == [1.25, 0.5]
    images, times = (decoded(tmp_path / "run.mcap", t) for t in ("/frames", "/frames/times"))
    assert [i.timestamp.ToNanoseconds() for i in images[:2]] == [
        1_500_000_000_250_000_000,
        1_500_000_002_250_000_000,
    ]
    assert [t.captured_ns for t in times] == [1_500_000_000_250_000_000, 1_500_000_002_250_000_000, 0]
    assert all(t.recorded_ns > 1.6e18 for t in times) and [t.frame for t in times] == list(FRAMES)


def test_copied_messages_keep_the_time_of_an_exposure_alone(tmp_path: Path) -> None:
    """The third frame has none: its messages have the time at which they are copied."""
    with Recorder(tmp_path / "old.mcap") as recorder:
        record(recorder)
    with Recorder(tmp_path / "new.mcap") as recorder:
        for message in stage_messages(read_recording(tmp_path / "old.mcap"), 0):
            recorder.copy(*message)
    with (tmp_path / "new.mcap").open("rb") as file:
        found = [(c.topic, m) for _, c, m in make_reader(file).iter_messages(log_time_order=False)]
    for topic in ("/frames", "/location/observed"):
        written = [m for at, m in found if at == topic]
        times = [m.timestamp.ToNanoseconds() for m in decoded(tmp_path / "new.mcap", topic)]
        assert times == [1_500_000_000_250_000_000, 1_500_000_002_250_000_000, written[2].log_time]
        assert times == [m.publish_time for m in written]


def test_poses_and_points_as_foxglove_has_them(scene: Path) -> None:
    """A point is in a frame where transform and calibration put it, by OpenCV."""
    tf, camera = (decoded(scene, topic)[1] for topic in ("/tf", "/cameras/FC_220"))
    assert (tf.parent_frame_id, tf.child_frame_id, camera.frame_id) == ("map", FRAMES[1], FRAMES[1])
    q, t = tf.rotation, tf.translation
    turn, at = Turn.from_quat([q.x, q.y, q.z, q.w]), np.array([t.x, t.y, t.z])
    assert at.tolist() == POSITIONS_M[1].tolist()
    point = np.array([42.0, 9.0, 3.0])
    seen, _ = cv2.projectPoints(
        turn.inv().apply(point - at)[None],
        np.zeros(3),
        np.zeros(3),
        np.array(camera.K).reshape(3, 3),
        np.array(camera.D),
    )
    pose = Pose(POSITIONS_M[1], Rotation(ROTATIONS.matrix[1]))
    assert seen.ravel() + 0.5 == pytest.approx(pose.image_from_ground(CAMERA, point), abs=1e-6)
    assert (camera.width, camera.height, camera.distortion_model) == (4000, 3000, "plumb_bob")
    (cloud,) = decoded(scene, "/points/ties")
    assert [f.name for f in cloud.fields] == ["x", "y", "z", "residual_m"] and cloud.frame_id == "map"
    values = np.frombuffer(cloud.data, "<f4").reshape(-1, cloud.point_stride // 4)
    np.testing.assert_allclose(values[:, :3], POINTS_M[[0, 1, 3]])
    np.testing.assert_allclose(values[:, 3], [0.01, 0.02, 0.04])


def test_a_name_that_is_no_unicode_is_recorded_with_a_question_mark(tmp_path: Path) -> None:
    name = os.fsdecode(b"bild\xe4.jpg")
    with Recorder(tmp_path / "run.mcap") as recorder:
        recorder.begin_run("", {}, {"file": name})
        recorder.log("error", f"{name}: no image", frame=name)
    assert read_recording(tmp_path / "run.mcap").log[0].frame == "bild?.jpg"


_KILLED = """
import os, signal, sys, time
from pathlib import Path
sys.path[:0] = {tests!r}
from recording_scene import record
from geomosaic.recording import Recorder
recorder = Recorder(Path({path!r}))
record(recorder)
recorder.stage_started("mosaic.compose", 1, {{}}, {{}})
for i in range(20):
    recorder.log("info", f"window {{i}}")
recorder.progress(7, 20, "windows")
time.sleep(1.3)
recorder.progress(8, 20, "windows")
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_process_loses_nothing_of_a_finished_stage(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    script = _KILLED.format(tests=sys.path, path=str(path))
    done = subprocess.run([sys.executable, "-c", script], timeout=60)
    assert done.returncode == -signal.SIGKILL
    recording = read_recording(path)
    assert recording.problem == "it was cut off" and not recording.whole
    assert [s.finished for s in recording.stages] == [True, True, False]
    assert recording.recipe_yaml == RECIPE and len(recording.rounds) == 3
    assert artefact_data(recording, recording.artefacts[0]) == ARTEFACT


def test_a_killed_process_says_where_it_was_to_the_second(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    script = _KILLED.format(tests=sys.path, path=str(path))
    assert subprocess.run([sys.executable, "-c", script], timeout=60).returncode == -signal.SIGKILL
    *_, beat = (Progress.FromString(data) for _, _, data in messages(path, "geomosaic.Progress"))
    assert (beat.stage_id, beat.stage_index, beat.text) == ("mosaic.compose", 2, "windows")
    assert (beat.done, beat.total) == (7, 20) and beat.seconds > 0.3, "killed after 1.3 s"
    assert read_recording(path).log[-1].text == "window 19", "the heartbeat takes along what came before it"


def test_a_killed_process_has_begun_the_stage_that_it_was_in(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    script = _KILLED.format(tests=sys.path, path=str(path)).replace("sleep(1.3)", "sleep(0)")
    assert subprocess.run([sys.executable, "-c", script], timeout=60).returncode == -signal.SIGKILL
    last = read_recording(path).stages[-1]
    assert (last.stage_id, last.finished) == ("mosaic.compose", False)


def test_no_signs_of_life_with_fixed_times(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap", fixed_time=True) as recorder:
        recorder.begin_run("", {}, {})
        recorder.stage_started("toy.slow", 1, {}, {})
        time.sleep(1.3)
        recorder.stage_finished("toy.slow", StageEnd(seconds=1.3, peak_memory_bytes=5))
    assert not list(messages(tmp_path / "run.mcap", "geomosaic.Progress"))
    assert not decoded(tmp_path / "run.mcap", "/stages")[1].HasField("peak_memory_bytes")


@pytest.mark.parametrize(
    ("level", "topics"),
    [
        ("summary", {"/stages", "/log", "/tables/pairs", "/metrics"}),
        ("normal", {"/stages", "/log", "/tables/pairs", "/metrics", "/artefacts", "/frames"}),
        ("full", {"/stages", "/log", "/tables/pairs", "/metrics", "/artefacts", "/frames", "/tie_points"}),
    ],
)
def test_levels(tmp_path: Path, level: str, topics: set[str]) -> None:
    with Recorder(tmp_path / "run.mcap", level=level) as recorder:
        record_all(recorder)
    assert set(read_recording(tmp_path / "run.mcap").topics) == topics


def test_the_level_off_writes_no_file(tmp_path: Path) -> None:
    with Recorder(None, level="off") as recorder:
        record_all(recorder)
    assert not list(tmp_path.iterdir())


def record_all(recorder: Recorder) -> None:
    """One of everything that levels distinguish."""
    recorder.begin_run(RECIPE, {}, {})
    recorder.stage_started("toy", 1, {}, {})
    recorder.image("/frames", FRAMES[0], thumbnail(np.zeros((8, 8, 3), np.uint8)))
    recorder.tie_points(
        (FRAMES[0], FRAMES[1]), np.zeros((3, 2)), np.ones((3, 2)), weight=np.array([1, 0, np.nan])
    )
    recorder.table("pairs", FRAMES[:1], {"rms_m": [0.5], "ties": [3]}, others=FRAMES[1:2], notes=["off"])
    recorder.metric("toy.figure", 2.5)
    recorder.log("info", "a line")
    recorder.artefact("toy", "out", "toy:Out", "ab" * 20, io.BytesIO(b"bytes"))
    recorder.stage_finished("toy", StageEnd(outputs={"out": "ab" * 20}, seconds=0.1))


def test_a_table_holds_its_columns_one_after_the_other(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        recorder.stage_started("toy", 1, {}, {})
        recorder.table("frames", FRAMES, {"a_m": [1, 2, np.nan], "b_px": 7.0}, notes=("x", "", "z"))
    (table,) = decoded(path, "/tables/frames")
    assert (table.stage_id, list(table.row), list(table.other)) == ("toy", list(FRAMES), [])
    assert list(table.column) == ["a_m", "b_px"] and list(table.note) == ["x", "", "z"]
    assert np.array_equal(table.value, [1, 2, np.nan, 7, 7, 7], equal_nan=True)


def test_figures_are_numbers_where_they_are_and_json_always(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        recorder.stage_started("toy", 1, {}, {})
        recorder.metric("toy.sigma_px", np.float64(0.5))
        recorder.metric("verdict", {"grade": "good"})
    number, entry = decoded(path, "/metrics")
    assert (number.name, number.number, number.json) == ("toy.sigma_px", 0.5, "0.5")
    assert not entry.HasField("number") and json.loads(entry.json) == {"grade": "good"}


def test_steps_are_counted_within_their_stage(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        for stage in ("a", "b"):
            recorder.stage_started(stage, 1, {}, {})
            recorder.iteration(stage, "all", 9.0, figures={"sigma_px": 0.5})
            recorder.iteration(stage, "all", 4.0)
    assert [(i.iteration, i.cost) for i in decoded(path, "/iterations/b")] == [(0, 9.0), (1, 4.0)]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_disk_is_one_clear_error_then_and_later() -> None:
    recorder = Recorder(Path("/dev/full"))
    for _ in range(2):
        with pytest.raises(OutputError, match="/dev/full: No space left on device; free some space"):
            recorder.begin_run(RECIPE, {}, {})
    recorder.close()


def test_a_folder_that_is_not_there_is_an_output_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="No such file or directory"):
        Recorder(tmp_path / "nowhere" / "run.mcap")


def test_an_error_within_the_block_still_closes_the_file(tmp_path: Path) -> None:
    with pytest.raises(KeyError), Recorder(tmp_path / "run.mcap") as recorder:
        recorder.begin_run(RECIPE, {}, {})
        raise KeyError
    assert read_recording(tmp_path / "run.mcap").whole


@pytest.mark.parametrize(
    ("image", "size"),
    [
        (np.zeros((3000, 4000, 3), np.uint8), (384, 512)),
        (np.zeros((40, 30), np.uint8), (40, 30)),
        (np.zeros((2000, 10, 5), np.uint16), (512, 3)),
        (np.full((10, 10, 2), np.nan), (10, 10)),
        (np.zeros((5, 2000, 1), np.int32), (1, 512)),
    ],
)
def test_thumbnails_keep_their_shape_and_never_grow(image: np.ndarray, size: tuple[int, int]) -> None:
    jpeg = cv2.imdecode(np.frombuffer(thumbnail(image), np.uint8), cv2.IMREAD_COLOR)
    assert jpeg.shape[:2] == size


def test_thumbnails_of_sixteen_bits_are_stretched() -> None:
    ramp = np.broadcast_to(np.linspace(1000, 3000, 200).astype(np.uint16)[None, :, None], (100, 200, 3))
    grey = cv2.imdecode(np.frombuffer(thumbnail(ramp), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert grey[:, :4].mean() < 6 and grey[:, -4:].mean() > 249
    assert abs(grey[:, 99:101].mean() - 127.5) < 3


def test_no_pixels_no_thumbnail() -> None:
    with pytest.raises(ValueError, match="shape"):
        thumbnail(np.zeros((0, 5, 3), np.uint8))


def test_positions_of_older_recordings_are_read_and_copied(tmp_path: Path) -> None:
    """They are JSON there: a file of the writer of 26 November 2026."""
    old = Path(__file__).parents[1] / "support" / "data" / "recording_json_positions.mcap"
    recording = read_recording(old)
    assert recording.whole and [s.finished for s in recording.stages] == [True, True]
    assert len(artefact_data(recording, recording.artefacts[0])) == recording.artefacts[0].total_bytes
    reported = [m for m in stage_messages(recording, 0) if m[1] == "foxglove.LocationFix"]
    with Recorder(tmp_path / "new.mcap") as recorder:
        recorder.stage_started("survey.read", 1, {}, {})
        for message in reported:
            recorder.copy(*message)
        data = reported[0][2]
        endless, deep = data.replace(b"46.5", b"1" * 400), b'{"frame_id": ' + b"[" * 100_000
        nowhere = LocationFix(frame_id="a.jpg", latitude=np.nan).SerializeToString()
        no_json = (b"{", b"{}", b'{"frame_id": 3}', b"[]", b'{"frame_id": "a", "latitude": "x"}')
        for bad in (*no_json, endless, deep, nowhere, data.replace(b"46.5", b"NaN")):
            with pytest.raises(InputError, match="is damaged"):
                recorder.copy("/location/tied", "foxglove.LocationFix", bad)
    again = decoded(tmp_path / "new.mcap", "/location/observed")
    assert [f.frame_id for f in again] == list(FRAMES) and again[0].latitude == 46.5
    assert again[0].color.g == 0.55 and list(again[0].position_covariance)[::4] == [2.25, 4.0, 9.0]
