"""From recorded values to reflectance: the sensor model, the sun, its sensor and panels, against known values."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest

from geomosaic.geodesy.sun import sun_direction
from geomosaic.radiometry.calibration import Calibration, Vignetting
from geomosaic.radiometry.panel import find_panel, middle_of
from geomosaic.radiometry.sun_sensor import horizontal_irradiance, sensor_axis, transmitted
from geomosaic.survey.calibration_tags import sensor_model
from geomosaic.survey.exif import Exif
from geomosaic.survey.header import FrameHeader
from geomosaic_simulate.multispectral import PANEL_TEXT


def test_a_value_becomes_reflectance_by_black_level_gain_row_and_vignetting() -> None:
    """At column 4 and row 3 the radius is 5 px: 1 - 0.02 * 5 = 0.9; the row divides by 1 + 0.1 * 3."""
    values = np.full((6, 8, 1), 5800, dtype=np.uint16)
    of = Calibration(1e-4, 4800.0, 0.1, Vignetting((-0.02, 0.0)))
    expected = 0.1 / 0.9 / 1.3
    assert of.reflectance(values)[3, 4, 0] == pytest.approx(expected)
    assert of.digital(values)[3, 4, 0] == round(32768 * expected)
    multiplied = Calibration(1e-4, 4800.0, 0.0, Vignetting((-0.02, 0.0), divides=False))
    assert multiplied.reflectance(values)[3, 4, 0] == pytest.approx(0.1 * 0.9)


def test_vignetting_of_two_dimensions_counts_in_shares_of_the_frame() -> None:
    fall = Vignetting((0.8, 0.4), exponents=((0, 0), (1, 2)))
    assert fall.correction(10, 4)[2, 5] == pytest.approx(1.0 / (0.8 + 0.4 * 0.5 * 0.25))


def test_tags_of_either_makers_vignetting_are_read() -> None:
    """RedEdge-P writes Parrot's polynomial in two dimensions; lists stand as XMP sequences."""
    xmp = {
        "MicaSense:RadiometricCalibration": "0.0002,0.0000001,0.00002",
        "Camera:VignettingPolynomial2D": "0.9,0.1",
        "Camera:VignettingPolynomial2DName": "0,0,1,0",
        "DLS:DirectIrradiance": "80",
        "DLS:ScatteredIrradiance": "20",
        "DLS:SolarElevation": "0.5235987756",
        "DLS:IrradianceScaleToSIUnits": "0.01",
    }
    exif = Exif(exposure_s=0.001, iso=200.0, black_level=4800.0)
    model = sensor_model(FrameHeader(Path("a.tif"), 10, 8, 1, "uint16", None, exif, xmp))
    assert model is not None and model.absolute and model.irradiance == pytest.approx(0.6)
    assert model.calibration.gain == pytest.approx(0.0002 / (2.0 * 0.001 * 65536.0))
    assert model.calibration.row_gradient_per_px == pytest.approx(1e-7 / 0.001 - 2e-5)
    assert model.calibration.vignetting == Vignetting((0.9, 0.1), exponents=((0.0, 0.0), (1.0, 0.0)))


def test_an_exposure_that_old_firmware_misreports() -> None:
    """Tags of 1/6329 s of a RedEdge stand for 0.274 ms (MicaSense's own imageprocessing); not of an Altum."""
    xmp = {"MicaSense:RadiometricCalibration": "0.0002,0.0000001,0.00002"}

    def gain(model: str, exposure_s: float) -> float:
        exif = Exif(exposure_s=exposure_s, iso=100.0, model=model)
        found = sensor_model(FrameHeader(Path("a.tif"), 10, 8, 1, "uint16", None, exif, xmp))
        assert found is not None
        return found.calibration.gain

    assert gain("RedEdge", 1.0 / 6329.0) == gain("RedEdge", 0.000274)
    assert gain("Altum", 1.0 / 6329.0) == pytest.approx(0.0002 * 6329.0 / 65536.0)


def test_values_below_black_are_0_and_beyond_two_are_cut() -> None:
    values = np.array([[[100], [65535]]], dtype=np.uint16)
    assert Calibration(1e-3, 4800.0).digital(values)[0, :, 0].tolist() == [0, 65535]


def test_the_sun_stands_where_the_almanac_says() -> None:
    """Example of Reda and Andreas (2004), Solar Position Algorithm: zenith 50.128 deg without refraction."""
    time_s = datetime(2003, 10, 17, 19, 30, 30, tzinfo=UTC).timestamp()
    east, north, up = sun_direction(-105.1786, 39.742476, time_s)
    assert math.degrees(math.acos(up)) == pytest.approx(50.128, abs=0.02)
    assert math.degrees(math.atan2(east, north)) % 360.0 == pytest.approx(194.34, abs=0.02)


def test_a_sensor_that_pitches_up_heading_east_leans_west() -> None:
    assert sensor_axis(math.pi / 2, 0.2, 0.0) == pytest.approx([-math.sin(0.2), 0.0, math.cos(0.2)])
    assert sensor_axis(0.0, 0.0, 0.2) == pytest.approx([math.sin(0.2), 0.0, math.cos(0.2)])


def test_a_level_sensor_measures_the_grounds_irradiance_less_its_window() -> None:
    """At the zenith air to 1.6 and 1.6 to 1.38 pass 1 - (0.6 / 2.6)² and 1 - (0.22 / 2.98)²."""
    up = np.array([0.0, 0.0, 1.0])
    window = (1.0 - (0.6 / 2.6) ** 2) * (1.0 - (0.22 / 2.98) ** 2)
    assert transmitted(0.0) == pytest.approx(window, abs=2e-4)
    assert horizontal_irradiance(window, up, up) == pytest.approx(1.0, abs=2e-4)


def test_a_sensor_that_leans_towards_the_sun_measures_too_much() -> None:
    sun = np.array([math.sin(0.8), 0.0, math.cos(0.8)])
    toward = np.array([math.sin(0.3), 0.0, math.cos(0.3)])
    expected = (math.cos(0.8) + 1.0 / 6.0) / (math.cos(0.5) + 1.0 / 6.0) / transmitted(0.5)
    assert horizontal_irradiance(1.0, toward, sun) == pytest.approx(expected)


@pytest.mark.parametrize("quarters", range(4))
def test_a_panel_is_found_by_its_code_whatever_way_it_lies(quarters: int) -> None:
    code = cv2.QRCodeEncoder.create().encode(PANEL_TEXT)
    side = round(100 * len(code) / (len(code) - 4))
    values = np.full((400, 480), 3000, dtype=np.uint16)
    values += np.random.default_rng(1).integers(0, 900, values.shape, dtype=np.uint16)
    code = cv2.resize(code, (side, side), interpolation=cv2.INTER_NEAREST)
    values[140 : 140 + side, 270 : 270 + side] = np.where(code > 0, 20_000, 2_000)
    col = 270 + side // 2 - round(145.8 * 100 / 90)
    values[130:270, col - 70 : col + 70] = 17_000
    found = find_panel(np.ascontiguousarray(np.rot90(values, quarters)))
    assert found is not None and found.text == PANEL_TEXT
    assert found.value(np.rot90(values, quarters).astype(np.float32)) == pytest.approx(17_000)
    assert found.albedo(650.0) == pytest.approx(0.5)


def test_nothing_even_is_no_panel() -> None:
    grass = np.random.default_rng(2).integers(1000, 9000, (300, 400), dtype=np.uint16)
    assert find_panel(grass) is None
    assert middle_of(grass).value(grass.astype(np.float32)) is None
    assert middle_of(np.full_like(grass, 7)).value(np.full(grass.shape, 7.0, np.float32)) == 7.0
