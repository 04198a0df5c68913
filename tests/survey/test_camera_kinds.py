"""An aircraft's wide and thermal pictures of one flight as bands of one mosaic."""

from __future__ import annotations

import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from rasterio.errors import NotGeoreferencedWarning
from scipy.spatial.transform import Rotation as Turn
from small_surveys import mosaic, small_survey, summary
from survey_files import dji_xmp, exif_block, gps, image, write_jpeg

from geomosaic.adjustment.model import Adjusted
from geomosaic.camera.interior import Camera
from geomosaic.errors import InputError
from geomosaic.matching.band_registration import BandPose, Captures, RigPoses, register_bands
from geomosaic.pipeline.run_results import load_artefact
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.model import Survey
from geomosaic.survey.read import read_survey

TURN = np.array([0.012, -0.02, 0.015])
"""Of the thermal camera against the wide one, rad about its axes: 0.7, 1.1 and 0.9 degrees."""
WIDE_PX, WIDE_FOCAL_PX = (720, 540), 700.0
THERMAL_PX, THERMAL_FOCAL_PX = (240, 192), 288.0


def lens(focal_px: float, size: tuple[int, int]) -> np.ndarray:
    """Of pixels whose centres are whole numbers."""
    return np.array([[focal_px, 0, (size[0] - 1) / 2], [0, focal_px, (size[1] - 1) / 2], [0, 0, 1.0]])


AXES = np.diag([1.0, -1.0, -1.0])
"""Of images (right, down, away) from the camera's."""
THERMAL_FROM_WIDE = (
    lens(THERMAL_FOCAL_PX, THERMAL_PX) @ AXES @ Turn.from_rotvec(TURN).as_matrix().T @ AXES
    @ np.linalg.inv(lens(WIDE_FOCAL_PX, WIDE_PX))
)  # fmt: skip
"""The homography between the images of a capture."""
KINDS = {"W": "WideCamera", "Z": "ZoomCamera", "T": "InfraredCamera"}


def picture(path: Path, letter: str, second: float, pixels: np.ndarray | None = None) -> None:
    """A picture of one of the aircraft's cameras, with its tag."""
    exif = exif_block(
        Make="DJI", Model="M30T", DateTimeOriginal=f"2024:05:17 10:11:{int(second):02d}",
        FocalLength=8.5 if letter == "T" else 5, FocalPlaneXResolution=40 if letter == "T" else 140,
        FocalPlaneResolutionUnit=4,
        **gps(9.1 + 1e-4 * second, 48.7, 412.5),
    )  # fmt: skip
    write_jpeg(path, image() if pixels is None else pixels, exif, dji_xmp(ImageSource=KINDS[letter]))


def kinds_of(folder: Path, asked: str | None) -> Survey:
    return read_survey(SurveyInputs(folder, camera_kind=asked))


def test_files_belong_together_by_name_else_by_time(tmp_path: Path) -> None:
    for k in range(3):
        picture(tmp_path / f"DJI_{k:04d}_W.JPG", "W", 2 * k)
        picture(tmp_path / f"DJI_{k:04d}_T.JPG", "T", 2 * k + 1)
        picture(tmp_path / f"DJI_{k:04d}_Z.JPG", "Z", 2 * k)
    picture(tmp_path / "DJI_20240517_0007_W.JPG", "W", 20)
    picture(tmp_path / "DJI_20240518_0007_T.JPG", "T", 21)
    picture(tmp_path / "DJI_0009_T.JPG", "T", 40)
    survey = kinds_of(tmp_path, "wide+thermal")
    (thermal,) = survey.other_bands
    assert survey.band == "wide" and thermal.name == "thermal" and survey.cameras[0] != thermal.camera
    together = {f.name: g and g.name for f, g in zip(survey.frames, thermal.frames, strict=True)}
    by_name = {f"DJI_{k:04d}_W.JPG": f"DJI_{k:04d}_T.JPG" for k in range(3)}
    assert together == {**by_name, "DJI_20240517_0007_W.JPG": "DJI_20240518_0007_T.JPG"}
    assert {f.bands for f in survey.frames} == {3}
    assert {f.bands for f in thermal.frames if f} == {1}, "its colours are a palette"
    texts = {w.code: w.text for w in survey.warnings}
    assert "DJI_0009_T.JPG" in texts["capture-incomplete"] and "thermal-grey" in texts
    assert [o.name for o in survey.left_out] == [f"DJI_{k:04d}_Z.JPG" for k in range(3)]


def test_what_was_not_taken_at_once_is_an_error(tmp_path: Path) -> None:
    picture(tmp_path / "a_W.JPG", "W", 0)
    picture(tmp_path / "b_T.JPG", "T", 30)
    with pytest.raises(
        InputError, match="no frame of the camera 'thermal' was taken at once with one of 'wide'"
    ):
        kinds_of(tmp_path, "wide+thermal")
    with pytest.raises(
        InputError, match=r"camera 'zoom' \(by the tag ImageSource there are: thermal, wide\)"
    ):
        kinds_of(tmp_path, "wide+zoom")


def test_bands_are_not_mosaicked_with_another_camera(tmp_path: Path) -> None:
    """A capture has several files of them, of which none stands for the others."""
    picture(tmp_path / "a_W.JPG", "W", 0)
    with pytest.raises(InputError, match="bands of the camera 'ms' can't be mosaicked with another camera's"):
        kinds_of(tmp_path, "wide+ms")


def degrees(rgb: np.ndarray) -> np.ndarray:
    """The temperature of ground of a colour: in parts warmer where it is darker, in parts where it is redder."""
    r, g, b = np.moveaxis(rgb.astype(np.float32) / 255.0, -1, 0)
    return 12.0 + 14.0 * (1.0 - (0.3 * r + 0.6 * g + 0.1 * b)) ** 2 + 8.0 * (r - b)


def write_degrees(path: Path, values: np.ndarray) -> None:
    """A TIFF in 32-bit floats with the tags that DJI's tools keep; the published focal length is 1.3 % wrong."""
    size = {"width": values.shape[1], "height": values.shape[0], "count": 1, "dtype": "float32"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        out = rasterio.open(path, "w", driver="GTiff", **size)
    with out:
        out.write(values[None].astype(np.float32))
        out.update_tags(ns="xml:XMP", **{"xml:XMP": dji_xmp(ImageSource="InfraredCamera").decode()})
        out.update_tags(
            EXIF_Make="DJI", EXIF_Model="M30T", EXIF_FocalLength="(9.1)"
        )  # fmt: skip


def flight(tmp_path: Path) -> tuple[Path, Path]:
    """Folder and POS of a simulated flight with a second, thermal camera. Its images are a homography of the
    middle of the first one's, in degrees, with noise and blur."""
    made = small_survey(
        tmp_path / "survey", lines=1, frames_per_line=4, width_px=WIDE_PX[0], height_px=WIDE_PX[1],
        ground_pixel_m=50.0 / WIDE_FOCAL_PX, forward_overlap=0.75, side_overlap=0.7, k1=0.0,
    )  # fmt: skip
    folder = tmp_path / "both"
    folder.mkdir()
    rng = np.random.default_rng(5)
    rows = made.pos.read_text()
    for k, path in enumerate(sorted(made.frames.glob("*.jpg"))):
        rgb = cv2.imread(str(path))[..., ::-1]
        warm = cv2.GaussianBlur(degrees(rgb), (0, 0), 0.5 * WIDE_FOCAL_PX / THERMAL_FOCAL_PX)
        seen = cv2.warpPerspective(warm, THERMAL_FROM_WIDE, THERMAL_PX, flags=cv2.INTER_CUBIC)
        name = f"DJI_{k:04d}_W.JPG"
        write_degrees(folder / f"DJI_{k:04d}_T.TIF", seen + rng.normal(0.0, 0.05, seen.shape))
        picture(folder / name, "W", k, np.ascontiguousarray(rgb))
        rows = rows.replace(path.name, name)
    (tmp_path / "pos.csv").write_text(rows)
    return folder, tmp_path / "pos.csv"


def registration_error_px(band: BandPose, wide: Camera) -> np.ndarray:
    """By how many thermal pixels the thermal image is off the wide one, over all its pixels."""
    cols, rows = np.meshgrid(np.arange(0.5, THERMAL_PX[0]), np.arange(0.5, THERMAL_PX[1]))
    thermal = np.stack([cols, rows], axis=-1).reshape(-1, 2)
    in_wide = wide.image_from_camera(band.camera.ray_from_image(thermal) @ band.own_from_band.T)
    true = cv2.perspectiveTransform(in_wide[None] - 0.5, THERMAL_FROM_WIDE)[0] + 0.5
    return np.asarray(np.linalg.norm(true - thermal, axis=1))


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The flight's folder and the run of its mosaic."""
    tmp_path = tmp_path_factory.mktemp("flown")
    folder, pos = flight(tmp_path)
    run = tmp_path / "run"
    assert (
        mosaic(folder, run, "--pos", pos, "--camera-kind", "wide+thermal", "--adjust", "least_squares", "-q")
        == 0
    )
    return folder, run


@pytest.mark.proof
def test_wide_and_thermal_become_one_mosaic(flown: tuple[Path, Path]) -> None:
    """The thermal band is within a tenth of its pixel of what the mosaic's own colours give."""
    _, run = flown
    summed = summary(run)
    assert summed["frames"]["tied"] == 4 and summed["metrics"]["bands"]["thermal"]["after_px"] < 0.3
    (band,) = load_artefact(run, summed, "rig", RigPoses).bands
    wide = load_artefact(run, summed, "adjusted", Adjusted).cameras[0]
    off = registration_error_px(band, wide)
    assert np.sqrt(np.mean(off**2)) < 0.06 and off.max() < 0.2
    with rasterio.open(run / "mosaic.tif") as found:
        assert found.descriptions == ("red", "green", "blue", "thermal") and found.dtypes[0] == "float32"
        assert [c.name for c in found.colorinterp[:3]] == ["red", "green", "blue"]
        assert found.tags(4)["QUANTITY"] == "temperature" and found.units[3] == "°C"
        pixels, valid = found.read(), found.dataset_mask() == 255
    expected = degrees(np.moveaxis(pixels[:3], 0, -1))
    thermal_px = WIDE_FOCAL_PX / THERMAL_FOCAL_PX
    rows, cols = (slice(int(of.min()), int(of.max()) + 1) for of in np.nonzero(valid))
    shifts = []
    for top in range(rows.start, rows.stop - 96, 32):
        for left in range(cols.start, cols.stop - 96, 32):
            at = slice(top, top + 96), slice(left, left + 96)
            if valid[at].all():
                blurred = cv2.GaussianBlur(expected[at], (0, 0), 0.5 * thermal_px).astype(np.float64)
                shift, _ = cv2.phaseCorrelate(
                    blurred - blurred.mean(), pixels[3][at].astype(np.float64) - pixels[3][at].mean(),
                    cv2.createHanningWindow((96, 96), cv2.CV_64F),
                )  # fmt: skip
                shifts.append(np.hypot(*shift) / thermal_px)
    assert len(shifts) > 10
    assert np.median(shifts) < 0.08 and np.quantile(shifts, 0.95) < 0.2
    assert abs(pixels[3][valid].mean() - expected[valid].mean()) < 0.2


@pytest.mark.proof
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_grey_thermal_pictures_are_registered_as_well(flown: tuple[Path, Path], tmp_path: Path) -> None:
    """As the aircraft writes them: JPEG of three equal bands, stretched to the picture's own range."""
    folder, run = flown
    for k, path in enumerate(sorted(folder.glob("*_W.JPG"))):
        shutil.copy(path, tmp_path)
        with rasterio.open(folder / f"DJI_{k:04d}_T.TIF") as tiff:
            values = tiff.read(1)
        low, high = np.percentile(values, (0.5, 99.5))
        grey = np.clip(255.0 * (values - low) / (high - low), 0.0, 255.0).astype(np.uint8)
        picture(tmp_path / f"DJI_{k:04d}_T.JPG", "T", k, np.repeat(grey[..., None], 3, axis=2))
    summed = summary(run)
    adjusted = load_artefact(run, summed, "adjusted", Adjusted)
    bands = kinds_of(tmp_path, "wide+thermal").other_bands
    survey = replace(load_artefact(run, summed, "survey", Survey), other_bands=bands)
    captures = Captures(survey, adjusted.poses, adjusted.cameras, [True] * 4, adjusted.ground)
    (band,) = register_bands(captures).bands
    off = registration_error_px(band, adjusted.cameras[0])
    assert np.sqrt(np.mean(off**2)) < 0.06 and off.max() < 0.2
