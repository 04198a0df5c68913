"""The world of a chaos trial: inputs that can be changed, a disk that can be full, runs that can be hit."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from random import Random
from typing import Any

import cv2
import numpy as np
import rasterio

DISK_MB = 256
LONGEST_S = 180.0
_VOLATILE = ("timings_s", "peak_memory_mb", "cached_stages", "recorded_stages", "versions")
"""What run.json says of the clock and the way, not of the result."""


@dataclass(frozen=True)
class Ended:
    """How a run ended: exit code (a signal negative), its words, seconds from the blow to the end."""

    code: int
    err: str
    seconds: float
    hung: bool
    orphans: int

    @property
    def last(self) -> str:
        return (self.err.strip().splitlines() or [""])[-1]


class Running:
    """A command of geomosaic in a session of its own."""

    def __init__(self, argv: list[str], log: Path) -> None:
        self.log = log
        with log.open("wb") as out:
            program = str(Path(sys.executable).with_name("geomosaic"))
            self.process = subprocess.Popen(
                [program, *argv], stdin=subprocess.DEVNULL, stdout=out, stderr=out, start_new_session=True
            )

    def wait(self, seconds: float) -> bool:
        """Whether it ended within so long."""
        try:
            self.process.wait(max(seconds, 0.0))
        except subprocess.TimeoutExpired:
            return False
        return True

    def children(self) -> list[int]:
        """Its worker processes."""
        return [pid for pid, parent, _ in processes() if parent == self.process.pid]

    def end(self, struck: float) -> Ended:
        """Waits for the end; a run that has none is ended."""
        hung = not self.wait(LONGEST_S)
        seconds = time.monotonic() - struck
        deadline = time.monotonic() + 5.0
        while (left := self._left()) and time.monotonic() < deadline:
            time.sleep(0.05)
        for pid in (*left, *([self.process.pid] if hung else [])):
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                continue
        code = self.process.wait()
        return Ended(code, self.log.read_bytes().decode(errors="replace"), seconds, hung, len(left))

    def _left(self) -> list[int]:
        """What lives on of its session after it."""
        return [p for p, _, session in processes() if session == self.process.pid and p != self.process.pid]


def processes() -> Iterator[tuple[int, int, int]]:
    """(id, parent, session) of the living processes of this machine."""
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                words = (folder / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if words[0] != "Z":
                yield int(folder.name), int(words[1]), int(words[3])


class Disk:
    """The run folder's disk: a small file system of its own where that is allowed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True)
        options = ["-t", "tmpfs", "-o", f"size={DISK_MB}m", "tmpfs", str(folder)]
        self.own = (
            os.geteuid() == 0 and subprocess.run(["mount", *options], capture_output=True).returncode == 0
        )

    def used_kb(self) -> int:
        told = os.statvfs(self.folder)
        return (told.f_blocks - told.f_bfree) * told.f_frsize // 1024

    def resize(self, kb: int) -> None:
        subprocess.run(["mount", "-o", f"remount,size={kb}k", str(self.folder)], check=True)

    def large(self) -> None:
        if self.own:
            self.resize(DISK_MB * 1024)

    def clear(self) -> None:
        self.large()
        for path in self.folder.iterdir():
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()

    def close(self) -> None:
        if self.own:
            subprocess.run(["umount", str(self.folder)], check=True)


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
    """The picture inverted, its tags kept; also its size, if asked, by bytes behind its end."""
    old = path.read_bytes()
    picture = 255 - cv2.imdecode(np.frombuffer(old, np.uint8), cv2.IMREAD_COLOR)
    for quality in range(92, 20, -4):
        new = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        at = old.index(b"\xff\xdb")
        whole = old[:at] + new[new.index(b"\xff\xdb") :]
        if not keep or len(whole) <= len(old):
            break
    whole += bytes(max(0, len(old) - len(whole))) if keep else b""
    _kept_time(path, keep, lambda: path.write_bytes(whole))


def _mask(path: Path) -> None:
    picture = np.full((240, 320), 255, np.uint8)
    picture[100:140, 120:200] = 0
    path.write_bytes(cv2.imencode(".png", picture)[1].tobytes())


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
    told = f"{name}{', time kept' if keep else ''}"
    match name:
        case "pixels":
            frame = rng.choice(sorted((inputs / "frames").glob("*.jpg")))
            _inverted_jpeg(frame, keep)
            return f"{told} {frame.name}"
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
            return f"{told} {strip.name}"
        case "attitude":
            lines = (inputs / "model_attitude.csv").read_text().splitlines()
            _other_digit(inputs / "model_attitude.csv", lines[len(lines) // 2][:8], rng, keep)
        case "geometry":
            text = (inputs / "geometry.yaml").read_text()
            new = text.replace("ground_pixel_m: 2.0", "ground_pixel_m: 2.1")
            _kept_time(inputs / "geometry.yaml", keep, lambda: (inputs / "geometry.yaml").write_text(new))
        case "removed":
            files = sorted([*inputs.glob("frames/*.jpg"), *inputs.glob("ccd*.tif"), *inputs.glob("pos.csv")])
            gone = rng.choice(files)
            gone.unlink()
            return f"{name} {gone.name}"
    return told


CHANGES = {
    "frames": ("pixels", "pixels", "positions", "camera", "mask", "removed"),
    "strips": ("strip", "attitude", "geometry", "removed"),
}


def result_of(run: Path) -> dict[str, str]:
    """Fingerprints of what a run's result is, by name; what is missing is not there."""
    found: dict[str, str] = {}
    for name in ("positions.csv", "offsets.csv", "mosaic_RPC.TXT"):
        if (run / name).exists():
            found[name] = _hash((run / name).read_bytes())
    if (run / "mosaic.tif").exists():
        with rasterio.open(run / "mosaic.tif") as file:
            found["mosaic.tif"] = _hash(file.read().tobytes() + f"{file.crs} {file.transform}".encode())
    if (run / "layers.gpkg").exists():
        found["layers.gpkg"] = _hash(json.dumps(_tables(run / "layers.gpkg"), default=repr).encode())
    if (run / "run.json").exists():
        told = json.loads((run / "run.json").read_text())
        for name, value in told.items():
            if name not in _VOLATILE:
                found[f"run.json {name}"] = _hash(json.dumps(value, sort_keys=True).encode())
    return found


def _hash(data: bytes) -> str:
    return blake2b(data, digest_size=16).hexdigest()


def _tables(path: Path) -> dict[str, list[Any]]:
    """All rows of a GeoPackage but the time of its last change."""
    with sqlite3.connect(f"file:{path}?mode=ro", uri=True) as file:
        names = [
            r[0] for r in file.execute("select name from sqlite_master where type = 'table' order by name")
        ]
        names = [n for n in names if not n.startswith(("rtree_", "sqlite_", "gpkg_"))]
        return {n: [list(row) for row in file.execute(f'select * from "{n}"')] for n in names}
