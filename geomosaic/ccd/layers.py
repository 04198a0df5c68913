"""Clouds as a second layer: moved against the ground by one vector, the wind's and their height's.

Correlation alone can't say which of two layers is the ground; but ground + vector is seen where there are
clouds and ground - vector nowhere, so that a path which may change layers for a fixed vector is the ground's
all the way, or the cloud's all the way. Which of the two is settled once for the scene (`paths`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, rfft2
from scipy.ndimage import gaussian_filter, maximum_filter, uniform_filter1d

from geomosaic.ccd.model import Floats
from geomosaic.constants import tuned

_LEAST_BINS = tuned(1, "bins", "gap between layers: less splits one peak; more misses low clouds")
_PEAK = tuned(5.0, "log-likelihood", "peak of a block: less gives chance vectors; more misses thin clouds")
_NOTABLE = tuned(0.004, "share", "of the unmoved correlation: less tries chance; more misses small clouds")
_SECOND_COSTS = tuned(1.0, "log-likelihood", "cost of a block in cloud: less makes clouds of noise")


@dataclass(frozen=True)
class LayerVector:
    """Clouds against the ground, in bins of the volumes: lines, columns."""

    lines: int
    cols: int


def layer_candidates(volumes: Floats, around_blocks: int, most: int = 4) -> list[LayerVector]:
    """Vectors between two layers, most probable first: peaks of the volumes' correlation with themselves.

    Args: volumes (pairs, blocks, h, c). around_blocks: both are looked for within so
    many. Only one of a vector and its opposite is given.
    """
    n, h, c = volumes.shape[1:]
    size = (2 * h, 2 * c)
    peaks = np.where(volumes >= maximum_filter(volumes, size=(1, 1, 3, 3)), volumes, 0.0)
    near = uniform_filter1d(
        np.maximum(peaks - _PEAK, 0.0), min(max(around_blocks, 1), n), axis=1, mode="nearest"
    )
    total = np.zeros(size)
    for pair in near:
        spectrum = rfft2(pair, s=size)
        total += irfft2((spectrum.real**2 + spectrum.imag**2).sum(axis=0), s=size)
    lag_l = np.fft.fftfreq(size[0], 1 / size[0]).astype(int)[:, None]
    lag_c = np.fft.fftfreq(size[1], 1 / size[1]).astype(int)[None, :]
    share = (h - np.abs(lag_l)) * (c - np.abs(lag_c))
    total = gaussian_filter(total, 0.6, mode="wrap")
    one_half = (lag_l > 0) | ((lag_l == 0) & (lag_c > 0))
    far = (np.abs(lag_l) > _LEAST_BINS) | (np.abs(lag_c) > _LEAST_BINS)
    # A single layer that moves gives what its two profiles give; the rest is another layer's.
    excess = np.where(lag_c == 0, total, total - total[:, :1] * total[:1] / max(total[0, 0], 1e-12))
    peak = (excess >= maximum_filter(excess, 3, mode="wrap")) & one_half & far & (share > 0)
    rows, cols = np.nonzero(peak & (excess > _NOTABLE * total[0, 0]))
    order = np.argsort(-excess[rows, cols], kind="stable")[:most]
    return [LayerVector(int(lag_l[rows[i], 0]), int(lag_c[0, cols[i]])) for i in order]


def either_layer(volumes: Floats, layers: list[LayerVector]) -> Floats:
    """For every shift of the ground, the evidence of the layer that explains a block best."""
    h, c = volumes.shape[2:]
    out = volumes
    for layer in layers:
        spread = maximum_filter(volumes, size=(1, 1, 3, 3), mode="constant") - _SECOND_COSTS
        to_l, from_l = _slices(layer.lines, h)
        to_c, from_c = _slices(layer.cols, c)
        out = out.copy() if out is volumes else out
        out[:, :, to_l, to_c] = np.maximum(out[:, :, to_l, to_c], spread[:, :, from_l, from_c])
    return out


def second_layer(volumes: Floats, layer: LayerVector, path: NDArray[np.intp]) -> NDArray[np.bool_]:
    """(pairs, blocks): where the second layer explains more than the first along paths (pairs, blocks, 2)."""
    spread = maximum_filter(volumes, size=(1, 1, 3, 3), mode="constant")
    away = np.array([layer.lines, layer.cols])
    return np.asarray(_along(spread, path + away) > _along(spread, path) + 2.0)


def _along(volumes: Floats, path: NDArray[np.intp]) -> Floats:
    h, c = volumes.shape[2:]
    inside = (path[..., 0] >= 0) & (path[..., 0] < h) & (path[..., 1] >= 0) & (path[..., 1] < c)
    k, n = path.shape[:2]
    at = volumes[
        np.arange(k)[:, None], np.arange(n), np.clip(path[..., 0], 0, h - 1), np.clip(path[..., 1], 0, c - 1)
    ]
    return np.where(inside, at, 0.0)


def _slices(shift: int, size: int) -> tuple[slice, slice]:
    """Where out[i] takes in[i + shift]."""
    if abs(shift) >= size:
        return slice(0, 0), slice(0, 0)
    return slice(max(0, -shift), size - max(0, shift)), slice(max(0, shift), size + min(0, shift))
