"""The dense surface's stage: frames that lie far off, and cells as large as a tenth of the flying height."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_surveys import small_survey

from geomosaic.adjustment.model import Adjusted
from geomosaic.constants import varied
from geomosaic.pipeline.context import Context
from geomosaic.projection.ground import GroundSurface
from geomosaic.stages.surface_dense import surface_dense
from geomosaic.surface.model import DenseSurface
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.model import Survey
from geomosaic.survey.read import read_survey
from geomosaic_simulate.flight import Flight, fly
from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.survey import world_of

MOVED = 2
"""Number of the frame that is moved."""


@dataclass(frozen=True)
class Flown:
    """A level survey with its true poses."""

    plan: SurveyPlan
    survey: Survey
    flight: Flight
    ground: GroundSurface

    def surface(
        self,
        folder: Path,
        cell_px: float = 4.0,
        moved_m: Sequence[float] = (0.0, 0.0),
        out: int | None = None,
    ) -> tuple[DenseSurface, Context]:
        """The surface and what the stage reports. moved_m: error of one frame, east and north. out: a frame
        that is rejected."""
        n, places = len(self.survey.frames), self.flight.poses.positions_m.copy()
        places[MOVED, :2] += moved_m
        adjusted = Adjusted(
            replace(self.flight.poses, positions_m=places),
            (self.plan.camera(),) * n,
            tuple("rejected" if i == out else "tied" for i in range(n)),
            (),
            (),
            self.ground,
        )
        context = Context(folder, stage_id="surface.dense", key="key", work_folder=folder / "work")
        given = {"survey": self.survey, "adjusted": adjusted, "ground": self.ground}
        found = surface_dense().run(given, surface_dense.Params(cell_px=cell_px), context)["surface"]
        assert isinstance(found, DenseSurface)
        return found, context


def flown(folder: Path, **asked: Any) -> Flown:
    plan = {"lines": 2, "frames_per_line": 3, "seed": 3, "height_above_ground_m": 50.0, **asked}
    made = small_survey(folder, position_sd_m=0.0, height_sd_m=0.0, **plan)
    full = SurveyPlan(position_sd_m=0.0, height_sd_m=0.0, **plan)
    flight = fly(full)
    survey = read_survey(SurveyInputs(made.frames, pos=made.pos, camera=made.camera))
    level_m = world_of(full, flight).relief.base_m - flight.work_frame.height_ellipsoidal_m
    ground = GroundSurface("flat", 0.0, 0.0, 1.0, np.full((1, 1), level_m))
    return Flown(full, replace(survey, work_frame=flight.work_frame), flight, ground)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    return flown(tmp_path_factory.mktemp("small"), width_px=240, height_px=180)


@pytest.fixture(scope="module")
def wide(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """Frames of a thermal camera: a focal length of 200 px."""
    asked = {"ground_pixel_m": 0.25, "forward_overlap": 0.8, "side_overlap": 0.7, "frames_per_line": 4}
    return flown(tmp_path_factory.mktemp("wide"), width_px=400, height_px=300, **asked)


def test_a_frame_that_the_adjustment_flings_away_leaves_the_surface_as_it_is(
    small: Flown, tmp_path: Path
) -> None:
    """150 km away, as if it were rejected."""
    without, _ = small.surface(tmp_path / "without", out=MOVED)
    found, context = small.surface(tmp_path / "flung", moved_m=(1.2e5, 9e4))
    assert found.cells == without.cells
    assert found.cells.cell_m == pytest.approx(0.4, rel=0.05)
    assert found.up_m.tobytes() == without.up_m.tobytes()
    assert "surface-coarse" not in {w["code"] for w in context.notes.warnings}


@pytest.mark.parametrize(
    ("moved_m", "frame", "fix"),
    [(400.0, "F0003.jpg", "correct its position with --pos"), (0.0, "", "map parts of the flight")],
)
def test_coarse_cells_name_the_frame_that_makes_the_extent(
    small: Flown, tmp_path: Path, moved_m: float, frame: str, fix: str
) -> None:
    with varied(MOST_CELLS=3000):
        found, context = small.surface(tmp_path, moved_m=(moved_m, moved_m))
    assert found.cells.cell_m > 0.8
    [warning] = [w for w in context.notes.warnings if w["code"] == "surface-coarse"]
    assert warning["frame"] == frame
    assert fix in warning["text"]


def test_level_ground_is_not_at_the_end_of_a_search_of_few_heights(wide: Flown, tmp_path: Path) -> None:
    """Cells of 2 m: 3 heights below the ground and 7 above it."""
    found, context = wide.surface(tmp_path, cell_px=8.0)
    matched = found.views > 0
    assert matched.mean() > 0.3
    assert np.median(np.abs(found.up_m - wide.ground.up_m.item())[matched]) < 0.1
    assert "surface-out-of-reach" not in {w["code"] for w in context.notes.warnings}


def test_cells_larger_than_the_search_keep_the_ground(wide: Flown, tmp_path: Path) -> None:
    """Cells of 16 m, heights searched from 5 m below the ground to 15 m above it."""
    found, _ = wide.surface(tmp_path, cell_px=64.0)
    assert found.cells.cell_m == pytest.approx(16.0, rel=0.05)
    np.testing.assert_allclose(found.up_m, wide.ground.up_m.item(), atol=0.5)
