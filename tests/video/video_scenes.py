"""Small videos of a window that moves over a texture, and subtitles with positions."""

from __future__ import annotations

import csv
from collections.abc import Collection
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT, RATE = 480, 360, 30
M_PER_DEG = 111_320.0 * np.cos(np.radians(48.0))


def texture(seed: int = 4) -> np.ndarray:
    rng = np.random.default_rng(seed)
    out = np.zeros((900, 2600, 3), np.float32)
    for size in (4, 16, 64):
        noise = rng.normal(0.0, 22.0, (900 // size + 2, 2600 // size + 2, 3)).astype(np.float32)
        out += cv2.resize(noise, (2600, 900), interpolation=cv2.INTER_CUBIC)
    return np.clip(out + 120.0, 0, 255).astype(np.uint8)


def window_at(ground: np.ndarray, right_px: float, down_px: float = 0.0) -> np.ndarray:
    right, down = round(right_px), round(down_px)
    return np.ascontiguousarray(ground[down : down + HEIGHT, right : right + WIDTH])


def write_video(
    path: Path, moved_px: np.ndarray, blurred: Collection[int] = (), rate: int = RATE, damaged: int = -1
) -> None:
    """moved_px: (n,) to the right, or (n, 2) to the right and down. damaged: number of an image of noise."""
    ground, rng = texture(), np.random.default_rng(1)
    at_px = moved_px if moved_px.ndim == 2 else np.column_stack([moved_px, np.full(len(moved_px), 200.0)])
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), rate, (WIDTH, HEIGHT))
    for k, at in enumerate(at_px):
        image = window_at(ground, *at)
        image = cv2.GaussianBlur(image, (0, 0), 3.0) if k in blurred else image
        writer.write(rng.integers(0, 255, image.shape).astype(np.uint8) if k == damaged else image)
    writer.release()


def numbers_of(folder: Path) -> list[int]:
    """Which frames of the video were taken."""
    return sorted(int(p.stem[-6:]) for p in folder.glob("*.jpg"))


def rows_of(folder: Path) -> dict[int, dict[str, str]]:
    """pos.csv by the frames' numbers."""
    with (folder / "pos.csv").open(encoding="utf-8") as file:
        return {int(row["frame"][-10:-4]): row for row in csv.DictReader(file)}


def east_m(rows: dict[int, dict[str, str]]) -> np.ndarray:
    return np.array([(float(row["lon_deg"]) - 11.0) * M_PER_DEG for row in rows.values()])


def words_at(east: float) -> str:
    return f"[latitude: 48.0] [longitude: {11.0 + east / M_PER_DEG:.9f}]"


def write_subtitles(path: Path, times_s: np.ndarray, easts_m: np.ndarray) -> None:
    path.write_text(
        "".join(
            f"1\n00:00:{t:06.3f} --> 00:00:{t + 1.0:06.3f}\n{words_at(east)}\n\n"
            for t, east in zip(times_s, easts_m, strict=True)
        ),
        encoding="utf-8",
    )
