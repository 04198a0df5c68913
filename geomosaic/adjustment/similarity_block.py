"""All frames as plane similarities, solved at once: the start of a bundle, however wrong the yaws."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix

from geomosaic.adjustment.block_tridiagonal import BlockTridiagonal
from geomosaic.adjustment.misalignment import OffsetNet

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
_MOST_TIES = 60
_CAUCHY = 3.0


def similarity_block(
    net: OffsetNet,
    nadir_m: Floats,
    position_sd_m: Floats,
    yaw_sd_rad: Floats,
    scale_sd: Floats,
    rounds: int = 12,
) -> tuple[Complexes, Complexes]:
    """Linear block of independent models in the plane (Ackermann's Helmert block, 4 unknowns a frame).

    Each frame's coarse ground points, counted from its nadir point, are turned and scaled by a complex
    number and put down at a new nadir point, so that tie points agree; the nadir points, turns and
    scales that POS gave are observations with their deviations. Since turn and scale enter linearly, a
    yaw that is 180 degrees off is no further from the solution than one of 1 degree. Ties and positions
    are re-weighted by Cauchy's function; positions against the bulk of them, since a whole block that
    shrinks onto itself would please the ties.

    Args: nadir_m (n, 2); position_sd_m, yaw_sd_rad, scale_sd (n,).
    Returns: turn (n,) and nadir point (n,) as complex numbers, east + i north.
    """
    n = net.n
    a, b, z_a, z_b = _thinned(net, nadir_m)
    m = len(a)
    row = np.arange(m)
    one = np.ones(m)
    # Rows: east parts of all ties, then north parts. Unknowns per frame: Re, Im of turn, Re, Im of nadir.
    entries = [
        (row, 4 * a, z_a.real), (row, 4 * a + 1, -z_a.imag), (row, 4 * a + 2, one),
        (row, 4 * b, -z_b.real), (row, 4 * b + 1, z_b.imag), (row, 4 * b + 2, -one),
        (row + m, 4 * a, z_a.imag), (row + m, 4 * a + 1, z_a.real), (row + m, 4 * a + 3, one),
        (row + m, 4 * b, -z_b.imag), (row + m, 4 * b + 1, -z_b.real), (row + m, 4 * b + 3, -one),
    ]  # fmt: skip
    rows, columns, values = (np.concatenate(part) for part in zip(*entries, strict=True))
    design = coo_matrix((values, (rows, columns)), shape=(2 * m, 4 * n)).tocsc()
    prior = np.column_stack([np.ones(n), np.zeros(n), nadir_m]).ravel()
    sd_turn = np.hypot(yaw_sd_rad, 1e-4)
    sd_scale = np.hypot(scale_sd, np.minimum(yaw_sd_rad, 2.0) ** 2 / 2.0)
    prior_sd = np.column_stack([sd_scale, sd_turn, position_sd_m, position_sd_m])
    tie_weight, position_weight = np.ones(m), np.ones(n)
    scale_m = 10.0 * net.step_m
    x = prior
    for _ in range(rounds):
        weight = np.tile(tie_weight / scale_m**2, 2)
        prior_weight = 1.0 / prior_sd**2
        prior_weight[:, 2:] *= position_weight[:, None]
        normal = design.T @ design.multiply(weight[:, None]).tocsc()
        normal = normal + coo_matrix((prior_weight.ravel(), (np.arange(4 * n),) * 2))
        side = (prior_weight.ravel() * prior)[:, None]
        x = BlockTridiagonal(normal.tobsr(blocksize=(4, 4))).solve(side)[:, 0]
        miss = design @ x
        length = np.hypot(miss[:m], miss[m:])
        scale_m = max(1.5 * float(np.median(length)) if m else 0.0, net.step_m)
        tie_weight = 1.0 / (1.0 + (length / (_CAUCHY * scale_m)) ** 2)
        moved = np.linalg.norm(x.reshape(n, 4)[:, 2:] - nadir_m, axis=1) / position_sd_m
        bulk = max(1.0, 1.5 * float(np.median(moved)))
        position_weight = 1.0 / (1.0 + (moved / (_CAUCHY * bulk)) ** 2)
    parts = x.reshape(n, 4)
    return parts[:, 0] + 1j * parts[:, 1], parts[:, 2] + 1j * parts[:, 3]


def _thinned(
    net: OffsetNet, nadir_m: Floats
) -> tuple[NDArray[np.intp], NDArray[np.intp], Complexes, Complexes]:
    """At most _MOST_TIES of each pair, evenly by number, counted from the nadir points."""
    a, b, z_a, z_b = [], [], [], []
    for p, (left, right) in enumerate(net.edges):
        some = np.linspace(0, len(net.left_m[p]) - 1, min(len(net.left_m[p]), _MOST_TIES)).astype(np.intp)
        a.append(np.full(len(some), left))
        b.append(np.full(len(some), right))
        z_a.append((net.left_m[p][some] - nadir_m[left]) @ [1, 1j])
        z_b.append((net.right_m[p][some] - nadir_m[right]) @ [1, 1j])
    if not a:
        nothing = np.zeros(0, np.intp)
        return nothing, nothing, np.zeros(0, complex), np.zeros(0, complex)
    return np.concatenate(a), np.concatenate(b), np.concatenate(z_a), np.concatenate(z_b)
