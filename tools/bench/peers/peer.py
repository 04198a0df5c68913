"""Other programs that make a mosaic of a folder of frames, all called in one way."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tools.bench.peers.environments import environment

Command = list[str | Path]
PYORTHOMOSAIC = "pyOrthomosaic==0.9.3"
STITCHING = "stitching==0.7.0"


@dataclass(frozen=True)
class Peer:
    """name: with its version where that is fixed. georeferenced: whether its mosaic says where it lies.

    command: what makes a mosaic of the frames' folder in an empty folder, given a folder for its environment
    (raises `UnavailableError`). mosaic: where it then lies in that folder. frames_used: read from it.
    """

    name: str
    georeferenced: bool
    command: Callable[[Path, Path, Path], Command]
    mosaic: str
    frames_used: Callable[[Path], int]


def _two_dimensions(frames: Path, out: Path, home: Path) -> Command:
    programs = environment(home / "pyorthomosaic", PYORTHOMOSAIC)
    return [programs / "orthomosaic", frames, "-o", out / "mosaic.tif", "--no-preview"]


def _three_dimensions(frames: Path, out: Path, home: Path) -> Command:
    programs = environment(home / "pyorthomosaic", PYORTHOMOSAIC)
    return [programs / "orthomosaic-3d", frames, "-o", out]


def _scans(frames: Path, out: Path, home: Path) -> Command:
    return [sys.executable, Path(__file__).with_name("opencv_scans.py"), frames, out]


def _affine(frames: Path, out: Path, home: Path) -> Command:
    programs = environment(home / "stitching", STITCHING)
    return [programs / "python", Path(__file__).with_name("stitching_affine.py"), frames, out]


def _counted(file: str) -> Callable[[Path], int]:
    return lambda out: int(json.loads((out / file).read_text())["images_used"])


PEERS = (
    Peer("pyOrthomosaic 0.9.3, 2D", True, _two_dimensions, "mosaic.tif", _counted("mosaic_report.json")),
    Peer("pyOrthomosaic 0.9.3, 3D", True, _three_dimensions, "orthophoto.tif", _counted("report.json")),
    Peer("OpenCV Stitcher, SCANS", False, _scans, "mosaic.tif", _counted("report.json")),
    Peer("stitching 0.7.0, affine", False, _affine, "mosaic.tif", _counted("report.json")),
)
