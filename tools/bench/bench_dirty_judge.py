"""The judge of dirty surveys: what came of one, against its truth, whatever the run itself says.

The map is judged on open ground. Roofs and crowns lean in every frame and stand upright in the true ortho. So
the ortho is masked where one of them may hide the ground. Crowns that wind moves are nowhere else in the true
ortho than at rest, and no frame shows them so: they are masked too.
"""

from __future__ import annotations

import csv
import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.vrt import WarpedVRT

from geomosaic.errors import GeomosaicError
from geomosaic.geodesy.local import LocalFrame
from geomosaic.quality.compare import Comparison, compare
from geomosaic.quality.compared_block import ComparisonOptions
from geomosaic.quality.figures import Figures
from geomosaic_simulate.changing import SWAY_REACH
from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.survey import landscape_of

Floats = NDArray[np.float64]
STANDS_M = 0.5
"""What is higher than this above the bare ground stands."""
LEAN = 0.6
"""Tangent of the angle at which a mosaic may still look at the ground: that of a frame's edge."""
STEP_M = 3.0
LEAST_PATCHES = 12
LEAST_SHARE = 0.3
"""Of the patches, that must be found: else the mosaic is first aligned with the ortho by its own features."""
OTHER_SCALE = 0.01
"""A patch of 64 px whose scale is off by more doesn't match from edge to edge. Then the mosaic is aligned
with the ortho first: scale is judged by the positions, and shape without it."""
ALIKE = 0.9
"""Of the patches found once the mosaic is aligned, what must be found before it to be judged as it is."""
FARTHEST_PX = 1600
KEYPOINTS = 3000
MATCH_RATIO = 0.75
SEARCH_PX = 128
MOST_PLACES = 200
"""Between which distances are measured, evenly spread."""


def of_map(folder: Path, mosaic: Path) -> dict[str, Any]:
    """Displacement of a mosaic on open ground: after the best similarity, jumps, and how much of the land it
    shows. No figures where too little of it can be measured."""
    reference = open_ground(folder)
    row: dict[str, Any] = {"covered": covered(mosaic, folder / "truth" / "ortho.tif"), "aligned": False}
    compared = _compared(mosaic, reference)
    found = None if compared is None else compared.figures
    little = found is None or found.measured < LEAST_PATCHES or found.share_measured < LEAST_SHARE
    if little or abs(found.similarity.scale - 1.0) > OTHER_SCALE:
        aligned = aligned_to(mosaic, folder / "truth" / "ortho.tif", folder / "judge-aligned.tif")
        again = _compared(aligned, reference) if aligned is not None else None
        if again is not None and (found is None or _better(again.figures, found, little)):
            compared, found, row["aligned"] = again, again.figures, True
            row["covered"] = covered(aligned, folder / "truth" / "ortho.tif")
    if found is None or compared is None or found.measured < LEAST_PATCHES:
        return {**row, "patches": 0 if found is None else found.measured}
    return {
        **row,
        "patches": found.measured,
        "measured": found.share_measured,
        "after_px": found.after_similarity_px,
        "jump_px": found.jump_99_px,
        **({} if row["aligned"] else of_distances(compared.vectors_m)),
        "map_absolute_m": None if row["aligned"] else found.absolute_rmse_m,
    }


def of_distances(vectors_m: Floats) -> dict[str, Any]:
    """RMSE of distances within the map, over about 100 m and over about its length, and its scale's error."""
    known = vectors_m[np.isfinite(vectors_m).all(axis=1)]
    some = known[np.linspace(0, len(known) - 1, min(len(known), MOST_PLACES)).astype(int)]
    one, other = np.triu_indices(len(some), 1)
    true_m = some[other, :2] - some[one, :2]
    length_m = np.hypot(*true_m.T)
    off_m = np.hypot(*(true_m + some[other, 2:] - some[one, 2:]).T) - length_m
    whole_m = float(length_m.max(initial=0.0))

    def rmse_m(over_m: float) -> float | None:
        near = (length_m > 0.7 * over_m) & (length_m < 1.4 * over_m)
        return _rms(off_m[near]) if near.any() else None

    away = some[:, :2] - some[:, :2].mean(axis=0)
    scale = float((away * some[:, 2:]).sum() / max(float((away**2).sum()), 1e-9))
    return {
        "over_100_m": rmse_m(100.0),
        "over_whole_m": rmse_m(whole_m),
        "scale_off_permille": 1000.0 * scale,
    }


def _better(again: Figures, found: Figures, little: bool) -> bool:
    """Whether the mosaic aligned with the ortho is judged, which has the same shape. It is where more places
    can be measured in it. Where as many can be measured in both, the better one is judged: a few wild matches
    (water, crowns) make the other worse."""
    if little:
        return again.share_measured > found.share_measured
    alike = found.share_measured > ALIKE * again.share_measured
    return not alike or again.after_similarity_px < found.after_similarity_px


def _compared(mosaic: Path, reference: Path) -> Comparison | None:
    """None where they don't overlap or lie on no common map."""
    try:
        return compare(mosaic, reference, ComparisonOptions(step_px=32, search_px=SEARCH_PX))
    except GeomosaicError:
        return None


def open_ground(folder: Path) -> Path:
    """The true ortho without what may be hidden by roofs and crowns, or moved by wind; itself where neither
    is."""
    ortho, path = folder / "truth" / "ortho.tif", folder / "judge-ortho.tif"
    if path.exists():
        return path
    plan = plan_of(folder)
    with rasterio.open(ortho) as source:
        profile, image, mask = source.profile, source.read(), source.dataset_mask()
    at = profile["transform"]
    if (folder / "truth" / "dsm.tif").exists():
        hidden, to_map = hidden_by_heights(folder)
        cols = at.c + (np.arange(mask.shape[1]) + 0.5) * at.a
        rows = at.f + (np.arange(mask.shape[0]) + 0.5) * at.e
        col = np.clip(((cols - to_map.c) / to_map.a).astype(int), 0, hidden.shape[1] - 1)
        row = np.clip(((rows - to_map.f) / to_map.e).astype(int), 0, hidden.shape[0] - 1)
        mask[hidden[np.ix_(row, col)]] = 0
    elif not plan.wind_in_trees_m:
        return ortho
    if plan.wind_in_trees_m:
        bounds = at.c, at.f + mask.shape[0] * at.e, at.c + mask.shape[1] * at.a, at.f
        for east, north, radius, _ in landscape_of(plan).trees_in(bounds):
            middle = round((east - at.c) / at.a - 0.5), round((north - at.f) / at.e - 0.5)
            cv2.circle(mask, middle, int(np.ceil(SWAY_REACH * radius / at.a)), 0, -1)
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(path, "w", **profile) as out:
        out.write(image)
        out.write_mask(mask)
    return path


def plan_of(folder: Path) -> SurveyPlan:
    """How a survey was simulated."""
    truth_record = json.loads((folder / "truth" / "truth.json").read_text())["plan"]
    return SurveyPlan(**{f.name: truth_record[f.name] for f in fields(SurveyPlan) if f.name in truth_record})


def hidden_by_heights(folder: Path) -> tuple[NDArray[np.bool_], Affine]:
    """Where what stands may hide the ground, on the grid of the surface's heights."""
    with (
        rasterio.open(folder / "truth" / "dsm.tif") as surface,
        rasterio.open(folder / "truth" / "dem.tif") as bare,
    ):
        like = {"crs": surface.crs, "transform": surface.transform, "width": surface.width,
                "height": surface.height, "resampling": Resampling.bilinear}  # fmt: skip
        with WarpedVRT(bare, **like) as below:
            stands_m = surface.read(1) - below.read(1)
        to_map, known = surface.transform, bare.bounds  # the bare ground may end before the surface
        east, north = to_map @ (np.indices(stands_m.shape)[::-1] + 0.5)
        inside = (east > known.left) & (east < known.right) & (north > known.bottom) & (north < known.top)
        stands_m[~inside] = 0.0
        hidden = np.zeros(stands_m.shape, np.uint8)
        for floor_m in np.arange(STANDS_M, max(float(stands_m.max()), STANDS_M) + STEP_M, STEP_M):
            reach = int(np.ceil(LEAN * (floor_m + STEP_M) / surface.transform.a))
            round_ = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
            hidden |= cv2.dilate((stands_m > floor_m).astype(np.uint8), round_)
        return hidden > 0, to_map


def covered(mosaic: Path, ortho: Path) -> float | None:
    """How much of what the frames saw the mosaic shows; None of a mosaic without a place on the map."""
    with rasterio.open(ortho) as true, rasterio.open(mosaic) as made:
        if made.crs is None or not made.crs.is_projected or made.crs.to_epsg() is None:
            return None
        like = {"crs": true.crs, "transform": true.transform, "width": true.width, "height": true.height}
        size = true.height // 8, true.width // 8
        with WarpedVRT(made, add_alpha=made.count == 3, **like) as on:
            there = on.dataset_mask(out_shape=size) > 0
        seen = true.dataset_mask(out_shape=size) > 0
    return float((there & seen).sum() / max(seen.sum(), 1))


def aligned_to(mosaic: Path, ortho: Path, path: Path) -> Path | None:
    """The mosaic moved, turned and scaled by one similarity so that it lies on the true ortho: its shape can
    be judged even where nothing tells its place. None where their features don't meet."""
    with rasterio.open(mosaic) as made, rasterio.open(ortho) as true:
        shrink = [min(FARTHEST_PX / max(d.width, d.height), 1.0) for d in (made, true)]
        small = [
            d.read([1, 2, 3], out_shape=(3, round(d.height * s), round(d.width * s)))
            for d, s in zip((made, true), shrink, strict=True)
        ]
        whole, profile, crs = made.read(), made.profile, true.crs
        to_map = true.transform
    sift = cv2.SIFT_create(KEYPOINTS)
    grey = [cv2.cvtColor(np.moveaxis(p, 0, -1), cv2.COLOR_RGB2GRAY) for p in small]
    (points, words), (true_points, true_words) = (sift.detectAndCompute(g, None) for g in grey)
    if words is None or true_words is None or min(len(words), len(true_words)) < 3:
        return None
    pairs = [
        a
        for a, b in cv2.BFMatcher().knnMatch(words, true_words, k=2)
        if a.distance < MATCH_RATIO * b.distance
    ]
    if len(pairs) < 3:
        return None
    here = np.array([points[m.queryIdx].pt for m in pairs])
    there = np.array([true_points[m.trainIdx].pt for m in pairs])
    found, inside = cv2.estimateAffinePartial2D(here, there, ransacReprojThreshold=8.0, maxIters=5000)
    if found is None or inside.sum() < 8:
        return None
    move = Affine(*found[0], *found[1])
    transform = to_map @ Affine.scale(1.0 / shrink[1]) @ move @ Affine.scale(shrink[0])
    profile.update(crs=crs, transform=transform, driver="GTiff", compress="deflate")
    profile.pop("photometric", None)
    with rasterio.open(path, "w", **profile) as out:
        out.write(whole)
    return _upright(path)


def _upright(path: Path) -> Path:
    """A turned raster resampled to a grid that isn't."""
    upright = path.with_name(f"{path.stem}-upright.tif")
    with rasterio.open(path) as turned, WarpedVRT(turned, crs=turned.crs, resampling=Resampling.cubic) as on:
        profile = {**on.profile, "driver": "GTiff"}
        with rasterio.open(upright, "w", **profile) as out:
            out.write(on.read())
    return upright


def of_positions(folder: Path, run: Path) -> dict[str, Any]:
    """Adjusted positions against the true ones, as root mean squares over tied frames: horizontal error and
    what is stated of it, and the same of heights. Frames that should not be in the map, or not be left out,
    are named as well."""
    truth = json.loads((folder / "truth" / "truth.json").read_text())
    frame = LocalFrame(**truth["work_frame"])
    true, reported = (_rows(p) for p in (folder / "truth" / "positions.csv", run / "positions.csv"))
    out = {f["frame"] for f in truth["leave_out"]}
    tied = [name for name, r in reported.items() if r["status"] == "tied"]
    row: dict[str, Any] = {
        "tied": len(tied),
        "wanted": len(set(true) - out),
        "strays_tied": sorted(set(tied) & out),
        "lost": sorted(set(true) - out - set(tied)),
    }
    placed = [n for n in tied if _has(reported[n], "lon_deg", "lat_deg", "height_ellipsoidal_m")]
    if not placed:
        return row
    off = np.array([_enu(frame, reported[n]) - _enu(frame, true[n]) for n in placed])
    stated = np.array([[float(reported[n][f"sd_{a}_m"] or "nan") for a in "enu"] for n in placed])
    level, up = np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2])
    return {
        **row,
        "absolute_m": _rms(level),
        "stated_m": _rms(np.hypot(stated[:, 0], stated[:, 1])),
        "height_m": _rms(up),
        "stated_height_m": _rms(stated[:, 2]),
    }


def _rows(path: Path) -> dict[str, dict[str, str]]:
    with path.open(newline="") as file:
        return {row["frame"]: row for row in csv.DictReader(file)}


def _has(row: dict[str, str], *columns: str) -> bool:
    return all(row.get(c) and np.isfinite(float(row[c])) for c in columns)


def _enu(frame: LocalFrame, row: dict[str, str]) -> Floats:
    return frame.enu_from_geodetic(*(float(row[c]) for c in ("lon_deg", "lat_deg", "height_ellipsoidal_m")))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))
