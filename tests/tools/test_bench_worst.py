"""The bench of named faults: how it counts them, and how much water frames see."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from quality_images import write_tif

from tools.bench.bench_worst import calibration, paired, rows, water_seen


@pytest.mark.parametrize(("east_m", "share"), [(100.0, 0.0), (500.0, 1.0), (300.0, 0.5), (-900.0, 0.0)])
def test_water_counts_where_three_frames_see_it(tmp_path: Path, east_m: float, share: float) -> None:
    """The eastern half is water; frames are 100 m wide from 100 m above, two more see water alone."""
    cover = np.zeros((1, 600, 600), np.uint8)
    cover[:, :, 300:] = 1
    write_tif(tmp_path / "cover.tif", cover, 0.0, 600.0, 1.0)
    write_tif(tmp_path / "dem.tif", np.full((1, 600, 600), 40, np.uint8), 0.0, 600.0, 1.0)
    camera = {"width_px": 1000, "height_px": 1000, "focal_length_px": 1000.0}
    (tmp_path / "truth.json").write_text(json.dumps({"camera": camera}))
    rows = [f"{east_m},{200.0},140,{yaw}" for yaw in (0, 90, 180)] + ["450,450,140,30"] * 2
    (tmp_path / "positions.csv").write_text(
        "\n".join(["easting_m,northing_m,height_ellipsoidal_m,yaw_deg", *rows])
    )
    assert water_seen(tmp_path) == pytest.approx(share, abs=0.02)


def test_a_heading_turns_what_is_seen_clockwise(tmp_path: Path) -> None:
    """A frame twice as wide as high, heading northeast, reaches the south-east: only there is water."""
    cover = np.zeros((1, 600, 600), np.uint8)
    cover[:, 300:, 300:] = 1
    write_tif(tmp_path / "cover.tif", cover, 0.0, 600.0, 1.0)
    write_tif(tmp_path / "dem.tif", np.zeros((1, 600, 600), np.uint8), 0.0, 600.0, 1.0)
    camera = {"width_px": 2000, "height_px": 200, "focal_length_px": 1000.0}
    (tmp_path / "truth.json").write_text(json.dumps({"camera": camera}))
    head = "easting_m,northing_m,height_ellipsoidal_m,yaw_deg"
    for yaw_deg, share in ((45, 0.5), (135, 0.05)):
        (tmp_path / "positions.csv").write_text("\n".join([head, *[f"300,300,100,{yaw_deg}"] * 3]))
        assert water_seen(tmp_path) == pytest.approx(share, abs=0.05)


def test_named_faults_are_right_wrong_missed_or_false() -> None:
    """A turned image named as a wrong heading; a position missed; a heading that is not wrong."""
    simulated = [("frame-turned", "A"), ("yaw-wrong", "B"), ("position-wrong", "C"), ("position-wrong", "A")]
    named = [("yaw-wrong", "A", 0.995), ("yaw-wrong", "B", 0.999), ("position-wrong", "A", 1.0)]
    found = paired("one", simulated, [*named, ("yaw-wrong", "D", 0.7)])
    by_code = {row["fault"]: tuple(row.values())[1:] for row in rows(found)}
    assert by_code == {
        "frame-turned": (1, 0, 1, 0, 0),
        "yaw-wrong": (1, 1, 0, 0, 1),
        "position-wrong": (2, 1, 0, 1, 0),
    }
    called = {row["called"]: (row["faults"], row["right"]) for row in calibration(found)}
    assert called == {"sure": (3, 2), "likely": (1, 0), "unsure": (0, 0)}


def test_a_fault_of_heading_and_one_of_position_are_not_taken_for_each_other() -> None:
    found = paired("one", [("position-wrong", "A")], [("yaw-wrong", "A", 0.9)])
    assert [(f.simulated, f.named) for f in found] == [("", "yaw-wrong"), ("position-wrong", "")]
