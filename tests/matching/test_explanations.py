"""Causes of headings that don't fit: wrong tags, turned images, both; and how probable each is."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from geomosaic.cli.main import main
from geomosaic.matching.explanations import (
    WRONG,
    HeadingEvidence,
    explained,
    placed_by_pairs,
    usual_angle,
    wrong_positions,
)

Floats = NDArray[np.float64]
COURSE = np.repeat([30.0, 210.0, 30.0, 210.0], 5)
HALF, ALL = (True, False, True, False), (True,) * 4
STAGES = (
    "survey.read", "matching.flying_height", "projection.ground", "placement.pos", "mosaic.estimate",
    "matching.sift", "adjustment.solve",
)  # fmt: skip


def shares(
    tag_deg: Floats, image_deg: Floats, course_deg: Floats = COURSE, possible: tuple[bool, ...] = HALF
) -> Floats:
    """Probabilities (n, 8) by tags, images and courses."""
    n = len(tag_deg)
    angles = (np.radians(v) for v in (tag_deg, image_deg, course_deg, np.full(n, 3.0)))
    tags, images, courses, sd = angles
    return explained(HeadingEvidence(tags, images, courses, sd, np.tile(possible, (n, 1)))).reshape(n, 8)


def flown(seed: int = 0, mount_deg: float = 0.0) -> tuple[Floats, Floats]:
    """Tags and images of a survey without faults."""
    rng = np.random.default_rng(seed)
    heading = COURSE + mount_deg + rng.normal(0.0, 3.0, 20)
    return heading + rng.normal(0.0, 1.5, 20), heading


@pytest.mark.parametrize("mount_deg", [0.0, 90.0, 180.0])
def test_each_fault_has_its_own_explanation(mount_deg: float) -> None:
    """Turned; kept from the line before; off by 141 degrees; both."""
    tag, image = flown(1, mount_deg)
    image[3] -= 180.0
    tag[6] = tag[4]
    tag[11] += 141.0
    image[17] -= 180.0
    tag[17] += 100.0
    found = shares(tag, image)
    best = found.argmax(axis=1)
    assert {int(i): int(best[i]) for i in np.flatnonzero(best)} == {3: 2, 6: WRONG, 11: WRONG, 17: WRONG + 2}
    assert found.sum(axis=1) == pytest.approx(np.ones(20))
    assert found[6, WRONG] > 0.99 and found[11, WRONG] > 0.99


def test_a_whole_line_of_wrong_headings_is_no_line_of_turned_images() -> None:
    for fault in ("tag", "image"):
        tag, image = flown(2)
        (tag if fault == "tag" else image)[5:10] -= 180.0
        best = shares(tag, image).argmax(axis=1)
        assert best.tolist() == [0] * 5 + [WRONG if fault == "tag" else 2] * 5 + [0] * 10


@pytest.mark.parametrize("kept", [False, True])
@pytest.mark.parametrize("seed", range(10))
def test_a_line_turned_and_a_line_of_kept_headings_are_distinguished_by_rough_courses(
    kept: bool, seed: int
) -> None:
    """Positions good to 1.5 m every 20 m: all images lie the same way, or all tags, as if nobody had turned."""
    rng = np.random.default_rng(seed)
    course = np.repeat([30.0, 210.0, 30.0], 8)
    image = course + rng.normal(0.0, 2.0, 24)
    tag = image + rng.normal(0.0, 1.0, 24)
    line = np.s_[8:16]
    if kept:
        tag[line] = tag[7] + rng.normal(0.0, 1e-4, 8)  # from each place's north to the map's
    else:
        image[line] -= 180.0
    best = shares(tag, image, course + rng.normal(0.0, 6.0, 24)).argmax(axis=1)
    assert best.tolist() == [0] * 8 + [WRONG if kept else 2] * 8 + [0] * 8


def test_quarter_turns_are_found_where_an_image_can_have_had_them() -> None:
    tag, image = flown(3)
    image[4] -= 90.0
    assert shares(tag, image, possible=ALL).argmax(axis=1)[4] == 1
    assert shares(tag, image).argmax(axis=1)[4] == WRONG


def test_without_courses_half_a_turn_has_no_sure_explanation() -> None:
    """A tag kept from the line before and a turned image look alike; any other angle is a wrong tag."""
    tag, image = flown(4)
    image[3] -= 180.0
    tag[6] += 120.0
    found = shares(tag, image, np.full(20, np.nan))
    assert found[3].argmax() in (2, WRONG) and found[3].max() < 0.99
    assert found[6].argmax() == WRONG and found[6].max() > 0.8


def test_a_survey_under_one_heading_is_no_survey_of_turned_images() -> None:
    """A platform that flies every second line backward."""
    rng = np.random.default_rng(5)
    image = 30.0 + rng.normal(0.0, 3.0, 20)
    tag = image + rng.normal(0.0, 1.5, 20)
    image[7] -= 180.0
    best = shares(tag, image).argmax(axis=1)
    assert best.tolist() == [2 if i == 7 else 0 for i in range(20)]


def test_frames_without_a_tag_or_an_image_heading_are_not_explained() -> None:
    tag, image = flown(6)
    tag[2], image[9] = np.nan, np.nan
    found = shares(tag, image)
    assert found[2, 0] == found[9, 0] == 1.0
    nothing = np.full(20, np.nan)
    assert (shares(nothing, nothing)[:, 0] == 1.0).all()


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10_000))
def test_headings_without_faults_have_none(seed: int) -> None:
    tag, image = flown(seed)
    assert shares(tag, image).argmax(axis=1).tolist() == [0] * 20


def test_of_explanations_called_sure_99_percent_are_right() -> None:
    """60 surveys of 20 frames; strays, wrong headings and turned images at rates drawn for each."""
    sure = right = named = 0
    rng = np.random.default_rng(7)
    for _ in range(60):
        tag, image = flown(int(rng.integers(1 << 30)))
        stray, wrong, turned = (rng.random(20) < rng.choice([0.0, 0.05, most]) for most in (0.1, 0.4, 0.15))
        away = np.where(stray, rng.uniform(0.0, 360.0, 20), 0.0)
        tag = tag + away + np.where(wrong, rng.uniform(30.0, 330.0, 20), 0.0)
        image = image + away - np.where(turned, 180.0, 0.0)
        found = shares(tag, image)
        best, truth = found.argmax(axis=1), WRONG * wrong + 2 * turned
        called = (best > 0) & (found.max(axis=1) >= 0.99)
        sure += int(called.sum())
        right += int((called & (best == truth)).sum())
        named += int((best > 0).sum())
    assert named > 200 and sure > 0.5 * named
    assert right >= 0.99 * sure


def test_a_position_is_wrong_far_outside_the_scatter_of_the_others() -> None:
    off_m = np.array([1.0, 2.0, 0.5, 3.0, np.nan, 60.0, 9.0])
    found = wrong_positions(off_m, np.full(7, 1.5), 200.0)
    assert found[5] > 0.999 and found[4] == 0.0 and (found[:4] < 0.05).all()
    assert wrong_positions(off_m, np.full(7, 15.0), 200.0)[5] < 0.99, "of a position known to 15 m"
    assert (wrong_positions(np.full(3, np.nan), np.ones(3), 200.0) == 0.0).all()


def test_a_frame_on_one_pair_is_never_sure() -> None:
    assert placed_by_pairs(np.array([0.0, 1.0, 2.0, 9.0])) == pytest.approx(
        [0.0, 0.98, 0.9996, 1.0], abs=1e-6
    )


def test_the_usual_angle_is_that_of_most() -> None:
    angles = np.radians([359.0, 1.0, 2.0, 3.0, 100.0, 180.0, 181.0, 250.0])
    assert np.degrees(usual_angle(angles)) % 360.0 == pytest.approx(1.5, abs=0.1)


@pytest.mark.proof
def test_six_wrong_headings_and_two_turned_images_of_twelve_frames_are_each_named_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of the wrong headings two, off by 141 and 133 degrees, were named as turned images; of the turned images one,
    whose position is wrong too, as a wrong heading."""
    bad = tmp_path / "bad"
    faults = ["--yaw-wrong-share", "0.4", "--gps-outliers", "2", "--turned", "3-4", "--seed", "5"]
    size = ["--width-px", "400", "--height-px", "300", "--workers", "1"]
    assert main(["simulate", "frames", str(bad), *faults, *size]) == 0
    recipe = tmp_path / "adjusted.yaml"
    recipe.write_text("name: adjusted\nstages:\n" + "".join(f"  - {stage}\n" for stage in STAGES))
    run = ["-o", str(bad / "run"), "--workers", "1", "--set", "matching.sift.keypoints=1500"]
    assert main(["run", str(recipe), "--frames", str(bad / "frames"), *run]) == 0
    capsys.readouterr()
    assert main(["inspect", str(bad / "run"), "--worst", "99", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)["worst"]["faults"]
    named = sorted((f["code"], frame) for f in said for frame in f["frames"] if f["probability"] is not None)
    code = {"turned-frame": "frame-turned", "wrong-yaw": "yaw-wrong", "position-outlier": "position-wrong"}
    truth = json.loads((bad / "truth" / "truth.json").read_text())["warnings"]
    assert named == sorted((code[w["code"]], w["frame"]) for w in truth) and len(named) == 9
    for fault in (f for f in said if f["probability"] is not None):
        word = "sure" if fault["probability"] >= 0.99 else "likely"
        assert fault["sure"].startswith(f"{word}: ")
        assert fault["probability"] > 0.5
    warning_list = json.loads((bad / "run" / "run.json").read_text())["warnings"]
    of_frames = [(w["code"], w["frame"]) for w in warning_list if w["code"] in code.values()]
    assert sorted(of_frames) == named
