"""TIFF frames whose directories lie behind their pixels."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import pytest
from survey_files import exif_block, gps

from geomosaic.survey.header import read_header


@pytest.mark.parametrize("order", ["<", ">"])
def test_tags_behind_the_pixels_of_a_large_tiff(tmp_path: Path, order: str) -> None:
    """Their directory begins at 9 MB."""
    width, height = 3000, 3000
    block = exif_block(
        order, bytes(width * height), Make="Maker", Model="Rig", BlackLevel=4800, FocalLength=Fraction("5.5"),
        ImageWidth=width, ImageLength=height, BitsPerSample=8, Compression=1, Photometric=1, StripOffsets=8,
        SamplesPerPixel=1, RowsPerStrip=height, StripByteCounts=width * height, **gps(9.5, 48.7, 412.5),
    )  # fmt: skip
    (tmp_path / "a.tif").write_bytes(block)
    exif = read_header(tmp_path / "a.tif").exif
    assert (exif.make, exif.model, exif.black_level, exif.focal_length_mm) == ("Maker", "Rig", 4800.0, 5.5)
    assert (exif.lon_deg, exif.lat_deg) == (pytest.approx(9.5), pytest.approx(48.7))
