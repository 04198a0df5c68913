"""The methods by name: strips in, offsets of every line of every pair out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from geomosaic.ccd.image_registration import image_registration, mean_offset
from geomosaic.ccd.joint import joint
from geomosaic.ccd.model import CcdSettings, PairOffsets, Progress
from geomosaic.ccd.overlaps import Strips
from geomosaic.ccd.sift_chains import piecewise_linear, whole_scene
from geomosaic.ccd.virtual_line import virtual_line

Method = Callable[[Strips, CcdSettings, Progress], tuple[PairOffsets, ...]]

METHODS: Final[dict[str, Method]] = {
    "joint": joint,
    "piecewise_linear": piecewise_linear,
    "whole_scene": whole_scene,
    "image_registration": image_registration,
    "mean_offset": mean_offset,
    "virtual_line": virtual_line,
}
SEARCHED_WITHIN_OVERLAP: Final = frozenset({"joint", "image_registration", "mean_offset"})
"""Whose search across is cut to what leaves columns of the overlap to compare (`volumes.within_overlap`)."""
