"""Inputs changed under a run's hands: other pixels, digits, masks; files removed."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from random import Random

import cv2
import numpy as np
import rasterio

LATER = "later"
"""Where frames lie that are to come."""


def _kept_time(path: Path, keep: bool, write: Callable[[], object]) -> None:
    """Writes; if asked, the time of change is put back."""
    before = path.stat()
    write()
    if keep:
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def _other_digit(path: Path, mark: str, rng: Random, keep: bool) -> None:
    """Another digit in the same place of a number in a text file, its size kept."""
    text = path.read_text()
    start = text.index(mark) + len(mark)
    at = start + rng.choice([i for i, c in enumerate(text[start : start + 40]) if c.isdigit()][-3:])
    digit = rng.choice([d for d in "0123456789" if d != text[at]])
    _kept_time(path, keep, lambda: path.write_text(text[:at] + digit + text[at + 1 :]))


def _inverted_jpeg(path: Path, keep: bool) -> None:
    """The image inverted, its tags kept; also its size, if asked, by bytes behind its end."""
    old = path.read_bytes()
    image = 255 - cv2.imdecode(np.frombuffer(old, np.uint8), cv2.IMREAD_COLOR)
    for quality in range(92, 20, -4):
        new = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        at = old.index(b"\xff\xdb")
        whole = old[:at] + new[new.index(b"\xff\xdb") :]
        if not keep or len(whole) <= len(old):
            break
    whole += bytes(max(0, len(old) - len(whole))) if keep else b""
    _kept_time(path, keep, lambda: path.write_bytes(whole))


def _mask(path: Path) -> None:
    image = np.full((240, 320), 255, np.uint8)
    image[100:140, 120:200] = 0
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())


def _darker_strip(path: Path, keep: bool) -> None:
    def write() -> None:
        with rasterio.open(path, "r+") as file:
            pixels = file.read()
            pixels[:, 300:340] = pixels[:, 300:340] * 0.8
            file.write(pixels)

    _kept_time(path, keep, write)


def change(inputs: Path, name: str, rng: Random) -> str:
    """Changes an input as `name` says: what was done, the same words for the same change."""
    keep = rng.random() < 0.5
    reported = f"{name}{', time kept' if keep else ''}"
    match name:
        case "pixels":
            frame = rng.choice(sorted((inputs / "frames").glob("*.jpg")))
            _inverted_jpeg(frame, keep)
            return f"{reported} {frame.name}"
        case "positions":
            _other_digit(inputs / "pos.csv", rng.choice(("F0001.jpg,11.29", "F0002.jpg,11.29")), rng, keep)
        case "camera":
            _other_digit(inputs / "cameras.json", '"focal_x": 1.5', rng, keep)
        case "mask":
            frame = rng.choice(sorted((inputs / "frames").glob("*.jpg")))
            _mask(frame.with_name(f"{frame.stem}_mask.png"))
            return f"{name} {frame.name}"
        case "strip":
            strip = rng.choice(sorted(inputs.glob("ccd*.tif")))
            _darker_strip(strip, keep)
            return f"{reported} {strip.name}"
        case "attitude":
            lines = (inputs / "model_attitude.csv").read_text().splitlines()
            _other_digit(inputs / "model_attitude.csv", lines[len(lines) // 2][:8], rng, keep)
        case "geometry":
            text = (inputs / "geometry.yaml").read_text()
            new = text.replace("ground_pixel_m: 2.0", "ground_pixel_m: 2.1")
            _kept_time(inputs / "geometry.yaml", keep, lambda: (inputs / "geometry.yaml").write_text(new))
        case "added":
            for file in sorted((inputs / LATER).glob("*.jpg")):
                file.rename(inputs / "frames" / file.name)
            rows = inputs / LATER / "rows.csv"
            if rows.exists():
                with (inputs / "pos.csv").open("a") as pos:
                    pos.write(rows.read_text())
                rows.unlink()
        case "vanished":
            gone = rng.choice(sorted((inputs / "frames").glob("*.jpg")))
            gone.rename(inputs / gone.name)
            return f"{name} {gone.name}"
        case "removed":
            files = sorted([*inputs.glob("frames/*.jpg"), *inputs.glob("ccd*.tif"), *inputs.glob("pos.csv")])
            gone = rng.choice(files)
            gone.unlink()
            return f"{name} {gone.name}"
    return reported


def put_back(inputs: Path) -> None:
    """Frames that vanished are there again, as they were."""
    for path in inputs.glob("*.jpg"):
        path.rename(inputs / "frames" / path.name)


def hold_back(inputs: Path) -> None:
    """The last two frames and their rows come later, if at all."""
    (inputs / LATER).mkdir()
    names = sorted(path.name for path in (inputs / "frames").glob("*.jpg"))[-2:]
    for name in names:
        (inputs / "frames" / name).rename(inputs / LATER / name)
    lines = (inputs / "pos.csv").read_text().splitlines(keepends=True)
    later = [line for line in lines if line.startswith(tuple(names))]
    (inputs / LATER / "rows.csv").write_text("".join(later))
    (inputs / "pos.csv").write_text("".join(line for line in lines if line not in later))


CHANGES = {
    "frames": ("pixels", "pixels", "positions", "camera", "mask", "removed", "added", "added"),
    "flight": ("pixels", "removed", "added"),
    "strips": ("strip", "attitude", "geometry", "removed"),
}
