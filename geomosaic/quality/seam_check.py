"""Whether the ground goes on across the seams: both frames of a seam, pixel against pixel.

Tie points say how well an adjustment agrees with itself; this looks at what people will see.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import CHOSEN, Because
from geomosaic.doors.raster import unreferenced_is_fine
from geomosaic.geodesy.local import LocalFrame
from geomosaic.matching.displacement import measure_displacements, patch_corners
from geomosaic.mosaic.model import OutputGrid, Seamline
from geomosaic.projection.ground import GroundSurface
from geomosaic.projection.resample import seen_on
from geomosaic.projection.warp import ground_window
from geomosaic.quality.ssim import luma
from geomosaic.survey.model import Frame
from geomosaic.survey.pixels import read_pixels

Floats = NDArray[np.float64]

WINDOW_PX: Annotated[
    int,
    Because(
        "px of the mosaic",
        "side of a place on a seam: smaller ones hold too few patches, larger ones lie outside the overlap "
        "and mix what the ground does elsewhere",
        CHOSEN,
    ),
] = 256
PATCH_PX: Annotated[
    int,
    Because(
        "px of the mosaic",
        "side of the patches compared there: smaller ones are found by chance, larger ones average over "
        "houses and ground",
        CHOSEN,
    ),
] = 64
SEARCH_PX: Annotated[
    int,
    Because(
        "px of the mosaic",
        "how far off the ground is looked for: a jump beyond it counts as not found, though such a map is "
        "wrong long before; more finds other ground and takes time",
        CHOSEN,
    ),
] = 48
LEAST_PATCHES: Annotated[
    int,
    Because(
        "patches of a place",
        "must be found again, of 49: fewer may be chance, more leave seams over woods and water unmeasured",
        CHOSEN,
    ),
] = 4
MOST_PLACES: Annotated[
    int,
    Because(
        "places of a mosaic",
        "each takes two frames off the disk, all together some seconds, and their median is good to a sixth "
        "of their deviation: fewer say less, more take time",
        "chosen; the median's deviation: sqrt(pi / (2 n)) deviations of n normal values",
    ),
] = 60
_FRAMES_KEPT: Annotated[
    int,
    Because(
        "frames",
        "decoded, since places follow each other along the same seams: fewer are read again, more take "
        "memory, 64 MB for 16 MP",
        CHOSEN,
    ),
] = 6


@dataclass(frozen=True)
class SeamCheck:
    """One row a place: left, right (k,) frames; at_m (k, 2) easting and northing; patches (k,) found again;
    displacement_px (k, 2) where the right frame shows the ground minus where the left one does, in the
    mosaic's cols and rows, median of the patches; NaN where too few were found."""

    left: NDArray[np.int64]
    right: NDArray[np.int64]
    at_m: Floats
    patches: NDArray[np.int64]
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


def check_seams(
    frames: Sequence[Frame],
    poses: Poses,
    cameras: Sequence[Camera],
    work_frame: LocalFrame,
    ground: GroundSurface,
    grid: OutputGrid,
    seamlines: Sequence[Seamline],
    *,
    threads: int = 2,
    progress: Callable[[int, int], None] | None = None,
) -> SeamCheck:
    """Measures `seam_places` of a mosaic: frames are read again, a few at a time."""
    places = seam_places(seamlines, WINDOW_PX * grid.gsd_m)
    side = WINDOW_PX
    half_m = side * grid.gsd_m / 2.0

    @lru_cache(maxsize=_FRAMES_KEPT)
    def grey(frame: int) -> tuple[NDArray[np.float32], NDArray[Any] | None]:
        pixels, mask = read_pixels(frames[frame])
        return luma(np.moveaxis(pixels[..., :3] if pixels.shape[2] >= 3 else pixels[..., :1], 2, 0)), mask

    def measured(place: tuple[int, int, float, float]) -> tuple[int, Floats]:
        left, right, east, north = place
        corner = east - half_m, north + half_m
        window = ground_window(grid.crs, work_frame, ground, *corner, grid.gsd_m, side, side)
        a, b = (seen_on(window, poses[i], cameras[i], *grey(i)) for i in (left, right))
        corners = patch_corners((WINDOW_PX, WINDOW_PX), PATCH_PX, PATCH_PX // 2)
        found = measure_displacements(b[0], a[0], b[1], a[1], corners, patch_px=PATCH_PX, search_px=SEARCH_PX)
        count = len(found.displacement_px)
        none = np.full(2, np.nan)
        return count, np.median(found.displacement_px, axis=0) if count >= LEAST_PATCHES else none

    results = []
    with unreferenced_is_fine(), ThreadPoolExecutor(threads) as pool:
        try:
            for done, result in enumerate(pool.map(measured, places), 1):
                results.append(result)
                if progress is not None:
                    progress(done, len(places))
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return SeamCheck(
        np.array([p[0] for p in places], dtype=np.int64),
        np.array([p[1] for p in places], dtype=np.int64),
        np.array([p[2:] for p in places], dtype=np.float64).reshape(-1, 2),
        np.array([count for count, _ in results], dtype=np.int64),
        np.array([d for _, d in results], dtype=np.float64).reshape(-1, 2),
    )
