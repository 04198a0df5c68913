"""How far frames of a video are apart, and which is taken."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from video_scenes import HEIGHT, WIDTH, numbers_of, write_video

from geomosaic.cli.main import main

LOOKS_PER_S = 6
"""As many as the images of the videos here: each image is looked at."""


def _taken(video: Path, overlap: float = 0.75) -> list[int]:
    folder = video.with_name("frames")
    assert main(["frames", str(video), "-o", str(folder), "--overlap", str(overlap), "-q"]) == 0
    return numbers_of(folder)


@pytest.mark.parametrize("per_look", [0.012, 0.05, 0.14, 0.35], ids=["slow", "usual", "fast", "fastest"])
@pytest.mark.parametrize("overlap", [0.3, 0.5, 0.6, 0.75])
def test_frames_overlap_as_asked(tmp_path: Path, overlap: float, per_look: float) -> None:
    """Shares of the width; a step ends at a look, so it is off by half of the motion between two."""
    moved_px = WIDTH * np.arange(0.0, 4.3, per_look)
    write_video(tmp_path / "a.mp4", moved_px, rate=LOOKS_PER_S)
    steps = np.diff(moved_px[_taken(tmp_path / "a.mp4", overlap)])[:-1] / WIDTH
    asked = 1.0 - overlap
    nearest = max(round(asked / per_look), 1) * per_look
    assert len(steps) >= 3
    np.testing.assert_allclose(steps, nearest, atol=0.04 * asked)


def test_frames_overlap_as_asked_along_a_diagonal(tmp_path: Path) -> None:
    """0.1 of the width and of the height a look: after 3 looks 0.7 * 0.7 = 0.49 of the image is shown again."""
    looks = np.arange(15)
    write_video(tmp_path / "a.mp4", np.column_stack([48.0 * looks, 36.0 * looks]), rate=LOOKS_PER_S)
    assert _taken(tmp_path / "a.mp4", 0.49) == [0, 3, 6, 9, 12, 14]


def _with_a_stop(looks: int) -> np.ndarray:
    """A step of a quarter of the width, a stop there, and three quarters more."""
    per_look = 0.025 * WIDTH
    return np.concatenate(
        [np.arange(10) * per_look, np.full(looks, 10 * per_look), np.arange(10, 40) * per_look]
    )


def test_memory_does_not_grow_while_the_drone_hovers(tmp_path: Path) -> None:
    """Of 300 looks of 300 kB each, a few are in memory at once. The only sharp one of them is taken."""
    sharp = 180
    blurred = [n for n in range(1, 340) if n != sharp]
    write_video(tmp_path / "a.mp4", _with_a_stop(300), blurred, rate=LOOKS_PER_S)
    tracemalloc.start()
    try:
        taken = _taken(tmp_path / "a.mp4")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 25e6
    assert taken[:2] == [0, sharp]


def test_a_damaged_image_is_not_taken(tmp_path: Path) -> None:
    """Noise is sharper than all else, and shows nothing of the ground."""
    moved_px = 0.025 * WIDTH * np.arange(60)
    write_video(tmp_path / "a.mp4", moved_px, rate=LOOKS_PER_S, damaged=24)
    taken = _taken(tmp_path / "a.mp4")
    assert 24 not in taken
    assert np.diff(moved_px[taken]).max() <= 0.3 * WIDTH


def test_frames_go_on_after_a_cut(tmp_path: Path) -> None:
    """From one ground to another that shows nothing alike, a tenth of the width after the first frame."""
    one, other = tmp_path / "one.mp4", tmp_path / "other.mp4"
    write_video(one, 0.05 * WIDTH * np.arange(3), rate=LOOKS_PER_S)
    write_video(other, 1200.0 + 0.05 * WIDTH * np.arange(20), rate=LOOKS_PER_S)
    joined = cv2.VideoWriter(
        str(tmp_path / "a.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), LOOKS_PER_S, (WIDTH, HEIGHT)
    )
    for path in (one, other):
        reader = cv2.VideoCapture(str(path))
        while (read := reader.read())[0]:
            joined.write(read[1])
    joined.release()
    assert _taken(tmp_path / "a.mp4")[:4] == [0, 3, 8, 13]
