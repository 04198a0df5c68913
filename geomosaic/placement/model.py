"""Predicted poses of frames before any are matched."""

from __future__ import annotations

from dataclasses import dataclass

from geomosaic.camera.exterior import Poses


@dataclass(frozen=True)
class Placement:
    """Prior poses in the work frame, the order of flight, and who may overlap whom.

    sequence: frame indices in order of capture. lines: the number of each frame's flight line.
    pairs: (left, right) with left < right, by falling overlap. ground_pixel_m: the median ground
    sampling distance, the paper's D. formula: how positions came into the work frame.
    turned: quarter turns (0 to 3) by which each frame's image was turned after the flight; `poses`
    are those of the images as they lie in the files.
    """

    poses: Poses
    sequence: tuple[int, ...]
    lines: tuple[int, ...]
    pairs: tuple[tuple[int, int], ...]
    ground_pixel_m: float
    formula: str
    turned: tuple[int, ...] = ()
