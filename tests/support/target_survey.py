"""A simulated survey whose surveyed points bear targets of four quadrants, and where each frame shows them."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from small_surveys import small_survey

HALF_PX = 10


@dataclass(frozen=True)
class TargetSurvey:
    """frames, and the run's inputs for them; rover: points without marks; truth: col and row by point and frame."""

    frames: Path
    camera: Path
    rover: Path
    truth: dict[str, dict[str, tuple[float, float]]]


def target_survey(out: Path, **plan: Any) -> TargetSurvey:
    """Eight frames with six points, unless more are asked for, each with a painted target."""
    survey = small_survey(out, **{"control_points": 6, "pos_in": "exif", **plan})
    assert survey.true_control and survey.control
    truth: dict[str, dict[str, tuple[float, float]]] = {}
    with survey.true_control.open(newline="") as file:
        for row in csv.DictReader(file):
            truth.setdefault(row["name"], {})[row["frame"]] = float(row["col"]), float(row["row"])
    for path in sorted(survey.frames.glob("*.jpg")):
        marks = [at[path.name] for at in truth.values() if path.name in at]
        if marks:
            path.write_bytes(painted(path.read_bytes(), marks))
    with survey.control.open(newline="") as file:
        points = {row["name"]: row for row in csv.DictReader(file)}
    rover = out / "rover.csv"
    head = ["name", "lon_deg", "lat_deg", "height_ellipsoidal_m"]
    rover.write_text(
        "\n".join([",".join(head), *(",".join(p[h] for h in head) for p in points.values()), ""])
    )
    return TargetSurvey(survey.frames, survey.camera, rover, truth)


def painted(jpeg: bytes, marks: list[tuple[float, float]]) -> bytes:
    """A JPEG with targets at these places (col, row) and its own tags."""
    pixels = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    for col, row in marks:
        with_target(pixels, col, row)
    new = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    return b"\xff\xd8" + tags(jpeg) + new[2:]


def with_target(pixels: np.ndarray, col: float, row: float) -> None:
    """Paints a target onto pixels (rows, cols, bands) whose centre lies at col and row."""
    left, top = int(col) - HALF_PX, int(row) - HALF_PX
    x, y = (
        np.clip(np.arange(2 * HALF_PX + 1) + first + 1.0 - at, 0.0, 1.0)
        for first, at in ((left, col), (top, row))
    )
    white = y[:, None] * x + (1.0 - y)[:, None] * (1.0 - x)
    target = cv2.GaussianBlur(20.0 + 215.0 * white, (0, 0), 0.7)
    rows, cols = (slice(max(at, 0), at + len(x)) for at in (top, left))
    there = pixels[rows, cols]
    skip_y, skip_x = max(-top, 0), max(-left, 0)
    there[:] = target[skip_y : skip_y + there.shape[0], skip_x : skip_x + there.shape[1], None].round()


def tags(jpeg: bytes) -> bytes:
    """The segments of applications (APP1 and following) at the head of a JPEG."""
    at, out = 2, b""
    while jpeg[at] == 0xFF and (0xE0 <= jpeg[at + 1] <= 0xEF or jpeg[at + 1] == 0xFE):
        end = at + 2 + int.from_bytes(jpeg[at + 2 : at + 4], "big")
        out += jpeg[at:end] if jpeg[at + 1] != 0xE0 else b""
        at = end
    return out
