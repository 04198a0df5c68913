"""Irradiance of level ground from what a tilted sun sensor measures."""

from __future__ import annotations

import itertools
import math

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.constants import sourced

_MICASENSE = "MicaSense, RedEdge and Altum Image Processing Tutorial 3: DLS sensor basic usage"
_DIFFUSE = sourced(1.0 / 6.0, "ratio", "diffuse to direct light of a clear sky", _MICASENSE)
_LAYERS = sourced((1.000277, 1.6, 1.38), "refractive index", "air, window, diffuser", _MICASENSE)


def sensor_axis(yaw_rad: float, pitch_rad: float, roll_rad: float) -> Floats:
    """The unit vector (east, north, up) that a sensor faces which looks up when it is level.

    The angles turn north-east-down axes into the body's: yaw about down, then pitch, then roll.
    """
    (cy, cp, cr), (sy, sp, sr) = (
        [function(angle) for angle in (yaw_rad, pitch_rad, roll_rad)] for function in (math.cos, math.sin)
    )
    return np.array([-(sy * sp * cr - cy * sr), -(cy * sp * cr + sy * sr), cp * cr])


def horizontal_irradiance(measured: float, axis: Floats, sun: Floats) -> float:
    """Irradiance of level ground, in the unit of what a sensor measured that faced `axis`.

    The measurement is direct light times the cosine of its incidence, plus diffuse light, less what the
    sensor's window reflects. Args: axis, sun: unit vectors (east, north, up).
    Reference: MicaSense, Image Processing Tutorial 3.
    """
    incidence = float(np.clip(axis @ sun, 0.0, 1.0))
    direct = measured / transmitted(math.acos(incidence)) / (incidence + _DIFFUSE)
    return direct * (max(float(sun[2]), 0.0) + _DIFFUSE)


def transmitted(incidence_rad: float) -> float:
    """The share of unpolarised light that passes the sensor's window (Fresnel's equations)."""
    share, sine = 1.0, math.sin(incidence_rad)
    for outer, inner in itertools.pairwise(_LAYERS):
        sine_out, sine_in = sine / outer, sine / inner
        cos_out, cos_in = math.sqrt(1.0 - sine_out**2), math.sqrt(1.0 - sine_in**2)
        across = (outer * cos_out - inner * cos_in) / (outer * cos_out + inner * cos_in)
        along = (outer * cos_in - inner * cos_out) / (outer * cos_in + inner * cos_out)
        share *= 1.0 - (across**2 + along**2) / 2.0
    return share
