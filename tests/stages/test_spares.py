"""What stages leave of frames for each other, and what of it stays for later runs."""

from __future__ import annotations

from pathlib import Path

from small_surveys import small_survey

from geomosaic.pipeline.artefact_reader import decode
from geomosaic.pipeline.run_options import RunOptions
from geomosaic.pipeline.runner import run
from geomosaic.requests.run_request import recipe_of
from geomosaic.survey.small import EighthColours


def test_colours_stay_for_later_runs(tmp_path: Path) -> None:
    """Not the brightness at half the size; also where reading the survey is from the cache."""
    made = small_survey(tmp_path / "survey", lines=1, frames_per_line=3, width_px=240, height_px=180)
    given = {"survey.read": {"frames": made.frames, "pos": made.pos, "camera": made.camera}}
    for _ in range(2):
        run(recipe_of(("survey", ""), ("survey.read",), given), tmp_path / "run", RunOptions())
        left = sorted((tmp_path / "run" / "work" / "spared" / "items").glob("*/*"))
        assert len(left) == 3
        assert {decode(path.read_bytes(), EighthColours).pixels.shape for path in left} == {(23, 30, 3)}
