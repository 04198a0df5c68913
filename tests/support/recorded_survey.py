"""A small survey with known faults, mosaicked once for all tests that ask its recording."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from made_once import made_once

from geomosaic.cli.main import main

PLANTED = {
    "wrong-yaw": "yaw-wrong",
    "position-outlier": "position-wrong",
    "turned-frame": "frame-turned",
}
"""How the simulation names its faults, and how they are named in the recording."""


_FLOWN = {
    "--lines": 3, "--frames-per-line": 4, "--side-overlap": 0.6, "--width-px": 400, "--height-px": 300,
    "--gps-outliers": 1, "--gps-outlier-m": 60, "--yaw-wrong-share": 0.1, "--turned": "9", "--seed": 4,
    "--workers": 1,
}  # fmt: skip


def bad_survey(folders: pytest.TempPathFactory) -> Path:
    """Its folder: frames, truth, and the run; not to be changed."""
    return made_once(folders, "bad-survey", _made)


def _made(survey: Path) -> Path:
    words = [str(word) for pair in _FLOWN.items() for word in pair]
    assert main(["simulate", "frames", str(survey), *words]) == 0
    run = ["-o", str(survey / "run"), "--workers", "1", "--set", "matching.sift.keypoints=1200"]
    assert main(["mosaic", str(survey / "frames"), *run]) == 0
    return survey


def planted(survey: Path) -> list[tuple[str, str]]:
    """The faults that were simulated: code and frame."""
    truth: dict[str, Any] = json.loads((survey / "truth" / "truth.json").read_text())
    return sorted((PLANTED[w["code"]], w["frame"]) for w in truth["warnings"])
