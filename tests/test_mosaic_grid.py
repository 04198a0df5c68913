"""The stage that settles the mosaic's grid: the ground pixel that is asked for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from mosaic_scenes import CAMERA, make_survey

from geomosaic.adjustment.model import Adjusted
from geomosaic.mosaic.ownership import Ownership
from geomosaic.pipeline.context import Notes
from geomosaic.pipeline.run_folder import RunFolder
from geomosaic.pipeline.single import run_stage
from geomosaic.placement.model import Placement
from geomosaic.stages.mosaic_seams import MosaicSeams

OWN_M = 0.2487


def given_for(folder: Path, **survey: Any) -> dict[str, Any]:
    """What the stages of composition take, of frames of 0.25 m."""
    made, poses, ground = make_survey(folder / "frames", **survey)
    n = len(poses)
    return {
        "survey": made,
        "ground": ground,
        "placement": Placement(poses, tuple(range(n)), (0,) * n, (), OWN_M, "rigorous"),
        "adjusted": Adjusted(poses, (CAMERA,) * n, ("tied",) * n, (), (), ground),
    }


def seams(folder: Path, given: dict[str, Any], **params: Any) -> tuple[Ownership, Notes]:
    inputs = {name: given[name] for name in MosaicSeams.inputs}
    outputs, notes = run_stage(
        MosaicSeams, MosaicSeams.Params(**params), RunFolder(folder / "RUN"), inputs,
        work_folder=folder / "work",
    )  # fmt: skip
    return outputs["ownership"], notes


@pytest.mark.parametrize("gsd_m, told", [("auto", ""), (0.13, ""), (0.12, "room and time"), (1.2, "lost")])
def test_a_ground_pixel_far_from_the_frames_own_is_told_once(
    tmp_path: Path, gsd_m: float | str, told: str
) -> None:
    owned, notes = seams(tmp_path, given_for(tmp_path, lines=1, per_line=2), gsd_m=gsd_m)
    assert owned.grid.gsd_m == (0.25 if gsd_m == "auto" else gsd_m)
    texts = [w["text"] for w in notes.warnings if w["code"] == "gsd-far"]
    assert len(texts) == bool(told)
    for text in texts:
        assert f"pixel is {gsd_m} m, the frames' own is 0.249 m: " in text and told in text
