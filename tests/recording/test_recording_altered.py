"""Recordings that somebody changed: what isn't as it was made is found, and takes no more than the file holds."""

from __future__ import annotations

import io
import json
import resource
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from adjustment_blocks import fly
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from test_recording_replay import recorded, replay

from geomosaic.adjustment.model import Adjusted
from geomosaic.camera.interior import Camera
from geomosaic.cli.main import main
from geomosaic.errors import FileError
from geomosaic.pipeline import replayed_stage
from geomosaic.pipeline.artefact_reader import decode
from geomosaic.pipeline.artefacts import encode
from geomosaic.recording import read_recording
from geomosaic.recording.file.run_kinds import Artefact, StageEvent
from geomosaic.recording.inspect.compare import compare
from geomosaic.recording.inspect.summary import summary

__all__ = ["recorded"]


def rewritten(source: Path, out: Path, change: Callable[[str, bytes], bytes]) -> None:
    """The same recording, each message and attachment as `change` (schema or name, bytes) gives it, written
    by mcap's own writer."""
    with source.open("rb") as file, out.open("wb") as target:
        reader, writer = make_reader(file), Writer(target, compression=CompressionType.ZSTD)
        header = reader.get_header()
        writer.start(header.profile, header.library)
        channels: dict[int, int] = {}
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        for a in reader.iter_attachments():
            reported = change(a.name, a.data)
            writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, reported)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            assert schema is not None
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number, channel.metadata
                )
            data = change(schema.name, message.data)
            writer.add_message(
                channels[channel.id], message.log_time, data, message.publish_time, message.sequence
            )
        writer.finish()


def heights_raised(schema: str, data: bytes) -> bytes:
    """Of replayed.raise's artefact: the last height is another one, as many bytes, the same fingerprint."""
    if schema != "geomosaic.Artefact":
        return data
    message = Artefact.FromString(data)
    if message.name != "raised":
        return data
    with zipfile.ZipFile(io.BytesIO(message.data)) as file:
        members = {name: file.read(name) for name in file.namelist()}
    members["0"] = members["0"][:-8] + np.array([99.0]).tobytes()
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as file:
        for name, member in members.items():
            file.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), member)
    message.data = out.getvalue()
    assert len(message.data) == message.total_bytes
    return message.SerializeToString()  # type: ignore[no-any-return]


def test_an_unchanged_copy_is_equal_and_replayed(recorded: Path) -> None:
    """The copy's chunks are other ones: content counts."""
    before = read_recording(recorded / "run.mcap")
    rewritten(recorded / "run.mcap", recorded / "copy.mcap", lambda _, data: data)
    copy = read_recording(recorded / "copy.mcap")
    assert all(stage.lineage for stage in copy.stages) and list(copy.stages[1].written) == [
        "work/replayed.raise/raster.bin"
    ]
    assert compare(before, copy)["equal"] and summary(copy)["altered"] == []
    (recorded / "copy.mcap").replace(recorded / "run.mcap")
    assert replay(recorded, "--from", "replayed.read")[0] == 0


def test_an_altered_artefact_is_named_by_diff_and_inspect_and_not_replayed(
    recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rewritten(recorded / "run.mcap", recorded / "changed.mcap", heights_raised)
    assert main(["diff", str(recorded / "run.mcap"), str(recorded / "changed.mcap"), "--json"]) == 1
    output = json.loads(capsys.readouterr().out)
    assert output["altered"] == [{"in": "b", "stage": "replayed.raise", "artefact": "raised"}]
    assert not output["equal"] and output["stages"] == []
    assert main(["inspect", str(recorded / "changed.mcap")]) == 0
    assert "'raised' of stage replayed.raise isn't what its fingerprint says" in capsys.readouterr().out
    (recorded / "changed.mcap").replace(recorded / "run.mcap")
    code, out = replay(recorded, "--from", "replayed.read")
    said = capsys.readouterr().err
    assert code == 2 and "'raised' of stage replayed.raise" in said and "replay with --from" in said
    assert not (out / "sum.txt").exists()
    assert replay(recorded, "--from", "replayed.raise")[0] == 0


def test_a_replay_of_a_replay_still_holds(recorded: Path) -> None:
    code, out = replay(recorded, "--from", "replayed.read")
    assert code == 0 and summary(read_recording(out / "run.mcap"))["altered"] == []
    assert main(["replay", str(out), "-o", str(recorded.parent / "RUN3"), "--from", "replayed.read"]) == 0


def test_an_array_belongs_to_one_place() -> None:
    """Each of thousands of references would be a copy: 1 MB as 4 GB."""
    data = encode([np.zeros(125_000)])
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        array = file.read("0")
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as file:
        file.writestr("tree.json", json.dumps({"list": [{"array": 0}] * 4000}))
        file.writestr("0", array)
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(FileError, match="no whole artefact"):
        decode(out.getvalue(), list)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb < 100_000


def test_a_lens_of_no_known_kind_is_no_artefact() -> None:
    """It was a fault of the program where the lens was first asked for."""
    data = encode(Camera("a", 400, 300, 500.0, 200.0, 150.0))
    for kind in (b'"brawn"', b"[1,2,3]"):
        with pytest.raises(FileError, match="no whole artefact"):
            decode(retold(data, b'"brown"', kind), Camera)


def test_cameras_without_focal_length_or_pixels_are_of_no_artefact() -> None:
    """A replay fell where it divided by them. Found by `make fuzz`, seed 922, case 1344."""
    block = fly(1, points=300).block
    n = len(block.names)
    data = encode(Adjusted(block.poses, block.cameras, ("tied",) * n, (), (), block.ground))
    assert len(decode(data, Adjusted).cameras) == n
    for old, new in (
        (b'"focal_length_px":1000.0', b'"focal_length_px":0.0'),
        (b'"width_px":800', b'"width_px":0'),
    ):
        with pytest.raises(FileError, match="no whole artefact"):
            decode(retold(data, old, new), Adjusted)


def test_artefacts_of_different_frames_are_not_replayed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A replay fell where it counted both. Found by `make fuzz`, seed 922, case 2653."""
    blocks = [fly(1, 1, n, points=50).block for n in (4, 5)]
    artefacts = [Adjusted(b.poses, b.cameras, ("tied",) * len(b.names), (), (), b.ground) for b in blocks]
    steps: dict[int, Adjusted] = dict(enumerate((*artefacts[:1], *artefacts)))
    monkeypatch.setattr(
        replayed_stage, "replayed_stage", lambda _r, _s, i: SimpleNamespace(outputs={"adjusted": steps[i]})
    )
    recording = SimpleNamespace(path=Path("run.mcap"))
    assert len(replayed_stage.replayed_stages(recording, None, 2)) == 2  # type: ignore[arg-type]
    with pytest.raises(FileError, match="of different frames"):
        replayed_stage.replayed_stages(recording, None, 3)  # type: ignore[arg-type]


def test_an_array_of_an_endless_number_is_no_artefact() -> None:
    data = encode((np.arange(3), 1.5))
    for old, new in ((b'"array":0', b'"array":Infinity'), (b'"array":0', b'"array":1e400')):
        with pytest.raises(FileError, match="no whole artefact"):
            decode(retold(data, old, new), tuple)


def retold(data: bytes, old: bytes, new: bytes) -> bytes:
    """An artefact with other words in its tree."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as file, zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as again:
        for name in file.namelist():
            again.writestr(name, file.read(name).replace(old, new))
    return out.getvalue()


def test_members_that_lie_on_each_other_are_refused() -> None:
    """A thousand names of the same megabyte."""
    data = bytearray(encode([np.zeros(125_000)]))
    at = data.rindex(b"PK\x01\x02")  # the directory's entry of "0"
    end = data.rindex(b"PK\x05\x06")
    tail, entry = bytearray(data[end:]), bytes(data[at:end])
    again = b"".join(entry.replace(b"0", str(k % 10).encode()) for k in range(1000))
    first = data.index(b"PK\x01\x02")
    directory = bytes(data[first:at]) + again
    tail[8:12] = (1001).to_bytes(2, "little") * 2
    tail[12:16] = len(directory).to_bytes(4, "little")
    with pytest.raises(FileError, match="no whole artefact"):
        decode(bytes(data[:first]) + directory + bytes(tail), list)


def test_artefacts_that_would_burst_are_refused(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """300 MB of zeros in a recording of some kilobytes."""

    def swollen(schema: str, data: bytes) -> bytes:
        if schema != "geomosaic.Artefact":
            return data
        message = Artefact.FromString(data)
        message.data = bytes(100 * 2**20)
        message.total_bytes = len(message.data)
        return message.SerializeToString()  # type: ignore[no-any-return]

    rewritten(recorded / "run.mcap", recorded / "swollen.mcap", swollen)
    assert (recorded / "swollen.mcap").stat().st_size < 2**20
    assert main(["inspect", str(recorded / "swollen.mcap")]) == 2
    assert "its artefacts would take more than" in capsys.readouterr().err


def test_a_damaged_event_is_one_line(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its chunk is whole and its sums are right; what it holds is no event."""

    def damaged(schema: str, data: bytes) -> bytes:
        if schema != "geomosaic.StageEvent" or StageEvent.FromString(data).stage_id != "replayed.raise":
            return data
        return b"\xff" * len(data)

    rewritten(recorded / "run.mcap", recorded / "damaged.mcap", damaged)
    assert main(["inspect", str(recorded / "damaged.mcap")]) == 0
    assert "is damaged" in capsys.readouterr().out
    (recorded / "damaged.mcap").replace(recorded / "run.mcap")
    code, out = replay(recorded, "--from", "replayed.read")
    said = capsys.readouterr().err
    assert code == 2 and said.count("\n") == 1 and "replayed.raise" in said
    assert not (out / "sum.txt").exists()


def test_inputs_under_a_name_that_no_file_can_have_are_gone(recorded: Path) -> None:
    """Too long for the system, which was a fault of the program; so was a folder that nobody may look into."""

    def longer(name: str, data: bytes) -> bytes:
        if name != "manifest.json":
            return data
        return json.dumps({k: {**v, "path": "a" * 5000} for k, v in json.loads(data).items()}).encode()

    rewritten(recorded / "run.mcap", recorded / "longer.mcap", longer)
    (recorded / "longer.mcap").replace(recorded / "run.mcap")
    assert replay(recorded, "--from", "replayed.raise")[0] == 0


def test_no_byte_of_an_artefact_ends_in_more_than_one_clear_error() -> None:
    """A flag of encryption and a version of the container that is yet to come were faults of the program."""
    data = encode((1, "a", np.arange(3)))
    wrong = 0
    for at in range(len(data)):
        for bits in (0x01, 0x80, 0xFF):
            spoiled = bytearray(data)
            spoiled[at] ^= bits
            try:
                decode(bytes(spoiled), tuple)
            except FileError:
                wrong += 1
    assert wrong > len(data)
