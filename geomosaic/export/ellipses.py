"""Standard error ellipses of places on the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from geomosaic.arrays import Floats

_CORNERS = 48
_SHARE_OF_SPACING = 0.4


@dataclass(frozen=True)
class ErrorEllipses:
    """At one standard deviation: semi-axes (n,) in m, azimuth (n,) of the major one from grid north, 0 to pi.

    NaN where nothing is known. Of two coordinates, 39 % of normal errors lie inside.
    """

    semi_major_m: Floats
    semi_minor_m: Floats
    azimuth_rad: Floats

    def outlines_m(self, at_m: Floats, factor: float) -> Floats:
        """Closed outlines (n, corners, 2) around places (n, 2), larger than life by a factor."""
        t = np.linspace(0.0, 2.0 * np.pi, _CORNERS, endpoint=False)
        along = np.stack([np.sin(self.azimuth_rad), np.cos(self.azimuth_rad)], axis=-1)
        across = np.stack([along[:, 1], -along[:, 0]], axis=-1)
        major = (self.semi_major_m[:, None] * np.cos(t))[..., None] * along[:, None]
        minor = (self.semi_minor_m[:, None] * np.sin(t))[..., None] * across[:, None]
        return np.asarray(at_m[:, None] + factor * (major + minor))


def error_ellipses(covariance_m2: Floats) -> ErrorEllipses:
    """Of covariances (n, 2, 2) of easting and northing: their principal axes in closed form.

    The covariance's eigenvalues are mean ± spread; tan(2 azimuth) = 2 c_en / (c_nn - c_ee).
    """
    east, north, both = covariance_m2[:, 0, 0], covariance_m2[:, 1, 1], covariance_m2[:, 0, 1]
    mean, spread = (east + north) / 2.0, np.hypot((north - east) / 2.0, both)
    return ErrorEllipses(
        np.sqrt(mean + spread),
        np.sqrt(np.maximum(mean - spread, 0.0)),
        np.asarray(np.arctan2(2.0 * both, north - east) / 2.0 % np.pi),
    )


def exaggeration(lengths_m: Floats, at_m: Floats, share: float = _SHARE_OF_SPACING) -> float:
    """How many times larger to draw lengths (k,) among places (n, 2).

    1, 2 or 5 times a power of ten, at least 1: the typical length then reaches so much of the way to the next
    place.
    """
    known = lengths_m[np.isfinite(lengths_m)]
    places = np.unique(at_m[np.isfinite(at_m).all(axis=1)].round(), axis=0)
    if len(places) < 2 or not known.size:
        return 1.0
    spacing_m = float(np.median(cKDTree(places).query(places, k=2)[0][:, 1]))
    most = share * spacing_m / max(float(np.median(known)), 1e-9)
    if most <= 1.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(most))
    return float(max(m for m in (1.0, 2.0, 5.0) if m * power <= most) * power)
