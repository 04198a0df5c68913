"""Small surveys with a known image on the ground, for the tests of mosaic and export."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.projection.footprint import ground_from_image
from geomosaic.projection.ground import GroundSurface, flat_ground
from geomosaic.survey.model import Attitude, Frame, Position, Survey

CRS = "EPSG:32632"
HOME = LocalFrame(9.71, 47.23, 400.0)
GSD_M = 0.25
CAMERA = Camera("cam", 240, 180, 200.0, 121.3, 88.6, -0.11, 0.03, 0.0, 0.0008, -0.0005)


def truth(easting: np.ndarray, northing: np.ndarray, bands: int = 3, top: float = 255.0) -> np.ndarray:
    """The ground's image: smooth waves of 9 to 30 m in map coordinates, other ones in each band."""
    e, n = easting - 553_000.0, northing - 5_231_000.0
    out = []
    for b in range(bands):
        wave = np.sin(e / (3.1 + b) + 0.3 * b) * np.cos(n / (4.3 - 0.5 * b)) + 0.6 * np.sin((e - n) / 5.7 + b)
        out.append((0.5 + 0.28 * wave) * top)
    return np.stack(out, axis=-1)


def truth_of(
    survey: Survey, ground: GroundSurface, poses: Poses, i: int, bands: int, top: float
) -> np.ndarray:
    """What frame i sees, by the exact way from its pixels to the ground."""
    camera = survey.camera_of(i)
    col, row = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    seen = ground_from_image(poses[i], camera, ground, np.stack([col, row], axis=-1))
    geodetic = survey.work_frame.geodetic_from_enu(seen)
    on_map = MapProjection(survey.map_crs).map_from_geodetic(geodetic[..., 0], geodetic[..., 1])
    return truth(on_map[..., 0], on_map[..., 1], bands, top)


def hills() -> GroundSurface:
    i, j = np.mgrid[0:41, 0:41]
    return GroundSurface("dem", -200.0, -200.0, 10.0, 4.0 * np.sin(i / 2.0) + 3.0 * np.cos(j / 1.7))


def make_survey(
    folder: Path,
    *,
    lines: int = 2,
    per_line: int = 3,
    bands: int = 3,
    dtype: str = "uint8",
    suffix: str = ".tif",
    ground: GroundSurface | None = None,
    gains: Sequence[float] | None = None,
    camera: Camera = CAMERA,
) -> tuple[Survey, Poses, GroundSurface]:
    """Frames of lines flown north and south, 50 m up, tilted by a few degrees, written as real files."""
    ground = ground or flat_ground(HOME, 400.0, 400.0)
    top = {"uint8": 255.0, "uint16": 65535.0, "float32": 1.0}[dtype]
    rng = np.random.default_rng(5)
    folder.mkdir(parents=True, exist_ok=True)
    positions, rotations, frames = [], [], []
    for line in range(lines):
        for k in range(per_line):
            yaw = 0.08 + (np.pi if line % 2 else 0.0) + rng.normal(0.0, 0.05)
            up = 50.0 + rng.normal(0.0, 0.5)
            positions.append([28.0 * (line - (lines - 1) / 2), 18.0 * (k - (per_line - 1) / 2), up])
            rotations.append(Rotation.from_yaw_pitch_roll(yaw, *rng.normal(0.0, 0.04, 2)).matrix)
    n = len(positions)
    poses = Poses(
        np.array(positions), np.array(rotations), np.full((n, 3), 0.7), np.full((n, 3), np.radians(0.4))
    )
    geodetic = HOME.geodetic_from_enu(poses.positions_m)
    for i in range(n):
        name = f"frame {i:02d}{suffix}"
        frames.append(
            Frame(
                name=name,
                path=str(folder / name),
                width_px=camera.width_px,
                height_px=camera.height_px,
                bands=bands,
                dtype=dtype,
                camera=camera.name,
                position=Position(*(float(x) for x in geodetic[i]), 50.0, 0.7, 0.7, 0.7, "test"),
                attitude=Attitude(0.0, 0.0, 0.0, 1.0, 0.3, "test"),
                time_s=1.7e9 + 2.0 * i,
            )
        )
    survey = Survey(tuple(frames), (camera,), HOME, CRS)
    for i, frame in enumerate(frames):
        image = truth_of(survey, ground, poses, i, bands, top) * (1.0 if gains is None else gains[i])
        write_frame(Path(frame.path), image if dtype == "float32" else np.rint(image), dtype)
    return survey, poses, ground


def write_frame(path: Path, image: np.ndarray, dtype: str) -> None:
    if path.suffix == ".jpg":
        bgr = np.ascontiguousarray(image.astype(np.uint8)[..., ::-1])
        best = [cv2.IMWRITE_JPEG_QUALITY, 100, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111]
        assert cv2.imwrite(str(path), bgr, best)
        return
    height, width, bands = image.shape
    shape = {"width": width, "height": height, "count": bands, "dtype": dtype}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", driver="GTiff", photometric="minisblack", **shape) as tiff:
            tiff.write(np.moveaxis(image, -1, 0).astype(dtype))


def paint(frame: Frame, pixels: np.ndarray) -> None:
    """Other pixels (rows, cols, bands) into a frame's file."""
    write_frame(Path(frame.path), pixels, frame.dtype)


def with_mask(survey: Survey, i: int, mask: np.ndarray) -> Survey:
    """The survey with a mask file for frame i."""
    frame = survey.frames[i]
    path = Path(frame.path).with_suffix(".mask.png")
    assert cv2.imwrite(str(path), mask)
    frames = list(survey.frames)
    frames[i] = replace(frame, valid_mask=str(path))
    return replace(survey, frames=tuple(frames))
