"""Differences of two maps of one place that the accuracy of both does not explain."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window

from geomosaic.arrays import Bools, Floats
from geomosaic.constants import FOUR_SIGMA, NORMAL_PER_MAD, ROUNDS, SIX_SIGMA, tuned
from geomosaic.doors.raster import OWN, Raster, open_raster
from geomosaic.errors import InputError
from geomosaic.estimation.robust import THREE_SIGMA
from geomosaic.matching.displacement import SMOOTHING_SIGMA_PX
from geomosaic.quality.changed_areas import ChangedArea, StrengthBlock, areas_in, joined_areas
from geomosaic.quality.compare import Comparison, registered
from geomosaic.quality.compared_block import GLANCE_PX
from geomosaic.quality.figures import Similarity, best_similarity
from geomosaic.quality.rasters import blocks, grown, on_grid_of, open_map, pixel_m, read_luma, within
from geomosaic.quality.surface_pair import SurfacePair, on_surface

IMAGE, HEIGHT = "image", "height"
_TONE_PX = tuned(129, "px", "window in which tones are brought together: less hides changes as tones")
_LEAST_SHARE = tuned(0.06, "of the span", "least grey difference: less finds shadows and haze")
_LEAST_PX = tuned(6, "px", "of a change's core: fewer are specks")
_STRENGTH = tuned(4.0, "steps a deviation", "of a stored strength: fewer are coarse; more end below 64")


@dataclass(frozen=True)
class Registration:
    """How the new map lies on the old one. similarity: best over most vectors; sd_px: what it leaves, per
    axis, in the new map's pixels."""

    similarity: Similarity
    sd_px: float

    @property
    def reach_px(self) -> int:
        """By how much edges of both may lie apart: resampling alone moves them by half a pixel."""
        return 1 + int(np.ceil(THREE_SIGMA * self.sd_px))

    @property
    def shift_m(self) -> float:
        """Length of the shift between both."""
        return float(np.hypot(self.similarity.shift_east_m, self.similarity.shift_north_m))


@dataclass(frozen=True)
class Change:
    """A difference. kind: IMAGE or HEIGHT. outline: on the new map. sigma: largest, in deviations. rise_m,
    volume_m3: mean and sum of the change of height, NaN for an image."""

    kind: str
    outline: Any
    sigma: float
    area_m2: float
    rise_m: float = float("nan")
    volume_m3: float = float("nan")


def registration(comparison: Comparison) -> Registration:
    """How two maps lie to one another, by most of the vectors between them.

    Raises: `InputError` where too little of both looks alike.
    """
    at_m, off_m = comparison.vectors_m[:, :2], comparison.vectors_m[:, 2:]
    kept = np.ones(len(at_m), dtype=bool)
    for _ in range(ROUNDS):
        similarity, _ = best_similarity(at_m[kept], off_m[kept])
        if not np.isfinite(similarity.scale):
            break
        left = np.linalg.norm(off_m - _moves(similarity, at_m), axis=1)
        sd_m = float(np.median(left[kept])) / np.sqrt(2.0 * np.log(2.0))
        kept = left <= THREE_SIGMA * max(sd_m, 1e-3 * comparison.gsd_m)
    if not np.isfinite(similarity.scale):
        problem = f"only {len(at_m)} places look alike in both maps"
        raise InputError(problem, fix="compare runs of the same place, of a like season and resolution")
    return Registration(similarity, sd_m / comparison.gsd_m)


def _moves(s: Similarity, at_m: Floats) -> Floats:
    """What a similarity moves places (n, 2) by."""
    z = (at_m - [s.centre_east_m, s.centre_north_m]) @ [1.0, 1.0j]
    moved = s.scale * np.exp(1j * s.rotation_rad) * z - z + complex(s.shift_east_m, s.shift_north_m)
    return np.stack([moved.real, moved.imag], axis=-1)


def image_changes(old: Path, new: Path, on_old: Registration) -> tuple[Change, ...]:
    """Where the images of two maps differ by more than noise, tones and edges that lie apart explain.

    A pixel has changed if it is brighter or darker than all pixels of the other map within
    `Registration.reach_px`, seen from either map. Tones are brought together window by window first.
    """
    with open_map(new) as b, open_map(old) as a:
        _, metres = pixel_m(b, new)
        over = registered(b.transform, on_old.similarity, metres)
        with on_grid_of(b, a, old, over) as before:
            noise, span = _noise(b, before)
            least = max(SIX_SIGMA * noise, _LEAST_SHARE * span)
            found: list[ChangedArea] = []
            for block in blocks(b.height, b.width, GLANCE_PX):
                wanted = grown(block, on_old.reach_px, b.height, b.width)
                outer = grown(wanted, _TONE_PX + 2 * on_old.reach_px, b.height, b.width)
                excess = _excess(_in_one_tone(b, before, outer), on_old.reach_px)[within(wanted, outer)]
                deviations = np.minimum(np.round(_STRENGTH * excess / noise), 255)
                strength = np.where(excess > least, deviations, 0).astype(np.uint8)
                of = StrengthBlock(strength, excess, wanted, block)
                found += areas_in(of, _LEAST_PX, on_old.reach_px)
        changes = []
        for area in joined_areas(found, _LEAST_PX):
            outline = area.on_map(b.transform)
            changes.append(Change(IMAGE, outline, area.strongest / _STRENGTH, outline.area * metres**2))
        return tuple(changes)


def _in_one_tone(b: Raster, on_b: WarpedVRT, window: Window) -> tuple[Floats, Floats, Bools]:
    """The new and the old image (rows, cols) in one tone, and where both are valid."""
    (new, new_valid), (old, old_valid) = read_luma(b, window), read_luma(on_b, window)
    both = new_valid & old_valid
    after, before = (
        np.asarray(cv2.GaussianBlur(i, (0, 0), SMOOTHING_SIGMA_PX), np.float64) for i in (new, old)
    )
    off = np.where(both, after - before, 0.0)
    alike = both
    for _ in range(2):
        weight = alike.astype(np.float64)
        share = cv2.blur(weight, (_TONE_PX, _TONE_PX))
        tone = cv2.blur(off * weight, (_TONE_PX, _TONE_PX)) / np.maximum(share, 1e-3)
        left = np.abs(off - tone)
        spread = NORMAL_PER_MAD * float(np.median(left[both])) if both.any() else 0.0
        alike = both & (left <= THREE_SIGMA * max(spread, 1.0))
    return np.asarray(after - tone), before, both


def _noise(b: Raster, before: WarpedVRT) -> tuple[float, float]:
    """Deviation of grey values between both maps, and their span, by the middle of the map."""
    side = min(GLANCE_PX, b.width, b.height)
    middle = Window((b.width - side) // 2, (b.height - side) // 2, side, side)
    new, old, both = _in_one_tone(b, before, middle)
    if not both.any():
        new, old, both = _in_one_tone(b, before, Window(0, 0, b.width, b.height))
    off, values = (new - old)[both], old[both]
    if not off.size:
        raise InputError("the maps show no place in common", fix="compare runs of the same place")
    span = 255.0 if b.dtypes[0] == "uint8" else float(np.quantile(values, 0.99) - np.quantile(values, 0.01))
    return max(NORMAL_PER_MAD * float(np.median(np.abs(off - np.median(off)))), 1e-3 * span), span


def _excess(in_one_tone: tuple[Floats, Floats, Bools], reach_px: int) -> Floats:
    """By how much grey values lie beyond those of the other map within reach, seen from either."""
    new, old, both = in_one_tone
    near = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach_px + 1,) * 2)
    inside = cv2.erode(both.astype(np.uint8), near) > 0

    def beyond(one: Floats, other: Floats) -> Floats:
        return np.asarray(np.maximum(one - cv2.dilate(other, near), cv2.erode(other, near) - one))

    excess = np.minimum(beyond(new, old), beyond(old, new))
    return np.where(inside, np.maximum(excess, 0.0), 0.0)


@dataclass(frozen=True)
class SurfaceRasters:
    """A run's surface.tif and surface_confidence.tif."""

    surface: Path
    confidence: Path


def height_changes(
    old: SurfaceRasters, new: SurfaceRasters, on_old: Registration, map_m: float
) -> tuple[tuple[Change, ...], float]:
    """Where the surfaces of two maps differ by more than their deviations explain; and by how much (m) the
    new one lies higher in common.

    What both have in common, an offset and a tilt, is the georeference's and does not count. A deviation is
    that of both surfaces and of the slope times what the maps lie apart. map_m: the new map's pixel.
    """
    with ExitStack() as stack:
        b = stack.enter_context(open_raster(new.surface, OWN))
        cell_m, metres = pixel_m(b, new.surface)
        over = registered(b.transform, on_old.similarity, metres) or b.transform
        others = (old.surface, over), (new.confidence, b.transform), (old.confidence, over)
        rasters = b, *(stack.enter_context(on_surface(b, path, at)) for path, at in others)
        pair = SurfacePair(rasters, cell_m, on_old.sd_px * map_m)
        windows = list(blocks(b.height, b.width, GLANCE_PX))
        common = pair.common_rise(windows)
        if common is None:
            return (), float("nan")
        found: list[ChangedArea] = []
        opening = np.ones((3, 3), np.uint8)
        for block in windows:
            window = grown(block, len(opening) - 1, b.height, b.width)
            rise_m, z = pair.beyond(common, window)
            beyond = np.nan_to_num(np.abs(z))
            specked = (beyond > FOUR_SIGMA).astype(np.uint8)
            far = cv2.morphologyEx(specked, cv2.MORPH_OPEN, opening)
            strength = np.where(far > 0, np.minimum(np.round(_STRENGTH * beyond), 255), 0).astype(np.uint8)
            found += areas_in(StrengthBlock(strength, rise_m, window, block), 1, 0)
        changes = []
        for area in joined_areas(found, 1):
            outline, volume_m3 = area.on_map(b.transform), area.total * cell_m**2
            size = outline.area * metres**2, area.total / area.known, volume_m3
            changes.append(Change(HEIGHT, outline, area.strongest / _STRENGTH, *size))
    return tuple(changes), common.middle_m
