"""The strips' object space: the rigorous model and the ground's heights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from geomosaic.camera.pushbroom import Pushbroom
from geomosaic.ccd.model import Floats

Heights = Callable[[Floats, Floats], Floats]
"""Ellipsoidal heights (m) of longitudes and latitudes (degrees)."""


@dataclass(frozen=True, eq=False)
class ObjectSpace:
    """Where the CCDs look, and how high the ground is there."""

    model: Pushbroom
    height_at: Heights
