"""Feature-matching stitching: every frame follows the last one. The method that accumulates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.paper.misalignment import OffsetNet

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]


def fit_similarity(source: Floats, target: Floats, rounds: int = 5) -> tuple[complex, complex]:
    """Robust similarity of the plane, target = turn * source + shift in complex numbers.

    Least squares with Cauchy weights, re-weighted `rounds` times; the scale of the weights is the
    residuals' median absolute deviation.

    Args: source, target (k, 2), k >= 2.
    """
    z, w = source @ [1, 1j], target @ [1, 1j]
    weight = np.ones(len(z))
    turn, shift = 1.0 + 0j, 0j
    for _ in range(rounds):
        z_0, w_0 = np.average(z, weights=weight), np.average(w, weights=weight)
        spread = float((weight * np.abs(z - z_0) ** 2).sum())
        if spread > 0.0:
            turn = complex((weight * (w - w_0) * np.conj(z - z_0)).sum() / spread)
        shift = complex(w_0 - turn * z_0)
        residual = np.abs(w - turn * z - shift)
        weight = 1.0 / (1.0 + (residual / max(2.0 * float(np.median(residual)), 1e-9)) ** 2)
    return turn, shift


def chain(net: OffsetNet, sequence: Sequence[int]) -> tuple[Complexes, Complexes]:
    """From the first frame on, each frame is laid on the last by a similarity fitted to all their tie
    points (the paper's reference 3, Xu et al. 2019, with similarities in place of homographies: the
    frames are already projected). A frame not tied to the last follows the latest earlier frame it is
    tied to; one tied to none starts again from its coarse place.

    Returns: turn (n,) and shift (n,): a frame's coarse ground point z = east + i north goes to
    turn * z + shift.
    """
    turn = np.ones(net.n, dtype=np.complex128)
    shift = np.zeros(net.n, dtype=np.complex128)
    joints = {pair: p for p, pair in enumerate(net.edges)}
    laid: list[int] = []
    for frame in sequence:
        last = next((i for i in reversed(laid) if (min(i, frame), max(i, frame)) in joints), None)
        laid.append(frame)
        if last is None:
            continue
        pair = joints[(min(last, frame), max(last, frame))]
        here, there = net.left_m[pair], net.right_m[pair]
        if frame > last:
            here, there = there, here
        if len(here) < 2:
            continue
        seen = (there @ [1, 1j]) * turn[last] + shift[last]
        turn[frame], shift[frame] = fit_similarity(here, np.column_stack([seen.real, seen.imag]))
    return turn, shift
