"""Strips opened for the stages that read their pixels, with what is known of the ground beneath them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from geomosaic.ccd.object_space import read_object_space
from geomosaic.ccd.overlaps import StripFiles
from geomosaic.ccd.virtual_line import relief_px
from geomosaic.survey.strips import StripGeometry


@contextmanager
def opened_strips(geometry: StripGeometry) -> Iterator[StripFiles]:
    """The strips, with model and heights where the geometry names them."""
    with StripFiles(geometry) as strips:
        strips.object_space = read_object_space(geometry)
        if strips.object_space is not None and geometry.dem is not None:
            strips.relief_px = relief_px(geometry, strips.object_space)
        yield strips


def better_offsets(geometry: StripGeometry, method: str) -> str:
    """What to give for better offsets than a method finds."""
    if method != "joint":
        return "--method joint" + (" or virtual_line" if method != "virtual_line" else "")
    if geometry.model is None or geometry.dem is None:
        return "'model' and 'dem' in the geometry file"
    return "--method virtual_line"
