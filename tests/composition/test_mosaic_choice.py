"""Which of two grounds frames agree on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mosaic_scenes import CAMERA, make_survey, paint

from geomosaic.composition.choice import Agreement, agreement
from geomosaic.composition.views import PosedFrames, frame_views
from geomosaic.projection.ground import GroundSurface
from geomosaic.spread import AtOnce
from geomosaic.survey.pixels import read_pixels

CAMERA_WIDE = replace(
    CAMERA, width_px=300, height_px=220, focal_length_px=170.0, principal_col_px=151.0, principal_row_px=109.0
)


def hall(height_m: float) -> GroundSurface:
    """Land with a hall of 24 m x 24 m, or without."""
    axis = -80.0 + np.arange(161)
    east, north = np.meshgrid(axis, axis)
    inside = (abs(east) < 12.0) & (abs(north) < 12.0)
    return GroundSurface("dense", -80.0, -80.0, 1.0, np.where(inside, height_m, 0.0))


@pytest.mark.proof
def test_frames_agree_on_the_ground_that_they_saw_and_only_where_grounds_differ(tmp_path: Path) -> None:
    """What stands agrees on the surface; frames of flat land, to which a hall was added, agree below it."""
    for name, true_m, best in (("stands", 8.0, 0), ("flat", 0.0, 1)):
        survey, poses, ground = make_survey(tmp_path / name, ground=hall(true_m), camera=CAMERA_WIDE)
        n = len(poses)
        frames = PosedFrames(survey, poses, [CAMERA_WIDE] * n, [True] * n, hall(0.0))
        views = frame_views(frames, survey.map_crs)
        grounds = hall(8.0), hall(0.0)
        found = agreement(survey, views, grounds, AtOnce())
        assert found.squares > 20 and found.places > 3
        assert found.best == best, found
        assert found.disagreement[best] < 0.05 < found.disagreement[1 - best]
        if name == "stands":
            assert found.disagreement[best] < 0.001, "what the hall hides is not asked"
        alike = agreement(survey, views, (ground, ground), AtOnce())
        assert (alike.squares, alike.places, alike.best) == (0, 0, 0)


def test_frames_of_little_contrast_in_16_bits_agree_on_the_ground_that_they_saw(tmp_path: Path) -> None:
    """Level land of 40,000 to 40,020, and a highlight: single precision leaves squares of 40,000 to 100."""
    survey, poses, _ = make_survey(tmp_path, per_line=2, dtype="uint16", camera=CAMERA_WIDE)
    for frame in survey.frames:
        pixels = 40_000.0 + np.rint(read_pixels(frame)[0] / 65_535.0 * 20.0)
        pixels[:4, :4] = 65_535.0
        paint(frame, pixels)
    n = len(poses)
    frames = PosedFrames(survey, poses, [CAMERA_WIDE] * n, [True] * n, hall(0.0))
    found = agreement(survey, frame_views(frames, survey.map_crs), (hall(8.0), hall(0.0)), AtOnce())
    assert found.best == 1 and found.squares > 20
    assert found.disagreement[1] < 0.1 and 0.3 < found.disagreement[0] < 1.5


@pytest.mark.parametrize(
    ("surface", "terrain", "best"),
    [(0.30, 0.60, 0), (0.60, 0.30, 1), (0.50, 0.52, 1), (0.981, 0.990, 1), (0.92, 0.99, 1), (0.85, 0.95, 0)],
)
def test_frames_lie_on_the_terrain_unless_they_clearly_agree_on_what_stands(
    surface: float, terrain: float, best: int
) -> None:
    """The fourth is a flight over woods that wind moves."""
    assert Agreement((surface, terrain), 800, 60).best == best
