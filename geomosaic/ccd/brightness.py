"""What is bright: clouds mostly are, and whatever is bright and moves against the rest as a whole is cloud.

Brightness alone condemns nothing: snow and sand are bright too. It says which part of a scene to ask last
and, once the curves are drawn by the rest, whether that part agrees with them.
"""

from __future__ import annotations

import numpy as np

from geomosaic.ccd.model import Flags, Floats

_BINS = 128
# The bright part's mean is above the other's by this, of the other's.
_STANDS_OUT = 0.2
_IN_PART = 0.25
_MOST_SHARE = 0.97
_MOVED_PX, _MOVED_DEVIATIONS = 0.06, 4.0
# Neighbouring knots' residuals are no independent facts: one in so many counts.
_KNOTS_PER_FACT = 10.0


def bright_part(brightness: Floats) -> Flags:
    """Where brightness (any shape) is more than that of the darker of two groups, if these stand apart.

    The groups are Otsu's (1979); what lies between them counts as bright: rows that are in part so.
    """
    counts, edges = np.histogram(brightness, _BINS)
    middle = 0.5 * (edges[1:] + edges[:-1])
    below = np.cumsum(counts)[:-1]
    above = counts.sum() - below
    total = np.cumsum(counts * middle)
    low = total[:-1] / np.maximum(below, 1)
    high = (total[-1] - total[:-1]) / np.maximum(above, 1)
    split = int(np.argmax(below * above * (high - low) ** 2))
    if high[split] - low[split] < _STANDS_OUT * low[split]:
        return np.zeros(brightness.shape, dtype=np.bool_)
    found: Flags = brightness > low[split] + _IN_PART * (high[split] - low[split])
    return found if found.mean() < _MOST_SHARE else np.zeros_like(found)


def moves(residual_px: Floats, information: Floats) -> bool:
    """Whether a part of the scene lies off the curves as a whole.

    Args: residual_px (n, 2) of the part's knots against curves drawn without it; information (n, 2, 2) of
    these residuals, zero where nothing was measured.
    """
    used = np.trace(information, axis1=1, axis2=2) > 0
    facts = used.sum() / _KNOTS_PER_FACT
    if facts < 1.0:
        return False
    middle = np.median(residual_px[used], axis=0)
    spread = 1.4826 * np.median(np.abs(residual_px[used] - middle), axis=0)
    sure = _MOVED_DEVIATIONS * spread / np.sqrt(facts)
    return bool((np.abs(middle) > np.maximum(sure, _MOVED_PX)).any())
