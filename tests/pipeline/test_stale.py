"""A result never outlives a file it goes back to, and nothing in RUN/work is taken on trust."""

from __future__ import annotations

import json
import os
import shutil
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from osgeo import gdal
from pipeline_toy import Numbers
from small_surveys import MAP_ALONE, geomosaic, made_map, small_survey
from test_pipeline_runner import Toys, toys  # noqa: F401

from geomosaic.doors.raster import DEM, open_raster
from geomosaic.errors import FileError, OutputError
from geomosaic.pipeline import hashes
from geomosaic.pipeline.artefacts import encode, fingerprint_of_bytes, fingerprint_of_file
from geomosaic.pipeline.hashes import FileHashes
from geomosaic_simulate.survey import SimulatedSurvey


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    folder = tmp_path_factory.mktemp("survey")
    return small_survey(folder, lines=1, frames_per_line=3, width_px=320, height_px=240, seed=21)


def copied(survey: SimulatedSurvey, to: Path) -> Path:
    to.mkdir()
    for frame in survey.frames.iterdir():
        (to / frame.name).write_bytes(frame.read_bytes())
    return to


def made(survey: SimulatedSurvey, frames: Path, run: Path) -> dict[str, Any]:
    """The map of frames in the place of the survey's; what run.json says of it."""
    stages = (MAP_ALONE[0], "matching.flying_height", *MAP_ALONE[1:])  # retouched frames have no XMP
    return made_map(replace(survey, frames=frames), run, stages, matching__sift={"keypoints": 600})


def invert(frame: Path) -> None:
    """Other pixels behind the same tags."""
    data = frame.read_bytes()
    tags = data[2 : 4 + int.from_bytes(data[4:6], "big")] if data[2:4] == b"\xff\xe1" else b""
    pixels = 255 - cv2.imdecode(
        np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    )
    plain = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes()
    frame.write_bytes(plain[:2] + tags + plain[2:])


def pixels_of(run: Path) -> np.ndarray:
    with rasterio.open(run / "mosaic.tif") as tiff:
        return np.where(tiff.dataset_mask() > 0, tiff.read(1).astype(float), np.nan)


def test_changed_images_and_masks_give_another_mosaic(survey: SimulatedSurvey, tmp_path: Path) -> None:
    frames = copied(survey, tmp_path / "frames")
    made(survey, frames, tmp_path / "run")
    first = pixels_of(tmp_path / "run")
    for frame in sorted(frames.iterdir()):
        invert(frame)
    again = made(survey, frames, tmp_path / "run")
    second = pixels_of(tmp_path / "run")
    assert np.nanmean(first) + np.nanmean(second) == pytest.approx(255.0, abs=3.0)
    assert abs(np.nanmean(first) - np.nanmean(second)) > 10.0
    assert "matching.sift" not in again["cached_stages"]
    mask = np.full((240, 320), 255, np.uint8)
    mask[:120] = 0
    for frame in sorted(frames.glob("*.jpg")):
        cv2.imwrite(str(frames / f"{frame.stem}_mask.png"), mask)
    made(survey, frames, tmp_path / "run")
    third = np.isfinite(pixels_of(tmp_path / "run")).mean()
    for frame in sorted(frames.glob("*.jpg")):
        cv2.imwrite(str(frames / f"{frame.stem}_mask.png"), mask[::-1].copy())
    made(survey, frames, tmp_path / "run")
    fourth = pixels_of(tmp_path / "run")
    made(survey, frames, tmp_path / "fresh")
    assert np.array_equal(fourth, pixels_of(tmp_path / "fresh"), equal_nan=True)
    assert 0.0 < third < 0.95 * np.isfinite(first).mean()


def test_frames_retouched_after_a_kill_are_matched_anew(survey: SimulatedSurvey, tmp_path: Path) -> None:
    """Pairs are kept by their numbers, so the frames' contents must be in their key."""
    frames = copied(survey, tmp_path / "frames")
    made(survey, frames, tmp_path / "run")
    (tmp_path / "run" / "run.json").unlink()
    for folder in ("adjustment.solve", "mosaic.compose", "export.cog"):
        for entry in (tmp_path / "run" / "work" / folder).glob("*/entry.json"):
            entry.unlink()
    names = sorted(frames.iterdir())
    first, last = names[0].read_bytes(), names[-1].read_bytes()
    names[0].write_bytes(last)
    names[-1].write_bytes(first)
    made(survey, frames, tmp_path / "run")
    made(survey, frames, tmp_path / "fresh")
    for name in ("positions.csv", "mosaic.tif"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "fresh" / name).read_bytes()


def test_a_mosaic_changed_in_place_is_made_again(survey: SimulatedSurvey, tmp_path: Path) -> None:
    """RUN/work has the same file by another name, so that a change reaches both."""
    frames = copied(survey, tmp_path / "frames")
    made(survey, frames, tmp_path / "run")
    mosaic, kept = (
        tmp_path / "run" / "mosaic.tif",
        tmp_path / "run" / "work" / "mosaic.compose" / "mosaic.tif",
    )
    before = mosaic.read_bytes()
    assert mosaic.samefile(kept)
    with mosaic.open("r+b") as file:
        file.seek(len(before) // 2)
        file.write(b"changed")
    made(survey, frames, tmp_path / "run")
    assert mosaic.read_bytes() == before


def test_a_replay_over_other_images_is_refused(
    survey: SimulatedSurvey, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = copied(survey, tmp_path / "frames")
    made(survey, frames, tmp_path / "run")
    invert(sorted(frames.iterdir())[1])
    capsys.readouterr()
    replay = ("replay", tmp_path / "run", "-o", tmp_path / "again", "--workers", 1, "--from")
    assert geomosaic(*replay, "mosaic.compose") == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert "has changed since the recording" in said and sorted(frames.iterdir())[1].name in said
    assert not (tmp_path / "again" / "mosaic.tif").exists()
    assert geomosaic(*replay, "survey.read") == 0


def test_an_edit_that_keeps_size_and_time_is_found(toys: Toys, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: F811
    numbers = toys.folder / "numbers.txt"
    monkeypatch.setattr(hashes, "UNTOUCHED_NS", 0)
    toys.run()
    toys.done()
    before = numbers.stat()
    time.sleep(0.02)
    numbers.write_text(numbers.read_text().replace("4", "5"))
    os.utime(numbers, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert (numbers.stat().st_size, numbers.stat().st_mtime_ns) == (before.st_size, before.st_mtime_ns)
    toys.run()
    assert toys.done() == ["read", "power", "item 5", "sum", "write", "tell"]


def test_a_vrt_stands_for_its_sources(tmp_path: Path) -> None:
    """The VRT itself stays as it is when a tile of the DEM is corrected."""
    shape = {"width": 8, "height": 8, "count": 1, "dtype": "float32", "crs": "EPSG:32632"}
    (tmp_path / "tiles").mkdir()
    tile = tmp_path / "tiles" / "a.tif"
    with rasterio.open(
        tile, "w", driver="GTiff", transform=rasterio.Affine(1, 0, 5e5, 0, -1, 5e6), **shape
    ) as out:
        out.write(np.zeros((1, 8, 8), np.float32))
    gdal.BuildVRT(str(tmp_path / "dem.vrt"), [str(tile)]).FlushCache()
    (tmp_path / "dem.hdr").write_text("x")
    (tmp_path / "other.vrt").write_text("x")
    first = FileHashes().manifest(tmp_path / "dem.vrt")
    assert list(first) == ["dem.hdr", "dem.vrt", str(tile)]
    with rasterio.open(tile, "r+") as out:
        out.write(np.ones((1, 8, 8), np.float32))
    second = FileHashes().manifest(tmp_path / "dem.vrt")
    assert {name for name in first if first[name] != second[name]} == {str(tile)}


def test_a_file_that_was_just_written_is_hashed_again(tmp_path: Path) -> None:
    """Within one tick of the clock a file can change without a trace in its times."""
    file, memory = tmp_path / "x", tmp_path / "hashes.json"
    file.write_bytes(b"one")
    known = FileHashes(memory)
    first = known.of_file(file)
    known.save()
    assert json.loads(memory.read_text()) == {}
    reported = json.loads(memory.read_text())
    reported[str(file)] = [0, 0, 0, 0, 0, "00"]
    memory.write_text(json.dumps(reported))
    assert FileHashes(memory).of_file(file) == first == fingerprint_of_bytes(b"one")


@pytest.mark.parametrize("other", [None, 0, 1, 2, 3, 4], ids=str)
def test_a_remembered_hash_counts_if_size_times_inode_and_device_are_as_they_were(
    other: int | None, tmp_path: Path
) -> None:
    file, memory = tmp_path / "x", tmp_path / "hashes.json"
    file.write_bytes(b"one")
    status = file.stat()
    mark = [status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino, status.st_dev]
    if other is not None:
        mark[other] += 1
    memory.write_text(json.dumps({str(file): [*mark, "remembered"]}))
    found = FileHashes(memory).of_file(file)
    assert found == ("remembered" if other is None else fingerprint_of_bytes(b"one"))


def test_a_file_that_changes_while_it_is_hashed_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "x"
    file.write_bytes(b"one")
    own = hashes.blake2b

    def written_meanwhile(**options: int) -> object:
        file.write_bytes(b"another")
        return own(**options)

    monkeypatch.setattr(hashes, "blake2b", written_meanwhile)
    with pytest.raises(FileError, match="x: was changed while the run read it"):
        FileHashes().of_file(file)


def test_an_input_that_changes_during_the_run_is_named(tmp_path: Path) -> None:
    file = tmp_path / "x"
    file.write_bytes(b"one")
    known = FileHashes()
    known.of_input(file)
    os.utime(file, ns=(1, 1))
    known.check_unchanged()
    file.write_bytes(b"two")
    with pytest.raises(FileError, match="x: was changed while the run read it; run again once nobody writes"):
        known.check_unchanged()
    file.unlink()
    known.check_unchanged()


def entry_of(toys: Toys, stage: str) -> Path:  # noqa: F811
    (folder,) = (toys.run_folder / "work" / stage).glob("*/entry.json")
    return folder.parent


def test_calls_that_were_cut_are_reported_anew(toys: Toys) -> None:  # noqa: F811
    toys.run()
    for stage in ("toy.read", "toy.sum"):
        calls = entry_of(toys, stage) / "messages"
        calls.write_bytes(calls.read_bytes()[:-3] if calls.stat().st_size else b"x")
        toys.done()
        toys.run()
        assert toys.done() == {"toy.read": ["read", "tell"], "toy.sum": ["sum", "tell"]}[stage]


@pytest.mark.parametrize("name", ["entry.json", "messages", "numbers.artefact", "hashes.json"])
@pytest.mark.parametrize("content", [b"", b"\0" * 400, b"{}", b"[" * 100_000, b'{"outputs": 3}'])
def test_what_can_not_be_read_is_redone(name: str, content: bytes, toys: Toys) -> None:  # noqa: F811
    first = toys.run()
    folder = toys.run_folder / "work" if name == "hashes.json" else entry_of(toys, "toy.power")
    (folder / name).write_bytes(content)
    toys.done()
    again = toys.run()
    same = name == "hashes.json" or (folder / name).read_bytes() == content
    assert toys.done() == (["tell"] if same else ["power", "tell"])
    assert again["artefacts"] == first["artefacts"]


def test_an_artefact_that_names_another_file_of_the_machine_is_not_taken(toys: Toys) -> None:  # noqa: F811
    """A stranger's run folder may hold entries whose every hash is right."""
    toys.run()
    folder = entry_of(toys, "toy.read")
    entry = json.loads((folder / "entry.json").read_text())
    for source, redone in ((str(toys.folder / "numbers.txt"), False), ("/etc/hostname", True)):
        data = encode(Numbers(np.array([1.0, 2.0, 3.0, 4.0]), source))
        (folder / "numbers.artefact").write_bytes(data)
        entry["outputs"]["numbers"] = fingerprint_of_bytes(data)
        (folder / "entry.json").write_text(json.dumps(entry))
        toys.done()
        toys.run()
        assert ("read" in toys.done()) == redone


def test_an_artefact_of_any_size_is_judged_without_memory_for_it(toys: Toys) -> None:  # noqa: F811
    """A sparse file costs a stranger nothing; its hash may be right."""
    toys.run()
    folder = entry_of(toys, "toy.read")
    artefact = folder / "numbers.artefact"
    with artefact.open("r+b") as file:
        file.truncate(200 << 20)
    entry = json.loads((folder / "entry.json").read_text())
    with artefact.open("rb") as file:
        entry["outputs"]["numbers"] = fingerprint_of_file(file)
    (folder / "entry.json").write_text(json.dumps(entry))
    toys.done()
    tracemalloc.start()
    toys.run()
    most_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert toys.done() == ["read", "tell"] and most_bytes < 100 << 20


def test_a_pipe_in_a_file_s_place_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(FileError, match="no regular file"):
        FileHashes().of_written(tmp_path / "pipe")


def test_a_file_of_the_system_that_can_not_be_read_is_refused_in_a_line(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="can't be read"):
        open_raster(Path("/proc/self/mem"), DEM)


@pytest.mark.parametrize("name", ["entry.json", "messages", "numbers.artefact"])
def test_an_entry_behind_a_link_is_not_taken(name: str, toys: Toys) -> None:  # noqa: F811
    toys.run()
    folder = entry_of(toys, "toy.read")
    (folder / name).rename(toys.folder / "theirs")
    (folder / name).symlink_to(toys.folder / "theirs")
    before = (toys.folder / "theirs").read_bytes()
    toys.done()
    toys.run()
    assert toys.done() == ["read", "tell"]
    assert (toys.folder / "theirs").read_bytes() == before and not (folder / name).is_symlink()


@pytest.mark.parametrize("number", ["1e999", "Infinity", "NaN"])
def test_an_entry_with_a_number_that_no_run_writes_is_redone(number: str, toys: Toys) -> None:  # noqa: F811
    toys.run()
    folder = entry_of(toys, "toy.read")
    entry = json.loads((folder / "entry.json").read_text())
    entry["notes"]["metrics"]["placed"] = 7777
    (folder / "entry.json").write_text(json.dumps(entry).replace("7777", number))
    toys.done()
    toys.run()
    assert toys.done() == ["read", "tell"]


def test_a_pipe_in_the_recording_s_place_is_not_waited_for(toys: Toys) -> None:  # noqa: F811
    toys.run()
    (toys.run_folder / "run.mcap").unlink()
    os.mkfifo(toys.run_folder / "run.mcap")
    toys.run()
    assert (toys.run_folder / "run.mcap").is_file()


@pytest.mark.parametrize("name", ["entry.json", "messages", "numbers.artefact"])
def test_a_folder_in_the_place_of_a_cached_file_is_named(name: str, toys: Toys) -> None:  # noqa: F811
    toys.run()
    place = entry_of(toys, "toy.read") / name
    place.unlink()
    place.mkdir()
    (place / "theirs.txt").write_text("theirs")
    with pytest.raises(OutputError, match=rf"{name}: a folder stands where the file is to go; move it away"):
        toys.run()
    assert (place / "theirs.txt").read_text() == "theirs"


def test_a_stage_that_fails_on_a_forged_artefact_says_where_it_lies(toys: Toys) -> None:  # noqa: F811
    """Its hashes are right, its content is text where numbers belong: the line names work/ and the fix."""
    toys.run()
    folder = entry_of(toys, "toy.read")
    entry = json.loads((folder / "entry.json").read_text())
    data = encode(Numbers(np.array(["a", "b"]), str(toys.folder / "numbers.txt")))
    (folder / "numbers.artefact").write_bytes(data)
    entry["outputs"]["numbers"] = fingerprint_of_bytes(data)
    (folder / "entry.json").write_text(json.dumps(entry))
    with pytest.raises(
        FileError, match=r"work: toy\.power fails on results stored there .*; remove it and run again"
    ):
        toys.run()
    assert not (toys.run_folder / "run.json").exists()
    shutil.rmtree(toys.run_folder / "work")
    toys.run()


def test_a_copy_is_not_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, copy, cut = (tmp_path / name for name in "abc")
    whole.write_bytes(b"mosaic")
    copy.write_bytes(whole.read_bytes())
    cut.write_bytes(b"mos")
    hashes = FileHashes()
    digest = hashes.of_written(whole)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", lambda *_: pytest.fail("was read"))
        assert hashes.of_copy(copy, whole) == hashes.of_written(copy) == digest
    assert FileHashes().of_written(copy) == digest
    with pytest.raises(FileError, match="was changed"):
        hashes.of_copy(cut, whole)
    copy.write_bytes(b"altered")
    assert hashes.of_written(copy) != digest
