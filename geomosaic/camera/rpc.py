"""Rational polynomial coefficients: image from ground as the quotient of two cubics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from geomosaic.arrays import Floats
from geomosaic.constants import ROUNDS, tuned
from geomosaic.errors import InputError
from geomosaic.geodesy.ellipsoid import longitudes_near

_OFFSETS = ("LINE_OFF", "SAMP_OFF", "LAT_OFF", "LONG_OFF", "HEIGHT_OFF")
_SCALES = ("LINE_SCALE", "SAMP_SCALE", "LAT_SCALE", "LONG_SCALE", "HEIGHT_SCALE")
_COEFFICIENTS = ("LINE_NUM_COEFF", "LINE_DEN_COEFF", "SAMP_NUM_COEFF", "SAMP_DEN_COEFF")
_RIDGE = tuned(1e-8, "half images", "per 1 of a coefficient: 1e-4 leaves 0.001 px, this 3e-8 px")


@dataclass(frozen=True, eq=False)
class Rpc:
    """The RPC00B of STDI-0002 (NGA), terms in its order.

    Convention: in the file lines and samples count from the middle of the first pixel; here, as everywhere,
    col and line count from its corner. offset, scale: (5,) of line, sample, latitude, longitude (degrees),
    ellipsoidal height (m), as in the file. coefficients: (4, 20) line numerator, line denominator, sample
    numerator, sample denominator.
    """

    offset: Floats
    scale: Floats
    coefficients: Floats

    def image_from_ground(self, ground: ArrayLike) -> Floats:
        """Col and line (..., 2) of longitude, latitude (degrees) and ellipsoidal height (..., 3)."""
        terms = _terms(self._normal(np.asarray(ground, dtype=np.float64)))
        line = (terms @ self.coefficients[0]) / (terms @ self.coefficients[1])
        col = (terms @ self.coefficients[2]) / (terms @ self.coefficients[3])
        image = np.stack([col, line], axis=-1)
        return np.asarray(image * self.scale[[1, 0]] + self.offset[[1, 0]] + 0.5)

    def _normal(self, ground: Floats) -> Floats:
        return np.asarray(
            (_unwrapped(ground, self.offset[3]) - self.offset[[3, 2, 4]]) / self.scale[[3, 2, 4]]
        )

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> Rpc:
        """From GDAL's RPC metadata; `InputError` for what is missing or no number."""
        try:
            offset, scale = (np.array([float(_value(metadata, k)) for k in ks]) for ks in (_OFFSETS, _SCALES))
            rows = [_list(metadata, key) for key in _COEFFICIENTS]
        except KeyError as error:
            raise InputError(f"the RPC has no {error.args[0]}") from error
        except (ValueError, IndexError) as error:
            raise InputError("the RPC holds what is no number") from error
        if any(len(row) != 20 for row in rows):
            raise InputError("the RPC has lists of other than 20 coefficients")
        rpc = cls(offset, scale, np.array(rows))
        finite = all(np.isfinite(a).all() for a in (rpc.offset, rpc.scale, rpc.coefficients))
        if not finite or not (rpc.scale > 0.0).all():
            raise InputError("the RPC's numbers aren't finite, or a scale isn't above 0")
        return rpc

    def metadata(self) -> dict[str, str]:
        """As GDAL's RPC metadata domain takes it."""
        named = {k: f"{v:.12g}" for k, v in zip(_OFFSETS, self.offset, strict=True)}
        named |= {k: f"{v:.12g}" for k, v in zip(_SCALES, self.scale, strict=True)}
        lists = zip(_COEFFICIENTS, self.coefficients, strict=True)
        return named | {k: " ".join(f"{v:.15g}" for v in row) for k, row in lists}

    def text(self) -> str:
        """As a file X_RPC.TXT next to X.tif, which GDAL reads."""
        lines = []
        for key, value in self.metadata().items():
            if key in _COEFFICIENTS:
                lines += [f"{key}_{i}: {v}" for i, v in enumerate(value.split(), 1)]
            else:
                lines.append(f"{key}: {value}")
        return "\n".join(lines) + "\n"


def parse_rpc(text: str) -> Rpc:
    """The RPC of a text of `KEY: value` lines (GeoEye's _RPC.TXT); `InputError` if it is none."""
    pairs = (line.partition(":")[::2] for line in text.splitlines() if ":" in line)
    return Rpc.from_metadata({key.strip().upper(): value.strip() for key, value in pairs})


def fit_rpc(ground: Floats, image: Floats) -> tuple[Rpc, float]:
    """The RPC that fits cols and lines (n, 2) of ground points (n, 3), and its worst residual in px.

    The denominators are multiplied out and reweighted (Tao and Hu 2001, PE&RS 67 (12), section 3), slightly
    regularised. Points should fill the scene and its span of heights.
    """
    ground = _unwrapped(ground, ground[0, 0])
    low, high = ground.min(axis=0), ground.max(axis=0)
    first, last = image.min(axis=0) - 0.5, image.max(axis=0) - 0.5
    middle, half = (low + high) / 2.0, np.maximum((high - low) / 2.0, [1e-6, 1e-6, 1.0])
    middle = _unwrapped(middle, 0.0)
    offset = np.concatenate([((first + last) / 2.0)[::-1], middle[[1, 0, 2]]])
    scale = np.concatenate([((last - first) / 2.0)[::-1], half[[1, 0, 2]]])
    offset, scale = (np.array([float(f"{v:.12g}") for v in a]) for a in (offset, scale))
    rpc = Rpc(offset, scale, np.zeros((4, 20)))
    terms = _terms(rpc._normal(ground))
    wanted = (image[:, ::-1] - 0.5 - offset[:2]) / scale[:2]
    rows = [row for k in range(2) for row in _quotient(terms, wanted[:, k])]
    rpc = Rpc(offset, scale, np.array(rows))
    return rpc, float(np.abs(rpc.image_from_ground(ground) - image).max())


def _quotient(terms: Floats, value: Floats) -> tuple[Floats, Floats]:
    """Numerator and denominator (20,) each, the denominator's constant being 1."""
    design = np.hstack([terms, -value[:, None] * terms[:, 1:]])
    weight = np.ones(len(value))
    ridge = _RIDGE * np.sqrt(len(value)) * np.eye(design.shape[1])
    for _ in range(ROUNDS):
        lhs = np.vstack([design * weight[:, None], ridge])
        rhs = np.concatenate([value * weight, np.zeros(len(ridge))])
        solved = np.linalg.lstsq(lhs, rhs, rcond=None)[0]
        denominator = np.concatenate([[1.0], solved[20:]])
        weight = 1.0 / (terms @ denominator)
    return solved[:20], denominator


def _unwrapped(ground: Floats, lon_deg: float) -> Floats:
    """Longitude, latitude (degrees), height (..., 3), with longitudes within 180 degrees of one of them."""
    return np.concatenate([longitudes_near(ground[..., :1], lon_deg), ground[..., 1:]], axis=-1)


def _terms(normal: Floats) -> Floats:
    lon, lat, h = (normal[..., k] for k in range(3))
    one = np.ones_like(lon)
    return np.stack(
        [one, lon, lat, h, lon * lat, lon * h, lat * h, lon**2, lat**2, h**2, lat * lon * h, lon**3,
         lon * lat**2, lon * h**2, lon**2 * lat, lat**3, lat * h**2, lon**2 * h, lat**2 * h, h**3],
        axis=-1,
    )  # fmt: skip


def _value(metadata: Mapping[str, str], key: str) -> str:
    """A value without its unit: 'LAT_OFF: 41.5 degrees'."""
    return metadata[key].split()[0]


def _list(metadata: Mapping[str, str], key: str) -> list[float]:
    if key in metadata:
        return [float(v) for v in metadata[key].split()]
    return [float(_value(metadata, f"{key}_{i}")) for i in range(1, 21)]
