"""`--reference TIF --coregister`: a mosaic of another flight, whose GNSS is off, lies on the first to a pixel."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_surveys import geomosaic, mosaic, small_survey, summary

from geomosaic.errors import FileError, InputError
from geomosaic.matching.features import Features
from geomosaic.matching.planes import guessed, unconstrained_guess
from geomosaic.matching.reference_map import (
    FoundOnMap,
    ReferenceGrid,
    expected_on_map,
    spread_places,
    tile_bounds,
)
from geomosaic.requests.mosaic_request import MosaicRequest


@pytest.mark.proof
def test_two_epochs_of_offset_gnss_agree_to_a_pixel_and_planted_squares_are_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = small_survey(tmp_path / "first", frames_per_line=3)
    later = {"frames_per_line": 3, "epoch": 1, "heading_deg": 75.0, "position_bias_m": 4.0, "changes": 2}
    second = small_survey(tmp_path / "second", **later)
    old, new = tmp_path / "old", tmp_path / "new"
    assert mosaic(first.frames, old, "--pos", first.pos, "--camera", first.camera, "-q") == 0
    onto = ("--reference", old / "mosaic.tif", "--coregister")
    assert mosaic(second.frames, new, "--pos", second.pos, "--camera", second.camera, *onto, "-q") == 0
    metrics = summary(new)["metrics"]
    assert metrics["reference"]["off_m"] > 1.0, "where GNSS puts it"
    assert metrics["reference"]["frames"] == 6
    assert metrics["quality"]["absolute_rmse_m"] < 0.05, "half a pixel"
    capsys.readouterr()
    assert geomosaic("compare", old, new, "-q") == 0
    assert "image      2 changes" in capsys.readouterr().out


def test_coregistering_wants_a_reference() -> None:
    with pytest.raises(InputError, match=r"--coregister needs a map.*add --reference TIF"):
        MosaicRequest(frames=Path("frames"), coregister=True).stages()
    with pytest.raises(FileError, match=r"none\.tif: there is no such file; give one with --reference TIF"):
        MosaicRequest(frames=Path("frames"), coregister=True, reference=Path("none.tif")).stages()


def test_a_map_s_tiles_cover_it_once() -> None:
    covered = np.zeros((7, 11), dtype=int)
    for (left, top), (right, bottom) in tile_bounds((11, 7), 4):
        covered[top:bottom, left:right] += 1
    assert (covered == 1).all()


def test_places_of_a_map_in_frames_pixels_and_back() -> None:
    grid = ReferenceGrid(Path("map.tif"), "EPSG:32632", 1000.0, 5000.0, (100, 100), 0.4, 4.0)
    assert grid.map_m(np.array([[40.0, 80.0]])) == pytest.approx(np.array([[1004.0, 4992.0]]))
    assert grid.image_px(np.array([[1004.0, 4992.0]])) == pytest.approx(np.array([[40.0, 80.0]]))


def test_only_keypoints_of_the_map_about_a_frame_are_compared_with_it() -> None:
    at = np.array([[50.0, 50.0], [900.0, 50.0], [120.0, 90.0]])
    of_map = Features(at, np.ones(3, np.float32), np.zeros((3, 128), np.uint8))
    near = expected_on_map(of_map, guessed((100, 80), np.eye(3), 32.0))
    assert near.number.tolist() == [0, 2]
    assert expected_on_map(of_map, unconstrained_guess((100, 80))).number.tolist() == [0, 1, 2]


def test_of_each_cell_the_place_that_most_frames_show_is_taken() -> None:
    at_m = np.array([[1.0, 1.0], [2.0, 2.0], [11.0, 1.0], [25.0, 25.0]])
    shown = [[0, 1, 2], [1, 2, 3], [1]]
    found = [FoundOnMap(np.zeros((len(n), 2)), np.array(n), 0.0) for n in shown]
    assert spread_places(found, at_m, 10.0) == [1, 2], "place 3 is seen once"
