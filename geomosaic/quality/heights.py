"""Figures of height differences that blunders don't govern."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bytes, Floats, Floats32, Ints
from geomosaic.constants import NORMAL_PER_MAD, sourced, tuned

SLOPES_DEG = tuned((5.0, 15.0, 35.0, 60.0), "degrees", "limits of level, gentle and steep; more lack points")
_KINDS: Final = {
    0: "never classified", 1: "unclassified", 2: "ground", 3: "low vegetation", 4: "medium vegetation",
    5: "high vegetation", 6: "building", 9: "water", 10: "rail", 11: "road", 17: "bridge",
}  # fmt: skip
"""ASPRS, LAS specification 1.4 R15, table 17."""
NOISE = sourced((7, 18), "ASPRS classes", "points that are no surface", "LAS 1.4 R15, table 17")


@dataclass(frozen=True)
class HeightFigures:
    """Of n differences, surface minus reference (m); NaN of none.

    nmad_m: 1.4826 times the median of what they are off their median; abs_68_m, abs_95_m: quantiles (68.3 %
    and 95 %) of their absolute values. Hoehle and Hoehle 2009, Accuracy assessment of digital elevation
    models by means of robust statistical methods (ISPRS Journal 64), tables 1 and 2.
    """

    n: int
    median_m: float
    mean_m: float
    nmad_m: float
    rmse_m: float
    abs_68_m: float
    abs_95_m: float


def height_figures(off_m: Floats) -> HeightFigures:
    """Of differences (n,)."""
    if not off_m.size:
        return HeightFigures(0, *[float("nan")] * 6)
    median = float(np.median(off_m))
    nmad = NORMAL_PER_MAD * float(np.median(np.abs(off_m - median)))
    near, far = np.quantile(np.abs(off_m), [0.683, 0.95]).tolist()
    rmse = float(np.sqrt(np.mean(off_m**2)))
    return HeightFigures(off_m.size, median, float(off_m.mean()), nmad, rmse, near, far)


def by_class(
    off_m: Floats, classes: NDArray[np.integer], names: Sequence[tuple[int, str]]
) -> tuple[tuple[str, HeightFigures], ...]:
    """Figures of those classes (n,) that have any differences, by their names."""
    found = ((name, height_figures(off_m[classes == number])) for number, name in names)
    return tuple((name, figures) for name, figures in found if figures.n)


def slope_classes(slope_deg: Floats32) -> tuple[Ints, list[tuple[int, str]]]:
    """The class of each slope, and the classes' names."""
    ends = ["0", *(f"{s:g}" for s in SLOPES_DEG), "90"]
    classes = enumerate(itertools.pairwise(ends))
    return np.digitize(slope_deg, SLOPES_DEG), [(k, f"{low} to {high}°") for k, (low, high) in classes]


def kind_names(kinds: Bytes) -> list[tuple[int, str]]:
    """Classes of a point cloud that occur."""
    return [(int(k), _KINDS.get(int(k), f"class {k}")) for k in np.unique(kinds)]
