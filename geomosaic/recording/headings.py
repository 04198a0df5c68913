"""Images that a run took for turned, held against the adjusted positions."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from geomosaic.matching.turned import headings_fit
from geomosaic.placement.graph import flight_lines
from geomosaic.placement.prior import courses_deg

Floats = NDArray[np.float64]


def against_their_course(
    turned: Collection[int], given_rad: Floats, found_rad: Floats, positions_m: Floats
) -> frozenset[int]:
    """Those of the turned images whose given headings go against their course: the heading is wrong, not the
    image turned. Where a position was wrong too, matching knew no course.

    Args: given_rad, found_rad (n,): headings as given, NaN if unknown, and as the images lie; positions_m (n,
        2): adjusted.
    """
    if not turned or not np.isfinite(positions_m).all():
        return frozenset()
    course_rad = np.radians(courses_deg(positions_m, flight_lines(positions_m)))
    fits, _ = headings_fit(turned, given_rad, found_rad, course_rad)
    return frozenset(i for i, fit in fits.items() if not fit)
