"""A small recording with one of everything, for the tests of the recording room."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.recording import Recorder, thumbnail
from geomosaic.recording.file.chips import SIDE_PX, chip, cuts
from geomosaic.recording.file.writer import StageEnd

FRAMES = ("DJI_0001.JPG", "DJI_0002.JPG", "DJI_0003.JPG")
CAMERA = Camera(
    "FC 220", 4000, 3000, 2300.0, 2001.5, 1499.25, k1=-0.011, k2=0.003, p1=1e-4, p2=-2e-4, k3=5e-4
)
POSITIONS_M = np.array([[0.0, 0.0, 100.0], [30.0, 0.0, 101.0], [60.0, 5.0, 99.5]])
ROTATIONS = Rotation.from_yaw_pitch_roll(np.radians([90.0, 91.0, 270.0]), np.zeros(3), np.radians([0, 2, 5]))
POINTS_M = np.array([[0.0, 0.0, 1.5], [30.0, 4.0, 0.0], [60.0, 5.0, np.nan], [12.0, -3.0, 2.25]])
ARTEFACT = np.random.default_rng(5).bytes(2_300_001)
RECIPE = "name: scene\nseed: 7\nstages: [survey.read, adjustment.solve]\n"


def captured_s(i: int) -> float | None:
    """When frames were exposed; of the last one nobody knows."""
    return 1_500_000_000.25 + 2.0 * i if i < 2 else None


def record(recorder: Recorder, *, method: str = "error_sharing", rounds: int = 3, warn: bool = True) -> None:
    """Two stages; the second may be varied."""
    recorder.begin_run(
        RECIPE, {"geomosaic": "0.1.0", "numpy": "2.4.6"}, {"survey.read.frames": {"a.jpg": "00ff"}}
    )
    recorder.stage_started("survey.read", 1, {"frames": "images", "crs": "auto"}, {})
    recorder.camera(CAMERA.name, CAMERA)
    for i, frame in enumerate(FRAMES):
        image = np.full((60, 90, 3), (200 - 40 * i, 30, 60), dtype=np.uint8)
        recorder.frame_image(frame, thumbnail(image), captured_s(i))
        place = (-91.25 + 0.001 * i, 46.5 + 0.0005 * i, 251.5)
        recorder.location(frame, place, (1.5, 2.0, 3.0), "observed", captured_s(i))
    recorder.artefact(
        "survey.read", "survey", "geomosaic.survey.model:Survey", "ab" * 20, io.BytesIO(ARTEFACT)
    )
    recorder.log("info", "3 frames", stage="survey.read")
    notes = {"warnings": [], "metrics": {"frames": 3}}
    recorder.stage_finished("survey.read", StageEnd(outputs={"survey": "ab" * 20}, seconds=1.25, notes=notes))
    recorder.stage_started(
        "adjustment.solve", 2, {"method": method, "epsilon_px": 10.0}, {"survey": "ab" * 20}
    )
    for k in range(rounds):
        left, right = 3.0 * 0.5**k, -4.0 * 0.5**k
        pairs = [(FRAMES[0], FRAMES[1], left, right), (FRAMES[1], FRAMES[2], np.nan, np.nan)]
        moves = [(FRAMES[0], 0.5, -0.25), (FRAMES[1], -1.0 * 0.5**k, 0.125), (FRAMES[2], 0.0, 0.0)]
        recorder.offsets("adjustment.solve", k, pairs, moves)
    points = np.array([[100.5, 200.25], [300.0, 400.75]])
    recorder.tie_points(
        (FRAMES[0], FRAMES[1]), points, points - [0.0, 180.0], np.array([[0.02, -0.03], [0.01, 0.04]])
    )
    recorder.iteration("adjustment.solve", method, 25.0, "m", {"step_m": 1.5})
    recorder.metric("adjustment.sigma_px", 0.5)
    recorder.table(
        "pairs.adjusted", FRAMES[:1], {"rms_m": [0.05], "tie_points": [2]}, others=FRAMES[1:2], notes=[""]
    )
    recorder.outlines("adjusted", FRAMES[:2], [np.eye(3), np.zeros((4, 2))])
    where = cuts(points, points - [0.0, 180.0], np.array([[0.02, -0.03], [0.01, 0.04]]))
    halves = tuple(np.full((SIDE_PX, SIDE_PX, 3), grey, np.uint8) for grey in (60, 90))
    residual = np.array([[0.02, -0.03], [0.01, 0.04]])
    recorder.chip(
        0, FRAMES[0], FRAMES[1], chip(halves, where, (points, points - [0.0, 180.0]), residual, [1.0, np.nan])
    )
    ring = [[-91.25, 46.5], [-91.249, 46.5], [-91.249, 46.501], [-91.25, 46.5]]
    polygon = {"type": "Polygon", "coordinates": [ring]}
    recorder.geojson(
        "/map/footprints", [{"type": "Feature", "properties": {"frame": FRAMES[0]}, "geometry": polygon}]
    )
    for frame, status in zip(FRAMES, ("tied", "placed", "rejected"), strict=True):
        recorder.location(frame, (-91.25, 46.5, 252.0), (0.05, 0.06, np.nan), status)
    for i, frame in enumerate(FRAMES):
        recorder.pose(frame, CAMERA, POSITIONS_M[i], ROTATIONS.matrix[i], captured_s(i))
    recorder.points("ties", POINTS_M, {"residual_m": [0.01, 0.02, 0.03, 0.04]}, captured_s(0))
    if warn:
        recorder.log("warning", "turned: corrected by 180 degrees", stage="adjustment.solve", frame=FRAMES[2])
    recorder.stage_finished(
        "adjustment.solve", StageEnd(outputs={"adjusted": f"{len(method):040x}"}, seconds=0.5)
    )


def written(path: Path, **changes: object) -> Path:
    """A whole recording with fixed times."""
    with Recorder(path, fixed_time=True, level="full") as recorder:
        record(recorder, **changes)  # type: ignore[arg-type]
    return path
