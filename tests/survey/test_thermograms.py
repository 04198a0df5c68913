"""Temperatures: FLIR's JPEG files, TIFF in floats as DJI's tools write them, and what is said without."""

from __future__ import annotations

import struct
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
from survey_files import dji_xmp, exif_block, gps, image, segment, write_jpeg, xmp_attributes

from geomosaic.doors.raster import unreferenced_is_fine
from geomosaic.doors.thermograms import thermogram
from geomosaic.errors import FileError, InputError
from geomosaic.radiometry.quantity import CELSIUS
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.model import Survey
from geomosaic.survey.pixels import read_pixels
from geomosaic.survey.read import read_survey

SIZE = 80, 64
R1, B, F, R2, OFFSET = 14906.216, 1396.5, 1.0, 0.010956882, -6303
"""A camera's Planck constants."""


def levels(seed: int = 2) -> np.ndarray:
    """What a sensor reads: 10 to 40 °C."""
    smooth = image(*SIZE, bands=1, seed=seed)[..., 0] / 255.0
    kelvin = 283.15 + 30.0 * smooth
    return np.asarray(R1 / (R2 * (np.exp(B / kelvin) - F)) - OFFSET).round().astype("<u2")


def celsius(raw: np.ndarray) -> np.ndarray:
    return np.asarray(B / np.log(R1 / (R2 * (raw.astype(np.float64) + OFFSET)) + F) - 273.15)


def flir_jpeg(path: Path, raw: np.ndarray, second: int = 0, records: int = 8) -> Path:
    """A FLIR camera's JPEG: emissivity and transmission 1, no air between."""
    info = bytearray(900)
    for at, *values in (
        (32, 1.0, 0.0, 293.15, 293.15, 293.15, 1.0), (60, 0.5), (88, R1, B, F), (112, 0.0066, 0.0126, -0.0023, -0.0067, 1.9),
        (132, 150.0, -40.0), (780, R2),
    ):  # fmt: skip
        struct.pack_into(f"<{len(values)}f", info, at, *values)
    struct.pack_into("<i", info, 776, OFFSET)
    pixels = struct.pack("<HHH", 2, raw.shape[1], raw.shape[0]).ljust(32, b"\0") + raw.astype("<u2").tobytes()
    first = 64 + 2 * 32
    entries = b"".join(
        struct.pack(">HHIIII", kind, 2, 100, 1, at, len(data)).ljust(32, b"\0")
        for kind, at, data in ((1, first, pixels), (32, first + len(pixels), info))
    )
    head = (b"FFF\0" + b"CAMCTRL".ljust(16, b"\0") + struct.pack(">III", 100, 64, records)).ljust(64, b"\0")
    data = head + entries + pixels + bytes(info)
    parts = [data[k : k + 60000] for k in range(0, len(data), 60000)]
    exif = exif_block(
        Make="FLIR", Model="Vue Pro R", DateTimeOriginal=f"2024:05:17 10:11:{second:02d}",
        FocalLength=13, FocalPlaneXResolution=6, FocalPlaneResolutionUnit=4, **gps(9.1 + 2e-4 * second, 48.7, 412.5),
    )  # fmt: skip
    written = write_jpeg(path, image(160, 120, seed=3 + second), exif).read_bytes()
    mark = b"".join(
        segment(0xE1, b"FLIR\0\1" + bytes([k, len(parts) - 1]) + part) for k, part in enumerate(parts)
    )
    path.write_bytes(written[:2] + mark + written[2:])
    return path


def read(folder: Path, **given: str) -> Survey:
    return read_survey(SurveyInputs(folder, **given))


def test_the_degrees_of_a_flir_jpeg_are_its_cameras(tmp_path: Path) -> None:
    pytest.importorskip("flyr")
    raws = [levels(seed) for seed in range(3)]
    for k, raw in enumerate(raws):
        flir_jpeg(tmp_path / f"{k}.jpg", raw, k)
    write_jpeg(tmp_path / "visible.jpg", image(160, 120, seed=9), exif_block(Make="FLIR", Model="Vue"))
    survey = read(tmp_path, radiometry="temperature")
    assert [(f.name, f.width_px, f.height_px, f.bands, f.dtype) for f in survey.frames] == [
        (f"{k}.jpg", *SIZE, 1, "float32") for k in range(3)
    ]
    assert survey.quantity == CELSIUS
    for frame, raw in zip(survey.frames, raws, strict=True):
        pixels, valid = read_pixels(frame)
        np.testing.assert_allclose(pixels[..., 0], celsius(raw), atol=0.01)
        assert valid is None and pixels.dtype == np.float32
        small = read_pixels(frame, 4, luma=True)[0]
        np.testing.assert_allclose(small[3, 5, 0], celsius(raw)[12:16, 20:24].mean(), atol=0.01)
    assert [(o.name, "no temperatures" in o.reason) for o in survey.left_out] == [("visible.jpg", True)]
    assert {f.dtype for f in read(tmp_path).frames} == {"uint8"}, "only where they are asked for"


def test_damaged_records_are_one_error(tmp_path: Path) -> None:
    pytest.importorskip("flyr")
    whole = flir_jpeg(tmp_path / "a.jpg", levels())
    assert thermogram(whole).shape[::-1] == SIZE
    data = whole.read_bytes()
    with pytest.raises(FileError, match="FLIR records are damaged"):
        thermogram(flir_jpeg(tmp_path / "many.jpg", levels(), records=1 << 31))
    at = data.index(b"FFF\0") + 64 + 64
    for name, change in (
        ("large", data[: at + 2] + b"\xff\xff\xff\xff" + data[at + 6 :]), ("cut", data[: at + 900]),
        ("without", data.replace(b"FFF\0", b"\0" * 4, 1)[: at - 100]),
    ):  # fmt: skip
        path = tmp_path / f"{name}.jpg"
        path.write_bytes(change)
        with pytest.raises(FileError, match=f"{name}.jpg: its temperatures"):
            thermogram(path)


def test_what_has_no_temperatures_or_reader_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_jpeg(
        tmp_path / "DJI_0001_T.JPG", image(), exif_block(Make="DJI"), dji_xmp(ImageSource="InfraredCamera")
    )
    if "flyr" in sys.modules or pytest.importorskip("flyr"):
        with pytest.raises(
            InputError, match=r"no temperatures of a FLIR camera; convert DJI's frames to TIFF"
        ):
            read(tmp_path, radiometry="temperature")
    monkeypatch.setitem(sys.modules, "flyr", None)
    with pytest.raises(
        InputError, match=r"flyr, .* is not installed; pip install 'geomosaic-ortho\[thermal\]'"
    ):
        read(tmp_path, radiometry="temperature")


def test_a_band_called_lwir_in_floats_is_in_degrees(tmp_path: Path) -> None:
    """As dji-thermal-cli writes them; in whole numbers it is MicaSense's, in hundredths of a kelvin."""
    for k in range(2):
        shape = {"width": SIZE[0], "height": SIZE[1], "count": 1, "dtype": "float32"}
        with (
            unreferenced_is_fine(),
            rasterio.open(tmp_path / f"{k}.tif", "w", driver="GTiff", **shape) as out,
        ):
            out.write(celsius(levels(k))[None].astype(np.float32))
            packet = xmp_attributes("http://pix4d.com/camera/1.0/", "Camera", BandName="LWIR").decode()
            out.update_tags(ns="xml:XMP", **{"xml:XMP": packet})
            out.update_tags(EXIF_GPSLatitude="(48) (42) (0)", EXIF_GPSLongitude=f"(9) (6) ({k})")
    assert read(tmp_path).quantity == CELSIUS
