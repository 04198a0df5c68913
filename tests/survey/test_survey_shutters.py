"""How long rows take to be read: by tags, by the model, or unreported."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from geomosaic.survey.exif import Exif
from geomosaic.survey.header import FrameHeader
from geomosaic.survey.shutters import UNREPORTED_SD_S, Shutter, shutter


def header(bands: int = 3, xmp: dict[str, str] | None = None, **exif: str) -> FrameHeader:
    return FrameHeader(Path("/f/a.jpg"), 4000, 3000, bands, "uint8", None, Exif(**exif), xmp or {})  # type: ignore[arg-type]


def sized(width_px: int, height_px: int, model: str) -> FrameHeader:
    exif = Exif(model=model, width_px=width_px, height_px=height_px)
    return replace(header(), width_px=width_px // 4, height_px=height_px // 4, exif=exif)


@pytest.mark.parametrize(
    ("reported", "expected"),
    [
        (header(make="DJI", model="FC330"), Shutter(0.033, pytest.approx(0.0033), "model")),
        (header(make="Hasselblad", model="L1D-20c"), Shutter(0.056, pytest.approx(0.0056), "model")),
        (sized(5472, 3078, "L1D-20c"), Shutter(0.047, pytest.approx(0.0047), "model")),
        (sized(5472, 3648, "L1D-20c"), Shutter(0.056, pytest.approx(0.0056), "model")),
        (sized(4032, 3024, "FC3582"), Shutter(0.026, pytest.approx(0.0026), "model")),
        (sized(8064, 6048, "FC3582"), Shutter(0.060, pytest.approx(0.0060), "model")),
        (sized(2250, 4000, "FC300S"), Shutter(0.0, 0.0, "turned")),
        (sized(3078, 5472, "FC6310"), Shutter(0.0, 0.0, "global")),
        (header(make="DJI", model="FC6310"), Shutter(0.0, 0.0, "global")),
        (header(make="Canon", model="Canon PowerShot S110"), Shutter(0.0, 0.0, "global")),
        (header(make="NIKON CORPORATION", model="NIKON D800"), Shutter(0.0, 0.0, "global")),
        (header(make="samsung", model="SM-G991B"), Shutter(0.0, UNREPORTED_SD_S, "unreported")),
        (header(make="Sony", model="XQ-BC52"), Shutter(0.0, UNREPORTED_SD_S, "unreported")),
        (header(make="SONY", model="ILCE-7RM4"), Shutter(0.0, 0.0, "global")),
        (header(make="DJI", model="FC9999"), Shutter(0.0, UNREPORTED_SD_S, "unreported")),
        (header(xmp={"drone-dji:ShutterType": "Mechanical"}), Shutter(0.0, 0.0, "global")),
        (header(xmp={"drone-dji:ShutterType": "Electronic"}), Shutter(0.0, UNREPORTED_SD_S, "unreported")),
        (header(xmp={"Camera:LineReadoutTime": "20000"}, model="FC330"), Shutter(0.06, 0.0, "tag")),
        (header(xmp={"Camera:LineReadoutTime": "-20000"}), Shutter(0.0, UNREPORTED_SD_S, "absurd")),
        (header(1, {"Camera:LineReadoutTime": "20000"}, model="Sequoia"), Shutter(0.0, 0.0, "global")),
    ],
)
def test_the_surest_source_tells(reported: FrameHeader, expected: Shutter) -> None:
    found = shutter(reported)
    assert (found.source, found.readout_s, found.sd_s) == (
        expected.source,
        pytest.approx(expected.readout_s),
        expected.sd_s,
    )
