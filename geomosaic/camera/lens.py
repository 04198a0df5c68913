"""How lenses bend rays: the one place of each kind's formulas.

A lens takes ideal coordinates (x to the right, y to the image's bottom, both divided by the depth) to those
in the image, divided by the focal length. Each kind has the five `TERMS`, whose meaning is its own:

- `brown` (Brown 1971, as OpenCV and OpenSfM write it), with r² = x² + y²:
  `x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²)`,
  `y' = y (1 + k1 r² + k2 r⁴ + k3 r⁶) + p1 (r² + 2 y²) + 2 p2 x y`;
- `fisheye` (Kannala and Brandt 2006, equation 6, as OpenCV's and OpenSfM's), with θ = atan r the angle from
  the axis: `(x', y') = (x, y) / r · θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + p1 θ⁸ + p2 θ)`. p1 is OpenCV's k4; p2 is
  Pix4D's, since a lens has no even powers.

Every function takes the terms in the order of `TERMS`, numbers or arrays that broadcast, in any precision.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Floats
from geomosaic.constants import MOST_ROUNDS, sourced, tuned

Array = NDArray[Any]

TERMS: Final = ("k1", "k2", "k3", "p1", "p2")
_WIDEST_RAD = tuned(1.5, "rad", "off a fisheye's axis: tangents end at a right angle; less cuts corners")
_FISHEYE_POWERS = sourced((2, 4, 6, 8, 1), "powers", "of the angle", "Kannala and Brandt 2006, eq. 6; Pix4D")
STEPS = tuned(4096, "steps", "of tables, each 0.001 of the radius: fewer are coarse; more are slow")
_TINY = tuned(1e-12, "focal lengths", "least radius, last step of the inverse: more shows in derivatives")
_FLATTEST = tuned(0.2, "1", "least slope of an inverse step: less lets it run off; more makes it short")
_OUTSIDE = tuned(1.1, "corner radii", "reach of the formula: less loses corners; more extrapolates")


@dataclass(frozen=True)
class Lens:
    """A kind of lens.

    bent: x' and y' of the terms, x, y and their squared radius. slopes: dx'/dx, dx'/dy = dy'/dx and dy'/dy of
    the same. by_terms: derivatives of x' and y' by each term, of x, y and their squared radius.
    straightened: ideal (..., 2) from bent coordinates (..., 2), to 1e-12; those past the limit, an ideal
    radius, come to lie near it. radial: the bent radius for an ideal one, without decentring. radii: ideal
    radii (n,) from 0 until past a bent one. shares: by what share of its radius a unit of each term moves a
    point there at most, (5,). decentring: whether p1 and p2 point down and right, and so turn with an image.
    """

    bent: Callable[[Array, Array, Array, Array], tuple[Array, Array]]
    slopes: Callable[[Array, Array, Array, Array], tuple[Array, Array, Array]]
    by_terms: Callable[[Array, Array, Array], list[tuple[Array | float, Array | float]]]
    straightened: Callable[[Array, Floats, float], Floats]
    radial: Callable[[Array, Array], Array]
    radii: Callable[[float], Floats]
    shares: Callable[[float], Floats]
    decentring: bool

    def limit(self, terms: Array, far: float) -> float:
        """The ideal radius past which the formula is no lens any more.

        Where the bent radius stops growing, else a little past `far`, that of the image's farthest corner.
        """
        radius = self.radii(far)
        grown = self.radial(terms, radius)
        falling = np.flatnonzero(np.diff(grown) <= 0.0)
        end = int(falling[0]) if falling.size else radius.size - 1
        outside = np.flatnonzero(grown[: end + 1] > _OUTSIDE * far)
        return float(radius[outside[0] if outside.size else end])


def _brown_bent(terms: Array, x: Array, y: Array, r_sq: Array) -> tuple[Array, Array]:
    k1, k2, k3, p1, p2 = terms
    if not np.any(terms):
        return x, y
    scale = r_sq * (k1 + r_sq * (k2 + r_sq * k3)) if np.any(k2) or np.any(k3) else r_sq * k1
    if not (np.any(p1) or np.any(p2)):
        return x + x * scale, y + y * scale
    scale += 2 * (p1 * y + p2 * x)
    return x + (x * scale + p2 * r_sq), y + (y * scale + p1 * r_sq)


def _brown_slopes(terms: Array, x: Array, y: Array, r_sq: Array) -> tuple[Array, Array, Array]:
    k1, k2, k3, p1, p2 = terms
    scale = 1.0 + r_sq * (k1 + r_sq * (k2 + r_sq * k3))
    per = k1 + r_sq * (2.0 * k2 + 3.0 * r_sq * k3)
    return (
        scale + 2.0 * x * x * per + 2.0 * p1 * y + 6.0 * p2 * x,
        2.0 * x * y * per + 2.0 * p1 * x + 2.0 * p2 * y,
        scale + 2.0 * y * y * per + 6.0 * p1 * y + 2.0 * p2 * x,
    )


def _brown_by_terms(x: Array, y: Array, r_sq: Array) -> list[tuple[Array | float, Array | float]]:
    radial = [(x * power, y * power) for power in (r_sq, r_sq * r_sq, r_sq * r_sq * r_sq)]
    both = 2.0 * x * y
    return [*radial, (both, r_sq + 2.0 * y * y), (r_sq + 2.0 * x * x, both)]


def _brown_straightened(terms: Array, xy: Floats, limit: float) -> Floats:
    """By fixed point: each step along the radius by the radial slope, across it by how far the lens enlarges
    there. Near the radius where the lens ends, the two differ by any factor."""
    ideal = np.array(xy, dtype=np.float64)
    if not np.any(terms):
        return ideal
    k1, k2, k3 = terms[:3]
    for _ in range(MOST_ROUNDS):
        x, y = ideal[..., 0], ideal[..., 1]
        r_sq = np.minimum(x * x + y * y, limit * limit)
        slope = np.maximum(1.0 + r_sq * (3.0 * k1 + r_sq * (5.0 * k2 + r_sq * 7.0 * k3)), _FLATTEST)
        scale = np.maximum(1.0 + r_sq * (k1 + r_sq * (k2 + r_sq * k3)), _FLATTEST)
        off = xy - np.stack(_brown_bent(terms, x, y, x * x + y * y), axis=-1)
        outward = (off * ideal).sum(axis=-1) / np.maximum(x * x + y * y, np.finfo(np.float64).tiny)
        along = outward[..., None] * ideal
        step = along / slope[..., None] + (off - along) / scale[..., None]
        ideal += step
        r_sq = ideal[..., 0] ** 2 + ideal[..., 1] ** 2
        if np.nanmax(r_sq, initial=0.0) > limit * limit:
            ideal *= (limit / np.maximum(np.sqrt(r_sq), limit))[..., None]
        if np.nanmax(np.abs(step), initial=0.0) < _TINY:
            break
    return ideal


def _brown_radial(terms: Array, radius: Array) -> Array:
    r_sq = radius * radius
    return np.asarray(radius * (1.0 + r_sq * (terms[0] + r_sq * (terms[1] + r_sq * terms[2]))))


def _brown_radii(far: float) -> Floats:
    return np.linspace(0.0, 3.0 * far, STEPS)


def _brown_shares(radius: float) -> Floats:
    return np.array([radius**2, radius**4, radius**6, 3.0 * radius, 3.0 * radius])


def _fisheye_angle(terms: Array, theta: Array) -> Array:
    """The bent radius at an angle from the axis."""
    k1, k2, k3, p1, p2 = terms
    t = theta
    sq = t * t
    return np.asarray(t + sq * (p2 + t * (k1 + sq * (k2 + sq * (k3 + sq * p1)))))


def _fisheye_slope(terms: Array, theta: Array) -> Array:
    """Its derivative by that angle."""
    k1, k2, k3, p1, p2 = terms
    t = theta
    sq = t * t
    return np.asarray(
        1.0 + t * 2.0 * p2 + sq * (3.0 * k1 + sq * (5.0 * k2 + sq * (7.0 * k3 + sq * 9.0 * p1)))
    )


def _fisheye_bent(terms: Array, x: Array, y: Array, r_sq: Array) -> tuple[Array, Array]:
    radius = np.maximum(np.sqrt(r_sq), r_sq.dtype.type(_TINY))
    scale = _fisheye_angle(terms, np.arctan(radius)) / radius
    return x * scale, y * scale


def _fisheye_slopes(terms: Array, x: Array, y: Array, r_sq: Array) -> tuple[Array, Array, Array]:
    square = np.maximum(r_sq, _TINY**2)
    radius = np.sqrt(square)
    theta = np.arctan(radius)
    scale = _fisheye_angle(terms, theta) / radius
    per = (_fisheye_slope(terms, theta) / (1.0 + square) - scale) / square
    return scale + x * x * per, x * y * per, scale + y * y * per


def _fisheye_by_terms(x: Array, y: Array, r_sq: Array) -> list[tuple[Array | float, Array | float]]:
    radius = np.maximum(np.sqrt(r_sq), _TINY)
    theta = np.arctan(radius)
    share = theta / radius
    powers = (theta**n * share for n in _FISHEYE_POWERS)
    return [(x * power, y * power) for power in powers]


def _fisheye_straightened(terms: Array, xy: Floats, limit: float) -> Floats:
    """By Newton's steps on the angle."""
    bent = np.maximum(np.hypot(xy[..., 0], xy[..., 1]), _TINY)
    widest = np.arctan(limit)
    theta = np.minimum(bent, widest)
    for _ in range(MOST_ROUNDS):
        step = (bent - _fisheye_angle(terms, theta)) / np.maximum(_fisheye_slope(terms, theta), _FLATTEST)
        before, theta = theta, np.clip(theta + step, 0.0, widest)
        if np.nanmax(np.abs(theta - before), initial=0.0) < _TINY:
            break
    return np.asarray(xy * (np.tan(theta) / bent)[..., None])


def _fisheye_radial(terms: Array, radius: Array) -> Array:
    return _fisheye_angle(terms, np.arctan(radius))


def _fisheye_radii(far: float) -> Floats:
    return np.tan(np.linspace(0.0, min(3.0 * far, _WIDEST_RAD), STEPS))


def _fisheye_shares(radius: float) -> Floats:
    """An equidistant lens's radius is about its angle."""
    return np.array([min(radius, _WIDEST_RAD) ** n for n in _FISHEYE_POWERS])


LENSES: Final = {
    "brown": Lens(
        _brown_bent, _brown_slopes, _brown_by_terms, _brown_straightened, _brown_radial, _brown_radii,
        _brown_shares, decentring=True,
    ),
    "fisheye": Lens(
        _fisheye_bent, _fisheye_slopes, _fisheye_by_terms, _fisheye_straightened, _fisheye_radial,
        _fisheye_radii, _fisheye_shares, decentring=False,
    ),
}  # fmt: skip
"""By the name that a `Camera` has as its kind."""


def fisheye_terms(coefficients: dict[int, float], widest_rad: float) -> tuple[float, Floats]:
    """Scale and terms (5,) of `scale * fisheye` that come nearest to a radius of sum c_n θ^n up to an angle.

    Exact but for Pix4D's fourth power, which the others take up to some thousandths of a pixel.
    """
    if set(coefficients) <= {1, *(n + 1 for n in _FISHEYE_POWERS)}:
        scale = coefficients.get(1, 0.0)
        return scale, np.array([coefficients.get(n + 1, 0.0) / scale for n in _FISHEYE_POWERS])
    theta = np.linspace(0.0, widest_rad, STEPS)
    wanted = sum(c * theta**n for n, c in coefficients.items())
    found = np.linalg.lstsq(
        np.stack([theta ** (n + 1) for n in (0, *_FISHEYE_POWERS)], 1), wanted, rcond=None
    )[0]
    return float(found[0]), found[1:] / found[0]


def opencv_terms(kind: str, terms: Floats, widest: float) -> Floats:
    """As OpenCV writes the terms: k1, k2, p1, p2, k3 of Brown's, k1 to k4 of a fisheye's. A fisheye's even
    power, which OpenCV lacks, is fitted by odd ones up to an ideal radius of `widest`."""
    if kind == "brown":
        return terms[[0, 1, 3, 4, 2]]
    if not terms[4]:
        return terms[:4]
    theta = np.linspace(0.0, np.arctan(widest), STEPS)
    odd = np.stack([theta**n for n in (3, 5, 7, 9)], axis=1)
    return np.asarray(np.linalg.lstsq(odd, _fisheye_angle(terms, theta) - theta, rcond=None)[0])
