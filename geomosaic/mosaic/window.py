"""One window of the mosaic: its frames warped once, weighed and added up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomosaic.mosaic.frames import Decoded
from geomosaic.mosaic.plan import Part, Scene, Window, distances_m, ground_of, margin_px, parts
from geomosaic.mosaic.seams import Seam
from geomosaic.mosaic.tones import Tones
from geomosaic.projection.resample import resample
from geomosaic.projection.warp import frame_from_map

Floats32 = NDArray[np.float32]


@dataclass(frozen=True)
class Composed:
    """A finished window: pixels (h, w, bands), valid (h, w), per pixel the heaviest frame's index + 1,
    and the frames that gave pixels."""

    window: Window
    pixels: NDArray[Any]
    valid: NDArray[np.bool_]
    source: NDArray[np.int32]
    frames: tuple[int, ...]


def compose_window(
    scene: Scene,
    window: Window,
    planned: Sequence[Part],
    decoded: Mapping[int, Decoded],
    dtype: str,
    bands: int,
    seam: Seam,
    resampling: str,
    tones: Tones | None = None,
) -> Composed:
    """All the window's pixels; those no frame sees are 0 and not valid."""
    shape = (window.height, window.width)
    masks = {frame: d.mask_distance_px for frame, d in decoded.items()}
    if any(mask is not None for mask in masks.values()):
        planned = parts(scene, window, [p.view for p in planned], masks)
    source = np.zeros(shape, dtype=np.int32)
    if not planned:
        nothing = np.zeros((*shape, bands), dtype=dtype)
        return Composed(window, nothing, np.zeros(shape, dtype=bool), source, ())
    ground = ground_of(scene, window)
    inside = np.zeros((len(planned), *shape), dtype=np.float32)
    maps = []
    for k, part in enumerate(planned):
        view = part.view
        cols, rows = frame_from_map(ground, view.pose, view.camera, part.rows, part.cols)
        margin = margin_px(cols, rows, view.camera, masks[view.frame])
        inside[k, part.rows, part.cols] = _ramp(margin, view.gsd_m, scene.feather_m)
        maps.append((cols, rows))
    weights = inside
    if len(planned) == 1:
        np.ceil(weights, out=weights)
    else:
        distance = np.stack([distances_m(scene.grid, window, p.view) for p in planned])
        weights = seam(distance, inside, scene.feather_m)
    total = np.zeros((*shape, bands), dtype=np.float32)
    gave_pixels = []
    for k, (part, (cols, rows)) in enumerate(zip(planned, maps, strict=True)):
        at = _bounding_box(weights[k, part.rows, part.cols] > 0.0)
        if at is None:
            continue
        gave_pixels.append(part.view.frame)
        seen = resample(decoded[part.view.frame].pixels, cols[at], rows[at], resampling)
        if tones is not None:
            seen = tones.evened(seen, part.view.frame, part.view.camera, cols[at], rows[at])
        weight = weights[k, part.rows, part.cols][at]
        total[part.rows, part.cols][at] += seen * weight[..., None]
    valid = np.asarray(weights.any(axis=0))
    frames = np.array([p.view.frame + 1 for p in planned], dtype=np.int32)
    source[valid] = frames[weights.argmax(axis=0)[valid]]
    if np.issubdtype(np.dtype(dtype), np.integer):
        np.rint(total, out=total)
    return Composed(window, total.astype(dtype), valid, source, tuple(gave_pixels))


def _ramp(margin: Floats32, gsd_m: float, feather_m: float) -> Floats32:
    """0 outside, 1 from feather_m inside the frame's valid pixels."""
    if feather_m <= 0.0:
        return np.asarray(margin > 0.0, dtype=np.float32)
    return np.asarray(np.clip(margin * np.float32(gsd_m / feather_m), 0.0, 1.0))


def _bounding_box(where: NDArray[np.bool_]) -> tuple[slice, slice] | None:
    rows, cols = np.flatnonzero(where.any(axis=1)), np.flatnonzero(where.any(axis=0))
    if not rows.size:
        return None
    return slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1)
