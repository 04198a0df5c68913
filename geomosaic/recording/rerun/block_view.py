"""The block in 3D in Rerun, in metres of the work frame: cameras as adjusted, tie points, surface."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation as Turn

from geomosaic.arrays import Floats
from geomosaic.recording.file.model import Recording
from geomosaic.recording.rerun.plan_view import ui

BLOCK: Final = "/block"
_COLOURS: Final = {"ties": (230, 190, 60), "surface": (120, 150, 120)}
_CAMERA, _OTHER = (80, 140, 210), (200, 200, 200)
_DEPTH_SHARE: Final = 0.35
"""Of the usual distance between cameras: how far a drawn image lies in front of its camera."""


def draw_block(recording: Recording, stream: Any) -> None:
    """Points of each cloud, and a pyramid for each camera."""
    import rerun

    for name, points in recording.clouds.items():
        shown = rerun.Points3D(points, colors=[_COLOURS.get(name, _OTHER)], radii=ui(1.2))
        stream.log(f"{BLOCK}/{name}", shown, static=True)
    lines = camera_lines(recording)
    if lines:
        cameras = rerun.LineStrips3D(lines, colors=[_CAMERA], radii=ui(0.7))
        stream.log(f"{BLOCK}/cameras", cameras, static=True)


def camera_lines(recording: Recording) -> list[Floats]:
    """A line strip (9, 3) for each camera: its projection centre and its image's corners."""
    names = [name for name in recording.transforms if name in recording.corners]
    centres = np.array([recording.transforms[n][0] for n in names]).reshape(-1, 3)
    extent = np.ptp(centres[:, :2], axis=0) if len(names) else np.zeros(2)
    depth_m = _DEPTH_SHARE * float(np.hypot(*extent)) / max(len(names), 1) ** 0.5 or 1.0
    out = []
    for name, centre in zip(names, centres, strict=True):
        corners = centre + Turn.from_quat(recording.transforms[name][1]).apply(
            depth_m * recording.corners[name]
        )
        a, b, c, d = corners
        out.append(np.array([a, b, centre, c, d, centre, a, d, c, b]))
    return out
