"""All offsets at once by weighted least squares, with GNSS positions as priors."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix, diags

from geomosaic.adjustment.paper.misalignment import OffsetNet
from geomosaic.arrays import Floats
from geomosaic.constants import sourced
from geomosaic.estimation.linear import SparseFactors

_HUBER = sourced(
    1.5, "deviations", "full weight up to here; more: wrong pairs pull", "Huber 1981, about 1.345"
)


def least_squares(
    net: OffsetNet, prior_sd_m: Floats, pair_sd_m: Floats, rounds: int = 8
) -> tuple[Floats, Floats]:
    """Moves (n, 2) and their standard deviations (n,) per axis, in metres.

    The minimum of sum (move / prior_sd)² + sum rho(misalignment / pair_sd), Huber's rho. A pair observes the
    difference of two moves as the median over its tie points. Priors keep errors from growing along a line.

    Args: prior_sd_m (n,): of the ground of a frame by GNSS and IMU; pair_sd_m (m,): of a pair's mean
        difference about a pure offset.
    """
    m, still = len(net.pairs), np.zeros((net.n, 2))
    observed = -np.array([np.median(net.differences_m(p, still), axis=0) for p in range(m)]).reshape(-1, 2)
    entries = np.concatenate([-np.ones(m), np.ones(m)])
    rows = np.tile(np.arange(m), 2)
    design = coo_matrix((entries, (rows, net.pairs.T.ravel())), shape=(m, net.n)).tocsc()
    weight, moves = 1.0 / pair_sd_m**2, still
    for _ in range(rounds):
        solver = SparseFactors((design.T @ diags(weight) @ design + diags(1.0 / prior_sd_m**2)).tocsc())
        moves = solver.solve(np.asarray(design.T @ (weight[:, None] * observed)))
        miss = np.linalg.norm(design @ moves - observed, axis=1) / pair_sd_m
        weight = np.minimum(1.0, _HUBER / np.maximum(miss, 1e-9)) / pair_sd_m**2
    variance = [solver.solve(np.eye(1, net.n, i)[0])[i] for i in range(net.n)]
    return np.asarray(moves), np.sqrt(variance)
