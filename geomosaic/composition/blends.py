"""How what shows the ground passes into each other at seams: frames, or CCD strips.

A blend takes, for a box of h x w pixels,

    pieces: what of it each source shows, see `Piece`;
    label (h, w): the piece (from 0) that gives each pixel, -1 where none does;
    reach_px: how wide the transition is;

and gives the mosaic (h, w, bands), float32; anything where no piece has a valid pixel. h and w are multiples
of `STEP_PX`. A pixel depends on nothing farther away than `halo_px` of the reach. Where no other piece gives
a pixel within that distance, the result is the pixel's own piece, and a blend need not be called.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bools, Floats32
from geomosaic.composition.plugins import BLENDS_GROUP, Named
from geomosaic.constants import sourced, tuned

Labels = NDArray[np.int16]
_LEVELS = sourced(4, "halvings", "fewer show brightness steps; more are slow", "Burt and Adelson 1983")
STEP_PX: Final = 1 << _LEVELS
_REACH_PX = tuned(4, "px of a level", "that a band reaches: fewer show its end; more are read in vain")
HALO_PX: Final = _REACH_PX * STEP_PX
"""Reach of the bands, in whole steps."""
_LEAST_WEIGHT = tuned(np.float32(1e-4), "full weight", "of an owner: 0 blackens its very edge; more shows it")


@dataclass(frozen=True)
class Piece:
    """What a source shows of a box, in its rows and cols.

    image (.., .., bands) float32: finite anywhere. inside (.., ..): 0 where it has no valid pixel, above 0
    where it has one. It rises to 1 over half the reach, inwards from the edge and from invalid pixels.
    """

    rows: slice
    cols: slice
    image: Floats32
    inside: Floats32

    @property
    def at(self) -> tuple[slice, slice]:
        """Its place in the box."""
        return self.rows, self.cols


@dataclass(frozen=True)
class Blend:
    """A way to blend, and how much around a seam it looks at: halo_px of a reach in px, whole STEP_PX.
    feathered: whether the result depends on the reach."""

    mosaic: Callable[[Sequence[Piece], Labels, float], Floats32]
    halo_px: Callable[[float], int]
    feathered: bool = True


def hard(pieces: Sequence[Piece], label: Labels, reach_px: float) -> Floats32:
    """Every pixel is one source's."""
    out = np.zeros((*label.shape, pieces[0].image.shape[-1]), dtype=np.float32)
    for k, piece in enumerate(pieces):
        _copy(piece.image, label[piece.at] == k, out[piece.at])
    return out


def feather(pieces: Sequence[Piece], label: Labels, reach_px: float) -> Floats32:
    """Straight from one source to the other over the reach, and to nothing where a source ends."""
    side = 2 * round(reach_px / 2.0) + 1
    bands = pieces[0].image.shape[-1]
    total, weights = _sums(label.shape, bands), np.zeros(label.shape, dtype=np.float32)
    for k, piece in enumerate(pieces):
        mine = (label == k).astype(np.float32)
        weight = cv2.blur(mine, (side, side), borderType=cv2.BORDER_REPLICATE)[piece.at] * piece.inside
        weight += mine[piece.at] * _LEAST_WEIGHT
        _add(total, piece.image, weight, piece.at)
        weights[piece.at] += weight
    np.maximum(weights, np.float32(1e-12), out=weights)
    total /= _widened(weights, bands)
    return total.reshape(*label.shape, bands)


def multi_band(pieces: Sequence[Piece], label: Labels, reach_px: float) -> Floats32:
    """Each band of frequencies over its own wavelength: no step of brightness, and nothing doubled.

    What a source doesn't show is taken from the mosaic, so that it pulls nothing towards black.
    """
    plain = hard(pieces, label, reach_px)
    label = _filled(plain, label)
    bands = plain.shape[-1]
    sums = [_sums((label.shape[0] >> n, label.shape[1] >> n), bands) for n in range(_LEVELS + 1)]
    finest = sums[0].reshape(*label.shape, bands)
    for k, piece in enumerate(pieces):
        at = _reached(label == k)
        if at is None:
            continue
        own, mine = plain[at].copy(), label[at] == k
        here, there = _common(piece.at, at)
        _copy(piece.image[here], piece.inside[here] > 0.0, own[there])
        for n, (detail, weight) in enumerate(_bands(own, mine.astype(np.float32))):
            if n:
                _add(sums[n], detail, weight, tuple(slice(s.start >> n, s.stop >> n) for s in at))
            else:
                _copy(detail, mine, finest[at])
    for smaller, total in zip(sums[:0:-1], sums[-2::-1], strict=True):
        up = cv2.pyrUp(smaller.reshape(len(smaller), -1, bands))
        total += up.reshape(total.shape)
    return finest


def _bands(image: Floats32, mask: Floats32) -> Iterator[tuple[Floats32, Floats32]]:
    """What of an image, which is used up, each band of frequencies holds, the highest first, and the mask as
    smooth."""
    for _ in range(_LEVELS):
        smaller = np.asarray(cv2.pyrDown(image), dtype=np.float32)
        image -= np.asarray(cv2.pyrUp(smaller)).reshape(image.shape)
        yield image, mask
        image = smaller.reshape(*smaller.shape[:2], image.shape[-1])
        mask = np.asarray(cv2.pyrDown(mask), dtype=np.float32)
    yield image, mask


def _reached(mine: Bools) -> tuple[slice, slice] | None:
    """Whole steps about the pixels of a piece, as far as its weights reach at the coarsest level."""
    found = []
    for axis, length in ((1, mine.shape[0]), (0, mine.shape[1])):
        used = np.flatnonzero(mine.any(axis=axis))
        if not used.size:
            return None
        first, last = used[0] // STEP_PX * STEP_PX, used[-1] // STEP_PX * STEP_PX + STEP_PX
        found.append(slice(max(int(first) - HALO_PX, 0), min(int(last) + HALO_PX, length)))
    return found[0], found[1]


def _common(
    one: tuple[slice, slice], other: tuple[slice, slice]
) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """What two parts of a box have in common, counted from the first of one and of the other."""
    both = [
        (max(a.start, b.start), max(min(a.stop, b.stop), a.start, b.start))
        for a, b in zip(one, other, strict=True)
    ]
    (rows, end_rows), (cols, end_cols) = both
    here, there = (
        (slice(rows - r.start, end_rows - r.start), slice(cols - c.start, end_cols - c.start))
        for r, c in (one, other)
    )
    return here, there


def _filled(image: Floats32, label: Labels) -> Labels:
    """Labels everywhere: where there is none, the nearest pixel's that has one; and its image, in place."""
    valid = label >= 0
    if valid.all() or not valid.any():
        return label
    _, nearest = cv2.distanceTransformWithLabels(
        (~valid).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    place = np.zeros(int(nearest.max()) + 1, dtype=np.intp)
    place[nearest[valid]] = np.flatnonzero(valid)
    taken = place[nearest[~valid]]
    image[~valid] = image.reshape(-1, image.shape[-1])[taken]
    whole = label.copy()
    whole[~valid] = label.ravel()[taken]
    return whole


def _copy(image: Floats32, where: Bools, into: Floats32) -> None:
    """In place, whatever OpenCV makes of empty arrays and single bands."""
    if where.size:
        cv2.copyTo(image, where.view(np.uint8), into)


def _sums(shape: tuple[int, ...], bands: int) -> Floats32:
    """(h, w x bands) of nothing yet: OpenCV takes that for one band, however many there are."""
    return np.zeros((shape[0], shape[1] * bands), dtype=np.float32)


def _widened(weight: Floats32, bands: int) -> Floats32:
    """(h, w) once for each band, (h, w x bands)."""
    wide = weight if bands == 1 else np.asarray(cv2.merge([weight] * bands), dtype=np.float32)
    return wide.reshape(len(weight), -1)


def _add(sums: Floats32, values: Floats32, weight: Floats32, at: tuple[slice, ...]) -> None:
    """Adds values times weight (h, w) to part of sums."""
    bands = values.size // weight.size if weight.size else 0
    if bands:
        rows, cols = at
        into = sums[rows, cols.start * bands : cols.stop * bands]
        cv2.accumulateProduct(values.reshape(len(weight), -1), _widened(weight, bands), into)


BLENDS: Final[Mapping[str, Blend]] = Named(
    {
        "multi_band": Blend(multi_band, lambda reach_px: HALO_PX, feathered=False),
        "feather": Blend(feather, lambda reach_px: STEP_PX * -(-(round(reach_px / 2.0) + 1) // STEP_PX)),
        "hard": Blend(hard, lambda reach_px: 0, feathered=False),
    },
    BLENDS_GROUP,
    lambda found: isinstance(found, Blend),
)
"""And what other distributions bring, see `plugins`."""
