"""How far two frames disagree: the paper's histogram, and a net of such disagreements."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import Block
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.matching.model import TiePairs
from geomosaic.projection.footprint import ground_from_images
from geomosaic.projection.ground import GroundSurface

Floats = NDArray[np.float64]


def fullest_bin_mean(differences: Floats, step: float = 1.0) -> Floats:
    """Misalignment of a pair: the mean of the fullest histogram bin, each axis by itself.

    Yue et al. 2021, equation 5: differences of tie-point coordinates counted in bins of one pixel;
    the mean of those in the fullest bin. Of equally full bins the one nearest the median counts.

    Args: differences (k, 2), k >= 1, in the unit of `step`. Returns: (2,).
    """
    out = np.empty(2)
    for axis in range(2):
        values = differences[:, axis]
        bins = np.floor(values / step).astype(np.int64)
        names, counts = np.unique(bins, return_counts=True)
        fullest = names[counts == counts.max()]
        middle = np.median(values) / step
        chosen = fullest[np.abs(fullest + 0.5 - middle).argmin()]
        out[axis] = values[bins == chosen].mean()
    return out


@dataclass(frozen=True)
class OffsetNet:
    """A block seen as frames that slide over the map.

    pairs: (m, 2) frame indices. left_m, right_m: per pair (k, 2) east and north of the tie points as
    each frame places them before any move.
    """

    n: int
    pairs: NDArray[np.intp]
    left_m: tuple[Floats, ...]
    right_m: tuple[Floats, ...]
    step_m: float

    def differences_m(self, pair: int, moves_m: Floats) -> Floats:
        """Right minus left (k, 2) of one pair once frames have moved by moves_m (n, 2)."""
        a, b = self.pairs[pair]
        return np.asarray(self.right_m[pair] - self.left_m[pair] + (moves_m[b] - moves_m[a]))

    def misalignment_m(self, pair: int, moves_m: Floats, seen_from: int | None = None) -> Floats:
        """Fullest-bin misalignment (2,) of one pair, bins of step_m: right minus left, or the other
        frame minus `seen_from`."""
        m = fullest_bin_mean(self.differences_m(pair, moves_m), self.step_m)
        return m if seen_from in (None, self.pairs[pair][0]) else -m

    def misalignments_m(self, moves_m: Floats) -> Floats:
        """Misalignment of every pair, (m, 2)."""
        return np.array([self.misalignment_m(p, moves_m) for p in range(len(self.pairs))]).reshape(-1, 2)

    @property
    def edges(self) -> list[tuple[int, int]]:
        """The pairs as plain tuples."""
        return [(int(a), int(b)) for a, b in self.pairs]


def ties_on_ground(
    block: Block, poses: Poses, cameras: Sequence[Camera], ground: GroundSurface
) -> Iterator[tuple[Floats, Floats]]:
    """Where each pair's left and its right frame put its tie points, east and north, (k, 2) each; NaN where a
    ray misses. A keypoint of several pairs goes down to the ground once."""
    seen = TiePairs.of(block.ties.pairs)
    frame = seen.frame.astype(np.intp)
    plan_m = ground_from_images(frame, seen.image_px, poses, cameras, ground)[:, :2].copy()
    for left, right in seen.ends:
        yield plan_m[left], plan_m[right]


def offset_net(block: Block) -> OffsetNet:
    """Projects a block's tie points to the ground once; points that miss it are left out."""
    left, right, pairs = [], [], []
    on_ground = ties_on_ground(block, block.poses, block.cameras, block.ground)
    for pair, (a, b) in zip(block.ties.frames, on_ground, strict=True):
        seen = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
        if seen.any():
            pairs.append(pair)
            left.append(a[seen])
            right.append(b[seen])
    return OffsetNet(
        n=len(block.names),
        pairs=np.array(pairs, dtype=np.intp).reshape(-1, 2),
        left_m=tuple(left),
        right_m=tuple(right),
        step_m=block.ground_pixel_m,
    )
