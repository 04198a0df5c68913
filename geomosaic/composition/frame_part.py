"""What a frame gives to a mosaic: the cells that were planned, decoded once and resampled once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bools, Floats32
from geomosaic.composition.cells import MosaicCells
from geomosaic.composition.frames import Decoded, decode
from geomosaic.composition.hidden import Clear
from geomosaic.composition.scene import Scene, margin_px
from geomosaic.composition.tiles import TILE_PX
from geomosaic.composition.tone_curve import curved
from geomosaic.composition.tones import Tones, evened
from geomosaic.composition.views import FrameView
from geomosaic.composition.visibility import FrameOnMap
from geomosaic.composition.window import SourcePixels, Window, as_type
from geomosaic.constants import tuned
from geomosaic.projection.lattice import WindowInFrame
from geomosaic.projection.resample import KERNEL_RADIUS_PX, resample

_NODES_OFF_PX = tuned(1.0, "frame px", "tolerance past its nodes: less loses edge pixels; more takes time")


@dataclass(frozen=True)
class Patch:
    """Part of a frame on the mosaic's grid, from pixel row and col on: see `SourcePixels`."""

    row: int
    col: int
    pixels: NDArray[Any]
    margin_px: Floats32 | None

    @property
    def last_row(self) -> int:
        """The first row beyond it."""
        return int(self.row + self.pixels.shape[0])

    @property
    def last_col(self) -> int:
        """The first col beyond it."""
        return int(self.col + self.pixels.shape[1])

    @property
    def valid(self) -> Bools:
        """Which pixels the frame shows, (h, w)."""
        if self.margin_px is None:
            return np.ones(self.pixels.shape[:2], dtype=bool)
        return np.asarray(self.margin_px > 0.0)


@dataclass(frozen=True)
class FramePart:
    """All that a frame gives."""

    patches: tuple[Patch, ...]

    def shown(self, wanted: Window) -> SourcePixels:
        """A box of the grid that was planned. Pixels of no patch are not valid."""
        last_row, last_col = wanted.row + wanted.height, wanted.col + wanted.width
        lying = [
            (p, *_overlap(p, wanted))
            for p in self.patches
            if p.row < last_row and p.col < last_col and p.last_row > wanted.row and p.last_col > wanted.col
        ]
        if len(lying) == 1 and lying[0][0].pixels[lying[0][1]].shape[:2] == (wanted.height, wanted.width):
            patch, there, _ = lying[0]
            return SourcePixels(
                patch.pixels[there], None if patch.margin_px is None else patch.margin_px[there]
            )
        like = self.patches[0].pixels
        shape = wanted.height, wanted.width
        pixels = np.zeros((*shape, like.shape[2]), dtype=like.dtype)
        margin = np.full(shape, -np.inf, dtype=np.float32)
        for patch, there, here in lying:
            pixels[here] = patch.pixels[there]
            margin[here] = np.inf if patch.margin_px is None else patch.margin_px[there]
        return SourcePixels(pixels, None if (margin == np.inf).all() else margin)


def _overlap(patch: Patch, window: Window) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """What a window takes of a patch, and where it lies in the window."""
    there, here = [], []
    for own, size, first, wanted in zip(
        (patch.row, patch.col),
        patch.pixels.shape,
        (window.row, window.col),
        (window.height, window.width),
        strict=False,
    ):
        begin, end = max(own, first), min(own + size, first + wanted)
        there.append(slice(begin - own, end - own))
        here.append(slice(begin - first, end - first))
    return (there[0], there[1]), (here[0], here[1])


@dataclass(frozen=True)
class Warping:
    """How frames are warped onto the grid.

    scene: its views don't matter. dtype: of the mosaic's pixels. far_px: how far inside a frame, in pixels of
    the mosaic, the distance from its edge ceases to matter.
    """

    scene: Scene
    resampling: str
    tones: Tones | None
    dtype: str
    far_px: float


@dataclass(frozen=True)
class Asked:
    """A frame, and the cells that are asked for."""

    on_map: FrameOnMap
    cells: MosaicCells


def frame_part(how: Warping, asked: Asked) -> FramePart:
    """All that a frame is asked for. Raises: as `patches`."""
    return FramePart(tuple(patches(how, asked)))


def patches(how: Warping, asked: Asked) -> Iterator[Patch]:
    """The same box by box, each within a tile. Raises: `FileError` if the frame can't be read."""
    decoded = decode(asked.on_map.frame, KERNEL_RADIUS_PX[how.resampling])
    hidden = asked.on_map.view.hidden
    clear = None if hidden is None else Clear(hidden)
    for box in asked.cells.boxes(TILE_PX):
        patch = _patch(how, asked.on_map.view, decoded, box)
        yield patch if clear is None else _cleared(patch, clear.margin_px(box), how)


def _cleared(patch: Patch, clear_px: Floats32, how: Warping) -> Patch:
    """Without what is hidden from the frame, which ends there as at its edge."""
    if patch.margin_px is not None:
        np.minimum(clear_px, patch.margin_px, out=clear_px)
    return replace(patch, margin_px=clear_px if clear_px.min() <= max(how.far_px, 0.0) else None)


def _patch(how: Warping, view: FrameView, decoded: Decoded, box: Window) -> Patch:
    tile = tile_of(box.row, box.col)
    rows, cols = box.within(tile)
    seen = how.scene.lattice(tile).seen(view.pose, view.camera, rows, cols)
    pixels = resample(decoded.pixels, seen.cols, seen.rows, how.resampling)
    pixels = _evened(pixels, seen, view, how)
    if how.tones is not None:
        pixels = curved(pixels, how.tones.curve)
    return Patch(box.row, box.col, pixels, _margin_px(how, view, decoded, seen))


def _margin_px(how: Warping, view: FrameView, decoded: Decoded, seen: WindowInFrame) -> Floats32 | None:
    """How far inside the frame pixels lie, in pixels of the mosaic; None where that doesn't matter. Nodes far
    inside need no look at what lies between them."""
    per_px, far_px = np.float32(view.gsd_m / how.scene.grid.gsd_m), max(how.far_px, 0.0)
    mask_px = decoded.mask_distance_px
    if mask_px is None:
        nodes = margin_px(seen.node_cols, seen.node_rows, view.camera, None)
        if float(nodes.min()) > far_px / per_px + _NODES_OFF_PX:
            return None
    margin = margin_px(seen.cols, seen.rows, view.camera, mask_px)
    margin *= per_px
    return margin if margin.min() <= far_px else None


def _evened(pixels: NDArray[Any], seen: WindowInFrame, view: FrameView, how: Warping) -> NDArray[Any]:
    """As all frames would show it. Tones bend over a tenth of a frame: every eighth pixel shows them."""
    tones = how.tones
    if tones is None or tones.flat(view.frame):
        return as_type(pixels, how.dtype)
    nodes = seen.node_cols, seen.node_rows
    gone = bool(np.isnan(nodes[0]).any())  # a node past the lens's end says nothing of pixels before it
    where = (seen.cols, seen.rows) if gone else nodes
    darker = np.exp(-tones.brighter(view.frame, view.camera, *where))
    return evened(pixels, darker if gone else seen.between(darker), tones.white, how.dtype)


def tile_of(row: int, col: int) -> Window:
    """The tile of a pixel; there are some beyond the grid as well."""
    return Window(col // TILE_PX * TILE_PX, row // TILE_PX * TILE_PX, TILE_PX, TILE_PX)
