"""Offsets out of object space: where model and DEM have neighbours see the same ground (`virtual_line`)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.camera.pushbroom import Pushbroom
from geomosaic.ccd.line_poses import SPARE_LINES, STEP_LINES, LinePoses
from geomosaic.ccd.model import (
    BRIDGED,
    RELIABLE_SD_PX,
    UNKNOWN_SD_PX,
    UNRELIABLE,
    CcdSettings,
    PairOffsets,
    Progress,
)
from geomosaic.ccd.object_space import ObjectSpace, level_ground
from geomosaic.ccd.overlaps import PIECE_LINES, Strips
from geomosaic.constants import NORMAL_PER_MAD, tuned
from geomosaic.errors import InputError
from geomosaic.survey.strips import StripGeometry

_MODEL_SD_PX = tuned(0.1, "px", "left by a calibrated model: less claims too much; 0.6 trusts nothing")


def virtual_line(strips: Strips, settings: CcdSettings, progress: Progress) -> tuple[PairOffsets, ...]:
    """Offsets that the rigorous model and the DEM predict; no image is looked at.

    For the middle of each line of a left strip: the ground under column width - overlap / 2, and where the
    right CCD sees it. The standard deviations combine three parts: what is taken for granted about such
    models (0.1 px), heights and attitudes. Heights count by `ObjectSpace.height_sd_m` times the parallax,
    attitudes by the noise that the third differences of their table show. Other errors of the model can't be
    distinguished from it. Lines whose right line is beyond the model's attitudes, or isn't found, are
    unreliable. No line is labelled measured.
    Raises: `InputError` without a model.
    """
    space, g = strips.object_space, strips.geometry
    if space is None:
        raise InputError(
            ("--method virtual_line needs a rigorous model of the camera"),
            fix="give 'model' in GEOMETRY.yaml",
        )
    total, done = sum(strips.lines(pair) for pair in strips.pairs), 0
    noise_line, noise_col = _attitude_noise_px(space.model)
    covered = space.model.attitude_time_s[[0, -1]] * g.line_rate_hz
    out = []
    for pair in strips.pairs:
        n = strips.lines(pair)
        found, by_height, known = np.empty((2, n)), np.empty((2, n)), np.empty(n, dtype=bool)
        for start, stop in _pieces(n):
            poses = _poses(space, g, pair, start, stop)
            line = np.arange(float(start), stop) + 0.5
            found[:, start:stop] = _predicted(space, g, poses, pair, line)
            by_height[:, start:stop] = _height_sd_px(space, g, poses, pair, 0.5 * (start + stop))[:, None]
            right = line + g.side(pair) * g.row_separation_lines + found[1, start:stop]
            known[start:stop] = (right >= covered[0]) & (right <= covered[1])
            done += stop - start
            progress(done, total)
        known &= np.isfinite(found).all(axis=0)
        noise = np.sqrt(2.0) * np.array([[noise_col], [noise_line]])
        sd = np.sqrt(_MODEL_SD_PX**2 + by_height**2 + noise**2)
        sd[:, ~known] = np.maximum(sd[:, ~known], UNKNOWN_SD_PX)
        label = np.where(sd.max(axis=0) <= RELIABLE_SD_PX, BRIDGED, UNRELIABLE)
        col, line = (_filled(axis) for axis in found)
        out.append(PairOffsets(pair, col, line, sd[0], sd[1], label.astype(np.uint8)))
    return tuple(out)


def relief_px(geometry: StripGeometry, space: ObjectSpace) -> dict[int, Floats]:
    """By pair, for each line of the left strip, the part of dline that the ground's heights make.

    That is the prediction on the DEM less the one on level ground at the scene's mean height. Model errors
    cancel in it but for where the DEM is asked.
    """
    level = level_ground(space.model, space.mean_m)
    out: dict[int, Floats] = {}
    for pair in geometry.pairs:
        n = geometry.lines[pair]
        if not n or not geometry.lines[pair + 1]:
            continue
        out[pair] = np.empty(n)
        for start, stop in _pieces(n):
            poses = _poses(space, geometry, pair, start, stop)
            knots = np.arange(float(start), stop + STEP_LINES, STEP_LINES) + 0.5
            on_dem, on_level = (
                _predicted(heights, geometry, poses, pair, knots)[1] for heights in (space, level)
            )
            part = np.nan_to_num(on_dem - on_level)
            out[pair][start:stop] = np.interp(np.arange(start, stop) + 0.5, knots, part)
    return out


def _pieces(lines: int) -> Iterator[tuple[int, int]]:
    for start in range(0, lines, PIECE_LINES):
        yield start, min(start + PIECE_LINES, lines)


def _poses(space: ObjectSpace, g: StripGeometry, pair: int, start: int, stop: int) -> LinePoses:
    """Poses of a left strip's lines and of the right strip's that see the same ground."""
    apart = g.side(pair) * g.row_separation_lines
    return LinePoses(space.model, start + min(apart, 0.0) - SPARE_LINES, stop + max(apart, 0.0) + SPARE_LINES)


def _predicted(space: ObjectSpace, g: StripGeometry, poses: LinePoses, pair: int, line: Floats) -> Floats:
    """dcol and dline (2, n) of a left strip's lines."""
    ground = space.ground(poses, pair, g.width_px - 0.5 * g.overlap_px, line)
    return _offsets(g, poses, pair, line, ground)


def _offsets(g: StripGeometry, poses: LinePoses, pair: int, line: Floats, ground: Floats) -> Floats:
    nominal = line + g.side(pair) * g.row_separation_lines
    col, seen = poses.image(pair + 1, ground, nominal)
    return np.stack([col - 0.5 * g.overlap_px, seen - nominal])


def _height_sd_px(space: ObjectSpace, g: StripGeometry, poses: LinePoses, pair: int, line: float) -> Floats:
    """By how much dcol and dline (2,) change for a deviation of the heights."""
    at = np.array([line])
    low, high = (
        _predicted(level_ground(space.model, space.mean_m + by), g, poses, pair, at)
        for by in (-space.height_sd_m, space.height_sd_m)
    )
    return np.abs(high - low)[:, 0] / 2.0


def _filled(values: Floats) -> Floats:
    """Straight lines across what isn't finite; 0 where nothing is."""
    known = np.isfinite(values)
    if known.all() or not known.any():
        return np.nan_to_num(values)
    at = np.arange(values.size)
    return np.interp(at, at[known], values[known])


def _attitude_noise_px(model: Pushbroom) -> tuple[float, float]:
    """Noise of single attitudes along (pitch) and across (roll), from their third differences."""
    third = np.diff(model.roll_pitch_yaw_rad[:, :2], n=3, axis=0)
    usual = np.median(np.abs(third - np.median(third, axis=0)), axis=0)
    roll, pitch = NORMAL_PER_MAD * usual / np.sqrt(20.0)
    pixel_rad = float(np.abs(model.right_tan[:, 1]).mean())
    return float(pitch) / pixel_rad, float(roll) / pixel_rad
