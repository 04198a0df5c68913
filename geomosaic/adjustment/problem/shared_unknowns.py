"""What frames share, as a bundle found it: numbers of lenses and of the platform."""

from __future__ import annotations

import numpy as np

from geomosaic.adjustment.model import SharedUnknowns
from geomosaic.adjustment.problem.bundle_model import Bundle, Priors
from geomosaic.adjustment.terms.collinearity import INTERIOR, interior_of
from geomosaic.adjustment.terms.mounting import MOUNTING, UNIT


def shared_unknowns(bundle: Bundle, priors: Priors) -> SharedUnknowns:
    """The cameras' numbers and the mounting's that are not known beforehand, in the units of their names."""
    cameras, unit = priors.cameras, np.concatenate([np.ones(bundle.interior_sd.size), UNIT])
    given = np.concatenate([*(interior_of(c) for c in cameras), np.zeros(len(MOUNTING))])
    found = np.concatenate([*(interior_of(c) for c in bundle.cameras), bundle.mounting])
    of = [c.name for c in cameras for _ in INTERIOR] + ["platform"] * len(MOUNTING)
    names = INTERIOR * len(cameras) + MOUNTING
    rows = np.flatnonzero(np.concatenate([priors.interior_sd.ravel(), priors.mounting.sd]))
    return SharedUnknowns(
        of=tuple(of[k] for k in rows),
        names=tuple(names[k] for k in rows),
        given=(given / unit)[rows],
        found=(found / unit)[rows],
        sd=(np.concatenate([bundle.interior_sd.ravel(), bundle.mounting_sd]) / unit)[rows],
        correlation=bundle.shared_correlation[np.ix_(rows, rows)],
        held=bundle.held[rows],
    )
