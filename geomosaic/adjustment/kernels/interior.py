"""A camera's numbers in one order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.camera.interior import Camera
from geomosaic.camera.lens import TERMS

INTERIOR = ("focal_length_px", "principal_col_px", "principal_row_px", *TERMS, "readout_s")
FOCAL = INTERIOR.index("focal_length_px")
PRINCIPAL = [INTERIOR.index(name) for name in ("principal_col_px", "principal_row_px")]
READOUT = INTERIOR.index("readout_s")


def interior_of(camera: Camera) -> Floats:
    """A camera's numbers in the order of INTERIOR, (9,)."""
    return np.array([getattr(camera, name) for name in INTERIOR])


def with_interior(camera: Camera, interior: Sequence[float] | Floats) -> Camera:
    """The camera with other numbers, in the order of INTERIOR."""
    values: dict[str, Any] = {name: float(v) for name, v in zip(INTERIOR, interior, strict=True)}
    return replace(camera, **values)
