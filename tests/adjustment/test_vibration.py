"""Frames that vibrate while a rolling shutter reads their rows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import fly, hills

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import ImageResiduals, Settings
from geomosaic.adjustment.procedure.residual_pattern import left_by_vibration
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera


@pytest.mark.proof
def test_frames_that_vibrate_are_followed_over_three_periods() -> None:
    """30 Hz while rows are read in 0.1 s: turning alone, of one period at most, leaves half of it."""
    shaking = {"points": 500, "relief": hills, "readout_s": 0.1, "rate_sd_rad_per_s": 0.4, "shaking_hz": 30.0}
    flown = fly(4, 2, 4, **shaking)
    turning, vibrating = (
        METHODS["bundle"](flown.block, Settings(model="given", turning=True, vibrating=v))
        for v in (False, True)
    )
    assert vibrating.figures["sigma_px"] < 0.35 < 2.0 * 0.3 < turning.figures["sigma_px"]
    missed = [_missed_share(a.poses, flown.truth) for a in (vibrating, turning)]
    assert missed[0] < 0.6 * missed[1], missed


def _missed_share(found: Poses, truth: Poses) -> float:
    """Of the true turns over a readout that the found ones miss, but for a straight line in each frame."""
    after_s = np.linspace(-0.05, 0.05, 41)
    line = np.vander(after_s, 2)
    rest = np.eye(41) - line @ np.linalg.pinv(line)
    own, true = (np.stack([rest @ p.turns[i].at(after_s)[0] for i in range(len(p))]) for p in (found, truth))
    return float(np.sqrt(np.mean((own - true) ** 2) / np.mean(true**2)))


def test_the_images_say_by_themselves_that_frames_vibrate() -> None:
    shaking = {"points": 500, "relief": hills, "readout_s": 0.1, "rate_sd_rad_per_s": 0.4, "shaking_hz": 25.0}
    adjusted = METHODS["bundle"](fly(4, 2, 4, **shaking).block, Settings())
    assert adjusted.model is not None and "vibrating" in adjusted.model.taken
    assert adjusted.figures["sigma_px"] < 0.4
    assert [w.code for w in adjusted.warnings if "vibrating" in w.text] == ["model-chosen"]


def test_residuals_of_vibration_differ_from_noise_and_slow_turns() -> None:
    camera = Camera("a", 800, 600, 700.0, 400.0, 300.0)
    rng = np.random.default_rng(7)
    frame = np.repeat(np.arange(5), 400)
    image_px = rng.uniform((0, 0), (800, 600), (len(frame), 2))
    noise = rng.normal(0.0, 0.3, image_px.shape)
    rows = image_px[:, 1] / 600.0
    fast, slow = np.sin(2.0 * np.pi * 2.5 * rows + frame), np.sin(np.pi * rows + frame)
    image = ImageResiduals(frame, image_px, noise, np.ones(len(frame)))
    left = [
        left_by_vibration(replace(image, residual_px=noise + 0.5 * wave[:, None] * [1.0, 0.0]), [camera] * 5)
        for wave in (np.zeros(len(frame)), slow, fast)
    ]
    assert 0.98 < left[0] < 1.02 and 0.98 < left[1] < 1.02
    assert 0.75 < left[2] < 0.85
    assert left_by_vibration(replace(image, weight=np.zeros(len(frame))), [camera] * 5) == 1.0
