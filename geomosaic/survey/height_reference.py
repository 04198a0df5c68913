"""What a survey's reported heights count from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.geodesy.heights import ellipsoidal_offset_m, sea_level
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import is_local
from geomosaic.survey.model import Survey


@dataclass(frozen=True)
class HeightReference:
    """What a survey's reported heights count from. height_m (n,): ellipsoidal as
    reported, NaN where not; sd_m (n,): as stated. datum_sd_m: common deviation of a vertical datum that is
    not stated, None where it is."""

    work_frame: LocalFrame
    height_m: Floats
    sd_m: Floats
    datum_sd_m: float | None


def height_reference(survey: Survey) -> HeightReference | None:
    """What the survey's heights count from; None with a DEM or in a local frame. A source that doesn't state
    its vertical datum (EXIF, most POS files) may count from the ellipsoid or from the sea. Their deviation is
    then the geoid's undulation at the survey."""
    if survey.elevation is not None or is_local(survey.map_crs):
        return None
    positions = [f.position for f in survey.frames]
    height_m = np.array([p.height_ellipsoidal_m for p in positions], dtype=np.float64)
    unstated = np.array([not p.datum_stated for p in positions], dtype=bool)[np.isfinite(height_m)]
    work_frame, datum_sd_m = survey.work_frame, None
    if unstated.size and unstated.mean() > 0.5:
        place = work_frame.lon_deg, work_frame.lat_deg
        datum_sd_m = abs(ellipsoidal_offset_m(sea_level(*place), *place))
    return HeightReference(work_frame, height_m, np.array([p.sd_vertical_m for p in positions]), datum_sd_m)
