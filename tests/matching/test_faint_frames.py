"""Frames of little contrast: they tie as others do, whatever their type; what can't tie says why."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_surveys import geomosaic, small_survey, summary

from geomosaic.matching.contrast import faint_tiles, noise_sd, raised
from geomosaic.matching.match import PairMatch
from geomosaic.matching.untied import untied_reasons
from geomosaic_simulate.survey import SimulatedSurvey

STAGES = ("survey.read", "matching.flying_height", "projection.ground", "placement.pos", "matching.sift")


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    """Two lines of three frames."""
    return small_survey(tmp_path_factory.mktemp("flown") / "s", frames_per_line=3, pos_in="csv")


@pytest.fixture(scope="module")
def clear(flown: SimulatedSurvey, tmp_path_factory: pytest.TempPathFactory) -> dict[str, object]:
    """The figures of matching the frames as they are."""
    return matched(flown, flown.frames, tmp_path_factory.mktemp("clear") / "run")


def thermal(grey: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What a thermal camera makes of an image: a tenth of the contrast, another gain and level in each frame,
    a dark rim and noise. A few hot places widen the range."""
    rows, cols = grey.shape
    row, col = np.mgrid[-1 : 1 : rows * 1j, -1 : 1 : cols * 1j]
    rim, share = (row**2 + col**2) / 2.0, grey.astype(np.float64) / 255.0
    smooth = cv2.GaussianBlur(share, (0, 0), 8.0)
    hot = np.clip((smooth - np.percentile(smooth, 97.0)) * 15.0, 0.0, 1.0)
    level, gain = rng.uniform(70.0, 120.0), rng.uniform(20.0, 45.0)
    return level + gain * (share - 0.5) - 35.0 * rim + 120.0 * hot + rng.normal(0.0, 0.5, grey.shape)


def folder(flown: SimulatedSurvey, out: Path, kind: str) -> Path:
    """The frames as thermal ones: in 8 bits, in 16 bits, or in degrees as float."""
    out.mkdir()
    rng = np.random.default_rng(7)
    for path in sorted(flown.frames.iterdir()):
        seen = thermal(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), rng)
        if kind == "jpeg":
            whole = np.clip(seen.round(), 0, 255).astype(np.uint8)
            cv2.imwrite(str(out / path.name), whole, [cv2.IMWRITE_JPEG_QUALITY, 95])
        elif kind == "uint16":
            cv2.imwrite(str(out / f"{path.stem}.tif"), (7000.0 + 10.0 * seen).round().astype(np.uint16))
        else:
            cv2.imwrite(str(out / f"{path.stem}.tif"), (seen / 20.0 - 5.0).astype(np.float32))
    return out


def matched(flown: SimulatedSurvey, frames: Path, run: Path) -> dict[str, object]:
    """The figures of matching."""
    recipe = run.with_suffix(".yaml")
    recipe.write_text(json.dumps({"name": "match", "stages": list(STAGES)}), encoding="utf-8")
    given = ("--set", f"survey.read.pos={flown.pos}", "--set", f"survey.read.camera={flown.camera}")
    assert geomosaic("run", recipe, frames, "-o", run, "--workers", 1, *given) == 0
    return summary(run)["metrics"]["matching"]  # type: ignore[no-any-return]


@pytest.mark.proof
@pytest.mark.parametrize("kind", ["jpeg", "uint16", "float32"])
def test_thermal_frames_tie_as_ordinary_ones_do(
    flown: SimulatedSurvey, clear: dict[str, object], tmp_path: Path, kind: str
) -> None:
    faint = matched(flown, folder(flown, tmp_path / kind, kind), tmp_path / "run")
    assert (clear["faint_frames"], faint["faint_frames"]) == (0, 6)
    assert faint["pairs_tied"] == clear["pairs_tied"]
    assert faint["tie_points"] >= 0.4 * clear["tie_points"]  # type: ignore[operator]


def textured(seed: int = 3) -> np.ndarray:
    """An 8 bit image with something to see at every scale."""
    rng = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(rng.standard_normal((480, 640)), (0, 0), s) for s in (1.5, 3.0, 6.0, 12.0)]
    out = sum(layer / layer.std() for layer in layers)
    return np.clip(128.0 + 20.0 * out, 0, 255).astype(np.uint8)


def test_an_image_that_is_not_faint_stays_as_it_is() -> None:
    image = textured()
    out, share = raised(image, None, 640)
    assert out is image and share == 0.0


def test_a_faint_half_is_raised_and_the_other_half_stays() -> None:
    image = textured()
    image[:, :320] = (100.0 + 0.05 * (image[:, :320].astype(np.float64) - 128.0)).round()
    assert faint_tiles(image, None, 1.0).tolist() == [[True, True, False, False]] * 4
    out, share = raised(image, None, 640)
    assert share == 0.5
    assert np.array_equal(out[:, 400:], image[:, 400:])
    assert image[:, :240].std() < 3.0 and 10.0 < out[:, :240].std() < 60.0


def test_invalid_pixels_are_not_judged_and_do_not_enter_the_local_mean() -> None:
    image = (100.0 + 0.05 * (textured().astype(np.float64) - 128.0)).round().astype(np.uint8)
    valid = np.full(image.shape, 255, np.uint8)
    valid[:, 500:] = 0
    image[:, 500:] = 255
    alone, _ = raised(np.ascontiguousarray(image[:, :500]), None, 640)
    out, _ = raised(image, valid, 640)
    assert abs(float(out[:, 440:490].mean()) - float(alone[:, 440:490].mean())) < 10.0


def test_noise_is_measured_in_spite_of_texture_and_is_not_raised_without_end() -> None:
    rng = np.random.default_rng(1)
    flat = np.full((480, 640), 100.0)
    noisy = (flat + rng.normal(0.0, 2.0, flat.shape)).round().astype(np.uint8)
    assert noise_sd(noisy, None) == pytest.approx(2.0, rel=0.05)
    assert raised(noisy, None, 640)[0].std() < 5.0
    assert raised(flat.astype(np.uint8), None, 640)[0].std() == 0.0


def test_a_frame_without_ties_says_why() -> None:
    none, some = np.zeros(0, np.int32), np.zeros(20, np.int32)
    looks = {
        (0, 1): PairMatch(some, some, False, (900, 800), 30, 20),
        (0, 2): PairMatch(none, none, False, (900, 14), 0, 0),
        (1, 3): PairMatch(none, none, False, (800, 700), 40, 9),
        (0, 3): PairMatch(none, none, False, (900, 700), 5, 0),
        (1, 5): PairMatch(none, none, False, (800, 300), 6, 0),
    }
    reasons = dict(untied_reasons(looks, [900, 800, 14, 700, 650, 300], [0, 0, 1, 0, 0, 0.75], 16))
    assert reasons == {
        2: "only 14 keypoints: its image has little contrast",
        3: "compared with 2 frames that may overlap, too few agree: 9 of 40, 16 are needed",
        4: "no other frame overlaps it or looks like it",
        5: "compared with 1 frame that may overlap, too few look alike: 6, 16 are needed; 300 keypoints, its "
        "image has little contrast",
    }
