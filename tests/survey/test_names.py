"""Names of frames as other programs write them."""

from __future__ import annotations

import unicodedata

import pytest

from geomosaic.errors import InputError
from geomosaic.survey.names import FrameNames


@pytest.mark.parametrize(
    "text", ["100media/dji_0001.jpg", r"C:\a\100MEDIA\DJI_0001.tif", "100MEDIA/DJI_0001"]
)
def test_names_of_several_folders_are_found_however_written(text: str) -> None:
    frames = FrameNames(["100MEDIA_DJI_0001.JPG", "101MEDIA_DJI_0001.JPG"])
    assert frames.find(text) == "100MEDIA_DJI_0001.JPG"
    assert frames.find("DJI_0001.JPG") is None


@pytest.mark.parametrize(
    "end", ["cr3", "RAF", "orf", "rw2", "3fr", "fff", "gpr", "pef", "srw", "hif", "rwl", "x3f"]
)
def test_the_raw_file_of_a_frame_means_the_frame(end: str) -> None:
    assert FrameNames(["DSC0001.JPG"]).find(f"DSC0001.{end}") == "DSC0001.JPG"


def test_accents_are_alike_whether_taken_apart_or_not() -> None:
    """macOS writes names taken apart (NFD), most tables do not (NFC)."""
    apart, whole = (unicodedata.normalize(form, "Höhe 1.jpg") for form in ("NFD", "NFC"))
    assert apart != whole
    assert FrameNames([apart]).find(whole) == apart
    assert FrameNames([apart]).quoted(f"{whole} 8 50") == f'"{whole}" 8 50'


def test_one_of_several_is_a_named_error() -> None:
    with pytest.raises(InputError, match=r"may be any of a\.jpg, a\.tif"):
        FrameNames(["a.jpg", "a.tif"]).find("A")
