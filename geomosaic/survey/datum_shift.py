"""How well PROJ knows the shift between WGS 84 and the datum of coordinates or of the map."""

from __future__ import annotations

import numpy as np
from pyproj import CRS
from pyproj.transformer import TransformerGroup

from geomosaic.constants import sourced
from geomosaic.doors.unwarned import unwarned
from geomosaic.geodesy.ellipsoid import SEMI_MAJOR_M
from geomosaic.geodesy.heights import area_about, installing, missing_grids
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.survey.model import Warn

_SHIFT_M = sourced(1.0, "m", "accuracy of the best shifts into WGS 84", "EPSG dataset: OSTN15, BeTA2007")
_SAME_DATUM_M = sourced(2.0, "m", "by which WGS 84's versions differ", "EPSG dataset: ensemble accuracy")
_SATELLITES_M = sourced(
    2.5, "m", "of equators' radii: WGS 72's differs by 2 m, that of IAG 1975 by 3 m", "EPSG dataset"
)


def check_shift(crs: CRS, lon_deg: float, lat_deg: float, what: str) -> list[Warn]:
    """Whether PROJ's operation between WGS 84 and a CRS at a place is less accurate than such shifts can be.

    Datums of an ellipsoid as large as WGS 84's were made with satellites, and share its centre: between them
    no shift is meant. Without a stated operation coordinates of other datums go over unchanged.

    Args: what: the file or option that states the CRS.
    """
    plan = crs.to_2d()
    shift = MapProjection(plan.to_wkt()).operation_at(lon_deg, lat_deg)
    by = [part for part in shift.operations or () if part.has_ballpark_transformation or part.accuracy > 0.0]
    unknown = any(part.has_ballpark_transformation for part in by)
    ellipsoid, datum = plan.ellipsoid, plan.datum
    alike = ellipsoid is not None and abs(ellipsoid.semi_major_metre - SEMI_MAJOR_M) < _SATELLITES_M
    if alike if unknown else round(shift.accuracy, 1) <= (_SAME_DATUM_M if alike else _SHIFT_M):
        return []
    name = crs.name if datum is None else datum.name
    operations = ", ".join(part.name.removeprefix("Inverse of ") for part in by)
    with unwarned(UserWarning):  # the grid that is missing is named below
        near = area_about(np.array([lon_deg]), np.array([lat_deg]))
        group = TransformerGroup("EPSG:4979", plan, always_xy=True, area_of_interest=near)
    better = [op for op in group.unavailable_operations if unknown or 0.0 <= op.accuracy < shift.accuracy]
    fix = "" if not better else f"{installing(missing_grids(better), 'the grid of a better one')}, or "
    fix += "give files and --crs in one system, where the shift cancels"
    text = (
        f"{what}: PROJ knows no shift between WGS 84 and {name}, so that coordinates go over unchanged and "
        "may be off by hundreds of metres"
        if unknown
        else f"{what}: PROJ's shift between WGS 84 and {name} ({operations}) is accurate to "
        f"{shift.accuracy:g} m, which stated deviations do not include"
    )
    return [Warn("datum-shift-unsure", "", f"{text}; {fix}")]
