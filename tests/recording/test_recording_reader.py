"""Recordings that are cut off, damaged, foreign or hostile."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from recording_scene import ARTEFACT, FRAMES, RECIPE, written

from geomosaic.errors import FileError
from geomosaic.recording import Recorder, artefact_data, messages, read_recording, stage_messages


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("scene") / "run.mcap")


@pytest.fixture(scope="module")
def chunk_ends(scene: Path) -> list[int]:
    """File offsets behind each chunk."""
    ends = []
    with scene.open("rb") as file:
        for record in StreamReader(file, emit_chunks=True).records:
            if isinstance(record, Chunk):
                ends.append(file.tell())
    return ends


def test_all_of_a_recording(scene: Path) -> None:
    recording = read_recording(scene)
    assert recording.whole and recording.problem == ""
    assert recording.recipe_yaml == RECIPE
    first, second = recording.stages
    assert (first.stage_id, first.version, first.finished, first.seconds) == ("survey.read", 1, True, None)
    assert first.params == {"frames": "images", "crs": "auto"} and first.outputs == {"survey": "ab" * 20}
    assert first.notes == {"warnings": [], "metrics": {"frames": 3}} and second.notes == {}
    assert second.inputs == {"survey": "ab" * 20} and second.index == 1
    assert [r.round_index for r in recording.rounds] == [0, 1, 2]
    assert recording.rounds[2].pairs == ((FRAMES[0], FRAMES[1]), (FRAMES[1], FRAMES[2]))
    assert recording.rounds[2].misalignments_m[0].tolist() == [0.75, -1.0]
    assert np.isnan(recording.rounds[2].misalignments_m[1]).all()
    assert recording.rounds[1].moves_m.tolist() == [[0.5, -0.25], [-0.5, 0.125], [0.0, 0.0]]
    (warning,) = recording.warnings
    assert (warning.level, warning.frame, warning.text) == (
        "warning",
        FRAMES[2],
        "turned: corrected by 180 degrees",
    )
    (entry,) = recording.artefacts
    assert (entry.name, entry.parts, entry.total_bytes) == ("survey", 3, 2_300_001)
    assert artefact_data(recording, entry) == ARTEFACT
    assert recording.topics["/location/observed"].messages == 3
    assert recording.topics["/tie_points"].schema == "geomosaic.TiePoints"
    assert len(list(messages(scene, "foxglove.CompressedImage"))) == 3 + 1


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_cut_anywhere_no_chunk_before_the_cut_is_lost(
    scene: Path, chunk_ends: list[int], tmp_path: Path, data: st.DataObject
) -> None:
    whole = scene.read_bytes()
    near = st.sampled_from(chunk_ends).flatmap(lambda end: st.integers(end - 12, end + 12))
    at = data.draw(st.one_of(near, st.integers(120, len(whole) - 1)))
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[:at])
    recording = read_recording(path)
    assert not recording.whole
    everything = read_recording(scene)
    count = sum(topic.messages for topic in recording.topics.values())
    expected = 0
    with scene.open("rb") as file:
        for record in StreamReader(file, emit_chunks=True).records:
            if isinstance(record, Chunk) and file.tell() <= at:
                with zstandard.ZstdDecompressor().stream_reader(record.data) as stream:
                    expected += _messages_in(stream.read())
    assert count == expected
    assert recording.stages == everything.stages[: len(recording.stages)] or not recording.stages[-1].finished
    for entry in recording.artefacts:
        if entry.complete:
            assert artefact_data(recording, entry) == ARTEFACT
        else:
            with pytest.raises(FileError, match="is incomplete; replay from an earlier stage"):
                artefact_data(recording, entry)


def _messages_in(chunk: bytes) -> int:
    at = count = 0
    while at < len(chunk):
        opcode, length = struct.unpack_from("<BQ", chunk, at)
        count += opcode == 5
        at += 9 + length
    return count


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    changes=st.lists(
        st.tuples(st.floats(0, 1, exclude_max=True), st.integers(1, 255)), min_size=1, max_size=4
    )
)
def test_flipped_bytes_never_pass_unnoticed(
    scene: Path, tmp_path: Path, changes: list[tuple[float, int]]
) -> None:
    """Every byte is under a CRC, a magic or a length, but for names and times of attachments."""
    data = bytearray(scene.read_bytes())
    for where, flip in changes:
        data[int(len(data) * where**4)] ^= flip
    path = tmp_path / "flipped.mcap"
    path.write_bytes(data)
    if bytes(data) == scene.read_bytes():
        return
    try:
        recording = read_recording(path)
        assert not recording.whole or recording.topics == read_recording(scene).topics
        for entry in recording.artefacts:
            assert artefact_data(recording, entry) == ARTEFACT
    except FileError as error:
        assert str(path) in str(error) and "\n" not in str(error)


def test_a_damaged_chunk_is_named_and_the_others_are_read(
    scene: Path, chunk_ends: list[int], tmp_path: Path
) -> None:
    data = bytearray(scene.read_bytes())
    data[chunk_ends[2] - 500] ^= 0x40
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    recording = read_recording(path)
    assert recording.problem.startswith("the chunk at byte ") and "is damaged" in recording.problem
    assert [s.stage_id for s in recording.stages] == ["survey.read", "adjustment.solve"]
    with pytest.raises(FileError, match="incomplete"):
        artefact_data(recording, recording.artefacts[0])


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "this file is empty"),
        (b"frame,lat,lon\n" * 20, "this is no MCAP file, or it was cut off in its header"),
        (b"\x89MCAP0\r\n", "this is no MCAP file, or it was cut off in its header"),
        (b"\x89MCAP0\r\n\x01\x20\x00\x00\x00\x00\x00\x00\x00geo", "no MCAP file, or it was cut off"),
        (b"\x89MCAP0\r\n\x01" + b"\xff" * 8, "no MCAP file, or it was cut off"),
    ],
)
def test_what_is_no_recording_is_said_in_one_line(tmp_path: Path, content: bytes, says: str) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(content)
    with pytest.raises(FileError) as caught:
        read_recording(path)
    assert str(caught.value).startswith(f"{path}: ") and says in str(caught.value)
    assert str(caught.value).endswith("give the run.mcap of a run folder")


def test_a_missing_file_and_a_folder(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="there is no such file"):
        read_recording(tmp_path / "run.mcap")
    with pytest.raises(FileError, match="no regular file but a folder"):
        read_recording(tmp_path)


def test_someone_elses_mcap(tmp_path: Path) -> None:
    path = tmp_path / "ros.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        writer.finish()
    with pytest.raises(FileError, match="this MCAP is no recording of geomosaic"):
        read_recording(path)


def test_a_format_of_the_future(scene: Path, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="geomosaic")
        writer.add_metadata("geomosaic", {"format": "9\x1b[2J"})
        writer.finish()
    with pytest.raises(FileError, match=r"format 9 \[2J, while this version reads 1"):
        read_recording(path)


@pytest.mark.parametrize("declared", [10, 300 * 2**20], ids=["little declared", "all declared"])
def test_a_chunk_that_would_burst_is_not_unpacked(tmp_path: Path, declared: int) -> None:
    """300 MB of zeros in 10 kB; zstandard by itself would believe the frame's own header."""
    packed = zstandard.compress(bytes(300 * 2**20))
    body = struct.pack("<QQQI", 0, 0, declared, 0)
    body += struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        recorder.begin_run(RECIPE, {}, {})
        recorder.flush()
        started = path.stat().st_size
    path.write_bytes(path.read_bytes()[:started] + b"\x06" + struct.pack("<Q", len(body)) + body)
    recording = read_recording(path)
    assert "its size disagrees with its header" in recording.problem


def test_what_a_stage_reported_can_be_reported_again(scene: Path, tmp_path: Path) -> None:
    recording = read_recording(scene)
    reported = list(stage_messages(recording, 1))
    assert [schema for _, schema, *_ in reported].count("geomosaic.PairOffsets") == 3
    assert {topic for topic, *_ in reported}.isdisjoint({"/stages", "/artefacts", "/frames"})
    with Recorder(tmp_path / "again.mcap", fixed_time=True) as recorder:
        recorder.begin_run(RECIPE, {}, {})
        for message in reported:
            recorder.copy(*message)
    again = read_recording(tmp_path / "again.mcap")
    assert again.warnings[0].text == recording.warnings[0].text
    assert np.array_equal(again.rounds[1].moves_m, recording.rounds[1].moves_m)
    assert again.topics["/location/tied"].messages == 1
