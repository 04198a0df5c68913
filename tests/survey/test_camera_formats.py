"""DNG and HEIC frames: pixels, tags, damage, and what is said without their readers."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from small_surveys import mosaic, summary
from survey_files import dji_xmp, exif_block, gps, image, survey_folder, write_dng, write_jpeg

from geomosaic.doors.camera_formats import CAMERA_FORMATS, camera_image, decoded_camera_image
from geomosaic.doors.raster import OWN, open_raster
from geomosaic.errors import FileError, InputError
from geomosaic.survey.damage import decoded, wholeness
from geomosaic.survey.folder import frame_files
from geomosaic.survey.header import FrameHeader, read_header
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.jpeg import read_structure
from geomosaic.survey.pixels import read_pixels
from geomosaic.survey.read import read_survey
from geomosaic_simulate.survey import SimulatedSurvey

SIZE = 240, 160
TAGS = {
    "Make": "DJI",
    "Model": "FC6310",
    "DateTimeOriginal": "2024:05:17 10:11:12",
    "FocalLengthIn35mmFilm": 24,
}


def linear(width: int = SIZE[0], height: int = SIZE[1]) -> np.ndarray:
    """Linear colours from 0.1 to 0.9, with a grey square."""
    rgb = 0.1 + 0.8 * image(width, height).astype(np.float64) / 255.0
    rgb[:40, :40] = 0.5
    return rgb


def heic(path: Path, pixels: np.ndarray, exif: bytes = b"", xmp: bytes = b"") -> Path:
    """A HEIC of 8 bits, or of 10 of 16."""
    pillow_heif = pytest.importorskip("pillow_heif")
    mode = {1: "L", 3: "RGB", 4: "RGBA"}[pixels.shape[2]] + (";16" if pixels.dtype == np.uint16 else "")
    made = pillow_heif.from_bytes(mode, pixels.shape[1::-1], np.ascontiguousarray(pixels).tobytes())
    made.save(
        path, quality=95, **({"exif": b"Exif\0\0" + exif} if exif else {}), **({"xmp": xmp} if xmp else {})
    )
    return path


@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_a_dng_is_linear_and_balanced(tmp_path: Path, orientation: int) -> None:
    pytest.importorskip("rawpy")
    rgb = linear()
    path = write_dng(
        tmp_path / "DJI_0001.DNG", rgb, {**TAGS, **gps(9.1, 48.7, 412.5)}, Orientation=orientation
    )
    header = read_header(path)
    assert (header.width_px, header.height_px, header.bands, header.dtype) == (*SIZE, 3, "uint16")
    pixels, valid = decoded_camera_image(path, SIZE)
    assert valid is None and pixels.dtype == np.uint16
    np.testing.assert_allclose(pixels[8:32, 8:32] / 65535.0, 0.5, atol=1e-3)
    off = pixels[4:-4, 4:-4] / 65535.0 - rgb[4:-4, 4:-4]
    assert np.abs(off).mean() < 0.02


def test_a_darker_dng_stays_darker(tmp_path: Path) -> None:
    """Each frame's own brightest pixel doesn't set its scale."""
    pytest.importorskip("rawpy")
    for name, level in (("a.dng", 0.8), ("b.dng", 0.4)):
        write_dng(tmp_path / name, np.full((SIZE[1], SIZE[0], 3), level), TAGS)
        pixels, _ = decoded_camera_image(tmp_path / name, SIZE)
        np.testing.assert_allclose(pixels / 65535.0, level, atol=1e-3)


def test_tags_of_a_dng_are_those_of_a_jpeg(tmp_path: Path) -> None:
    pytest.importorskip("rawpy")
    tags, xmp = {**TAGS, **gps(9.1234567, 48.7654321, 412.5)}, dji_xmp(GimbalYawDegree="+37.00")
    dng = read_header(write_dng(tmp_path / "a.dng", linear(), tags, xmp))
    jpeg = read_header(write_jpeg(tmp_path / "a.jpg", image(*SIZE), exif_block(**tags), xmp))
    assert dng.xmp == jpeg.xmp != {}
    for name in ("make", "model", "lon_deg", "lat_deg", "altitude_m", "time_s", "focal_length_35mm"):
        assert getattr(dng.exif, name) == getattr(jpeg.exif, name) is not None


@pytest.mark.parametrize(("bands", "dtype"), [(3, np.uint8), (3, np.uint16), (1, np.uint8), (4, np.uint8)])
def test_a_heic_gives_what_was_put_in(tmp_path: Path, bands: int, dtype: type) -> None:
    whole = image(*SIZE, bands=bands).astype(dtype) * (256 if dtype == np.uint16 else 1)
    if bands == 4:
        whole[..., 3] = 255
        whole[:50, :, 3] = 0
    xmp = dji_xmp(GimbalYawDegree="+37.00")
    path = heic(tmp_path / "a.HEIC", whole, exif_block(**TAGS, **gps(9.1, 48.7, 412.5)), xmp)
    header = read_header(path)
    assert (header.width_px, header.height_px, header.bands) == (*SIZE, 1 if bands == 1 else 3)
    assert header.dtype == np.dtype(dtype).name and header.xmp is not None
    assert header.exif.lat_deg == pytest.approx(48.7) and header.xmp["drone-dji:GimbalYawDegree"] == "+37.00"
    pixels, valid = decoded_camera_image(path, SIZE)
    most = float(np.iinfo(dtype).max)
    assert np.abs(pixels / most - whole[..., : pixels.shape[2]] / most).mean() < 0.04  # half of the colours
    assert (valid is not None) == (bands == 4)
    if valid is not None:
        assert not valid[:48].any() and valid[52:].all()


@pytest.mark.parametrize("share", [0.001, 0.02, 0.5, 0.99])
@pytest.mark.parametrize("suffix", [".dng", ".heic"])
def test_a_damaged_file_is_one_error(tmp_path: Path, suffix: str, share: float) -> None:
    pytest.importorskip("rawpy" if suffix == ".dng" else "pillow_heif")
    path = tmp_path / f"a{suffix}"
    _ = write_dng(path, linear(), TAGS) if suffix == ".dng" else heic(path, image(*SIZE))
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    try:
        found = wholeness(str(path))
        assert found.damage and found.whole_rows == 0
    except FileError as error:
        assert "can't be decoded" in str(error)


def test_stated_sizes_are_checked_before_a_pixel_is_decoded(tmp_path: Path) -> None:
    """A kilobyte that states 60,000 x 60,000 pixels; and a file that grew after its header was read."""
    pytest.importorskip("rawpy")
    path = write_dng(tmp_path / "a.dng", linear(), TAGS, ImageWidth=30000, ImageLength=30000)
    assert camera_image(path).width_px == 30000
    with pytest.raises(FileError, match=r"bytes can't hold 30000 x 30000 pixels"):
        read_header(path)
    with pytest.raises(FileError, match=r"are 30000 x 30000, its header states 240 x 160"):
        decoded_camera_image(path, SIZE)


@pytest.mark.parametrize("one", CAMERA_FORMATS, ids=lambda one: one.name)
def test_without_its_reader_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, one: object
) -> None:
    (form,) = (f for f in CAMERA_FORMATS if f is one)
    (tmp_path / f"a{min(form.suffixes)}").write_bytes(b"x")
    monkeypatch.setitem(sys.modules, form.module, None)
    with pytest.raises(InputError) as caught:
        read_survey(SurveyInputs(tmp_path))
    assert str(caught.value).startswith(f"{tmp_path}: holds {form.name} frames, and {form.module}, which")
    assert f"pip install 'geomosaic-ortho[{form.extra}]', or convert them to JPEG" in str(caught.value)
    assert caught.value.exit_code == 2


def test_they_are_frames_where_there_are_no_others(tmp_path: Path) -> None:
    pytest.importorskip("rawpy")
    folder = survey_folder(tmp_path / "f", 2)
    write_dng(folder / "DJI_0003.DNG", linear(), TAGS)
    assert list(frame_files(folder).values()) == ["DJI_0001.JPG", "DJI_0002.JPG"]
    for path in folder.glob("*.JPG"):
        path.unlink()
    assert list(frame_files(folder).values()) == ["DJI_0003.DNG"]


def converted(jpegs: Path, folder: Path, suffix: str) -> list[FrameHeader]:
    """A folder of JPEG frames in another format, with their tags."""
    folder.mkdir()
    headers = []
    for path in sorted(jpegs.glob("*.jpg")):
        data, out = path.read_bytes(), folder / f"{path.stem}{suffix}"
        pixels, structure = decoded(data, 3), read_structure(path)
        if suffix == ".heic":
            heic(out, pixels, structure.exif, structure.xmp)
        else:
            e = read_header(path).exif
            assert e.lon_deg is not None and e.lat_deg is not None and e.focal_length_35mm is not None
            tags = {**TAGS, **gps(e.lon_deg, e.lat_deg, e.altitude_m)} | {
                "FocalLengthIn35mmFilm": round(e.focal_length_35mm)
            }
            write_dng(out, (pixels / 255.0) ** 2.2, tags, structure.xmp)
        headers.append(read_header(out))
    return headers


@pytest.mark.parametrize(
    ("suffix", "module"), [(".dng", "rawpy"), pytest.param(".heic", "pillow_heif", marks=pytest.mark.proof)]
)
def test_a_folder_of_them_becomes_a_mosaic(
    few_survey: SimulatedSurvey, tmp_path: Path, suffix: str, module: str
) -> None:
    pytest.importorskip(module)
    folder, run = tmp_path / f"frames{suffix}", tmp_path / "run"
    headers = converted(few_survey.frames, folder, suffix)
    quick = ("--adjust", "least_squares", "--set", "matching.sift.keypoints=600", "-q")
    assert mosaic(folder, run, *quick) == 0
    assert summary(run)["frames"]["tied"] == len(headers)
    with open_raster(run / "mosaic.tif", OWN) as raster:
        assert raster.dtypes[0] == headers[0].dtype
    frame = read_survey(SurveyInputs(folder)).frames[0]
    full, eighth = read_pixels(frame)[0], read_pixels(frame, 8)[0]
    np.testing.assert_allclose(eighth[0, 0], full[:8, :8].mean(axis=(0, 1)), atol=1.0)
