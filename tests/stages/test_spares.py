"""What stages leave of frames for each other, and what of it stays for later runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_surveys import small_survey

from geomosaic.pipeline.artefact_reader import decode
from geomosaic.pipeline.hashes import FileHashes
from geomosaic.pipeline.run_options import RunOptions
from geomosaic.pipeline.runner import run
from geomosaic.pipeline.stage import Context
from geomosaic.requests.run_request import recipe_of
from geomosaic.stages.spares import spare_of
from geomosaic.survey.small import EighthColours, HalfGrey


def test_colours_stay_for_later_runs(tmp_path: Path) -> None:
    """Not the brightness at half the size; also where reading the survey is from the cache."""
    made = small_survey(tmp_path / "survey", lines=1, frames_per_line=3, width_px=240, height_px=180)
    given = {"survey.read": {"frames": made.frames, "pos": made.pos, "camera": made.camera}}
    for _ in range(2):
        run(recipe_of(("survey", ""), ("survey.read",), given), tmp_path / "run", RunOptions())
        left = sorted((tmp_path / "run" / "work" / "spared" / "items").glob("*/*"))
        assert len(left) == 3
        assert {decode(path.read_bytes(), EighthColours).pixels.shape for path in left} == {(23, 30, 3)}


def test_what_earlier_versions_made_is_not_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.jpg").write_bytes(b"a frame")
    context = Context(tmp_path / "run", key="k", hashes=FileHashes())
    spare_of(context, str(tmp_path / "a.jpg")).leave(np.zeros((4, 4, 3), np.uint8))
    found = spare_of(context, str(tmp_path / "a.jpg"))
    assert found.at(2, 1) is not None and found.at(8, 3) is not None
    monkeypatch.setattr(HalfGrey, "version", HalfGrey.version + 1)
    found = spare_of(context, str(tmp_path / "a.jpg"))
    assert found.at(2, 1) is None and found.at(8, 3) is not None
    monkeypatch.setattr(EighthColours, "version", EighthColours.version + 1)
    assert spare_of(context, str(tmp_path / "a.jpg")).at(8, 3) is None


def test_the_versions_are_those_of_these_values() -> None:
    """Where they change, the version rises, since later runs would find the earlier ones."""
    half = np.full((4, 5, 3), (200, 100, 50), np.uint8)
    half[0, :4], half[:, 4] = (40, 20, 10), (8, 4, 250)
    assert HalfGrey.version == EighthColours.version == 1
    assert HalfGrey.of(half).pixels[:, 3:, 0].tolist() == [[25, 33], [124, 33], [124, 33], [124, 33]]
    assert EighthColours.of(half).pixels.tolist() == [[[160, 80, 40], [8, 4, 250]]]
