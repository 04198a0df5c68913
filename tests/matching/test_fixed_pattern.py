"""The fixed pattern of thermal sensors is found and taken away; what frames look at stays."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from mosaic_scenes import make_survey
from osgeo import gdal

from geomosaic.matching.fixed_pattern import SAMPLE, fixed_pattern, without_pattern
from geomosaic.pipeline.context import Context
from geomosaic.pipeline.hashes import FileHashes
from geomosaic.stages.keypoints import FrameReduction, frame_features, pictured

SIZE = (240, 320)


def scenes(
    count: int, seed: int, pattern: np.ndarray | None = None, contrast: float = 6.0
) -> list[np.ndarray]:
    """Frames of a flight over ground of little contrast, 40 px from one to the next."""
    rng = np.random.default_rng(seed)
    ground = rng.normal(0.0, 1.0, (SIZE[0] + 40 * count, SIZE[1])).astype(np.float32)
    ground = cv2.GaussianBlur(ground, (0, 0), 2.0)
    ground *= contrast / ground.std()
    shown = np.zeros(SIZE, np.float32) if pattern is None else pattern
    gains = rng.uniform(0.7, 1.3, count)
    return [
        np.clip(np.rint(120.0 + ground[40 * k : 40 * k + SIZE[0]] + gains[k] * shown), 0, 255).astype(
            np.uint8
        )
        for k in range(count)
    ]


def noise(seed: int, sd: float) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, sd, SIZE).astype(np.float32)


@pytest.mark.parametrize("seed", range(3))
def test_the_pattern_is_found_and_goes(seed: int) -> None:
    pattern = noise(100 + seed, 4.0)
    frames, clean = scenes(SAMPLE, seed, pattern), scenes(SAMPLE, seed)
    found = fixed_pattern(frames)
    assert found is not None
    assert np.corrcoef(found.ravel(), pattern.ravel())[0, 1] > 0.9
    off = [np.std(without_pattern(f, found).astype(float) - c) for f, c in zip(frames, clean, strict=True)]
    assert np.median(off) < 0.45 * 4.0


@pytest.mark.parametrize("seed", range(3))
def test_frames_without_a_pattern_have_none(seed: int) -> None:
    assert fixed_pattern(scenes(SAMPLE, seed)) is None
    assert fixed_pattern([np.full(SIZE, 90, np.uint8)] * SAMPLE) is None
    assert fixed_pattern(scenes(SAMPLE - 1, seed, noise(seed, 9.0))) is None


def test_keypoints_of_frames_with_a_pattern_are_those_of_the_ground(tmp_path: Path) -> None:
    """Keypoints that all frames have in one place belong to the sensor."""
    survey, _, _ = make_survey(tmp_path / "frames", lines=1, per_line=SAMPLE)
    frames = list(survey.frames)
    size = (frames[0].height_px, frames[0].width_px)
    pattern = np.random.default_rng(3).normal(0.0, 14.0, size)

    for frame in frames:
        tiff = gdal.Open(str(frame.path), gdal.GA_Update)
        tiff.WriteArray(np.clip(tiff.ReadAsArray() + pattern, 0, 255).astype(np.uint8))
        tiff.FlushCache()

    def common(count: int) -> float:
        """Share of the first frame's keypoints that the sixth has within half a pixel."""
        context = Context(tmp_path / str(count), key="k", hashes=FileHashes())
        with pictured(context, FrameReduction(400, 400), frames[:count]) as pictures:
            found = context.stored("keypoints", partial(frame_features, 400, 800), pictures)
            one, other = (found[i].load().image_px for i in (0, 5))
        apart = np.linalg.norm(one[:, None] - other[None], axis=2).min(axis=1)
        return float((apart < 0.5).mean())

    too_few_frames_to_tell = common(SAMPLE - 1)
    assert too_few_frames_to_tell > 0.4
    assert common(SAMPLE) < 0.2 * too_few_frames_to_tell
