"""Images in the folder that don't belong to the survey: left out, named, and the rest is read."""

from __future__ import annotations

import shutil
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from rasterio.errors import NotGeoreferencedWarning
from survey_files import dji_xmp, exif_block, gps, image, write_jpeg

from geomosaic.errors import InputError
from geomosaic.survey.header import FrameHeader, read_header
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.lens_tags import label
from geomosaic.survey.pixels import read_pixels
from geomosaic.survey.read import read_survey
from geomosaic.survey.strays import camera_kind, other_kinds

LON, LAT, STEP = 9.1234567, 48.7654321, 2.7e-4
SIZE = (320, 240)


def frame(
    path: Path, i: int, *, pixels: np.ndarray | None = None, lon: float | None = None, **xmp: object
) -> Path:
    """Frame i of a flight east, 20 m a frame, 80 m above the ground."""
    exif = exif_block(
        Make="DJI", Model="FC6310", DateTimeOriginal=f"2024:05:17 10:{i // 60:02d}:{i % 60:02d}",
        FocalLengthIn35mmFilm=24, **gps(LON + i * STEP if lon is None else lon, LAT, 412.5),
    )  # fmt: skip
    tags = {
        "AbsoluteAltitude": "+412.50", "RelativeAltitude": "+80.20", "GimbalYawDegree": "+37.00",
        "GimbalPitchDegree": "-90.00", "GimbalRollDegree": "+0.00",
    } | xmp  # fmt: skip
    return write_jpeg(path, image(*SIZE, seed=i) if pixels is None else pixels, exif, dji_xmp(**tags))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Twelve good frames."""
    for i in range(12):
        frame(tmp_path / f"DJI_{i:04d}.JPG", i)
    return tmp_path


def left_out(folder: Path) -> dict[str, str]:
    """Code of the warning of every image that is left out; each code has one warning."""
    survey = read_survey(SurveyInputs(folder))
    lines = {w.code: w for w in survey.warnings if w.text.startswith("left out:")}
    assert len(lines) == sum(w.text.startswith("left out:") for w in survey.warnings)
    assert len(read_survey(SurveyInputs(folder, leave_out="none")).left_out) == 0
    return {
        out.name: next(
            c for c, w in lines.items() if len(lines) == 1 or out.name in (w.frame, *w.text.split())
        )
        for out in survey.left_out
    }


def test_a_logo_does_not_take_the_order_of_capture(folder: Path) -> None:
    """It has no time, nor has it any other tag."""
    (folder / "DJI_0011.JPG").rename(folder / "A_last.JPG")
    write_jpeg(folder / "logo.jpg", image(100, 60))
    survey = read_survey(SurveyInputs(folder))
    assert [out.name for out in survey.left_out] == ["logo.jpg"]
    assert survey.frames[-1].name == "A_last.JPG"
    assert "order-by-name" not in {w.code for w in survey.warnings}


def test_good_frames_stay(folder: Path) -> None:
    (folder / "._DJI_0001.JPG").write_bytes(b"\0\5\x16\7 of another system")
    (folder / "Thumbs.db").write_bytes(b"junk")
    assert left_out(folder) == {}


def test_copies(folder: Path) -> None:
    """The same bytes; the same capture saved anew at half its size. Frames of one second aren't copies."""
    shutil.copy(folder / "DJI_0003.JPG", folder / "Copy of DJI_0003.JPG")
    small = cv2.resize(image(*SIZE, seed=5), (160, 120), interpolation=cv2.INTER_AREA)
    frame(folder / "small.jpg", 5, pixels=small)
    frame(folder / "DJI_0007b.JPG", 7, pixels=image(*SIZE, seed=70))
    assert left_out(folder) == {"Copy of DJI_0003.JPG": "frame-copy", "small.jpg": "frame-copy"}


def test_bands_of_one_capture_are_no_copies(folder: Path) -> None:
    for i in range(12):
        frame(folder / f"DJI_{i:04d}.JPG", i, pixels=image(*SIZE, 1, seed=i) // 2 + 40)
        frame(folder / f"DJI_{i:04d}_b.JPG", i, pixels=image(*SIZE, 1, seed=i) // 2 + 100)
    assert left_out(folder) == {}


def test_take_off_and_landing(folder: Path) -> None:
    """Only at the ends of the flight: one low frame amid it may be right."""
    frame(folder / "DJI_0000.JPG", 0, RelativeAltitude="+0.10", AbsoluteAltitude="+332.40")
    frame(folder / "DJI_0001.JPG", 1, RelativeAltitude="+14.00")
    frame(folder / "DJI_0011.JPG", 11, RelativeAltitude="+9.00")
    frame(folder / "DJI_0006.JPG", 6, RelativeAltitude="+9.00")
    low = ("DJI_0000.JPG", "DJI_0001.JPG", "DJI_0011.JPG")
    assert left_out(folder) == dict.fromkeys(low, "frame-take-off")


def test_oblique_and_horizon_frames_stay(folder: Path) -> None:
    """They are adjusted where they tie; trimming takes their pixels."""
    frame(folder / "DJI_0004.JPG", 4, GimbalPitchDegree="-30.00")
    frame(folder / "DJI_0008.JPG", 8, GimbalPitchDegree="-2.00")
    frame(folder / "DJI_0009.JPG", 9, GimbalPitchDegree="-65.00")
    assert left_out(folder) == {}


def test_a_survey_that_looks_aside_is_one(folder: Path) -> None:
    for i in range(12):
        frame(folder / f"DJI_{i:04d}.JPG", i, GimbalPitchDegree="-50.00" if i < 9 else "-90.00")
    assert left_out(folder) == {}


def test_another_flight(folder: Path) -> None:
    """4 km away; one frame far off alone stays: its position may be wrong."""
    for i in range(4):
        frame(folder / f"OTHER_{i}.JPG", 40 + i, lon=LON + 0.055 + i * STEP)
    frame(folder / "DJI_0006.JPG", 6, lon=LON - 0.03)
    out = left_out(folder)
    assert out == {f"OTHER_{i}.JPG": "frame-other-place" for i in range(4)}
    (text,) = [w.text for w in read_survey(SurveyInputs(folder)).warnings if w.code == "frame-other-place"]
    assert "(4: OTHER_0.JPG, OTHER_1.JPG, OTHER_2.JPG and 1 more)" in text


def test_a_receiver_that_kept_its_last_fix(folder: Path) -> None:
    """Four frames at one place far off were flown with the others: the images say where."""
    for i in range(4):
        frame(folder / f"DJI_{i:04d}.JPG", i, lon=LON + 0.055)
    assert left_out(folder) == {}


def test_two_fields_of_one_flight_stay(folder: Path) -> None:
    for i in range(4):
        frame(folder / f"FIELD_{i}.JPG", 40 + i, lon=LON + 0.008 + i * STEP)
    assert left_out(folder) == {}


def test_blurred(folder: Path) -> None:
    """One amid sharp ones; not two in a row, whose ground nobody else may see; nor smooth ground."""
    blur = cv2.GaussianBlur(_fine(5), (0, 0), 4.0)
    for i in range(12):
        frame(folder / f"DJI_{i:04d}.JPG", i, pixels=_fine(i))
    frame(folder / "DJI_0005.JPG", 5, pixels=blur)
    frame(folder / "DJI_0008.JPG", 8, pixels=_fine(8) // 8 + 100)
    assert left_out(folder) == {"DJI_0005.JPG": "frame-blurred"}
    frame(folder / "DJI_0006.JPG", 6, pixels=cv2.GaussianBlur(_fine(6), (0, 0), 4.0))
    assert left_out(folder) == {}


def _fine(seed: int) -> np.ndarray:
    """An image with detail of all sizes."""
    rng = np.random.default_rng(seed)
    grey = sum(
        cv2.resize(rng.normal(0.0, 12.0, (SIZE[1] // k, SIZE[0] // k)), SIZE, interpolation=cv2.INTER_CUBIC)
        for k in (1, 2, 4, 8, 16)
    )
    return np.repeat(np.clip(grey + 128.0, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def test_other_bands_and_other_cameras(folder: Path) -> None:
    """A grey one among colour, and a screenshot that tells no lens."""
    frame(folder / "DJI_0004.JPG", 4, pixels=image(*SIZE, 1))
    write_jpeg(folder / "Screenshot.jpg", image(200, 100, seed=99))
    assert left_out_but_kinds(folder) == {
        "DJI_0004.JPG": "has 1 band of uint8, the mosaic's frames 3 bands of uint8",
        "Screenshot.jpg": "the frame doesn't report its focal length",
    }
    texts = {w.code: w.text for w in read_survey(SurveyInputs(folder)).warnings}
    says = "left out: other bands or pixel type than the frames of the mosaic"
    assert texts["frame-other-bands"] == f"{says}; put them into a folder of their own to map them"
    assert texts["frame-no-camera"].endswith("; --keep-strays uses them")


def test_panoramas_that_a_program_made_of_frames_of_an_unknown_lens(tmp_path: Path) -> None:
    """No frame reports a lens; the panoramas name no camera either, and are as large as no frame."""
    for i in range(6):
        exif = exif_block(Make="Acme", Model="A1", DateTimeOriginal=f"2024:05:17 10:00:{i:02d}")
        write_jpeg(tmp_path / f"image{i}.jpg", image(*SIZE, seed=i), exif)
    for i in range(3):
        write_jpeg(tmp_path / f"panorama{i}.jpg", image(500 + 40 * i, SIZE[1], seed=20 + i), b"")
    write_jpeg(tmp_path / "image6.jpg", image(*SIZE, seed=9), b"")  # lost its tags
    assert left_out(tmp_path) == {f"panorama{i}.jpg": "frame-no-camera" for i in range(3)}


def left_out_but_kinds(folder: Path) -> dict[str, str]:
    return {out.name: out.reason for out in read_survey(SurveyInputs(folder)).left_out}


def test_orientation_is_known_and_pixels_stay_as_stored(tmp_path: Path) -> None:
    """All eight values of EXIF's tag: columns and rows are the sensor's, whatever a viewer would show."""
    stored = image(*SIZE, seed=3)
    for value in range(1, 9):
        exif = exif_block(
            Make="X", Model="Y", Orientation=value, FocalLengthIn35mmFilm=24,
            DateTimeOriginal=f"2024:05:17 10:11:{value:02d}", **gps(LON + value * STEP, LAT, 412.5),
        )  # fmt: skip
        write_jpeg(tmp_path / f"F{value}.jpg", stored, exif)
    survey = read_survey(SurveyInputs(tmp_path))
    assert len(survey.frames) == 8 and len(survey.cameras) == 1
    first, _ = read_pixels(survey.frames[0])
    for f in survey.frames:
        assert (f.width_px, f.height_px) == SIZE
        for reduction in (1, 8):
            pixels, _ = read_pixels(f, reduction)
            expected, _ = read_pixels(survey.frames[0], reduction)
            assert np.array_equal(pixels, expected)
    assert np.abs(first.astype(int) - stored).mean() < 3.0


def test_every_third_frame_in_the_order_of_exposure(folder: Path) -> None:
    """Names run against time; lines of the others' positions are not missed."""
    for i in range(12):
        (folder / f"DJI_{i:04d}.JPG").rename(folder / f"R{11 - i:02d}.JPG")
    pos = folder / "pos.csv"
    rows = [f"R{11 - i:02d}.JPG,{LON + i * STEP},{LAT},412.5" for i in range(12)]
    pos.write_text("\n".join(["name,lon,lat,height_ellipsoidal", *rows]))
    survey = read_survey(SurveyInputs(folder, pos=pos, every=3))
    assert [f.name for f in survey.frames] == ["R11.JPG", "R08.JPG", "R05.JPG", "R02.JPG"]
    assert len(survey.left_out) == 8 and {u.reason for u in survey.left_out} == {"is left out by --every 3"}
    assert not {"pos-line-without-frame", "pos-frame-without-line"} & {w.code for w in survey.warnings}


def test_the_cameras_of_one_aircraft_are_distinguished(tmp_path: Path) -> None:
    """An M30T's wide, zoom and thermal frames of the same moments; the wide ones by default, or those asked
    for."""
    for i in range(6):
        for source in ("WideCamera", "ZoomCamera", "InfraredCamera"):
            seen = image(*SIZE, seed=len(source) * 100 + i)
            frame(tmp_path / f"DJI_{i:04d}_{source[0]}.JPG", i, pixels=seen, ImageSource=source)
    survey = read_survey(SurveyInputs(tmp_path))
    assert [f.name for f in survey.frames] == [f"DJI_{i:04d}_W.JPG" for i in range(6)]
    (warning,) = [w for w in survey.warnings if w.code == "frame-other-camera"]
    assert "--camera-kind" in warning.text and len(survey.left_out) == 12
    thermal = read_survey(SurveyInputs(tmp_path, camera_kind="thermal"))
    assert [f.name for f in thermal.frames] == [f"DJI_{i:04d}_I.JPG" for i in range(6)]
    pos = tmp_path / "pos.csv"
    rows = [f"DJI_{i:04d}_I.JPG,{LON + i * STEP},{LAT},412.5" for i in range(6)]
    pos.write_text("\n".join(["name,lon,lat,height_ellipsoidal", *rows]))
    warned = {w.code: w.text for w in read_survey(SurveyInputs(tmp_path, pos=pos)).warnings}
    assert "no line for 6 of 6 frames" in warned["pos-frame-without-line"]
    assert "pos-line-without-frame" not in warned
    with pytest.raises(InputError, match="there are: thermal, wide, zoom"):
        read_survey(SurveyInputs(tmp_path, camera_kind="lidar"))


def write_tiff(path: Path, values: np.ndarray, **xmp: object) -> FrameHeader:
    """A TIFF of bands (b, h, w), with DJI's tags where there are any."""
    size = {"width": values.shape[2], "height": values.shape[1], "count": len(values)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", driver="GTiff", dtype=values.dtype, **size) as out:
            out.write(values)
            if xmp:
                out.update_tags(ns="xml:XMP", **{"xml:XMP": dji_xmp(**xmp).decode()})
                out.update_tags(EXIF_Make="DJI", EXIF_Model="M3M")
        return read_header(path)


BANDS = {"G": 560, "R": 650, "RE": 730, "NIR": 860}
"""Of a Mavic 3 Multispectral, in nm."""


def test_the_bands_of_a_multispectral_camera_are_one_kind(tmp_path: Path) -> None:
    """A Mavic 3 Multispectral names each band a camera of its own; its RGB pictures are another kind."""
    grey = np.full((1, 24, 32), 900, dtype=np.uint16)
    bands = [
        write_tiff(
            tmp_path / f"DJI_{i:04d}_MS_{band}.TIF",
            grey,
            ImageSource=f"MS_{band}_CAMERA",
            CentralWavelength=nm,
        )
        for i in range(3)
        for band, nm in BANDS.items()
    ]
    colours = [
        read_header(frame(tmp_path / f"DJI_{i:04d}_D.JPG", i, ImageSource="RGB_CAMERA")) for i in range(3)
    ]
    assert {camera_kind(h) for h in bands} == {"ms"}
    assert other_kinds(bands) == []
    for asked, left in (("ms", colours), ("rgb", bands), (None, colours)):
        out = other_kinds([*bands, *colours], asked)
        assert [o.name for _, o in out] == [h.name for h in left]
        assert {code for code, _ in out} == {"frame-other-camera"}
    assert [label(h) for h in bands[:4]] == [f"DJI M3M {nm}" for nm in BANDS.values()]


@pytest.mark.parametrize(
    ("source", "kind"),
    [
        ("WideCamera", "wide"),
        ("WIDE_CAMERA", "wide"),
        ("InfraredCamera", "thermal"),
        ("INFRARED_CAMERA", "thermal"),
        ("MS_RE_CAMERA", "ms"),
    ],
)
def test_what_tags_call_a_camera(tmp_path: Path, source: str, kind: str) -> None:
    assert camera_kind(read_header(frame(tmp_path / "a.jpg", 0, ImageSource=source))) == kind


def test_an_old_map_in_the_folder_does_not_displace_the_survey(folder: Path) -> None:
    """A DSM and an orthophoto with more pixels than all twelve frames."""
    write_tiff(folder / "dsm.tif", np.zeros((1, 1200, 1000), dtype=np.float32))
    write_tiff(folder / "ortho.tif", np.zeros((5, 1200, 1000), dtype=np.uint8))
    survey = read_survey(SurveyInputs(folder))
    assert len(survey.frames) == 12
    assert {out.name: out.reason for out in survey.left_out} == {
        "dsm.tif": "has 1 band of float32, the mosaic's frames 3 bands of uint8",
        "ortho.tif": "has 5 bands of uint8, the mosaic's frames 3 bands of uint8",
    }


def test_of_kinds_with_about_as_many_files_the_one_with_most_pixels_counts(tmp_path: Path) -> None:
    """One wide picture is missing, and the thermal ones are small."""
    for i in range(6):
        seen = image(*SIZE, seed=i)
        if i:
            frame(tmp_path / f"DJI_{i:04d}_W.JPG", i, pixels=seen, ImageSource="WideCamera")
        frame(tmp_path / f"DJI_{i:04d}_T.JPG", i, pixels=seen[::2, ::2], ImageSource="InfraredCamera")
    headers = [read_header(path) for path in sorted(tmp_path.iterdir())]
    assert [o.name for _, o in other_kinds(headers)] == [f"DJI_{i:04d}_T.JPG" for i in range(6)]
