"""The hot spot: ground looks brightest with the sun behind the camera, where it hides its own shadows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.sparse import csr_matrix
from scipy.special import chdtri

from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.camera.interior import Camera
from geomosaic.composition.tone_equations import ToneDesign
from geomosaic.composition.views import FrameView
from geomosaic.constants import sourced, tuned
from geomosaic.geodesy.sun import sun_direction
from geomosaic.matching.tracks import frame_by_frame
from geomosaic.survey.model import Survey

_WIDTHS_RAD = tuned(
    (0.04, 0.06, 0.09, 0.13, 0.2), "rad", "of the spot: fields came to 0.09; wider are slopes"
)
_ZONES_H = sourced(
    tuple(k / 2.0 for k in range(-28, 25)),
    "h",
    "from civil to universal time",
    "IANA time zone database: -14 to 12 h",
)
_LEAST_UP = tuned(0.2, "sine of the sun's elevation", "lower: its shadow lies beyond every frame")
_SEEN = tuned(0.5, "of the spot's peak", "less: slopes and vignettes of frames that see none look like one")
_MOST = tuned(30_000, "sightings", "to look for a spot in: more take minutes of thousands of frames")
_MOST_LOG = sourced(
    math.log(2.0),
    "log brightness",
    "of a spot: where no shadow shows, light once scattered is twice as bright at most",
    "Hapke 1986, Bidirectional reflectance spectroscopy 4, Icarus 67: B0 is 0 to 1",
)
_BY_CHANCE = tuned(1e-3, "probability", "of a spot where there is none; more: cars make some")


@dataclass(frozen=True)
class SunBehind:
    """Where frames look with the sun behind, and where they are looked at. away (z, n, 3): in each camera's
    axes, by the time zone that tags may be in; NaN where the sun is low. rays (m, 3): of sightings, in their
    camera's axes. All of unit length."""

    away: Floats
    rays: Floats

    @classmethod
    def of(
        cls, survey: Survey, views: Sequence[FrameView], frame: Ints, image_px: Floats
    ) -> SunBehind | None:
        """By the frames' times; None where nothing tells when or where they were taken. Times without their
        offset from universal time may be of any time zone."""
        times_s = np.array([f.time_s for f in survey.frames], dtype=np.float64)
        if np.isnan(times_s).all() or not any(survey.located):
            return None
        times_s[np.isnan(times_s)] = np.nanmedian(times_s)
        origin = survey.work_frame
        away = np.full((len(_ZONES_H), len(times_s), 3), np.nan)
        rays = np.empty((len(frame), 3))
        its = dict(frame_by_frame(frame))
        for view in views:
            mine = its.get(view.frame, np.arange(0))
            rays[mine] = directions(view.camera, image_px[mine])
            for k, zone_h in enumerate(_ZONES_H):
                sun = sun_direction(origin.lon_deg, origin.lat_deg, times_s[view.frame] + 3600.0 * zone_h)
                if sun[2] > _LEAST_UP:
                    away[k, view.frame] = -sun @ view.pose.rotation.matrix
        return cls(away, rays)


def directions(camera: Camera, image_px: Floats) -> Floats:
    """Of what a camera sees at image coordinates (..., 2), in its axes, of unit length (..., 3)."""
    rays = camera.ray_from_image(image_px)
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def hot_spot(rays: Floats, away: Floats, width_rad: float) -> Floats:
    """How much of the spot rays (..., 3) of unit length see, (...). It is 1 in the spot's middle and falls
    off as an exponential of the angle (Chen and Leblanc 1997, A four-scale bidirectional reflectance model,
    section II-C). It is 0 where a ray is unknown, past the end of the lens. away (..., 3):
    `SunBehind.away`."""
    off = np.arccos(np.clip((rays * away).sum(axis=-1), -1.0, 1.0))
    return np.asarray(np.nan_to_num(np.exp(-off / width_rad)))


@dataclass(frozen=True)
class TonesLeft:
    """What evened frames differ by: logs (k, b) of sightings less their places' means, with their weights
    (k, b); known (m,): which sightings these are. design: of these sightings; priors: each band's part of
    the normal equations. bent: by how much more logs differ than the light, in the median."""

    logs: Floats
    weight: Floats
    known: Bools
    design: ToneDesign
    priors: Sequence[csr_matrix]
    bent: float = 1.0

    def some(self) -> TonesLeft:
        """Those of every n-th place, as many as tell; known (k,): which of these sightings."""
        step = -(-len(self.logs) // _MOST)
        mine = np.asarray(self.design.place % step == 0)
        return replace(
            self,
            logs=self.logs[mine],
            weight=self.weight[mine],
            known=mine,
            design=self.design.of(mine),
        )


def shown_spot(behind: SunBehind, left: TonesLeft) -> tuple[Floats, float] | None:
    """The directions away from the sun (n, 3) and the width of the spot that lessens what frames differ by
    most; None where it may be chance.

    All time zones and widths are tried: chance has as many goes. A spot is partly absorbed by gains, slopes
    and vignettes, wide ones most. The width of the zone's spot accounts for this.
    """
    if not len(left.logs):
        return None
    rays, some = behind.rays[left.known], left.some()
    up = [away for away in behind.away if not np.isnan(away[some.design.frame]).any()]
    spots = [(away, width) for away in up for width in _WIDTHS_RAD]
    gains = [_gain(hot_spot(rays[some.known], away[some.design.frame], width), some) for away, width in spots]
    if not any(gains):
        return None
    best = int(np.argmax(gains))
    least = chdtri(left.logs.shape[1], _BY_CHANCE / np.count_nonzero(gains))
    if gains[best] * len(left.logs) / len(some.logs) <= least:
        return None
    away = spots[best][0]
    return away, _width_rad(rays, away[left.design.frame], left)


def can_be_spot(logs: Floats, bent: float) -> bool:
    """Whether heights (b,) of a spot are those of hidden shadows: brighter in all bands, by a factor of two
    at most. Others come from errors of another kind, such as of frames taken from one place. These show
    each place under one angle, and tell nothing of the sun. bent: see `TonesLeft`."""
    return bool((logs > 0.0).all() and (logs <= _MOST_LOG * bent).all())


def _width_rad(rays: Floats, away: Floats, left: TonesLeft) -> float:
    """The width of the spot about directions (k, 3) that lessens what frames differ by most, with all other
    unknowns free."""

    each = zip(left.weight.T, left.priors, strict=True)
    normals = [left.design.normal(weight, priors) for weight, priors in each]

    def left_over(log_width: float) -> float:
        spot, gain = hot_spot(rays, away, math.exp(log_width)), 0.0
        for logs, weight, of_band in zip(left.logs.T, left.weight.T, normals, strict=True):
            own, square = _own(spot, weight, left)
            along = left.design.summed(weight * own)
            square -= float(along @ of_band.solve(along))
            gain += float((weight * own * logs).sum()) ** 2 / square if square > 0.0 else 0.0
        return -gain

    ends = math.log(_WIDTHS_RAD[0]), math.log(_WIDTHS_RAD[-1])
    return math.exp(float(minimize_scalar(left_over, bounds=ends, method="bounded").x))


def _gain(spot: Floats, left: TonesLeft) -> float:
    """By how much the weighted squares lessen; 0 where no frame looks into the spot."""
    if spot.max() < _SEEN:
        return 0.0
    gain = 0.0
    for logs, weight in zip(left.logs.T, left.weight.T, strict=True):
        own, square = _own(spot, weight, left)
        gain += float((weight * own * logs).sum()) ** 2 / square if square > 0.0 else 0.0
    return gain


def _own(spot: Floats, weight: Floats, left: TonesLeft) -> tuple[Floats, float]:
    """What sightings (k,) see of the spot beyond their place's mean, and its weighted square."""
    own = spot - left.design.means(weight, spot)
    return own, float((weight * own * own).sum())
