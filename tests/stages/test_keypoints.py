"""What matching decodes: each frame once, and none of which all that is wanted is there from before."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from mosaic_scenes import make_survey

from geomosaic.pipeline.context import Context
from geomosaic.pipeline.hashes import FileHashes
from geomosaic.stages.keypoints import FrameReduction, frame_features, pictured
from geomosaic.survey.model import Frame


def decoded(folder: Path, frames: list[Frame]) -> list[bool]:
    """Which frames are decoded when their keypoints are wanted, in a run of its own."""
    context = Context(folder / "run", key="k", hashes=FileHashes())
    with pictured(context, FrameReduction(400, 200), frames) as pictures:
        context.stored("keypoints", partial(frame_features, 200, 50), pictures)
        there = [picture.decoded.found() is not None for picture in pictures]
        assert all((picture.brightness().grey > 0).any() for picture in pictures)
    assert not any(picture.decoded.found() for picture in pictures)
    return there


def test_only_new_frames_are_decoded(tmp_path: Path) -> None:
    survey, _, _ = make_survey(tmp_path / "frames", lines=1, per_line=3)
    frames = list(survey.frames)
    assert decoded(tmp_path, frames[:2]) == [True, True]
    assert decoded(tmp_path, frames) == [False, False, True]
