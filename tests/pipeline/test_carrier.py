"""Files of a run for workers on other machines: which may go, what a worker asks for, what it keeps."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from geomosaic.doors.at_hand import Copies, NotAtHand, at_hand, own_place, reading_copies, shares_disk
from geomosaic.errors import FileError, LinkError
from geomosaic.pipeline.artefacts import encode
from geomosaic.pipeline.carrier import RunFiles, paths_in
from geomosaic.pipeline.hashes import FileHashes
from geomosaic.pipeline.stored_result import OptionalCache, SpoolingFunction, StoredResult


def frames_and_run(folder: Path) -> tuple[Path, RunFiles]:
    """A frame with a sidecar and a stranger of its folder; a run that reads the first two."""
    run, frame = folder / "run", folder / "frames" / "a.tif"
    (run / "work").mkdir(parents=True)
    frame.parent.mkdir()
    hashes = FileHashes()
    for name in ("a.tif", "a.tfw", "b.tif"):
        (frame.parent / name).write_text(name)
    for name in ("a.tif", "a.tfw"):
        hashes.of_input(frame.parent / name)
    return frame, RunFiles(run, hashes)


def test_a_run_sends_what_it_reads_and_what_it_made_and_nothing_else(tmp_path: Path) -> None:
    frame, run_files = frames_and_run(tmp_path)
    made = run_files.folder / "work" / "made"
    made.write_bytes(b"made")
    assert run_files.bytes_of(frame) == b"a.tif" and run_files.bytes_of(made) == b"made"
    assert run_files.with_companions(frame) == [frame.with_suffix(".tfw"), frame]
    assert run_files.bytes_of(frame.with_name("b.tif")) is None
    assert run_files.bytes_of(run_files.folder / ".." / "frames" / "b.tif") is None
    assert run_files.bytes_of(Path("/etc/hostname")) is None
    (run_files.folder / "work" / "link").symlink_to(frame.with_name("b.tif"))
    with pytest.raises(LinkError):
        run_files.bytes_of(run_files.folder / "work" / "link")


def test_a_vrt_is_refused_with_the_way_out(tmp_path: Path) -> None:
    _, run_files = frames_and_run(tmp_path)
    (run_files.folder / "dem.vrt").write_text("<VRTDataset/>")
    with pytest.raises(FileError, match="names other files, which a worker elsewhere lacks; write one TIFF"):
        run_files.bytes_of(run_files.folder / "dem.vrt")


def test_copies_stand_in_for_files_and_lie_together(tmp_path: Path) -> None:
    copies = Copies(tmp_path / "run", tmp_path / "copies")
    frame = tmp_path / "frames" / "a.tif"
    assert at_hand(frame) == own_place(frame) == frame and shares_disk()
    with reading_copies(copies):
        assert not shares_disk()
        with pytest.raises(NotAtHand) as lacking:
            at_hand(frame)
        assert lacking.value.path == frame
        copies.take(frame, b"pixels")
        copies.take(frame.with_suffix(".tfw"), b"place")
        copies.take(frame.with_suffix(".prj"), None)
        assert at_hand(frame).read_bytes() == b"pixels"
        assert at_hand(frame).with_suffix(".tfw").read_bytes() == b"place"
        assert at_hand(at_hand(frame)) == at_hand(frame)
        assert at_hand(frame.with_suffix(".prj")) == frame.with_suffix(".prj")
        seen: list[Path] = []
        other = threading.Thread(target=lambda: seen.append(at_hand(frame)))
        other.start()
        other.join()
        assert seen == [frame]
        copies.forget([frame])
        with pytest.raises(NotAtHand):
            at_hand(frame)
    copies.remove()
    assert not copies.folder.exists()


def test_results_come_home_as_bytes_from_where_the_disk_is_not_shared(tmp_path: Path) -> None:
    place = tmp_path / "run" / "work" / "items" / "ab" / "cd"
    with reading_copies(Copies(tmp_path / "run", tmp_path / "copies")):
        assert SpoolingFunction(abs)((-3, place)) == encode(3)
        kept = OptionalCache(int, place)
        assert kept.found() is None
        kept.leave(5)
        assert kept.found() == 5
    assert not (tmp_path / "run").exists()


def test_paths_are_found_however_deep_they_stand(tmp_path: Path) -> None:
    stored = StoredResult[int](int, "mark", tmp_path / "kept")
    found = paths_in((1, {"a": [stored, str(tmp_path / "frame.jpg"), "no path"]}))
    assert {path for path in found if path.name} == {tmp_path / "kept", tmp_path / "frame.jpg"}
