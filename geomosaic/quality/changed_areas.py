"""Connected pixels of a map as polygons, found block by block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import shapely
from rasterio import Affine
from rasterio.features import shapes
from rasterio.windows import Window
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from geomosaic.arrays import Bytes, Floats
from geomosaic.quality.rasters import within


@dataclass(frozen=True)
class ChangedArea:
    """Connected pixels. outline: in col and row of the map; core_px: how many of them have a strength.

    strongest: the largest strength. known, total: how many of their values are known, and the sum of these.
    """

    outline: Any
    core_px: int
    strongest: int
    known: int
    total: float

    def on_map(self, transform: Affine) -> Any:
        """The outline on the map."""
        linear = np.array([[transform.a, transform.b], [transform.d, transform.e]])
        return shapely.transform(self.outline, lambda at: at @ linear.T + [transform.c, transform.f])


@dataclass(frozen=True)
class StrengthBlock:
    """Strengths (rows, cols) of a window, 0 where nothing changed, and values of the same pixels, NaN where
    unknown. block: the part of the window whose areas are wanted."""

    strength: Bytes
    values: Floats
    window: Window
    block: Window


def areas_in(of: StrengthBlock, least_px: int, reach_px: int) -> list[ChangedArea]:
    """The areas of a block, grown by the reach, which the window must have around the block.

    Those of fewer core pixels are left out, unless they may go on in another block.
    """
    near = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach_px + 1,) * 2)
    inner = within(of.block, of.window)
    changed = cv2.dilate((of.strength > 0).astype(np.uint8), near)[inner]
    strength, values = of.strength[inner], of.values[inner]
    labels, _ = ndimage.label(changed, np.ones((3, 3), dtype=int))
    out = []
    for number, (rows, cols) in enumerate(ndimage.find_objects(labels), start=1):
        mask = labels[rows, cols] == number
        core, value = strength[rows, cols][mask], values[rows, cols][mask]
        known = value[np.isfinite(value)]
        ends = rows.start > 0 and cols.start > 0 and rows.stop < len(labels) and cols.stop < labels.shape[1]
        if ends and np.count_nonzero(core) < least_px:
            continue
        at = Affine.translation(of.block.col_off + cols.start, of.block.row_off + rows.start)
        parts = shapes(mask.astype(np.uint8), mask=mask, transform=at)
        outline = shapely.unary_union([shapely.geometry.shape(g) for g, _ in parts])
        size = int(np.count_nonzero(core)), int(core.max()), len(known), float(known.sum())
        out.append(ChangedArea(outline, *size))
    return out


def joined_areas(areas: Sequence[ChangedArea], least_px: int) -> list[ChangedArea]:
    """Areas of all blocks, those that touch as one. Left out are those of fewer core pixels."""
    outlines = np.array([a.outline for a in areas], dtype=object)
    touching = shapely.STRtree(outlines).query(outlines, predicate="intersects")
    links = coo_array((np.ones(touching.shape[1]), tuple(touching)), shape=(len(areas), len(areas)))
    count, group = connected_components(links, directed=False)
    members: list[list[ChangedArea]] = [[] for _ in range(count)]
    for area, number in zip(areas, group, strict=True):
        members[number].append(area)
    whole = [_joined(parts) for parts in members]
    return [area for area in whole if area.core_px >= least_px]


def _joined(parts: Sequence[ChangedArea]) -> ChangedArea:
    if len(parts) == 1:
        return parts[0]
    outline = shapely.simplify(shapely.unary_union([p.outline for p in parts]), 0.0)
    strongest = max(p.strongest for p in parts)
    core, known = sum(p.core_px for p in parts), sum(p.known for p in parts)
    return ChangedArea(outline, core, strongest, known, sum(p.total for p in parts))
