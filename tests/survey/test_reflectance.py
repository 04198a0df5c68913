"""A rig's flight comes back to the true reflectance; what is not reflectance is not called so."""

from __future__ import annotations

import shutil
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import rasterio
from small_surveys import mosaic, small_survey, summary
from survey_files import exif_block, gps, write_jpeg, xmp_attributes

from geomosaic.errors import InputError
from geomosaic.radiometry.quantity import CELSIUS
from geomosaic.survey.calibration_tags import temperature
from geomosaic.survey.header import read_header
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.model import Frame, Survey
from geomosaic.survey.pixels import read_pixels
from geomosaic.survey.read import read_survey
from geomosaic_simulate.multispectral import BANDS, RigFlight, panel_albedo, reflectance, rig_flight
from geomosaic_simulate.survey import SimulatedSurvey

WITHIN = 0.02


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    """Frames whose positions are all but true: the mosaic is compared with the true map, pixel by pixel."""
    out = tmp_path_factory.mktemp("flown")
    return small_survey(out, lines=1, frames_per_line=4, position_sd_m=0.02, height_sd_m=0.02)


def read(folder: Path, **given: str) -> Survey:
    return read_survey(SurveyInputs(folder, radiometry="reflectance", **given))


def files(survey: Survey) -> list[Frame]:
    others = [frame for band in survey.other_bands for frame in band.frames if frame]
    return [*survey.frames, *others]


@pytest.mark.parametrize(
    ("flight", "source"),
    [
        (RigFlight("micasense"), "panel P0001_1.tif, P0002_1.tif and sun sensor"),
        (RigFlight("micasense", sun_sensor=""), "panel P0001_1.tif, P0002_1.tif"),
        (RigFlight("micasense", panels=False), "sun sensor"),
        (RigFlight("micasense", panels=False, sun_sensor="tilted"), "sun sensor"),
        (RigFlight("dji"), "panel P0001_1.tif, P0002_1.tif and sun sensor"),
        (RigFlight("parrot"), "panel P0001_1.tif, P0002_1.tif and sun sensor"),
    ],
    ids=["panel and sun sensor", "panels alone", "sun sensor alone", "tilted sun sensor", "DJI", "Parrot"],
)
def test_frames_come_back_to_the_true_reflectance(
    flown: SimulatedSurvey, tmp_path: Path, flight: RigFlight, source: str
) -> None:
    truth = rig_flight(flown.frames, tmp_path / "rig", flight)
    survey = read(tmp_path / "rig")
    assert survey.quantity is not None
    assert (survey.quantity.name, survey.quantity.source) == ("reflectance", source)
    assert len(survey.frames) == 4 and not any("P000" in f.name for f in survey.frames)
    for frame in files(survey):
        off = read_pixels(frame)[0][..., 0] / 32768.0 - truth[frame.name]
        assert abs(off.mean()) < 0.001 and np.quantile(np.abs(off), 0.99) < WITHIN


@pytest.mark.parametrize("maker", ["dji", "parrot"])
def test_without_a_panel_their_values_are_relative_alike_in_all_bands(
    flown: SimulatedSurvey, tmp_path: Path, maker: str
) -> None:
    truth = rig_flight(flown.frames, tmp_path / "rig", RigFlight(maker, panels=False))
    survey = read(tmp_path / "rig")
    assert survey.quantity is not None and survey.quantity.name == "relative reflectance"
    factors = [np.median(read_pixels(f)[0][..., 0] / 32768.0 / truth[f.name]) for f in files(survey)]
    assert np.ptp(factors) < 0.01 * np.mean(factors) and 0.05 < factors[0] < 1.0


def test_a_panel_without_a_code_is_given_with_its_albedo(flown: SimulatedSurvey, tmp_path: Path) -> None:
    flight = RigFlight("micasense", with_code=False, sun_sensor="")
    truth = rig_flight(flown.frames, tmp_path / "rig", flight)
    with pytest.raises(InputError, match=r"neither; give a photo of a panel with --panel IMAGE=ALBEDO"):
        read(tmp_path / "rig")
    lines = [f"{band},{panel_albedo(nm)}" for band, (nm, _) in BANDS.items()]
    table = tmp_path / "panel.csv"
    table.write_text("\n".join(["band,albedo", *lines]))
    survey = read(tmp_path / "rig", panel=f"P0001_2.tif={table},P0002={table}".replace("P0002=", "P0002_3="))
    assert len(survey.frames) == 4
    frame = survey.frames[2]
    assert read_pixels(frame)[0].mean() / 32768.0 == pytest.approx(truth[frame.name].mean(), abs=0.002)
    for wrong, problem in (("X.tif=0.5", "no frame"), ("P0001_1=1.5", "no albedo"), ("P0001_1", "no frame")):
        with pytest.raises(InputError, match=problem):
            read(tmp_path / "rig", panel=wrong)
    with pytest.raises(InputError, match="no panel can be read in the band Green"):
        read(tmp_path / "rig", panel="F0002_1=0.5")


def test_a_camera_without_a_known_model_is_an_error_that_names_the_option(flown: SimulatedSurvey) -> None:
    with pytest.raises(InputError, match=r"no known sensor model .*; leave out --radiometry reflectance"):
        read(flown.frames)


@pytest.mark.parametrize(
    ("system", "maker", "tag"),
    [("parrot", "Parrot", "SensorModel"), ("dji", "DJI", "SensorGain")],
)
def test_a_missing_tag_of_a_known_maker_is_named(
    flown: SimulatedSurvey, tmp_path: Path, system: str, maker: str, tag: str
) -> None:
    """As Parrot's Sequoia of firmware 1.2.0, which writes all but SensorModel."""
    rig_flight(flown.frames, tmp_path / "rig", RigFlight(system, panels=False))
    for path in (tmp_path / "rig").glob("*.tif"):
        made = path.read_bytes().replace(b"Maker\0", maker.encode().ljust(6, b"\0"))
        path.write_bytes(made.replace(tag.encode(), b"X" * len(tag)))
    says = rf"its tags lack {tag}, without .*\(camera {maker} .*\); leave out --radiometry reflectance"
    with pytest.raises(InputError, match=says):
        read(tmp_path / "rig")


def test_a_thermal_band_keeps_its_temperature(flown: SimulatedSurvey, tmp_path: Path) -> None:
    rig_flight(flown.frames, tmp_path / "rig", RigFlight("micasense", panels=False))
    for path in (tmp_path / "rig").glob("*_3.tif"):
        path.write_bytes(
            path.read_bytes().replace(b'BandName="NIR"', b'BandName="LWIR"').replace(b"b\n", b"b")
        )
    survey = read(tmp_path / "rig")
    (thermal,) = [band for band in survey.other_bands if band.name == "LWIR"]
    assert thermal.quantity is not None and thermal.quantity.unit == "°C"
    assert 30_000 * thermal.quantity.scale + thermal.quantity.offset == pytest.approx(26.85)
    assert thermal.frames[0] is not None and thermal.frames[0].calibration is None


@pytest.mark.proof
def test_a_mosaic_of_a_rig_shows_reflectance_and_says_so(flown: SimulatedSurvey, tmp_path: Path) -> None:
    rig_flight(flown.frames, tmp_path / "rig", RigFlight("micasense"))
    assert flown.pos is not None
    pos, run = tmp_path / "pos.csv", tmp_path / "run"
    pos.write_text(flown.pos.read_text().replace(".jpg", "_1.tif"))
    given = ("--pos", pos, "--camera", flown.camera)
    assert mosaic(tmp_path / "rig", run, *given, "--radiometry", "reflectance") == 0
    assert summary(run)["metrics"]["survey"]["values"]["are"] == "reflectance"
    with rasterio.open(run / "mosaic.tif") as found, rasterio.open(flown.ortho) as ortho:
        assert found.descriptions == ("Green", "Red", "NIR") and found.scales == (1.0 / 32768.0,) * 3
        assert found.tags(1)["QUANTITY"] == "reflectance" and "sun sensor" in found.tags(1)["CALIBRATION"]
        left, top = (
            round(off / 0.1)
            for off in (found.bounds.left - ortho.bounds.left, ortho.bounds.top - found.bounds.top)
        )
        rgb = np.moveaxis(ortho.read([1, 2, 3]), 0, -1)[top:, left:]
        bands, valid = found.read() / 32768.0, found.dataset_mask() > 0
    for k, band in enumerate(BANDS):
        true = reflectance(band, rgb)[: bands.shape[1], : bands.shape[2]]
        off = np.where(valid, bands[k] - true, np.nan)
        rows, cols = (n // 10 * 10 for n in off.shape)
        blocks = np.mean(off[:rows, :cols].reshape(rows // 10, 10, cols // 10, 10), axis=(1, 3))
        known = blocks[np.isfinite(blocks)]
        assert abs(known.mean()) < 0.005 and np.quantile(np.abs(known), 0.95) < WITHIN


@pytest.mark.proof
def test_values_of_a_rig_that_nobody_calibrates_are_called_so(flown: SimulatedSurvey, tmp_path: Path) -> None:
    rig_flight(flown.frames, tmp_path / "rig", RigFlight("dji", panels=False))
    run = tmp_path / "run"
    shutil.rmtree(run, ignore_errors=True)
    assert mosaic(tmp_path / "rig", run, "--adjust", "least_squares") == 0
    assert "uncalibrated values as recorded" in (run / "report.html").read_text()
    with rasterio.open(run / "mosaic.tif") as found:
        assert found.tags(2)["QUANTITY"] == "uncalibrated values as recorded" and found.scales == (1.0,) * 3


def test_frames_of_a_thermal_camera_are_degrees_in_floats_and_grey_pictures_in_jpeg(tmp_path: Path) -> None:
    source = xmp_attributes("http://www.dji.com/drone-dji/1.0/", "drone-dji", ImageSource="InfraredCamera")
    exif = exif_block(
        Make="DJI", Model="M30T", DateTimeOriginal="2024:05:17 10:11:12", FocalLength=Fraction("9.1"),
        FocalLengthIn35mmFilm=40, **gps(9.1, 48.7, 412.5),
    )  # fmt: skip
    pixels = np.random.default_rng(1).integers(0, 255, (90, 120, 3), dtype=np.uint8)
    (tmp_path / "jpeg").mkdir()
    write_jpeg(tmp_path / "jpeg" / "a.jpg", pixels, exif, source)
    survey = read_survey(SurveyInputs(tmp_path / "jpeg"))
    assert "thermal-grey" in [w.code for w in survey.warnings] and survey.quantity is None
    header = replace(read_header(tmp_path / "jpeg" / "a.jpg"), dtype="float32", bands=1)
    assert temperature(header) == CELSIUS
