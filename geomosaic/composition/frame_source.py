"""A frame as a source of the mosaic: its share by who owns what, its pixels by what it gives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Floats32
from geomosaic.composition.frame_part import FramePart
from geomosaic.composition.model import OutputGrid
from geomosaic.composition.ownership import Ownership, owner_share
from geomosaic.composition.scene import distances_m
from geomosaic.composition.views import FrameView
from geomosaic.composition.window import SourcePixels, Window
from geomosaic.constants import tuned

_NEARER_PER_M = tuned(np.float32(1e-7), "shares per m", "order of unseen cells by nadir: larger moves seams")


@dataclass(frozen=True)
class FrameSource:
    """One frame of a scene. Its material is `FramePart`."""

    grid: OutputGrid
    ownership: Ownership
    view: FrameView

    @property
    def number(self) -> int:
        """The frame's index in `Survey.frames`."""
        return self.view.frame

    def share(self, window: Window, rows: slice, cols: slice) -> Floats32:
        """Of its owned cells; where none that sees the ground owns it, the nearest nadir point decides."""
        nearer = distances_m(self.grid, window.part(rows, cols), self.view)
        nearer *= -_NEARER_PER_M
        nearer += owner_share(self.ownership, window, rows, cols, self.view.frame)
        return nearer

    def shown(self, window: Window, rows: slice, cols: slice, material: FramePart) -> SourcePixels:
        """As it was brought onto the grid."""
        return material.shown(window.part(rows, cols))
