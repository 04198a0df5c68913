"""What a mosaic's tiles were composed with, and which of them the next mosaic can keep.

Of a tile's frames it is noted where each shows places of the tile, and how bright. So poses, lens and ground
count together by what they do to pixels. A tile that is kept keeps its note: the next run compares with what
was composed, and errors do not add up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from geomosaic.arrays import Bools, Floats, Floats32, Ints64
from geomosaic.camera.interior import Camera
from geomosaic.composition.area import Area
from geomosaic.composition.grid import SAME_CELL
from geomosaic.composition.kept_tile import KeptTile
from geomosaic.composition.model import OutputGrid
from geomosaic.composition.ownership import Ownership
from geomosaic.composition.scene import Scene, ground_of
from geomosaic.composition.tiles import TILE_PX
from geomosaic.composition.tones import GREYS, Tones
from geomosaic.composition.views import FrameView
from geomosaic.composition.window import CompositionStep, Window
from geomosaic.constants import tuned
from geomosaic.projection.warp import GroundWindow, ProjectionEquations, frame_from_map, middles

MOST_MOVED_PX = tuned(0.05, "mosaic px", "that a kept tile may be off: more shows at adjacent tiles")
MOST_GREY = tuned(0.5, "grey levels of 256", "that a kept tile may be off: more shows at adjacent tiles")
_ACROSS = tuned(4, "places", "along a tile, of a frame's place and brightness: fewer miss what moved")
_NEAR = tuned(0.1, "of a frame's side", "outside that still counts: less loses rims; more sees nothing")


@dataclass(frozen=True)
class ComposedTiles:
    """Notes of t tiles. manner: blend, resampling and what else all share. frames: of the whole survey, by
    name and content. places (t, 2): col and row of each tile, in tiles. owners: who gives what in and about
    it, as a fingerprint. first (t + 1,): where its parts begin among the k of all tiles; part (k,): whose it
    is; image_px (k, s, 2), brighter (k, s, b): places of the tile in it, see `Tones.brighter`."""

    grid: OutputGrid
    manner: str
    frames: tuple[str, ...]
    places: Ints64
    owners: tuple[str, ...]
    first: Ints64
    part: Ints64
    image_px: Floats32
    brighter: Floats32

    @cached_property
    def row_of(self) -> dict[tuple[int, int], int]:
        """The tiles' numbers by their places."""
        return {(int(col), int(row)): k for k, (col, row) in enumerate(self.places)}

    def note(self, col: int, row: int, like: Window) -> TileNote | None:
        """Of the tile at a place; None where there is none, or one cut off at the grid's edge that is smaller
        than a window."""
        k = self.row_of.get((col, row))
        whole = (col * TILE_PX + like.width, row * TILE_PX + like.height)
        if k is None or whole[0] > self.grid.width_px or whole[1] > self.grid.height_px:
            return None
        its = range(int(self.first[k]), int(self.first[k + 1]))
        parts = {self.frames[self.part[i]]: (self.image_px[i], self.brighter[i]) for i in its}
        return TileNote(self.owners[k], parts)


@dataclass(frozen=True)
class TileNote:
    """Of one tile: a fingerprint of who gives what; of each frame by name and content, image_px (s, 2) and
    brighter (s, b) of places of the tile."""

    owners: str
    parts: Mapping[str, tuple[Floats32, Floats32]]


def tiles_of(
    like: ComposedTiles, places: Sequence[tuple[int, int]], notes: Sequence[TileNote]
) -> ComposedTiles:
    """The notes of tiles as one. like: the mosaic's, of no tile."""
    number = {name: k for k, name in enumerate(like.frames)}
    parts = [(number[name], *its) for note in notes for name, its in note.parts.items()]
    samples, bands = like.image_px.shape[1], like.brighter.shape[2]
    return ComposedTiles(
        like.grid,
        like.manner,
        like.frames,
        np.array(places, dtype=np.int64).reshape(-1, 2),
        tuple(note.owners for note in notes),
        np.cumsum([0, *(len(note.parts) for note in notes)], dtype=np.int64),
        np.array([p for p, _, _ in parts], dtype=np.int64),
        np.array([px for _, px, _ in parts], dtype=np.float32).reshape(-1, samples, 2),
        np.array([b for _, _, b in parts], dtype=np.float32).reshape(-1, samples, bands),
    )


@dataclass(frozen=True)
class EarlierMosaic:
    """A mosaic's raster, the raster of its sources, and the notes of its tiles."""

    raster: Path
    sources: Path
    tiles: ComposedTiles


@dataclass(frozen=True)
class Noting:
    """What notes are made by. frames: of the survey, by name and content; manner: see
    `ComposedTiles`; halo_px: how far about a tile who gives what matters; area: what tiles are cut to."""

    scene: Scene
    ownership: Ownership
    tones: Tones | None
    frames: tuple[str, ...]
    manner: str
    halo_px: int
    bands: int
    area: Area | None = None

    def none(self) -> ComposedTiles:
        """The mosaic's notes, of no tile."""
        nothing, samples = np.zeros(0, dtype=np.int64), _ACROSS**2
        image, bright = (np.zeros((0, samples, n), dtype=np.float32) for n in (2, self.bands))
        curve = "" if self.tones is None or self.tones.curve == 1.0 else f" {self.tones.curve:.4f}"
        manner = f"{self.manner} {self.ownership.cell_px} {self._white}{curve}"
        return ComposedTiles(
            self.scene.grid, manner, self.frames, nothing.reshape(0, 2), (), np.zeros(1, np.int64),
            nothing, image, bright,
        )  # fmt: skip

    @property
    def _white(self) -> float:
        return float("inf") if self.tones is None else self.tones.white

    @property
    def most_log(self) -> float:
        """How much brighter a frame may be than it was: by MOST_GREY where that shows most."""
        share = MOST_GREY / GREYS
        return share if not np.isfinite(self._white) else 4.0 * share

    def note(self, step: CompositionStep) -> TileNote:
        """Of the tile that a step composes."""
        window = step.window
        whole = Window(window.col, window.row, TILE_PX, TILE_PX)
        ground = ground_of(self.scene, whole, TILE_PX // _ACROSS)
        parts = {}
        for number, view in ((p.source.number, _view_of(p.source)) for p in step.parts):
            cols, rows = _places(ground, view)
            bright = np.zeros((*cols.shape, self.bands), dtype=np.float32)
            if self.tones is not None:
                nearest = np.clip(cols, 0, view.camera.width_px), np.clip(rows, 0, view.camera.height_px)
                bright = self.tones.brighter(number, view.camera, *nearest)
            image = np.stack([cols, rows], axis=-1).reshape(-1, 2)
            parts[self.frames[number]] = image, bright.reshape(len(image), -1)
        _, _, owner = self.ownership.around(whole.grown(self.halo_px))
        named, inverse = np.unique(owner, return_inverse=True)
        names = [self.frames[n - 1] if n else "" for n in named.tolist()]
        order = np.argsort(names, kind="stable")
        rank = np.empty(len(order), dtype=np.int32)
        rank[order] = np.arange(len(order), dtype=np.int32)
        mark = blake2b("\n".join(names[k] for k in order).encode(), digest_size=20)
        mark.update(rank[inverse.ravel()].tobytes())
        if self.area is not None:
            mark.update(np.packbits(self.area.mask(self.scene.grid, whole)).tobytes())
        return TileNote(mark.hexdigest(), parts)

    def alike(self, was: TileNote, now: TileNote, views: Mapping[str, FrameView]) -> bool:
        """Whether a tile would be the same within MOST_MOVED_PX and MOST_GREY."""
        if was.owners != now.owners or was.parts.keys() != now.parts.keys():
            return False
        for name, (image_px, brighter) in now.parts.items():
            before_px, before = was.parts[name]
            camera = views[name].camera
            some = _inside(image_px, camera) | _inside(before_px, camera)
            some = some if some.any() else np.ones(len(some), dtype=bool)
            moved_px = np.linalg.norm(image_px[some] - before_px[some], axis=1)
            moved_px *= views[name].gsd_m / self.scene.grid.gsd_m
            if not (moved_px <= MOST_MOVED_PX).all():
                return False
            if not (np.abs(brighter[some] - before[some]) <= self.most_log).all():
                return False
        return True


class TileNotes:
    """The notes of a mosaic's tiles, one after the other, and which tiles are kept of an earlier one."""

    def __init__(self, noting: Noting, earlier: EarlierMosaic | None) -> None:
        self._noting = noting
        self._earlier = earlier if earlier is not None and _goes_with(noting, earlier.tiles) else None
        self._places: list[tuple[int, int]] = []
        self._notes: list[TileNote] = []
        self.kept = 0
        if self._earlier is not None:
            number = {name: k for k, name in enumerate(noting.frames)}
            was = self._earlier.tiles
            self._numbers = np.array([number.get(name, -1) for name in was.frames], dtype=np.int64)
            self._offset = np.rint(_offset_px(noting.scene.grid, was.grid) / TILE_PX).astype(int).tolist()

    def look(self, step: CompositionStep) -> KeptTile | None:
        """The tile of a step, if it can be kept; it is noted in any case."""
        if not step.parts:
            return None
        col, row = step.window.col // TILE_PX, step.window.row // TILE_PX
        note, found = self._noting.note(step), None
        if self._earlier is not None:
            across, down = col + self._offset[0], row + self._offset[1]
            was = self._earlier.tiles.note(across, down, step.window)
            views = {self._noting.frames[p.source.number]: _view_of(p.source) for p in step.parts}
            if was is not None and self._noting.alike(was, note, views):
                files, first = (
                    (self._earlier.raster, self._earlier.sources),
                    (across * TILE_PX, down * TILE_PX),
                )
                note, found = was, KeptTile(*files, *first, self._numbers)
                self.kept += 1
        self._places.append((col, row))
        self._notes.append(note)
        return found

    def tiles(self) -> ComposedTiles:
        """All of them."""
        return tiles_of(self._noting.none(), self._places, self._notes)


def _offset_px(grid: OutputGrid, was: OutputGrid) -> Floats:
    """Cols and rows of an earlier grid before the first of the present one."""
    return np.array([grid.west_m - was.west_m, was.north_m - grid.north_m]) / grid.gsd_m


def _goes_with(noting: Noting, was: ComposedTiles) -> bool:
    """Whether tiles of an earlier mosaic may be tiles of this one."""
    grid, manner = noting.scene.grid, noting.none().manner
    if (was.grid.crs, was.grid.gsd_m, was.manner) != (grid.crs, grid.gsd_m, manner):
        return False
    off = _offset_px(grid, was.grid) / TILE_PX
    ground = noting.scene.ground
    standing = ground.has_walls or bool(ground.raised) or bool(noting.ownership.hidden)
    return not standing and bool(np.abs(off - np.rint(off)).max() * TILE_PX < SAME_CELL)


def _view_of(source: Any) -> FrameView:
    view: FrameView = source.view
    return view


def _places(ground: GroundWindow, view: FrameView) -> tuple[Floats32, Floats32]:
    """Cols and rows of ground points in a frame. Points beyond the range of its lens are projected without
    distortion: nothing else shows whether a frame that only touches a tile has moved."""
    camera = view.camera
    cols, rows = frame_from_map(ground, view.pose, camera)
    beyond = np.isnan(cols)
    if beyond.any():
        u, v = middles(ground.width_px), middles(ground.height_px)[:, None]
        x, y, z = ProjectionEquations(view.pose, camera).axes(ground, u, v, ground.relief_m)
        with np.errstate(divide="ignore", invalid="ignore"):
            cols[beyond] = (camera.principal_col_px - camera.focal_length_px * x / z)[beyond]
            rows[beyond] = (camera.principal_row_px + camera.focal_length_px * y / z)[beyond]
    return cols, rows


def _inside(image_px: Floats32, camera: Camera) -> Bools:
    """Which places lie in a frame or near its edge."""
    size = np.array([camera.width_px, camera.height_px])
    with np.errstate(invalid="ignore"):
        return np.asarray(((image_px > -_NEAR * size) & (image_px < (1.0 + _NEAR) * size)).all(axis=1))
