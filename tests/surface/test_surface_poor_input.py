"""Surveys that show too little for a surface, or more relief than is looked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dense_scene import GSD_M, scene
from small_surveys import mosaic, small_survey, summary

from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.cells import Cells
from geomosaic.surface.consistency_filter import MatchCounts
from geomosaic.surface.match_warnings import match_warnings
from geomosaic.surface.pyramid import pyramid_levels
from geomosaic_simulate.flight import fly
from geomosaic_simulate.survey import world_of


def test_no_place_that_three_frames_see_is_reported(tmp_path) -> None:
    line = scene(tmp_path, lines=1, frames_per_line=3, forward_overlap=0.45)
    surface, counted, level = line.matched(line.cells(12.0))
    assert line.frames_seeing(surface).max() == 2
    assert surface.views.max() <= 2
    by_code = dict(match_warnings(counted, level, line.base.kind))
    assert by_code.keys() & {"surface-two-views", "surface-not-matched"}
    assert np.isfinite(surface.up_m).all()


@pytest.mark.proof
def test_a_dem_given_as_well_is_where_the_search_starts(tmp_path) -> None:
    """Hills of 45 m below a flight of 50 m, farther down than the search from level ground reaches."""
    hills = scene(tmp_path, relief_m=45.0, relief_wavelength_m=120.0, frames_per_line=3)
    world = world_of(hills.plan, fly(hills.plan))
    axis = np.arange(-90.0, 91.0)
    east, north = np.meshgrid(axis, axis)
    up = np.full(east.shape, hills.base.up_m.item())
    for _ in range(3):
        at = world.map_from_enu(np.stack([east, north, up], axis=-1))
        up += world.relief.height_at(at[..., 0], at[..., 1]) - at[..., 2]
    dem = GroundSurface("dem", -90.0, -90.0, 1.0, up)
    off = {}
    for name, base in (("level", hills.base), ("dem", dem)):
        surface, _, _ = hills.matched(hills.cells(16.0), base)
        errors_m, kind = hills.truth(surface)
        seen = (kind == 0) & (hills.frames_seeing(surface) >= 3)
        off[name] = float(np.mean(np.abs(errors_m[seen]) > 10.0 * GSD_M))
    assert off["dem"] < 0.05 < off["level"]


@pytest.mark.parametrize(
    ("known", "fix"), [("flat", "with --dem"), ("tie_surface", "with --dem"), ("dem", "--dem-offset")]
)
def test_who_gave_an_elevation_model_is_not_asked_to_give_one(known: str, fix: str) -> None:
    level = pyramid_levels(Cells(0.0, 0.0, 0.4, 8, 8), 100.0)[-1]
    by_code = dict(match_warnings(MatchCounts(looked_at=64, matched=64, beyond=10, alike=64), level, known))
    assert list(by_code) == ["surface-out-of-reach"]
    assert "10 m below to 30 m above" in by_code["surface-out-of-reach"]
    assert fix in by_code["surface-out-of-reach"]


@pytest.mark.proof
def test_run_and_report_say_that_two_frames_are_few(tmp_path: Path) -> None:
    survey = small_survey(tmp_path / "survey", lines=1, frames_per_line=2)
    asked = ("--surface", "dense", "--pos", survey.pos, "--camera", survey.camera)
    assert mosaic(survey.frames, tmp_path / "run", *asked) == 0
    run_summary = {w["code"]: w["text"] for w in summary(tmp_path / "run")["warnings"]}
    assert run_summary["surface-two-views"] in (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
