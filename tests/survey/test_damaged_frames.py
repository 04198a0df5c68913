"""Frames whose data are damaged: detected by the decoder, left out and named, or used above the damage."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from small_surveys import mosaic, small_survey, summary, warned

from geomosaic.errors import FileError
from geomosaic.quality.positions import read_poses
from geomosaic.survey.damage import wholeness
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.jpeg import parse_structure
from geomosaic.survey.model import Frame
from geomosaic.survey.pixels import read_pixels
from geomosaic.survey.read import read_survey
from geomosaic_simulate.survey import SimulatedSurvey

HEIGHT, WIDTH = 400, 600


def image(**options: int) -> bytes:
    """A JPEG of something to see."""
    rng = np.random.default_rng(4)
    coarse = cv2.resize(rng.integers(0, 255, (25, 38, 3), dtype=np.uint8), (WIDTH, HEIGHT))
    noisy = np.clip(coarse + rng.normal(0.0, 6.0, coarse.shape), 0, 255).astype(np.uint8)
    flags = [v for name, value in options.items() for v in (getattr(cv2, f"IMWRITE_JPEG_{name}"), value)]
    return cv2.imencode(".jpg", noisy, flags)[1].tobytes()


def coded(data: bytes) -> tuple[int, int]:
    """Where the coded data begin and end."""
    start = parse_structure(data, Path("a.jpg")).data_start
    return start, data.rfind(b"\xff\xd9")


def zeroed(data: bytes, first: float, last: float = 1.0) -> bytes:
    """A part of the coded data lost, as a card or a disk loses blocks; the end marker is kept."""
    start, end = coded(data)
    a, b = (start + int((end - start) * share) for share in (first, last))
    return data[:a] + bytes(b - a) + data[b:]


def found(path: Path, data: bytes) -> tuple[str, int]:
    """What is detected of a JPEG's damage, and how many rows are said to be whole."""
    path.write_bytes(data)
    detected = wholeness(str(path))
    return detected.damage, detected.whole_rows


KINDS = [{}, {"PROGRESSIVE": 1}, {"RST_INTERVAL": 20}, {"OPTIMIZE": 1}, {"SAMPLING_FACTOR": 0x111111}]


@pytest.mark.parametrize("options", KINDS)
def test_whole_images_are_whole(tmp_path: Path, options: dict[str, int]) -> None:
    """Also with previews behind the image, padding before its end, and an odd version in its header."""
    data = image(**options)
    preview = cv2.imencode(".jpg", np.full((50, 60, 3), 90, np.uint8))[1].tobytes()
    odd = bytearray(data)
    odd[data.index(b"JFIF\0") + 5] = 3
    for whole in (data, data + preview, data[:-2] + bytes(3000) + data[-2:], bytes(odd), data + bytes(500)):
        assert found(tmp_path / "a.jpg", whole) == ("", HEIGHT)
    grey = cv2.imencode(".jpg", cv2.imdecode(np.frombuffer(data, np.uint8), 0))[1].tobytes()
    assert found(tmp_path / "a.jpg", grey) == ("", HEIGHT)


@pytest.mark.parametrize("options", KINDS)
def test_damage_is_detected_and_the_rows_above_it_reported(tmp_path: Path, options: dict[str, int]) -> None:
    data = image(**options)
    start, end = coded(data)
    middle = (start + end) // 2
    noise = np.random.default_rng(9).integers(1, 255, 400, dtype=np.uint8).tobytes()
    odd = bytearray(zeroed(data, 0.5))
    odd[data.index(b"JFIF\0") + 5] = 3
    kinds = {
        "zeros": zeroed(data, 0.5),
        "zeros within": zeroed(data, 0.5, 0.6),
        "ones": data[:middle] + b"\xff\x00" * ((end - middle) // 2) + data[end:],
        "cut": data[:middle],
        "cut and ended": data[:middle] + b"\xff\xd9",
        "zeros, odd version": bytes(odd),
        "noise": data[:middle] + noise + data[middle + 400 :],
        "hole": data[:middle] + data[middle + 700 :],
    }
    whole = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB)
    for name, damaged in kinds.items():
        said, rows = found(tmp_path / "a.jpg", damaged)
        assert said.startswith("libjpeg says '"), name
        got, _ = read_pixels(frame(tmp_path / "a.jpg", whole_rows=rows))
        assert (got[:rows] == whole[:rows]).all(), name
        if "PROGRESSIVE" in options:
            assert rows == 0, name
        elif name in ("zeros", "zeros within", "cut", "zeros, odd version") or "RST_INTERVAL" in options:
            assert 120 <= rows <= 208, name


def frame(path: Path, bands: int = 3, whole_rows: int | None = None) -> Frame:
    """A frame without a survey around it."""
    return Frame(path.name, str(path), WIDTH, HEIGHT, bands, "uint8", "", None, None, whole_rows=whole_rows)  # type: ignore[arg-type]


def test_what_is_below_the_damage_is_masked(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(zeroed(image(), 0.5)[:-2])
    with pytest.raises(FileError, match="truncated"):
        read_pixels(frame(path))
    pixels, valid = read_pixels(frame(path, whole_rows=170))
    assert valid is not None and pixels.shape == (HEIGHT, WIDTH, 3)
    assert (valid[:170] == 255).all() and not valid[170:].any()
    _, reduced = read_pixels(frame(path, whole_rows=170), 8)
    assert reduced is not None and (reduced[:21] == 255).all() and not reduced[21:].any()


@pytest.mark.parametrize("compress", ["deflate", "lzw", "jpeg"])
def test_a_tiff_that_does_not_decode(tmp_path: Path, compress: str) -> None:
    path = tmp_path / "a.tif"
    pixels = np.moveaxis(cv2.imdecode(np.frombuffer(image(), np.uint8), cv2.IMREAD_COLOR), -1, 0)
    with rasterio.open(
        path, "w", driver="GTiff", width=WIDTH, height=HEIGHT, count=3, dtype="uint8", compress=compress,
        interleave="pixel", blockysize=16, crs="EPSG:32632", transform=rasterio.Affine(1, 0, 5, 0, -1, 5),
    ) as tiff:  # fmt: skip
        tiff.write(pixels)
        at = int(tiff.get_tag_item("BLOCK_OFFSET_0_20", "TIFF", bidx=1) or 0)
    if not at:
        with rasterio.open(path) as tiff:
            at = int(tiff.get_tag_item("BLOCK_OFFSET_0_20", "TIFF", bidx=1))
    data = path.read_bytes()
    path.write_bytes(data[: at + 20] + bytes(600) + data[at + 620 :])
    detected = wholeness(str(path))
    assert detected.damage.startswith("GDAL says '") and detected.whole_rows == 256
    with pytest.raises(FileError, match="can't be decoded whole"):
        read_pixels(frame(path))
    got, valid = read_pixels(frame(path, whole_rows=256))
    assert valid is not None and (valid[:256] == 255).all() and not valid[256:].any()
    assert got.shape == (HEIGHT, WIDTH, 3)


@pytest.fixture(scope="module")
def line(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    """One line of five frames."""
    folder = tmp_path_factory.mktemp("line")
    return small_survey(folder, lines=1, frames_per_line=5, seed=41, pos_in="csv", buildings=0.0)


@pytest.fixture
def frames(line: SimulatedSurvey, tmp_path: Path) -> Path:
    """A copy of the line's frames to spoil."""
    shutil.copytree(line.frames, tmp_path / "frames")
    return tmp_path / "frames"


def test_the_rest_is_mosaicked_and_the_damaged_are_named(
    line: SimulatedSurvey, frames: Path, tmp_path: Path
) -> None:
    """One zeroed, one cut, one that is no image; their lines in the POS file do no harm."""
    second, last = frames / "F0002.jpg", frames / "F0005.jpg"
    second.write_bytes(zeroed(second.read_bytes(), 0.5))
    last.write_bytes(last.read_bytes()[:-4000])
    (frames / "notes.jpg").write_text("not an image")
    (frames / "folder.jpg").mkdir()
    run = tmp_path / "run"
    given = ["--pos", line.pos, "--camera", line.camera, "--adjust", "least_squares"]
    assert mosaic(frames, run, *given) == 0
    run_summary = summary(run)
    out = ["F0002.jpg", "F0005.jpg", "folder.jpg", "notes.jpg"]
    assert run_summary["frames"] == {"total": 7, "tied": 3, "placed": 0, "rejected": 0, "left_out": 4}
    assert sorted(warned(run, "frame-damaged")) == out
    text = next(w["text"] for w in run_summary["warnings"] if w["frame"] == "F0002.jpg")
    assert text.startswith("left out: the image data are damaged: libjpeg says 'Corrupt JPEG data")
    with (run / "positions.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [r["frame"] for r in rows if r["status"] == "left_out"] == out
    assert all(v == "" for r in rows[3:] for k, v in r.items() if k not in ("frame", "status"))
    again = read_survey(SurveyInputs(frames, pos=run / "positions.csv", camera=line.camera))
    assert len(again.frames) == 3 and len(again.left_out) == 4
    assert len(read_poses(run / "positions.csv", [f.name for f in again.frames], again.work_frame)) == 3


def test_a_frame_whose_mask_is_spoiled_is_left_out_and_named(line: SimulatedSurvey, frames: Path) -> None:
    """What of it is valid is unknown; the others keep theirs."""
    given = {"pos": line.pos, "camera": line.camera}
    for name in ("F0001", "F0002", "F0004"):
        cv2.imwrite(
            str(frames / f"{name}_mask.png"), np.full(cv2.imread(str(frames / f"{name}.jpg")).shape[:2], 255)
        )
    assert all(read_survey(SurveyInputs(frames, **given)).frames[i].valid_mask for i in (0, 1, 3))
    mask = frames / "F0002_mask.png"
    mask.write_bytes(mask.read_bytes()[:-12])
    cv2.imwrite(str(frames / "F0004_mask.png"), np.ones((30, 41), np.uint8))
    survey = read_survey(SurveyInputs(frames, **given))
    assert [f.name for f in survey.frames] == ["F0001.jpg", "F0003.jpg", "F0005.jpg"]
    assert survey.frames[0].valid_mask == str(frames / "F0001_mask.png")
    reported = {out.name: out.reason for out in survey.left_out}
    assert reported.keys() == {"F0002.jpg", "F0004.jpg"}
    assert (
        reported["F0002.jpg"].startswith("the mask is damaged")
        and "(F0002_mask.png)" in reported["F0002.jpg"]
    )
    assert reported["F0004.jpg"].startswith("the mask has 41 x 30 pixels, its frame ")
    with pytest.raises(FileError, match=r"F0002_mask\.png: the mask is damaged"):
        read_survey(SurveyInputs(frames, **given, strict=True))


def test_the_part_above_the_damage_is_used_if_asked(line: SimulatedSurvey, frames: Path) -> None:
    third = frames / "F0003.jpg"
    third.write_bytes(zeroed(third.read_bytes(), 0.7))
    given = {"pos": line.pos, "camera": line.camera}
    survey = read_survey(SurveyInputs(frames, **given, damaged="mask"))
    assert survey.left_out == () and len(survey.frames) == 5
    (used,) = [f for f in survey.frames if f.whole_rows is not None]
    assert used.name == "F0003.jpg" and used.whole_rows is not None and 180 < used.whole_rows < 260
    (warning,) = [w for w in survey.warnings if w.code == "frame-damaged"]
    assert f"only its first {used.whole_rows} of 360 rows are used" in warning.text
    third.write_bytes(zeroed(third.read_bytes(), 0.1))
    survey = read_survey(SurveyInputs(frames, **given, damaged="mask"))
    (out,) = survey.left_out
    assert out.name == "F0003.jpg" and "libjpeg says" in out.reason and "above row 90" in out.reason


def test_where_all_are_damaged_the_first_is_blamed(
    line: SimulatedSurvey, frames: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for path in frames.iterdir():
        path.write_bytes(zeroed(path.read_bytes(), 0.5))
    assert mosaic(frames, tmp_path / "run", "--pos", line.pos, "--camera", line.camera) == 2
    text = capfd.readouterr().err.strip().splitlines()[-1]
    assert "F0001.jpg: the image data are damaged: libjpeg says" in text and "copy it again" in text
