"""All offsets at once, weighted, with POS as priors: one sparse solve."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, diags

from geomosaic.adjustment.paper.misalignment import OffsetNet
from geomosaic.constants import sourced
from geomosaic.estimation.linear import SparseFactors

Floats = NDArray[np.float64]
_HUBER = sourced(
    1.5,
    "deviations",
    "beyond which a misalignment pulls no harder: with 1.345 a normal error loses 5 % of its say, "
    "with more, wrong pairs pull",
    "chosen above Huber's 1.345 (Huber 1981, Robust statistics)",
)


def least_squares(
    net: OffsetNet, prior_sd_m: Floats, pair_sd_m: Floats, rounds: int = 8
) -> tuple[Floats, Floats]:
    """Moves that minimise sum (move / prior_sd)² + sum rho(misalignment / pair_sd), Huber's rho.

    A pair observes the difference of two moves: minus the median of its tie points' differences.
    Since each frame has a prior, no frame is the base, and what the pairs carry along a line is held
    by every frame's own position: the error stays level instead of growing.

    Args: prior_sd_m (n,): how far a frame's POS may put its ground off; pair_sd_m (m,): how far a
        pair's mean disagreement may be from a pure offset.
    Returns: moves (n, 2) and their standard deviations (n,), the same in east and north.
    """
    a, b = net.pairs.T
    observed = -np.array(
        [np.median(net.differences_m(p, np.zeros((net.n, 2))), axis=0) for p in range(len(a))]
    )
    observed = observed.reshape(-1, 2)
    m = len(a)
    design = coo_matrix(
        (np.concatenate([-np.ones(m), np.ones(m)]), (np.tile(np.arange(m), 2), np.concatenate([a, b]))),
        shape=(m, net.n),
    ).tocsc()
    weight = 1.0 / pair_sd_m**2
    moves = np.zeros((net.n, 2))
    for _ in range(rounds):
        normal = (design.T @ diags(weight) @ design + diags(1.0 / prior_sd_m**2)).tocsc()
        solver = SparseFactors(normal)
        moves = solver.solve(np.asarray(design.T @ (weight[:, None] * observed)))
        miss = np.linalg.norm(design @ moves - observed, axis=1) / pair_sd_m
        weight = np.minimum(1.0, _HUBER / np.maximum(miss, 1e-9)) / pair_sd_m**2
    sd = np.sqrt([solver.solve(_unit(net.n, i))[i] for i in range(net.n)])
    return np.asarray(moves), np.asarray(sd)


def _unit(n: int, i: int) -> Floats:
    e = np.zeros(n)
    e[i] = 1.0
    return e
