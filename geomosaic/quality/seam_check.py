"""Whether the ground goes on across the seams: both frames of a seam, pixel against pixel.

Tie points say how well an adjustment agrees with itself; this looks at what people will see.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray

from geomosaic.arrays import Bools, Bytes, Floats, Ints64
from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.composition.choice import MOST_PLACES
from geomosaic.composition.model import OutputGrid, Seamline
from geomosaic.composition.views import PosedFrames
from geomosaic.constants import tuned
from geomosaic.geodesy.local import LocalFrame
from geomosaic.matching.displacement import PatchMatching, measure_displacements, patch_corners
from geomosaic.matching.least_squares_matching import MaskedImage
from geomosaic.projection.ground import GroundSurface
from geomosaic.projection.lattice import MapLattice
from geomosaic.projection.map_grid import MapGrid
from geomosaic.projection.resample import resample
from geomosaic.quality.ssim import luma
from geomosaic.spread import AtOnce, Spread
from geomosaic.survey.model import Frame
from geomosaic.survey.pixels import read_pixels
from geomosaic.survey.small import brightness

WINDOW_PX = tuned(256, "mosaic px", "tested place: smaller lacks patches; larger leaves the overlap")
PATCH_PX: Final = PatchMatching.patch_px
SEARCH_PX = tuned(48, "mosaic px", "farther is not found: less misses jumps; more finds other ground")
LEAST_PATCHES = tuned(4, "patches", "of 49 found: fewer are chance; more leave woods unmeasured")


@dataclass(frozen=True)
class SeamCheck:
    """How frames agree at seams, one row a place.

    left, right (k,): the frames. at_m (k, 2): easting and northing. patches (k,): how many were found again.
    displacement_px (k, 2): where the right frame shows the ground minus where the left one does, in the
    mosaic's cols and rows. It is the median of the patches, NaN where too few were found.
    """

    left: Ints64
    right: Ints64
    at_m: Floats
    patches: Ints64
    displacement_px: Floats

    @property
    def length_px(self) -> Floats:
        """(k,), of the places that could be measured, with those that couldn't as NaN."""
        return np.asarray(np.linalg.norm(self.displacement_px, axis=1))


def seam_places(
    seamlines: Sequence[Seamline], window_m: float, most: int = MOST_PLACES
) -> list[tuple[int, int, float, float]]:
    """(left, right, easting, northing) of places along all seams, a window apart, at most so many, evenly."""
    areas = [shapely.union_all([shapely.Polygon(p[0], p[1:]) for p in line.polygons]) for line in seamlines]
    if not areas:
        return []
    tree = shapely.STRtree(areas)
    near = {tuple(sorted(pair)) for pair in tree.query(areas, predicate="intersects").T.tolist()}
    places = []
    for a, b in sorted(pair for pair in near if pair[0] != pair[1]):
        shared = shapely.line_merge(shapely.intersection(areas[a].boundary, areas[b].boundary))
        for line in shapely.get_parts(shared):
            if line.length > 0.0 and line.geom_type == "LineString":
                count = max(1, int(line.length / window_m))
                for share in (np.arange(count) + 0.5) / count:
                    at = line.interpolate(share, normalized=True)
                    frames = sorted((seamlines[a].frame, seamlines[b].frame))
                    places.append((frames[0], frames[1], float(at.x), float(at.y)))
    some = np.unique(np.linspace(0, len(places) - 1, min(most, len(places))).astype(int))
    return [places[i] for i in some]


@dataclass(frozen=True)
class SeamGround:
    """What the places of a mosaic have in common: its CRS and pixel, and the ground."""

    crs: str
    gsd_m: float
    work_frame: LocalFrame
    ground: GroundSurface


@dataclass(frozen=True)
class Sighting:
    """A frame, and the middles (k, 2) of the places that are to be seen in it, easting and northing."""

    frame: Frame
    pose: Pose
    camera: Camera
    at_m: Floats


@dataclass(frozen=True)
class Sights:
    """How a frame shows k places: pixels (k, h, w, bands) in its own type, and where they are valid."""

    pixels: NDArray[Any]
    valid: Bools


@dataclass(frozen=True)
class Jump:
    """Where the right frame shows a place minus where the left one does, (2,) in cols and rows, NaN where too
    few patches were found."""

    patches: int
    displacement_px: Floats


Look = Callable[[SeamGround, Mapping[int, Sighting]], Sequence[Sights]]
"""Frames, by number, each looked at once for all its places."""


def seen_at(shared: SeamGround, job: Sighting) -> Sights:
    """Decodes a frame once and takes all its places."""
    return seen_in(*read_pixels(job.frame), shared, job)


def seen_in(pixels: NDArray[Any], mask: Bytes | None, shared: SeamGround, job: Sighting) -> Sights:
    """Takes all places of a frame's pixels (rows, cols, bands) and its mask of valid ones: of a picture's
    colours one band, since there are many places."""
    height, width, bands = pixels.shape
    pixels = pixels[..., : 3 if bands >= 3 else 1]
    if pixels.dtype == np.uint8:
        pixels = brightness(pixels)
    shown, seen = [], []
    for east, north in job.at_m:
        corner = east - WINDOW_PX * shared.gsd_m / 2.0, north + WINDOW_PX * shared.gsd_m / 2.0
        grid = MapGrid(shared.crs, *corner, shared.gsd_m, WINDOW_PX, WINDOW_PX)
        lattice = MapLattice(grid, shared.work_frame, shared.ground)
        at = lattice.seen(job.pose, job.camera, slice(0, WINDOW_PX), slice(0, WINDOW_PX))
        valid = (at.cols > 0.0) & (at.cols < width) & (at.rows > 0.0) & (at.rows < height)
        if mask is not None:
            rows, cols = (np.where(valid, a, 0.0).astype(np.intp) for a in (at.rows, at.cols))
            valid &= mask[rows, cols] != 0
        shown.append(resample(pixels, at.cols, at.rows, "cubic"))
        seen.append(valid)
    return Sights(np.stack(shown), np.stack(seen))


def jump_between(place: tuple[Sights, Sights]) -> Jump:
    """Compares how the left and the right frame show one place."""
    left, right = (
        MaskedImage(np.where(s.valid[0], luma(np.moveaxis(s.pixels[0], 2, 0)), np.float32(0.0)), s.valid[0])
        for s in place
    )
    corners = patch_corners((WINDOW_PX, WINDOW_PX), PATCH_PX, PATCH_PX // 2)
    found = measure_displacements(right, left, corners, PatchMatching(search_px=SEARCH_PX))
    count = len(found.displacement_px)
    none = np.full(2, np.nan)
    return Jump(count, np.median(found.displacement_px, axis=0) if count >= LEAST_PATCHES else none)


def check_seams(
    frames: PosedFrames,
    grid: OutputGrid,
    seamlines: Sequence[Seamline],
    spread: Spread | None = None,
    look: Look | None = None,
) -> SeamCheck:
    """Measures `seam_places` of a mosaic: each frame that has some is decoded once, by `look` if given."""
    spread = spread or AtOnce()
    places = seam_places(seamlines, WINDOW_PX * grid.gsd_m)
    at_m = np.array([p[2:] for p in places], dtype=np.float64).reshape(-1, 2)
    of: dict[int, list[int]] = {}
    for k, (left, right, _, _) in enumerate(places):
        of.setdefault(left, []).append(k)
        of.setdefault(right, []).append(k)
    survey = frames.survey
    jobs = {i: Sighting(survey.frames[i], frames.poses[i], frames.cameras[i], at_m[k]) for i, k in of.items()}
    shared = SeamGround(grid.crs, grid.gsd_m, survey.work_frame, frames.ground)
    sights: dict[tuple[int, int], Sights] = {}
    looks = (
        spread.map("seams", partial(seen_at, shared), list(jobs.values()), list(jobs))
        if look is None
        else look(shared, jobs)
    )
    for (i, ks), found in zip(of.items(), looks, strict=True):
        sights |= {(i, k): Sights(found.pixels[n : n + 1], found.valid[n : n + 1]) for n, k in enumerate(ks)}
    both = [(sights[left, k], sights[right, k]) for k, (left, right, _, _) in enumerate(places)]
    jumps = spread.map("jumps at seams", jump_between, both, range(len(both)))
    return SeamCheck(
        np.array([p[0] for p in places], dtype=np.int64),
        np.array([p[1] for p in places], dtype=np.int64),
        at_m,
        np.array([jump.patches for jump in jumps], dtype=np.int64),
        np.array([jump.displacement_px for jump in jumps], dtype=np.float64).reshape(-1, 2),
    )
