"""What becomes of a frame's light on its way: shadows of clouds, motion blur, the camera's own exposure."""

from __future__ import annotations

import cv2
import numpy as np

from geomosaic.arrays import Floats, Floats32
from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.geodesy.sun import sun_direction
from geomosaic_simulate.noise import spline_noise
from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.render import Sight

CLOUD_M = 150.0
"""From cloud to cloud: low, broken clouds; a small survey has several of their edges."""
WIND_M_PER_S = 6.0
SHADE = 0.45
"""Of the light that is left under a cloud: the sky's."""
MEAN_LIGHT = 110.0
"""Of 255: what the camera's automatic aims at."""
SHAKE_PX = (10.0, 20.0)
"""How far a blurred frame's image is shaken along a line."""
HOT_SPOT_DEG = 5.0
"""From the middle of the hot spot to where an e-th of it is left."""
DEFOCUS_PX = 1.5
_EDGE = 0.04
_GRID_PX = 8
_SUBSTEPS = 16


def clouds_shade(plan: SurveyPlan, sight: Sight, time_s: float, width_px: int, height_px: int) -> Floats32:
    """The share of the light (rows, cols) that clouds leave to a frame; they drift with the wind."""
    rows, cols = (np.arange(-_GRID_PX // 2, n + _GRID_PX, _GRID_PX) for n in (height_px, width_px))
    seconds = time_s % 86400.0
    direction = plan.rng("wind").uniform(0.0, 2.0 * np.pi)
    gone = WIND_M_PER_S * seconds * np.array([np.sin(direction), np.cos(direction)])
    east, north = sight.easting(rows, cols) - gone[0], sight.northing(rows, cols) - gone[1]
    lit = 1.0 - (1.0 - SHADE) * _cover(plan, east, north)
    fine = cv2.resize(lit.astype(np.float32), None, fx=_GRID_PX, fy=_GRID_PX, interpolation=cv2.INTER_LINEAR)
    return np.asarray(fine[_GRID_PX : _GRID_PX + height_px, _GRID_PX : _GRID_PX + width_px])


def hot_spot(plan: SurveyPlan, camera: Camera, pose: Pose, time_s: float) -> Floats32:
    """How much brighter (rows, cols) the ground looks about the direction away from the sun."""
    image = np.stack(np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px)), axis=-1)
    ray = pose.ray_from_image(camera, image + 0.5)
    sun = sun_direction(plan.lon_deg, plan.lat_deg, time_s)
    behind = -(ray @ sun) / np.linalg.norm(ray, axis=-1)
    spot = np.exp(-np.degrees(np.arccos(np.clip(behind, -1.0, 1.0))) / HOT_SPOT_DEG)
    return np.asarray(1.0 + plan.hot_spot * spot, dtype=np.float32)


def _cover(plan: SurveyPlan, east: Floats, north: Floats) -> Floats:
    """How much cloud stands over places, 0 to 1: the largest values of a smooth noise, soft at the edges."""
    places = plan.rng("clouds").uniform(0.0, 100.0 * CLOUD_M, (2, 4000))
    level = float(np.quantile(_billows(plan.seed, *places), 1.0 - plan.clouds))
    cover = np.clip((_billows(plan.seed, east, north) - level) / _EDGE + 0.5, 0.0, 1.0)
    return np.asarray(cover * cover * (3.0 - 2.0 * cover))


def _billows(seed: int, east: Floats, north: Floats) -> Floats:
    node = CLOUD_M / 2.0
    coarse = spline_noise(seed, 910, east / node, north / node)
    return np.asarray(0.75 * coarse + 0.25 * spline_noise(seed, 911, 4.0 * east / node, 4.0 * north / node))


def motion_blur(light: Floats32, length_px: Floats) -> Floats32:
    """The mean of the image shifted along a line: length_px (2,) from its beginning to its end, col and
    row, the middle where it was."""
    reach = int(np.ceil(np.abs(length_px).max() / 2.0)) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), dtype=np.float32)
    steps = max(int(np.ceil(_SUBSTEPS * float(np.linalg.norm(length_px)))), 1)
    shares = (np.arange(steps) + 0.5) / steps - 0.5
    for col, row in reach + shares[:, None] * length_px:
        c, r = int(np.floor(col)), int(np.floor(row))
        dc, dr = col - c, row - r
        kernel[r : r + 2, c : c + 2] += np.outer([1.0 - dr, dr], [1.0 - dc, dc]) / steps
    return np.asarray(cv2.filter2D(light, cv2.CV_32F, kernel, borderType=cv2.BORDER_REPLICATE))


def shaken(plan: SurveyPlan, light: Floats32, i: int) -> Floats32:
    """A frame that came out blurred: the camera shaken along a line, and out of focus."""
    rng = plan.rng("shake", i)
    direction, length = rng.uniform(0.0, np.pi), rng.uniform(*SHAKE_PX)
    line = motion_blur(light, length * np.array([np.cos(direction), np.sin(direction)]))
    return np.asarray(cv2.GaussianBlur(line, (0, 0), DEFOCUS_PX), dtype=np.float32)


def automatic_gain(share: float, light: Floats32) -> float:
    """The gain by which the camera's automatic brings a frame's mean (a share of the way) to MEAN_LIGHT."""
    return float((MEAN_LIGHT / max(float(light.mean()), 1.0)) ** share)
