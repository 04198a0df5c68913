"""The scene of CCD strips, composed by blocks of rows: memory does not grow with the strips' lines."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray

from geomosaic.ccd.layout import SceneLayout
from geomosaic.ccd.radiometry import Radiometry
from geomosaic.doors.raster import STRIP, open_raster, unreferenced_is_fine
from geomosaic.errors import UnknownNameError
from geomosaic.mosaic.strip_blends import BLENDS, REACH_ROWS, Blend
from geomosaic.mosaic.strip_lines import StripLines
from geomosaic.mosaic.strip_raster import BLOCK_ROWS, writing_scene
from geomosaic.mosaic.strip_window import Part, part_of_strip
from geomosaic.projection.resample import KERNEL_RADIUS_PX, RESAMPLING
from geomosaic.survey.strips import StripGeometry

_CACHE_MB = 64
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class StripMosaic:
    """The composed scene, as an uncompressed raster with an internal mask and overviews.

    raster: the raster's name inside the run folder. first_line: scene line of its upper edge. lines_read: of
    each CCD's strip. gaps_px: raster cols (first, one beyond the last) that no living CCD covers.
    """

    raster: str
    width_px: int
    height_px: int
    first_line: float
    dtype: str
    bit_depth: int
    nodata: float | None
    lines_read: tuple[int, ...]
    gaps_px: tuple[tuple[int, int], ...]


def compose_strips(
    geometry: StripGeometry,
    layout: SceneLayout,
    radiometry: Radiometry | None,
    raster_path: Path,
    *,
    blend: str = "smooth",
    resampling: str = "lanczos",
    rpc: Mapping[str, str] | None = None,
    threads: int = 2,
    progress: Callable[[int, int], None] | None = None,
    check_cancelled: Callable[[], None] | None = None,
) -> StripMosaic:
    """Every strip's own pixels resampled once into one raster of the strips' type; in overlaps a blend.

    Where one strip alone has a valid pixel that one is used. Greys are cut to the strips' bits; saturated
    pixels stay saturated. The same bytes come out whatever the number of threads. `rpc` is GDAL's metadata
    of that name. `progress` is told rows, `check_cancelled` raises to stop.

    Raises: `UnknownNameError` for a blend or resampling, `FileError` if a strip can't be read, `OSError` if
    the raster can't be written.
    """
    if blend not in BLENDS:
        raise UnknownNameError("blend", blend, BLENDS)
    if resampling not in RESAMPLING:
        raise UnknownNameError("resampling", resampling, RESAMPLING)
    height, width = layout.height_px, layout.width_px
    with (
        unreferenced_is_fine(),
        rasterio.Env(GDAL_CACHEMAX=_CACHE_MB),
        ExitStack() as files,
        ThreadPoolExecutor(threads) as pool,
    ):
        sources = _sources(geometry, layout, radiometry, resampling, files)
        dtype = sources[0].dtype
        with writing_scene(raster_path, width, height, dtype, geometry.bit_depth, rpc) as raster:
            seams = _seams(geometry, layout, sources, BLENDS[blend])
            blocks = [(top, min(top + BLOCK_ROWS, height)) for top in range(0, height, BLOCK_ROWS)]
            waiting: tuple[_Block, list[_Edges]] | None = None
            try:
                for rows in [*blocks, None]:
                    if check_cancelled is not None:
                        check_cancelled()
                    running = []
                    if rows is not None:
                        block = _Block.empty(*rows, width, dtype, geometry.bit_depth)
                        running = [pool.submit(source.fill, block, height) for source in sources]
                    if waiting is not None:
                        _finish(*waiting, seams)
                        raster.write(waiting[0].top, waiting[0].pixels, waiting[0].valid)
                        if progress is not None:
                            progress(waiting[0].bottom, height)
                    # Strips are read in order, so a block begins when the one before is through.
                    waiting = (block, [f.result() for f in running]) if running else None
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise
    read = dict.fromkeys(range(len(geometry.ccds)), 0) | {s.ccd: s.lines.lines_read for s in sources}
    return StripMosaic(
        raster=raster_path.name,
        width_px=width,
        height_px=height,
        first_line=layout.first_line,
        dtype=dtype,
        bit_depth=geometry.bit_depth,
        nodata=None,
        lines_read=tuple(read.values()),
        gaps_px=_gaps([layout.cols(s.ccd) for s in sources], width),
    )


@dataclass(frozen=True, eq=False)
class _Block:
    """Rows of the scene: what will be written of them."""

    top: int
    bottom: int
    pixels: NDArray[Any]
    valid: Flags
    lowest: int
    highest: int

    @classmethod
    def empty(cls, top: int, bottom: int, width: int, dtype: str, bit_depth: int) -> _Block:
        shape = bottom - top, width
        lowest = min(int(np.iinfo(dtype).min), 0)
        return cls(top, bottom, np.zeros(shape, dtype), np.zeros(shape, bool), lowest, 2**bit_depth - 1)

    def put(self, part: Part) -> None:
        """Takes a part's rows; the part's pixels are used up."""
        at = slice(part.left, part.left + part.pixels.shape[1])
        own = slice(self.top - part.top, self.bottom - part.top)
        greys = part.pixels[own]
        np.rint(greys, out=greys)
        np.clip(greys, self.lowest, self.highest, out=greys)
        valid = part.valid[own]
        if not valid.all():
            greys[~valid] = 0.0
        self.pixels[:, at] = greys
        self.valid[:, at] = valid


_Edges = tuple[Part | None, Part | None]
"""What a strip has of its left and of its right overlap, with some rows above and below the block."""


@dataclass(frozen=True, eq=False)
class _Source:
    """A living CCD: its strip, and the raster cols that are its own and those shared with its neighbours."""

    ccd: int
    lines: StripLines
    dtype: str
    layout: SceneLayout
    resampling: str
    left: tuple[int, int] | None
    own: tuple[int, int]
    right: tuple[int, int] | None

    def fill(self, block: _Block, height: int) -> _Edges:
        """Puts the strip's own columns into a block and gives its overlaps; blocks come in their order."""
        begin, end = max(block.top - REACH_ROWS, 0), min(block.bottom + REACH_ROWS, height)
        places = self.layout.places(self.ccd, begin, end)
        line = places.image_px[1]
        line = line[np.isfinite(line)]
        lines = self.lines.between(float(line.min()), float(line.max())) if line.size else None

        def part(cols: tuple[int, int], top: int, bottom: int) -> Part:
            rows = begin, top, bottom
            return part_of_strip(lines, self.lines.count, places, rows, cols, self.resampling)

        block.put(part(self.own, block.top, block.bottom))
        left, right = (None if cols is None else part(cols, begin, end) for cols in (self.left, self.right))
        return left, right


def _sources(
    geometry: StripGeometry,
    layout: SceneLayout,
    radiometry: Radiometry | None,
    resampling: str,
    files: ExitStack,
) -> list[_Source]:
    living = [k for k, ccd in enumerate(geometry.ccds) if ccd.path is not None]
    shared: dict[int, tuple[int, int]] = {}
    for k in living:
        if k + 1 in living:
            first, last = layout.cols(k + 1)[0], layout.cols(k)[1]
            shared[k] = first, max(first, last)
    found = []
    for k in living:
        path = geometry.ccds[k].path
        assert path is not None
        strip = files.enter_context(open_raster(path, STRIP))
        lines = StripLines(
            strip,
            path,
            nodata=geometry.nodata,
            gain=1.0 if radiometry is None else float(radiometry.gain[k]),
            offset=0.0 if radiometry is None else float(radiometry.offset[k]),
            highest=2**geometry.bit_depth - 1,
            radius_px=KERNEL_RADIUS_PX[resampling],
        )
        left, right = shared.get(k - 1), shared.get(k)
        first, last = layout.cols(k)
        own = first if left is None else left[1], last if right is None else right[0]
        found.append(_Source(k, lines, strip.dtypes[0], layout, resampling, left, own, right))
    return found


@dataclass(frozen=True, eq=False)
class _Joint:
    """Two neighbours by their places in the list of sources, and how they are joined."""

    left: int
    right: int
    distance_px: NDArray[np.float32]
    half_px: float
    blend: Blend


def _seams(
    geometry: StripGeometry, layout: SceneLayout, sources: Sequence[_Source], blend: Blend
) -> list[_Joint]:
    spare = geometry.read_px - geometry.overlap_px  # by so much offsets may make the overlap narrower
    joints = []
    for i, source in enumerate(sources):
        if source.right is None:
            continue
        first, last = source.right
        seam = layout.seams_px[source.ccd]
        half = max(min(seam - first, last - seam), 0.0)
        half -= min(spare, 0.5 * half)
        distance = (np.arange(first, last) + 0.5 - seam).astype(np.float32)
        joints.append(_Joint(i, i + 1, distance, half, blend))
    return joints


def _finish(block: _Block, edges: Sequence[_Edges], joints: Sequence[_Joint]) -> None:
    """Joins the strips' overlaps and puts them into the block."""
    for joint in joints:
        left, right = edges[joint.left][1], edges[joint.right][0]
        assert left is not None
        assert right is not None
        both = left.valid & right.valid
        pixels = np.where(left.valid, left.pixels, right.pixels)
        if both.any():
            mixed = joint.blend(left.pixels, right.pixels, both, joint.distance_px, joint.half_px)
            pixels = np.where(both, mixed, pixels)
        block.put(Part(left.top, left.left, pixels, left.valid | right.valid))


def _gaps(covered: Sequence[tuple[int, int]], width: int) -> tuple[tuple[int, int], ...]:
    gaps, at = [], 0
    for first, last in [*sorted(covered), (width, width)]:
        if first > at:
            gaps.append((at, first))
        at = max(at, last)
    return tuple(gaps)
