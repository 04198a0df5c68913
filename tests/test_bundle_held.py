"""What is held: the covariance of the rest, against draws of what is not known."""

from __future__ import annotations

import numpy as np
from adjustment_blocks import fly

from geomosaic.adjustment.bundle_equations import normals_of
from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Settings
from geomosaic.adjustment.normal import reduce_normals


def test_held_numbers_keep_their_deviation_and_make_the_others_wrong_by_it() -> None:
    """A dense system by hand: u is solved with h at its prior; P = P_u + S V S' with S = -M_uu^-1 M_uh."""
    rng = np.random.default_rng(4)
    flown = fly(4, 2, 4)
    seen: list = []
    import geomosaic.adjustment.bundle as bundle

    whole = bundle.normals_of

    def spy(*args):  # type: ignore[no-untyped-def]
        seen.append(args)
        return whole(*args)

    bundle.normals_of = spy  # type: ignore[assignment]
    try:
        METHODS["bundle"](flown.block, Settings())
    finally:
        bundle.normals_of = whole  # type: ignore[assignment]
    reduced = reduce_normals(normals_of(*seen[-1]))
    s = len(reduced.shared)
    variance = np.zeros(s)
    held = [0, 2, 5]
    variance[held] = rng.uniform(0.5, 2.0, 3)
    poses = reduced.poses.toarray()
    m = np.block([[poses, reduced.border], [reduced.border.T, reduced.shared]])
    n = len(poses)
    h = np.array(held) + n
    u = np.setdiff1d(np.arange(n + s), h)
    fixed = np.linalg.inv(m[np.ix_(u, u)])
    lever = -fixed @ m[np.ix_(u, h)]
    want = np.zeros_like(m)
    want[np.ix_(u, u)] = fixed + lever @ np.diag(variance[held]) @ lever.T
    want[np.ix_(u, h)] = lever * variance[held]
    want[np.ix_(h, u)] = want[np.ix_(u, h)].T
    want[np.ix_(h, h)] = np.diag(variance[held])
    found, shared = reduced.considering(variance).covariance()
    np.testing.assert_allclose(shared, want[n:, n:], rtol=1e-5, atol=1e-9 * np.abs(want[n:, n:]).max())
    for i in range(n // 6):
        own = want[6 * i : 6 * i + 6, 6 * i : 6 * i + 6]
        np.testing.assert_allclose(found[i], own, rtol=1e-5, atol=1e-7 * np.abs(own).max())
