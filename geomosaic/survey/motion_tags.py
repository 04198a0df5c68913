"""How a frame moved while its rows were read: the inertial unit's samples in Pix4D's namespace `Camera`."""

from __future__ import annotations

import base64
from typing import Final

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.camera.exterior import LEAST_RECORDED, Turns
from geomosaic.constants import sourced, tuned
from geomosaic.estimation.robust import LEAST_OBSERVATIONS
from geomosaic.survey.header import FrameHeader
from geomosaic.survey.plausible import FASTEST, FASTEST_TURN, SLOWEST
from geomosaic.survey.xmp import Xmp, numbers

CAMERA_FROM_UNIT: Final = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""The unit's axes are the body's, forward, right and down, and forward is the image's top: of all 24
right-handed assignments the one that the images confirm, see docs/methods/rolling_shutter.md."""
UNIT_DELAY_S = tuned(0.0425, "s", "lag of a Sequoia's rates: ties 1.59 px, 1.95 with 0.04, 1.82 with 0.045")
_SAMPLE = sourced(
    np.dtype([("time_us", "<u8"), ("rad_per_s", "<f4", 3), ("flags", "<u4")]),
    "bytes",
    "a record of the tag: 24 bytes, little endian",
    "a Parrot Sequoia's files; docs/inputs.md",
)
_SAMPLES_A_TURN = tuned(4, "samples", "between tabled rotations, half of the fewest: more cut vibration off")
_FARTHEST_RAD = tuned(0.25, "rad", "rotation within a frame: more is wrong samples, or nothing is sharp")


def turns_of(header: FrameHeader) -> Turns | None:
    """The frame's turns by `Camera:IMUAngularVelocity`, None without it, where it can't be, or where the
    record ends before the rows are read.

    Base64 of 24-byte records, little endian: uint64 microseconds, three float32 in rad/s, uint32.
    """
    samples = _samples(header.xmp or {})
    if samples is None:
        return None
    time_s, rates = samples
    span_s = float(time_s[-1])
    before, after = rates[:LEAST_OBSERVATIONS].mean(axis=0), rates[-LEAST_OBSERVATIONS:].mean(axis=0)
    time_s = np.concatenate([[-span_s], time_s, [2.0 * span_s]])
    rates = np.concatenate([[before], rates, [after]]) @ CAMERA_FROM_UNIT.T
    steps = (rates[1:] + rates[:-1]) / 2.0 * np.diff(time_s)[:, None]
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    times = 2 * (len(time_s) // (2 * _SAMPLES_A_TURN)) + 1
    at_s = span_s / 2.0 + UNIT_DELAY_S + np.linspace(-0.5, 0.5, times) * span_s
    rad = np.stack([np.interp(at_s, time_s, turned[:, axis]) for axis in range(3)], axis=1)
    rad -= rad[times // 2]
    until_s = np.array(span_s / 2.0 - UNIT_DELAY_S)
    if until_s <= LEAST_RECORDED * span_s:
        return None
    return Turns(span_s, rad, until_s) if np.abs(rad).max() <= _FARTHEST_RAD else None


def velocity_of(header: FrameHeader) -> tuple[float, float, float] | None:
    """`Camera:IMULinearVelocity`: east, north and up in m/s, as the positions of the frames confirm."""
    found = numbers(header.xmp or {}, "Camera:IMULinearVelocity", 3)
    if found is None or not max(map(abs, found)) <= FASTEST.value:
        return None
    return found[0], found[1], found[2]


def _samples(xmp: Xmp) -> tuple[Floats, Floats] | None:
    """Times (n,) from the first one on, in s, and rates (n, 3) about the unit's axes."""
    text = xmp.get("Camera:IMUAngularVelocity", "")
    try:
        data = base64.b64decode(text, validate=True)
    except ValueError:
        return None
    if len(data) % _SAMPLE.itemsize or len(data) < 2 * _SAMPLES_A_TURN * _SAMPLE.itemsize:
        return None
    samples = np.frombuffer(data, dtype=_SAMPLE)
    time_us = samples["time_us"]
    passed_us = np.diff(time_us)  # of unsigned numbers: a step back is a huge one
    rates = samples["rad_per_s"].astype(np.float64)
    if not (np.abs(rates) <= FASTEST_TURN.value).all() or not passed_us.all():
        return None
    time_s = 1e-6 * np.concatenate([[0.0], np.cumsum(passed_us.astype(np.float64))])
    return (time_s, rates) if time_s[-1] <= SLOWEST.value else None
