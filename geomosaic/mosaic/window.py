"""One window of the mosaic: its frames warped once and blended into each other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomosaic.mosaic.blends import Blend
from geomosaic.mosaic.frames import Decoded
from geomosaic.mosaic.ownership import Ownership, owned_cells, owner_share
from geomosaic.mosaic.plan import Part, Scene, Window, distances_m, ground_of, margin_px, near, parts
from geomosaic.mosaic.tones import Tones
from geomosaic.projection.resample import resample
from geomosaic.projection.warp import frame_from_map

Floats32 = NDArray[np.float32]
_NEARER_PER_M = np.float32(1e-7)
"""What a metre to the nadir point counts beside a pixel's share in an owner: nothing, unless none sees it."""


@dataclass(frozen=True)
class Composed:
    """A finished window: pixels (h, w, bands), valid (h, w), per pixel the index + 1 of the frame that gives
    it, and the frames that gave pixels."""

    window: Window
    pixels: NDArray[Any]
    valid: NDArray[np.bool_]
    source: NDArray[np.int32]
    frames: tuple[int, ...]


@dataclass(frozen=True)
class Manner:
    """How windows are composed: who owns what, how frames blend and over which reach, how they are resampled
    and how bright they show the ground, the mosaic's bands and type."""

    ownership: Ownership
    blend: Blend
    reach_px: float
    resampling: str
    tones: Tones | None
    bands: int
    dtype: str


@dataclass(frozen=True)
class Step:
    """A window, as much around it as its seams need (`window` itself where there are none), and the frames'
    parts in that."""

    window: Window
    around: Window
    parts: tuple[Part, ...]


def planned(scene: Scene, manner: Manner, window: Window, masks: Mapping[int, Floats32 | None]) -> Step:
    """What a window takes; masks: of the frames whose validity is known, see `parts`."""
    around = window.grown(manner.blend.halo_px(manner.reach_px))
    views = near(scene, around)
    found = parts(scene, around, views, masks, owned_cells(manner.ownership, around, views))
    if len(found) > 1 or around == window:
        return Step(window, around, found)
    views = [p.view for p in found]
    return Step(
        window, window, parts(scene, window, views, masks, owned_cells(manner.ownership, window, views))
    )


def compose_window(scene: Scene, manner: Manner, step: Step, decoded: Mapping[int, Decoded]) -> Composed:
    """All the window's pixels; those no frame sees are 0 and not valid."""
    masks = {frame: d.mask_distance_px for frame, d in decoded.items()}
    if any(mask is not None for mask in masks.values()):
        views = [p.view for p in step.parts]
        owned = owned_cells(manner.ownership, step.around, views)
        step = Step(step.window, step.around, parts(scene, step.around, views, masks, owned))
    window, around = step.window, step.around
    if not step.parts:
        shape = window.height, window.width
        nothing = np.zeros((*shape, manner.bands), dtype=manner.dtype)
        return Composed(window, nothing, np.zeros(shape, bool), np.zeros(shape, np.int32), ())
    ground = ground_of(scene, around)
    shape = around.height, around.width
    margin = np.full((len(step.parts), *shape), -np.inf, dtype=np.float32)
    share = np.full_like(margin, -np.inf)
    maps = []
    for k, part in enumerate(step.parts):
        view = part.view
        cols, rows = frame_from_map(ground, view.pose, view.camera, part.rows, part.cols)
        inside = margin_px(cols, rows, view.camera, masks[view.frame])
        margin[k, part.rows, part.cols] = inside * np.float32(view.gsd_m / scene.grid.gsd_m)
        maps.append((cols, rows))
    for k, part in enumerate(step.parts):
        nearer = distances_m(scene.grid, around, part.view) * _NEARER_PER_M
        own = owner_share(manner.ownership, around, part.view.frame)
        np.copyto(share[k], own - nearer, where=margin[k] > 0.0)
    label = np.where((margin > 0.0).any(axis=0), share.argmax(axis=0), -1).astype(np.int32)
    half = max(manner.reach_px / 2.0, 1e-6)
    shown = np.clip(margin / np.float32(half), 0.0, 1.0)
    pictures = []
    for part, (cols, rows) in zip(step.parts, maps, strict=True):
        picture = np.zeros((*shape, manner.bands), dtype=np.float32)
        seen = resample(decoded[part.view.frame].pixels, cols, rows, manner.resampling)
        if manner.tones is not None:
            seen = manner.tones.evened(seen, part.view.frame, part.view.camera, cols, rows)
        picture[part.rows, part.cols] = seen
        pictures.append(picture)
    one = (label[0, 0] >= 0) & (label == label[0, 0]).all()
    total = pictures[label[0, 0]] if one else manner.blend.mosaic(pictures, shown, label, manner.reach_px)
    inner = (
        slice(window.row - around.row, window.row - around.row + window.height),
        slice(window.col - around.col, window.col - around.col + window.width),
    )
    total, label = total[inner], label[inner]
    return _finished(window, total, label, [p.view.frame for p in step.parts], manner.dtype)


def _finished(
    window: Window, total: Floats32, label: NDArray[np.int32], frames: list[int], dtype: str
) -> Composed:
    valid = label >= 0
    source = np.append(np.asarray(frames, dtype=np.int32) + 1, np.int32(0))[label]
    if np.issubdtype(np.dtype(dtype), np.integer):
        limits = np.iinfo(dtype)
        total = np.clip(np.rint(total), limits.min, limits.max)
    pixels = np.where(valid[..., None], total, 0.0).astype(dtype)
    gave = tuple(int(f) - 1 for f in np.unique(source[valid]))
    return Composed(window, pixels, np.asarray(valid), np.asarray(source), gave)
