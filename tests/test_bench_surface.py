"""What the bench of the surface counts as seen."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.surface.cells import Cells

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))

from bench_surface_judge import frames_seeing


def test_frames_see_what_nothing_stands_before_at_its_true_height() -> None:
    """A house 10 m high and 4 m wide; a frame from its west, one from its east, one that ends 5 m beside it."""
    squares = Cells(-50.0, -50.0, 0.5, 200, 200)
    land = np.zeros((200, 200), dtype=np.float32)
    land[90:110, 96:104] = 10.0
    wide, narrow = (Camera("any", 2000, 2000, f, 1000.0, 1000.0) for f in (500.0, 1000.0))
    down = Rotation.from_yaw_pitch_roll(0.0, 0.0, 0.0)
    adjusted = SimpleNamespace(
        poses=[Pose(np.array([east, 0.0, 40.0]), down) for east in (-40.0, 40.0, 45.0)],
        cameras=[wide, wide, narrow],
    )
    places = {
        "in the house's eastern shadow": ((3.0, 0.0, 0.0), 2, 1),
        "in its western one": ((-3.0, 0.0, 0.0), 2, 1),
        "on its roof": ((0.0, 0.0, 10.0), 2, 2),
        "just before the eastern shadow ends, at 16 m": ((15.0, 0.0, 0.0), 3, 2),
        "just past it": ((17.0, 0.0, 0.0), 3, 3),
        "at the same place, beside the house": ((15.0, 20.0, 0.0), 3, 3),
    }
    points = np.array([point for point, *_ in places.values()])
    looking, seeing = frames_seeing(adjusted, points, squares, land)
    assert [(int(a), int(b)) for a, b in zip(looking, seeing, strict=True)] == [
        (inside, unhidden) for _, inside, unhidden in places.values()
    ]
