"""Options of a mosaic that would have no effect are refused."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_surveys import geomosaic

import geomosaic as gm
from geomosaic.errors import InputError
from geomosaic.requests.mosaic_request import MosaicRequest


def test_an_option_of_a_file_needs_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert geomosaic("mosaic", tmp_path, "--pos-crs", "EPSG:32633") == 2
    said = capsys.readouterr().err
    assert "--pos-crs has an effect only on a " in said and "; add --" in said


def test_in_python_it_is_an_argument(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^pos_crs has an effect .*; add pos="):
        gm.mosaic(tmp_path, pos_crs="EPSG:32633")


@pytest.mark.parametrize(
    ("file", "given"),
    [
        ("geo.txt", {"pos_crs": "EPSG:32633"}),
        ("gcp_list.txt", {"pos_crs": "EPSG:32633", "gcp_optional": True}),
        ("", {"pos_crs": "EPSG:32633", "pos": "pos.csv"}),
        ("", {"pos_crs": "EPSG:32633", "set": ["survey.read.pos=pos.csv"]}),
        ("", {"gcp_optional": True}),
    ],
)
def test_the_file_may_be_the_project_s_own(tmp_path: Path, file: str, given: dict[str, object]) -> None:
    """What OpenDroneMap's folder holds is found there."""
    if file:
        (tmp_path / file).write_text("EPSG:32633\n")
    read = MosaicRequest(frames=tmp_path, workers=1, **given).recipe().steps[0].params.model_dump()
    assert read["pos_crs"] == given.get("pos_crs") and read["gcp_optional"] is given.get(
        "gcp_optional", False
    )
