"""Chain registration: each frame is aligned to the last one, so that errors accumulate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geomosaic.adjustment.paper.misalignment import OffsetNet
from geomosaic.arrays import Complexes
from geomosaic.estimation.similarity import fit_similarity


def chain(net: OffsetNet, sequence: Sequence[int]) -> tuple[Complexes, Complexes]:
    """Turn (n,) and shift (n,): a frame's ground point z = east + i north goes to turn * z + shift.

    Each frame gets the similarity to the latest earlier frame with common tie points (Xu et al. 2019, the
    paper's reference 3, with similarities for homographies). Without one it keeps its coarse position.
    """
    turn = np.ones(net.n, dtype=np.complex128)
    shift = np.zeros(net.n, dtype=np.complex128)
    for k, frame in enumerate(sequence):
        last = next((i for i in reversed(sequence[:k]) if (i, frame) in net.pair_of), None)
        if last is None:
            continue
        pair = net.pair_of[last, frame]
        there, here = (net.left_m[pair], net.right_m[pair])[:: 1 if frame > last else -1]
        if len(here) < 2:
            continue
        aligned = (there @ [1, 1j]) * turn[last] + shift[last]
        turn[frame], shift[frame] = fit_similarity(here, np.column_stack([aligned.real, aligned.imag]))
    return turn, shift
