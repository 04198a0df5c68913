"""Small simulated surveys, and the command line run in this process."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

from geomosaic.cli.main import main
from geomosaic.pipeline.recipe import Recipe
from geomosaic.pipeline.run_options import RunOptions
from geomosaic.pipeline.runner import run
from geomosaic.requests.run_request import recipe_of
from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.survey import SimulatedSurvey, simulate_frames
from geomosaic_simulate.terrain import GroundImage

NOISE_M = 0.4
"""Of each axis of a position."""

MAP_ALONE = (
    "survey.read", "projection.ground", "placement.pos", "matching.sift", "adjustment.solve",
    "mosaic.seams", "mosaic.compose", "export.cog", "export.layers",
)  # fmt: skip
"""The stages of a map. Tones, verdict and report take half of a small run."""


_tile = lru_cache(maxsize=64)(GroundImage.tile)


def simulated(out: Path, plan: SurveyPlan) -> SimulatedSurvey:
    """As `simulate_frames`; tiles of ground that this process has painted are kept, at most 54 MB."""
    with patch.object(GroundImage, "tile", _tile):
        return simulate_frames(out, plan)


def small_survey(out: Path, **plan: Any) -> SimulatedSurvey:
    """480 x 360 frames from 50 m, pixels of 0.1 m: two lines of four unless asked otherwise."""
    usual = {"lines": 2, "frames_per_line": 4, "width_px": 480, "height_px": 360, "seed": 3}
    noise = {"position_sd_m": NOISE_M, "height_sd_m": NOISE_M}
    return simulated(out, SurveyPlan(**{**usual, **noise, "height_above_ground_m": 50.0, **plan}))


def geomosaic(*arguments: object) -> int:
    """Runs a command; its output goes to this process's stdout and stderr."""
    return main([str(a) for a in arguments])


def mosaic(frames: Path, run: Path, *arguments: object) -> int:
    """`geomosaic mosaic` with one worker."""
    return geomosaic("mosaic", frames, "-o", run, "--workers", 1, *arguments)


def map_alone(made: SimulatedSurvey, stages: Sequence[str] = MAP_ALONE, **params: dict[str, Any]) -> Recipe:
    """The recipe of a survey's map by least squares. params: of stages, with `__` for the point in their names."""
    given: dict[str, dict[str, Any]] = {
        "survey.read": {"frames": made.frames, "pos": made.pos, "camera": made.camera},
        "adjustment.solve": {"method": "least_squares"},
    }
    for name, more in params.items():
        stage = name.replace("__", ".")
        given[stage] = given.get(stage, {}) | more
    return recipe_of(("map", ""), stages, given)


def made_map(
    made: SimulatedSurvey, to: Path, stages: Sequence[str] = MAP_ALONE, **params: dict[str, Any]
) -> dict[str, Any]:
    """Runs `map_alone`; what run.json says of it."""
    return run(map_alone(made, stages, **params), to, RunOptions())


def summary(run: Path) -> dict[str, Any]:
    """run.json."""
    return json.loads((run / "run.json").read_text(encoding="utf-8"))  # type: ignore[no-any-return]


def warned(run: Path, code: str) -> list[str]:
    """The frames that warnings of a code name."""
    return [w["frame"] for w in summary(run)["warnings"] if w["code"] == code]
