"""What a mosaic will ask for."""

from __future__ import annotations

import json

import pytest
from small_surveys import geomosaic

from geomosaic.composition.estimate import Before, FilledPixels, estimate
from geomosaic.composition.model import OutputGrid
from geomosaic_simulate.survey import SimulatedSurvey

NOTHING = Before((0.0, 0.0), 0.0, 0.0)


def grid(side_px: int, gsd_m: float) -> OutputGrid:
    return OutputGrid("EPSG:32632", 0.0, 0.0, gsd_m, side_px, side_px)


def test_a_surface_has_no_more_cells_than_one_may_have() -> None:
    """8 gigapixels in cells of 4 x 4 are 500 million; 16 million of 128 bytes are 2 GB, and 13 s each."""
    plain, matched = (
        estimate(grid(100_000, 0.02), FilledPixels(0.8, 3, cell_m), NOTHING, 1) for cell_m in (None, 0.08)
    )
    assert plain.scratch_gb == pytest.approx(6.0)
    assert matched.scratch_gb == pytest.approx(6.0 + 2.048)
    assert matched.minutes[0] - plain.minutes[0] == pytest.approx(16.0 * 13.0 / 60.0)


def test_cells_of_a_surface_are_as_large_as_frames_see_the_ground() -> None:
    """0.1 gigapixels of 2 cm in cells of 20 cm, four pixels of frames of 5 cm, are a million."""
    found = estimate(grid(10_000, 0.02), FilledPixels(1.0, 3, 0.2), NOTHING, 1)
    assert found.scratch_gb == pytest.approx(0.075 + 0.128)


def test_a_surface_takes_as_much_at_any_pixel_of_the_mosaic(
    few_survey: SimulatedSurvey, capsys: pytest.CaptureFixture[str]
) -> None:
    """A mosaic of half the pixel has no finer surface: its cells follow what frames see."""

    def disk_gb(gsd_m: float, surface: str) -> float:
        dry = ("mosaic", few_survey.frames, "--dry-run", "--json", "-q", "--workers", 1)
        assert geomosaic(*dry, "--gsd", gsd_m, "--surface", surface) == 0
        return float(json.loads(capsys.readouterr().out)["metrics"]["estimate"]["disk_gb"][0])

    more = [disk_gb(gsd_m, "dense") - disk_gb(gsd_m, "ties") for gsd_m in (0.25, 0.125)]
    assert more[0] > 0.0 and more[1] == pytest.approx(more[0], rel=0.05)
