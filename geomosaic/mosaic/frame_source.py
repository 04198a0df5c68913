"""A frame as a source of the mosaic: its share by who owns what, its pixels by the warp."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from geomosaic.constants import CHOSEN, Because
from geomosaic.mosaic.frames import Decoded
from geomosaic.mosaic.ownership import Ownership, owner_share
from geomosaic.mosaic.scene import Scene, distances_m, margin_px
from geomosaic.mosaic.tones import Tones, evened
from geomosaic.mosaic.views import FrameView
from geomosaic.mosaic.window import Shown, Window
from geomosaic.projection.lattice import MapLattice, Seen
from geomosaic.projection.resample import resample

Floats32 = NDArray[np.float32]
_NEARER_PER_M: Annotated[
    np.float32,
    Because(
        "shares per m",
        "what a metre to the nadir point counts beside a pixel's share in an owner: nothing, unless no "
        "owner sees it; a larger one moves seams, a smaller one is the same",
        CHOSEN,
    ),
] = np.float32(1e-7)


@dataclass(frozen=True)
class FrameSource:
    """One frame of a scene. Its material is `Decoded`, and what its windows share `Scene.lattice`."""

    scene: Scene
    ownership: Ownership
    view: FrameView
    resampling: str
    tones: Tones | None

    @property
    def number(self) -> int:
        """The frame's index in `Survey.frames`."""
        return self.view.frame

    def share(self, window: Window, rows: slice, cols: slice) -> Floats32:
        """Of its owned cells; where none that sees the ground owns it, the nearest nadir point decides."""
        part = Window(
            window.col + cols.start, window.row + rows.start, cols.stop - cols.start, rows.stop - rows.start
        )
        nearer = distances_m(self.scene.grid, part, self.view)
        nearer *= -_NEARER_PER_M
        nearer += owner_share(self.ownership, window, rows, cols, self.view.frame)
        return nearer

    def shown(self, place: MapLattice, window: Window, rows: slice, cols: slice, material: Decoded) -> Shown:
        """Resampled, its tones evened."""
        view = self.view
        seen = place.seen(view.pose, view.camera, rows, cols)
        margin = margin_px(seen.cols, seen.rows, view.camera, material.mask_distance_px)
        margin *= np.float32(view.gsd_m / self.scene.grid.gsd_m)
        pixels = resample(material.pixels, seen.cols, seen.rows, self.resampling)
        return Shown(self._evened(pixels, seen), margin)

    def _evened(self, pixels: NDArray[Any], seen: Seen) -> NDArray[Any]:
        """As all frames would show it. Tones bend over a tenth of a frame: every eighth pixel shows them."""
        if self.tones is None or self.tones.flat(self.view.frame):
            return pixels
        nodes = seen.node_cols, seen.node_rows
        gone = bool(np.isnan(nodes[0]).any())  # a node past the lens's end says nothing of pixels before it
        where = (seen.cols, seen.rows) if gone else nodes
        brighter = self.tones.brighter(self.view.frame, self.view.camera, *where)
        return evened(pixels, brighter if gone else seen.between(brighter))
