"""A roof as frames show it: from any side, and of any type of pixel."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mosaic_scenes import write_frame

from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.composition.roof_views import Roof, RoofsOfFrame, roofs_seen
from geomosaic.composition.views import FrameView
from geomosaic.survey.model import Attitude, Frame, Position

CAMERA = Camera("cam", 200, 200, 200.0, 100.0, 100.0)
GSD_M = 0.25


def shown(path: Path, pixels: np.ndarray, yaw_rad: float, pixel_m: float) -> np.ndarray:
    """Level land of pixels (200, 200), from 50 m above its middle, in pixels of a roof's window."""
    write_frame(path, pixels[..., None], str(pixels.dtype))
    frame = Frame(
        name=path.name,
        path=str(path),
        width_px=200,
        height_px=200,
        bands=1,
        dtype=str(pixels.dtype),
        camera="cam",
        position=Position(9.7, 47.2, 450.0, 50.0, 0.7, 0.7, 0.7, "test"),
        attitude=Attitude(0.0, 0.0, 0.0, 1.0, 0.3, "test"),
        time_s=0.0,
    )
    pose = Pose(np.array([0.0, 0.0, 50.0]), Rotation.from_yaw_pitch_roll(yaw_rad, 0.0, 0.0))
    view = FrameView(0, pose, CAMERA, np.zeros(2), np.zeros(4), GSD_M)
    level_m = np.zeros((60, 60), np.float32)
    roof = Roof(-14.87, -15.11, pixel_m, level_m, level_m, np.ones((60, 60), dtype=bool), (0,))
    (seen,) = roofs_seen(RoofsOfFrame(frame, view, (roof,)))
    np.testing.assert_array_equal(seen.on_roof, seen.on_ground)
    return seen.on_roof.astype(np.float64)


def texture() -> np.ndarray:
    """As fine as pixels, (200, 200), from 0 to 255."""
    return np.random.default_rng(3).integers(0, 256, (200, 200)).astype(np.uint8)


@pytest.mark.parametrize("pixels_of_frame", [1.0, 2.0, 3.0, 4.0])
def test_frames_of_opposite_headings_show_the_same(tmp_path: Path, pixels_of_frame: float) -> None:
    """Means over a roof's pixels lie where these lie. Half a pixel aside each way leaves 0.25 of noise."""
    north = shown(tmp_path / "north.tif", texture(), 0.0, pixels_of_frame * GSD_M)
    south = shown(tmp_path / "south.tif", texture()[::-1, ::-1], np.pi, pixels_of_frame * GSD_M)
    assert north.std() > 8.0
    assert np.corrcoef(north.ravel(), south.ravel())[0, 1] > 0.99


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_frames_of_any_type_show_contrast(tmp_path: Path, dtype: str) -> None:
    """Reflectances from 0 to 1, and 16 bits of which 8 are in use but for a highlight."""
    pixels = texture().astype(np.float64) / (255.0 if dtype == "float32" else 1.0)
    if dtype == "uint16":
        pixels = 2000.0 + pixels
        pixels[:3, :3] = 65535.0
    found = shown(tmp_path / f"{dtype}.tif", pixels.astype(dtype), 0.0, 2.0 * GSD_M)
    assert found.min() >= 1.0
    assert found.std() == pytest.approx(28.0, abs=2.0)


@pytest.mark.parametrize("towards", [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_a_roof_hides_the_ground_behind_it_up_to_its_highest_line_of_sight(towards: tuple[int, int]) -> None:
    """10 m x 10 m, 6 m high, seen from 40 m up and 45 m aside. The line over its far edge, 50 m off, ends at
    58.82 m; those over its corners end 5.88 m aside."""
    level_m, mask = np.zeros((160, 160), np.float32), np.zeros((160, 160), dtype=bool)
    mask[60:100, 60:100] = True
    roof = Roof(-19.875, -19.875, GSD_M, level_m + 6.0, level_m, mask, (0,))
    east, north = towards
    pose = Pose(np.array([-45.0 * east, -45.0 * north, 40.0]), Rotation.from_yaw_pitch_roll(0.0, 0.0, 0.0))
    (hidden,) = roof.hides(mask, [FrameView(0, pose, CAMERA, np.zeros(2), np.zeros(4), GSD_M)])
    row, col = np.argwhere(hidden).T
    ahead_m = GSD_M * ((col - 79.5) * east + (row - 79.5) * north)
    aside_m = GSD_M * np.abs((col - 79.5) * north + (row - 79.5) * east)
    assert ahead_m.max() == pytest.approx(13.82, abs=GSD_M)
    assert aside_m.max() == pytest.approx(5.88, abs=GSD_M)
    assert len(row) * GSD_M**2 == pytest.approx(115.1, abs=5.0)
