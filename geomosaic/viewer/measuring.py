"""What is measured on the page: places, distances, profiles, areas and volumes with their deviations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
import shapely
from pyproj import CRS, Transformer

from geomosaic.arrays import Floats
from geomosaic.doors.raster import OWN, open_raster
from geomosaic.doors.vector import Shapes
from geomosaic.errors import InputError
from geomosaic.geodesy.mapcrs import check_on_earth, same_map
from geomosaic.quality.measured import Figure
from geomosaic.quality.run_heights import height_difference, measure_heights
from geomosaic.quality.run_measures import RunRasters, measure_lines, measure_polygons
from geomosaic.viewer.run_view import RunView

_SAMPLES: Final = 600  # of a profile: more are finer than a screen


def measured(view: RunView, kind: str, points_px: Floats) -> dict[str, Any]:
    """A measure by its kind and its points (n, 2), columns and rows of the map; values as JSON has them, None
    where unknown.

    Raises: `InputError` for a kind that is none, too few points, an outline that crosses itself,
    or a run that cannot be measured.
    """
    if view.rasters is None:
        raise InputError("this run cannot be measured", fix=view.unmeasured)
    check_on_earth(view.grid.crs, "measurement")
    if kind not in MEASURES:
        raise InputError(f"'{kind}' is no measure", fix=f"ask for one of {', '.join(MEASURES)}")
    least, of = MEASURES[kind]
    if len(points_px) < least or not np.isfinite(points_px).all():
        raise InputError(f"a measure of {len(points_px)} points", fix=f"give {least} or more")
    return of(view.rasters, CRS.from_wkt(view.grid.crs), view.grid.map_from_px(points_px))


def _on_rasters(rasters: RunRasters, crs: CRS, at_m: Floats) -> Floats:
    """Places (n, 2) of the map that is shown, in the CRS of a run's own rasters."""
    with open_raster(rasters.accuracy, OWN) as accuracy:
        own = CRS.from_user_input(accuracy.crs.to_wkt())
    if same_map(own, crs):
        return at_m
    return np.column_stack(Transformer.from_crs(crs, own, always_xy=True).transform(at_m[:, 0], at_m[:, 1]))


def _place(rasters: RunRasters, crs: CRS, at_m: Floats) -> dict[str, Any]:
    """Where a place lies and how high, with deviations against the world."""
    own_m = _on_rasters(rasters, crs, at_m)
    with open_raster(rasters.accuracy, OWN) as accuracy:
        plan_m = np.array([v[0] for v in accuracy.sample(own_m[:1])], dtype=np.float64)
    found: dict[str, Any] = {"east": at_m[0, 0], "north": at_m[0, 1], "plan_sd": _known(float(plan_m[0]))}
    if crs.is_projected:
        lon, lat = Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(*at_m[0])
        found |= {"lon": lon, "lat": lat}
    heights = measure_heights(rasters, own_m)
    if heights is not None:
        found |= {"height": _known(float(heights.up_m[0])), "height_sd": _known(float(heights.sd_m[0]))}
    return found


def _distance(rasters: RunRasters, crs: CRS, at_m: Floats) -> dict[str, Any]:
    """The length of a line, and how much higher its end is than its beginning."""
    _, (length,) = measure_lines(rasters, _shapes(shapely.LineString(at_m), crs), rasters.accuracy)
    heights = measure_heights(rasters, _on_rasters(rasters, crs, at_m))
    rise = None if heights is None else _figure(height_difference(rasters, heights))
    return {"length": _figure(length), "rise": rise}


def _profile(rasters: RunRasters, crs: CRS, at_m: Floats) -> dict[str, Any]:
    """The same, with heights along the line."""
    line = shapely.LineString(at_m)
    along_m = np.linspace(0.0, line.length, _SAMPLES + 1)
    places_m = shapely.get_coordinates(shapely.line_interpolate_point(line, along_m))
    heights = measure_heights(rasters, _on_rasters(rasters, crs, places_m))
    if heights is None:
        raise InputError("the run has no surface", fix="make the mosaic with --surface dense")
    profile = {
        "along": along_m.tolist(),
        "height": [_known(v) for v in heights.up_m.tolist()],
        "sd": [_known(v) for v in heights.own_m.tolist()],
    }
    return {**_distance(rasters, crs, at_m), "profile": profile}


def _area(rasters: RunRasters, crs: CRS, at_m: Floats) -> dict[str, Any]:
    """The area of an outline, and the volumes above and below the plane through its rim."""
    outline = shapely.Polygon(at_m)
    if not outline.is_valid or outline.area == 0.0:
        raise InputError("the outline crosses itself or encloses nothing", fix="take points back and go on")
    _, (found,) = measure_polygons(rasters, _shapes(outline, crs), rasters.accuracy)
    volume = found.volume
    return {
        "area": _figure(found.area),
        "volume": volume
        and {"above": _known(volume.above), "below": _known(volume.below), "sd": _known(volume.sd)},
        "surface": rasters.surface is not None,
    }


MEASURES: Final[Mapping[str, tuple[int, Callable[[RunRasters, CRS, Floats], dict[str, Any]]]]] = {
    "place": (1, _place),
    "distance": (2, _distance),
    "profile": (2, _profile),
    "area": (3, _area),
    "volume": (3, _area),
}
"""By its name: the least number of points, and the function that measures."""


def _shapes(shape: Any, crs: CRS) -> Shapes:
    return Shapes((shape,), crs.to_wkt())


def _figure(of: Figure) -> dict[str, float | None]:
    ellipsoidal = None if of.ellipsoidal is None else _known(of.ellipsoidal)
    return {"value": _known(of.value), "sd": _known(of.sd), "ellipsoidal": ellipsoidal}


def _known(value: float) -> float | None:
    return value if np.isfinite(value) else None
