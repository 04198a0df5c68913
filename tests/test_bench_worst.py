"""How much water the bench of named faults says that frames see."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from quality_images import write_tif

TOOLS = Path(__file__).parents[1] / "tools"
sys.path.insert(0, str(TOOLS))

from bench_worst import water_seen  # noqa: E402


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
