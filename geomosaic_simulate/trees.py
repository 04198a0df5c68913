"""Trees that stand up: paraboloids cut by each ray."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Bools, Floats


@dataclass(frozen=True)
class Tree:
    """A tree as a frame sees it: at map height `base_m + z` its radius is `radius_m sqrt(1 - z / height_m)`.

    low_px, high_px: the image box (col, row) that it fills.
    """

    easting_m: float
    northing_m: float
    radius_m: float
    height_m: float
    base_m: float
    low_px: Floats
    high_px: Floats


def raise_trees(
    trees: Sequence[Tree],
    rays: tuple[Floats, ...],
    rows: Floats,
    cols: Floats,
    east: Floats,
    north: Floats,
    top_m: Floats,
) -> Iterator[tuple[tuple[slice, slice], Bools]]:
    """Move east and north to where rays meet a crown first (in place); yields each window and what it hit.

    A ray meets the ground in g at height h and passes g + rise (Z - h) at height Z. Let Z = base + z and a =
    g - centre + rise (base - h). A crown is then met at the larger root of
    `|rise|² z² + 2 (a rise + r² / 2H) z + |a|² - r² = 0`.

    Args: rays: east, north, height of the ground, east and north per metre of height at the samples; rows,
    cols: where the samples lie; top_m: heights that rays have met already, at the samples or (1, 1).
    """
    met_m = np.maximum(rays[2], top_m)
    for t in trees:
        r_0, r_1 = np.searchsorted(rows, [t.low_px[1], t.high_px[1]])
        c_0, c_1 = np.searchsorted(cols, [t.low_px[0], t.high_px[0]])
        if r_0 == r_1 or c_0 == c_1:
            continue
        window = np.s_[r_0:r_1, c_0:c_1]
        g_east, g_north, ground_m, rise_east, rise_north = (layer[window] for layer in rays)
        lift = t.base_m - ground_m
        a_east = g_east - t.easting_m + rise_east * lift
        a_north = g_north - t.northing_m + rise_north * lift
        half = a_east * rise_east + a_north * rise_north + t.radius_m**2 / (2.0 * t.height_m)
        rest = a_east**2 + a_north**2 - t.radius_m**2
        slant = rise_east**2 + rise_north**2
        under = half * half - slant * rest
        root = np.sqrt(np.maximum(under, 0.0))
        outward = half <= 0.0  # the ray leans back over the crown; else the root's stable form
        z = np.where(outward, root - half, -rest) / np.where(outward, slant, half + root)
        hit = (under > 0.0) & (t.base_m + z > met_m[window])
        for plane, centre, a, rise in (
            (east, t.easting_m, a_east, rise_east),
            (north, t.northing_m, a_north, rise_north),
        ):
            plane[window] = np.where(hit, centre + a + rise * z, plane[window])
        met_m[window] = np.where(hit, t.base_m + z, met_m[window])
        yield window, hit
