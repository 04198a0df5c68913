"""Who gives a pixel its value: strategies that weigh the frames against each other.

A strategy takes, for k frames over one window of h x w pixels,

    distance_m (k, h, w): from each pixel to each frame's nadir point, on the map;
    inside (k, h, w): 0 where the frame has no valid pixel, rising to 1 over the feather's width from its
        edge and from its invalid pixels inwards;
    feather_m: the width of the transition on the ground; 0 makes a hard seam;

and gives weights (k, h, w) that sum to 1 wherever any frame is valid, and are 0 elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats32 = NDArray[np.float32]
Bools = NDArray[np.bool_]
Seam = Callable[[Floats32, Floats32, float], Floats32]
_HARD_M = 1e-6


def nearest_nadir(distance_m: Floats32, inside: Floats32, feather_m: float) -> Floats32:
    """The frame whose nadir point is nearest wins: it looks down most steeply.

    Each frame keeps what the nearer ones leave: w_i = inside_i * prod_j (1 - inside_j s_ij), then divided
    by the sum, where s_ij rises from 0 to 1 as j becomes nearer than i, over `feather_m` across the line
    halfway. So weights are continuous both across the seam and where a frame ends.
    """
    weights = inside.copy()
    per_m = np.float32(0.5 / max(feather_m, _HARD_M))
    for i in range(len(weights)):
        for j in range(i + 1, len(weights)):
            j_nearer = (distance_m[i] - distance_m[j]) * per_m
            j_nearer += np.float32(0.5)
            np.clip(j_nearer, 0.0, 1.0, out=j_nearer)
            weights[i] *= 1.0 - inside[j] * j_nearer
            weights[j] *= 1.0 - inside[i] * (1.0 - j_nearer)
    total = weights.sum(axis=0)
    np.divide(weights, total, out=weights, where=total > 0.0)
    return weights


SEAMS: dict[str, Seam] = {"nearest_nadir": nearest_nadir}


def can_matter(
    distance_m: Floats32, valid_somewhere: Bools, inside_everywhere: Bools, reach_m: float
) -> Bools:
    """Which of k frames can have a weight in which of h x w cells, (k, h, w).

    A frame can't where it has no valid pixel, nor where another one is wholly inside (`inside` is 1 all over
    the cell) and nearer by `reach_m`: the feather and the cell's diagonal.
    """
    surely = np.where(inside_everywhere, distance_m, np.inf).min(axis=0)
    return np.asarray(valid_somewhere & (distance_m <= surely + reach_m))
