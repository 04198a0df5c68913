"""Images that a run took for turned, held against the adjusted positions."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

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


def reheaded(
    said: Iterable[tuple[str, str, str]], off_deg: Mapping[str, float]
) -> tuple[tuple[str, str, str], ...]:
    """Warnings (code, frame, text), with turned images whose headings are off by so much accused of that."""
    text = (
        "its heading was off by {:.0f} degrees: as given it is against the course over the adjusted "
        "positions; the run took its image for turned, which laid it alike"
    )
    return tuple(
        ("yaw-wrong", frame, text.format(off_deg[frame]))
        if code == "frame-turned" and frame in off_deg
        else (code, frame, words)
        for code, frame, words in said
    )
