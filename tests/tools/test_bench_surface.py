"""What the bench of the surface counts as seen, and as a corner that is found again."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np

from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.matching.displacement import Displacements
from geomosaic.surface.cells import Cells
from tools.bench.bench_surface_judge import frames_seeing
from tools.bench.bench_surface_roofs import _both_ways


def test_frames_see_what_nothing_stands_before_at_its_true_height() -> None:
    """A house 10 m high and 4 m wide; a frame from its west, one from its east, one that ends 5 m off it."""
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
        "at the same place, next to the house": ((15.0, 20.0, 0.0), 3, 3),
    }
    points = np.array([point for point, *_ in places.values()])
    looking, seeing = frames_seeing(adjusted, points, squares, land)
    assert [(int(a), int(b)) for a, b in zip(looking, seeing, strict=True)] == [
        (inside, unhidden) for _, inside, unhidden in places.values()
    ]


def test_a_corner_that_meets_something_alike_is_refused_and_one_that_has_moved_is_not() -> None:
    """The truth has it twice, the mosaic has lost the first one; of its lower half all lies 12 px aside."""
    rng = np.random.default_rng(2)
    true = cv2.GaussianBlur(rng.normal(120.0, 200.0, (400, 256)).astype(np.float32), (0, 0), 1.5)
    alike = true[100:132, 60:92] + rng.normal(0.0, 8.0, (32, 32))
    true[100:132, 110:142] = alike
    image = true.copy()
    image[100:132, 60:92] = 120.0
    image[200:] = np.roll(true[200:], 12, axis=1)
    seen = np.ones(true.shape, dtype=bool)
    centres = np.array([[76.0, 116.0], [116.0, 316.0], [36.0, 36.0]])
    moved = np.array([[50.0, 0.0], [12.0, 0.0], [0.0, 0.0]])
    found = Displacements(centres, moved, np.full(3, 0.1), np.full(3, 0.9), 3)
    assert _both_ways(image, true, seen, found).tolist() == [False, True, True]
