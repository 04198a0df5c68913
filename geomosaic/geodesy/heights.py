"""Vertical datums: what to add to a height above a geoid to have the height above the ellipsoid."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS
from pyproj.crs import CompoundCRS
from pyproj.transformer import AreaOfInterest, TransformerGroup

from geomosaic.errors import InputError

Floats = NDArray[np.float64]


def vertical_crs(crs: CRS) -> CRS | None:
    """The vertical part of a CRS; the CRS itself where its heights are ellipsoidal; None without heights."""
    if crs.is_compound:
        return next((part for part in crs.sub_crs_list if part.is_vertical), None)
    if crs.is_vertical or len(crs.axis_info) == 3:
        return crs
    if crs.source_crs is not None and crs.is_bound:
        return crs if crs.source_crs.is_vertical else vertical_crs(crs.source_crs)
    return None


def ellipsoidal_offset_m(vertical: CRS, lon_deg: float, lat_deg: float) -> float:
    """As `ellipsoidal_offsets_m`, at one point."""
    return float(ellipsoidal_offsets_m(vertical, np.array([lon_deg]), np.array([lat_deg]))[0])


def ellipsoidal_offsets_m(vertical: CRS, lon_deg: Floats, lat_deg: Floats) -> Floats:
    """Ellipsoidal minus orthometric height at points of any shape: the geoid's undulation, in metres.

    Only transformations with a stated operation count: a ballpark one, which leaves heights as they
    are, is never used. Among several the most accurate one whose grids are here is taken.

    Args: a vertical CRS (`EPSG:5773`), or one with ellipsoidal heights, whose offset is 0.
    Raises: `InputError` when its heights aren't metres upwards, or no geoid grid for it is installed.
    """
    axis = vertical.axis_info[-1]
    if axis.direction != "up" or axis.unit_conversion_factor != 1.0:
        raise InputError(
            f"heights of '{vertical.name}' are counted {axis.direction} in {axis.unit_name}",
            fix="convert them to metres upwards first",
        )
    if not vertical.is_vertical or "ellips" in vertical.name.lower():
        return np.zeros(lon_deg.shape)
    heights = CompoundCRS(name="heights of a vertical datum", components=["EPSG:4326", vertical])
    south, north = max(float(lat_deg.min()) - 0.01, -90.0), min(float(lat_deg.max()) + 0.01, 90.0)
    near = AreaOfInterest(float(lon_deg.min()) - 0.01, south, float(lon_deg.max()) + 0.01, north)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a better grid is missing: judged below
        group = TransformerGroup(
            heights, "EPSG:4979", always_xy=True, area_of_interest=near, allow_ballpark=False
        )
    for transformer in group.transformers:
        height = np.asarray(transformer.transform(lon_deg, lat_deg, np.zeros(lon_deg.shape))[2])
        if np.isfinite(height).all():
            return height
    raise InputError(
        f"the geoid model for '{vertical.name}' is not installed",
        fix=_installing(group.unavailable_operations),
    )


def _installing(operations: Sequence[Any]) -> str:
    """How to install the geoid model of the most accurate of the operations that lack the fewest grids."""
    lacking = [[grid for grid in op.grids if not grid.available] for op in operations]
    ranked = sorted(zip(lacking, operations, strict=True), key=lambda of: (len(of[0]), abs(of[1].accuracy)))
    grids = ranked[0][0] if ranked else []
    if grids and all(grid.url for grid in grids):
        return "install it: " + " && ".join(f"pyproj sync --file {grid.short_name}" for grid in grids)
    names = ", ".join(grid.short_name for grid in grids) or "its grid"
    return f"copy {names} into PROJ's data folder, which geomosaic doctor names"
