"""Pairs of strips made ready for refinement, and their curves through knots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from geomosaic.arrays import Floats
from geomosaic.ccd.least_squares_matching import PairImages
from geomosaic.ccd.rows import RowPair


@dataclass(frozen=True)
class PreparedPairs:
    """Pairs, their images at one scale, coarse offsets (pairs, knots, 2) and the knots' centres (knots,)."""

    pairs: Sequence[RowPair]
    images: Sequence[PairImages]
    coarse_px: Floats
    centres: Floats


def curve_of(centres: Floats, knots_px: Floats, at: Floats) -> Floats:
    """Curves (2, n) through values (knots, 2) at the knots' centres; straight on beyond them."""
    curve = CubicSpline(centres, knots_px, axis=0, bc_type="natural")
    inside = np.clip(at, centres[0], centres[-1])
    return np.asarray(curve(inside) + (at - inside)[:, None] * curve(inside, 1)).T
