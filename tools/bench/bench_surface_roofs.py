"""Roofs and bridges of a mosaic against the true ortho: corners' places, doubled and missing edges, SSIM."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.windows import Window

from geomosaic.constants import sourced, tuned
from geomosaic.matching.displacement import Displacements, PatchMatching, measure_displacements
from geomosaic.matching.least_squares_matching import MaskedImage
from geomosaic.quality.compare import compare
from geomosaic.quality.compared_block import ComparisonOptions
from geomosaic.quality.figures import Similarity, best_similarity
from geomosaic.quality.ssim import luma, ssim_maps
from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.survey import landscape_of

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]
Image = NDArray[np.float32]
_PATCH_PX = tuned(
    32,
    "px",
    "side of the patches about corners: smaller ones don't match, larger ones are all yard",
)
_INWARD_PX = tuned(
    8.0,
    "px",
    "by which patches lie inside their corner: about the corner itself three quarters are ground, which "
    "is where it belongs whatever the roof does",
)
_SEARCH_PX = tuned(64, "px", "a roof 14 m high at the side of a frame leans by 60 on a smooth ground")
_SAME_PX = tuned(1.0, "px", "by which a corner that is looked for both ways may come back off itself")
_BACK_SD_PX = tuned(1.0, "px", "deviation of the way back: it only has to tell one place from another")
FAR_PX = sourced(2.0, "px", "by which a corner is off that is listed", "what is asked")
_RIM_M = tuned(15.0, "m", "of the mosaic at its border, where less than three frames see")
_PIECE_M = tuned(2.0, "m", "of an edge that are averaged: longer ones hide what a seam doubles in part")
_REACH_M = tuned(3.0, "m", "across an edge in which it is looked for: a neighbour's edge is farther away")
_ABOUT_ROOFS_M = tuned(3.0, "m", "about roofs, where SSIM is taken separately")
_CLEAR = tuned(
    4.0,
    "times what else steps in its profile",
    "that an edge must step in the true ortho to be counted: roofs as dark as their shadow have none",
)
_THERE = tuned(0.4, "of the true step", "that the mosaic has to show, else the edge is missing")
_ALIKE = tuned(
    0.6,
    "of the strongest step",
    "that a second one has where the true ortho has none: the edge is doubled; less are tiles, shadows",
)
_APART_M = tuned(0.6, "m", "between two steps of a doubled edge: nearer ones are one that is blurred")


_TILE_PX = tuned(128, "px", "side of a tile: larger ones dilute a torn tree; smaller ones are noise")
_MOST_PX = tuned(
    3000,
    "px",
    "side of the mosaic's middle in which roofs are judged: dozens of houses; more only take time and memory",
)
_MOST_PATCHES = tuned(2000, "patches", "by which the mosaic is fitted to the true ortho: four numbers")


@dataclass(frozen=True)
class Roofs:
    """How well roofs lie in a mosaic.

    corners: how many. matched: how many of them matched both ways. rmse_px, p90_px: RMSE and 90 % of what
    they are off. far: col, row and how far off of those that are off by more than `FAR_PX`. pieces: edges
    that the true ortho shows. missing, doubled, moved: shares of these that are missing, doubled, and that
    lie farther off than `_APART_M`. ssim, ssim_roofs: SSIM of all, and about roofs.
    """

    corners: int
    matched: int
    rmse_px: float
    p90_px: float
    far: tuple[tuple[float, float, float], ...]
    pieces: int
    missing: float
    doubled: float
    moved: float
    ssim: float
    ssim_roofs: float


def roofs(mosaic: Path, truth: Path) -> dict[str, Roofs]:
    """Houses and bridges of a mosaic on the true ortho's grid. A similarity, found on all that lies still, is
    taken off: it is the positions' error."""
    image, true, seen, affine = _registered(mosaic, truth / "ortho.tif")
    truth_record = json.loads((truth / "truth.json").read_text(encoding="utf-8"))
    height, width = seen.shape
    west, north = affine * (0, 0)
    east, south = affine * (width, height)
    built = landscape_of(SurveyPlan(**truth_record["plan"])).buildings_in((west, south, east, north))
    inner = cv2.distanceTransform(seen.view(np.uint8), cv2.DIST_L2, 5) * affine.a > _RIM_M
    found = {}
    for name, of in (
        ("houses", [b for b in built if not b.road]),
        ("bridges", [b for b in built if b.open_m]),
    ):
        outlines = [np.column_stack(~affine * b.outline_m().T) for b in of]
        outlines = [px for px in outlines if _all_within(inner, px)]
        if outlines:
            found[name] = _judged(image, true, seen, inner, outlines, affine.a)
    return found


def similarity_by_tile(mosaic: Path, truth: Path) -> Floats:
    """Mean SSIM of a mosaic and the true ortho by tiles (rows, cols) of 128 px, NaN where less than half of
    one is seen."""
    image, true, seen, _ = _registered(mosaic, truth / "ortho.tif")
    grey, true_grey = (luma(np.moveaxis(a, -1, 0)) for a in (image, true))
    found = ssim_maps(np.clip(grey, 0, 255), true_grey, seen, 255.0).ssim
    rows, cols = (n // _TILE_PX for n in found.shape)
    tiles = found[: rows * _TILE_PX, : cols * _TILE_PX].reshape(rows, _TILE_PX, cols, _TILE_PX)
    known = np.isfinite(tiles)
    number = known.sum(axis=(1, 3))
    total = np.where(known, tiles, 0.0).sum(axis=(1, 3))
    return np.where(2 * number > _TILE_PX**2, total / np.maximum(number, 1), np.nan)


def _registered(mosaic: Path, ortho: Path) -> tuple[Image, Image, Bools, rasterio.Affine]:
    """Both (rows, cols, 3) on the pixels of the true ortho that the mosaic covers, and where it does."""
    with rasterio.open(mosaic) as a, rasterio.open(ortho) as b:
        width, height = min(a.width, _MOST_PX), min(a.height, _MOST_PX)
        middle = Window((a.width - width) // 2, (a.height - height) // 2, width, height)
        bounds, affine = a.window_bounds(middle), a.window_transform(middle)
        window = rasterio.windows.from_bounds(*bounds, b.transform).round_offsets().round_lengths()
        true = b.read((1, 2, 3), window=window, boundless=True, fill_value=0)
        valid = a.dataset_mask(window=middle) > 0
        valid &= b.read_masks(1, window=window, boundless=True) > 0
        image = a.read((1, 2, 3), window=middle)
        step_px = max(48, round(np.sqrt(a.width * a.height / _MOST_PATCHES)))
    of = compare(mosaic, ortho, ComparisonOptions(patch_px=48, step_px=step_px)).vectors_m
    still = np.ones(len(of), dtype=bool)
    for _ in range(5):
        similarity, _ = best_similarity(of[still, :2], of[still, 2:])
        left = of[:, 2:] - _moved(similarity, of[:, :2])
        length = np.linalg.norm(left, axis=1)
        still = length < 3.0 * np.median(length)
    corners = np.array([[0.0, 0.0], [image.shape[2], 0.0], [0.0, image.shape[1]]])
    at = np.column_stack(affine * corners.T)
    to = np.column_stack(~affine * (at + _moved(similarity, at)).T)
    m = cv2.getAffineTransform((corners - 0.5).astype(np.float32), (to - 0.5).astype(np.float32))
    size = image.shape[2], image.shape[1]
    how = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    registered = cv2.warpAffine(np.moveaxis(image, 0, -1).astype(np.float32), m, size, flags=how)
    mask = cv2.warpAffine(valid.view(np.uint8) * 255, m, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    return registered, np.moveaxis(true, 0, -1).astype(np.float32), valid & (mask > 250), affine


def _moved(similarity: Similarity, at: Floats) -> Floats:
    """Displacements (n, 2) of places by a similarity."""
    centre = np.array([similarity.centre_east_m, similarity.centre_north_m])
    z = (at - centre) @ [1.0, 1.0j]
    moved = (similarity.scale * np.exp(1j * similarity.rotation_rad) - 1.0) * z
    shift = np.array([similarity.shift_east_m, similarity.shift_north_m])
    return np.column_stack([moved.real, moved.imag]) + shift


def _all_within(inner: Bools, px: Floats) -> bool:
    at = np.floor(px).astype(int)
    there = (at >= 0).all() and (at < [inner.shape[1], inner.shape[0]]).all()
    return bool(there and inner[at[:, 1], at[:, 0]].all())


def _judged(
    image: Image, true: Image, seen: Bools, inner: Bools, outlines: list[Floats], pixel_m: float
) -> Roofs:
    grey, true_grey = (luma(np.moveaxis(a, -1, 0)) for a in (image, true))
    corners = np.concatenate([_inward(px) for px in outlines])
    at = np.round(corners[:, ::-1] - _PATCH_PX / 2.0).astype(np.int64)
    found = measure_displacements(
        MaskedImage(grey, seen), MaskedImage(true_grey, seen), at, PatchMatching(_PATCH_PX, _SEARCH_PX)
    )
    same = _both_ways(grey, true_grey, seen, found)
    off = np.linalg.norm(found.displacement_px[same], axis=1)
    far = np.flatnonzero(off > FAR_PX)
    places = found.centres_px[same][far]
    pieces = [_steps(image, true, a, b, pixel_m) for px in outlines for a, b in _edges(px, pixel_m)]
    counted = [p for p in pieces if p is not None]
    maps = ssim_maps(np.clip(grey, 0, 255), true_grey, seen, 255.0).ssim
    about = np.zeros(seen.shape, np.uint8)
    cv2.fillPoly(about, [np.round(px * 16 - 8).astype(np.int32) for px in outlines], (1, 0, 0), shift=4)
    side = 2 * round(_ABOUT_ROOFS_M / pixel_m) + 1
    about = cv2.dilate(about, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)))
    return Roofs(
        len(corners),
        len(off),
        float(np.sqrt(np.mean(off**2))) if off.size else np.nan,
        float(np.quantile(off, 0.9)) if off.size else np.nan,
        tuple((float(c), float(r), float(o)) for (c, r), o in zip(places, off[far], strict=True)),
        len(counted),
        *np.mean(counted, axis=0).tolist(),
        float(np.nanmean(maps[inner])),
        float(np.nanmean(maps[about > 0])),
    )


def _both_ways(image: Image, true: Image, seen: Bools, found: Displacements) -> Bools:
    """Which patches the mosaic finds in the truth again where they came from: others met something alike."""
    first = found.centres_px + np.rint(found.displacement_px) - _PATCH_PX / 2.0
    at = first[:, ::-1].astype(np.int64)
    back = measure_displacements(
        MaskedImage(true, seen),
        MaskedImage(image, seen),
        at,
        PatchMatching(_PATCH_PX, _SEARCH_PX, max_sd_px=_BACK_SD_PX),
    )
    came = {tuple(c): d for c, d in zip(back.centres_px.tolist(), back.displacement_px, strict=True)}
    nowhere = np.full(2, np.inf)
    again = np.array([came.get(tuple(c), nowhere) for c in (first + _PATCH_PX / 2.0).tolist()]).reshape(-1, 2)
    return np.asarray(np.linalg.norm(found.displacement_px + again, axis=1) < _SAME_PX)


def _inward(px: Floats) -> Floats:
    middle = px.mean(axis=0)
    return np.asarray(px + _INWARD_PX * np.sign(middle - px))


def _edges(px: Floats, pixel_m: float) -> Iterator[tuple[Floats, Floats]]:
    """Pieces of an outline (4, 2), without its corners: begin and end of each."""
    for a, b in zip(px, np.roll(px, -1, axis=0), strict=True):
        length = np.linalg.norm(b - a) * pixel_m
        count = int((length - 2.0) // _PIECE_M)
        ends = (length / 2.0 + (np.arange(count + 1) - count / 2.0) * _PIECE_M) / max(length, 1e-9)
        for first, last in pairwise(ends):
            yield a + (b - a) * first, a + (b - a) * last


def _steps(image: Image, true: Image, a: Floats, b: Floats, pixel_m: float) -> tuple[bool, bool, bool] | None:
    """Whether a piece of an edge is missing, doubled, or elsewhere; None where the truth shows none."""
    ahead = (b - a) / np.linalg.norm(b - a)
    across = np.array([-ahead[1], ahead[0]])
    reach_px = _REACH_M / pixel_m
    off = np.arange(-reach_px - 4.0, reach_px + 4.5, 0.5)
    along = np.linspace(0.0, 1.0, 2 * int(np.linalg.norm(b - a)) + 1)
    at = a + (b - a) * along[:, None, None] + across * off[:, None] - 0.5
    left, top = np.floor(at.min(axis=(0, 1))).astype(int).clip(0)
    right, bottom = np.ceil(at.max(axis=(0, 1))).astype(int) + 1
    x, y = (
        np.ascontiguousarray(at[..., k] - from_px, dtype=np.float32) for k, from_px in ((0, left), (1, top))
    )
    slopes = []
    for of in (true, image):  # cut out: OpenCV looks through all of what it is given, for each piece
        profile = cv2.remap(of[top:bottom, left:right], x, y, cv2.INTER_LINEAR).mean(axis=0)
        slopes.append(np.gradient(cv2.GaussianBlur(profile, (1, 0), 0, sigmaY=2.0), 0.5, axis=0))
    near = np.abs(off) <= 3.0
    middle = np.flatnonzero(near)[np.linalg.norm(slopes[0][near], axis=1).argmax()]
    direction = slopes[0][middle] / np.linalg.norm(slopes[0][middle])
    truth, shown = (slope @ direction for slope in slopes)
    within = np.abs(off) <= reach_px
    strength = float(truth[middle])
    others = within & (np.abs(off) > _APART_M / pixel_m)
    if strength < _CLEAR * float(np.median(np.abs(truth[others]))):
        return None
    peaks = _peaks(shown, within)
    if not peaks.size or shown[peaks].max() < _THERE * strength:
        return True, False, False
    first = peaks[shown[peaks].argmax()]
    true_peaks = _peaks(truth, within)
    true_off = off[true_peaks[truth[true_peaks] >= _THERE * strength]]
    alike = off[peaks[shown[peaks] >= _ALIKE * shown[first]]]
    apart = _APART_M / pixel_m
    alone = np.abs(alike[:, None] - true_off).min(axis=1) > apart
    doubled = bool(alone.any() and np.ptp(alike) > apart)
    return False, doubled, bool(abs(off[first] - off[middle]) > apart)


def _peaks(values: Floats, within: Bools) -> NDArray[np.intp]:
    inner = values[1:-1]
    return np.flatnonzero((inner > values[:-2]) & (inner >= values[2:]) & within[1:-1]) + 1


if __name__ == "__main__":
    import sys

    for name, of in roofs(Path(sys.argv[1]), Path(sys.argv[2])).items():
        print(name, of)
