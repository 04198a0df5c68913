"""The scene of CCD strips, composed by blocks of rows: memory does not grow with the strips' lines."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import rasterio

from geomosaic.ccd.layout import SceneLayout
from geomosaic.ccd.parallel import opencv_alone
from geomosaic.ccd.radiometry import Radiometry
from geomosaic.composition.blends import BLENDS, STEP_PX, Blend
from geomosaic.composition.driver import composed
from geomosaic.composition.raster import BLOCK_ROWS, Raster, SceneGreys, writing_scene
from geomosaic.composition.strip_lines import StripGreys, StripLines
from geomosaic.composition.strip_source import StripBlocks, StripSource
from geomosaic.composition.window import CompositionStep, Manner, SourcePart, Window, compose_window
from geomosaic.doors.raster import READ_CACHE_BYTES, unreferenced_is_fine
from geomosaic.errors import UnknownNameError
from geomosaic.projection.resample import KERNEL_RADIUS_PX, RESAMPLING
from geomosaic.spread import UNOBSERVED, ProgressObserver
from geomosaic.survey.strip_pixels import open_strip
from geomosaic.survey.strips import StripGeometry


@dataclass(frozen=True)
class StripMosaic:
    """The composed scene, as a raster with an internal mask and overviews.

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


@dataclass(frozen=True)
class PlacedStrips:
    """Strips of a focal plane, where they lie in the scene, and how they are balanced. rpc:
    GDAL's metadata of that name."""

    geometry: StripGeometry
    layout: SceneLayout
    radiometry: Radiometry | None = None
    rpc: Mapping[str, str] | None = None


@dataclass(frozen=True)
class StripOptions:
    """How strips become a scene: one of BLENDS, one of RESAMPLING, and threads at work."""

    blend: str = "feather"
    resampling: str = "lanczos"
    threads: int = 2


def compose_strips(
    scene: PlacedStrips,
    raster_path: Path,
    options: StripOptions = StripOptions(),
    progress: ProgressObserver = UNOBSERVED,
) -> StripMosaic:
    """Every strip's own pixels resampled once into one raster of the strips' type; in overlaps a blend.

    Where one strip alone has a valid pixel that one is used; `multi_band` spreads a difference of brightness
    that lies at its end over some pixels more. Greys are cut to the strips' bits; saturated
    pixels stay saturated. The same bytes come out whatever the number of threads. `progress` is given rows.

    Raises: `UnknownNameError` for a blend or resampling, `FileError` if a strip can't be read, `OSError` if
    the raster can't be written.
    """
    if options.blend not in BLENDS:
        raise UnknownNameError("blend", options.blend, BLENDS)
    if options.resampling not in RESAMPLING:
        raise UnknownNameError("resampling", options.resampling, RESAMPLING)
    geometry, layout, blend = scene.geometry, scene.layout, BLENDS[options.blend]
    height, width = layout.height_px, layout.width_px
    with (
        unreferenced_is_fine(),
        opencv_alone(),
        rasterio.Env(GDAL_CACHEMAX=READ_CACHE_BYTES),
        ExitStack() as files,
        ThreadPoolExecutor(options.threads) as pool,
    ):
        sources, dtype = _sources(scene, options.resampling, files)
        columns = _columns(geometry, layout, sources, blend)
        steps, rows = _steps(columns, sources, layout, blend)
        manner = Manner(blend, 1, dtype, highest=2**geometry.bit_depth - 1)
        greys = SceneGreys(dtype, geometry.bit_depth, geometry.scale)
        with writing_scene(raster_path, (width, height), greys, scene.rpc) as raster:
            blocks = StripBlocks(sources, steps, rows, pool)
            work = partial(_written, raster, manner)
            ahead = len(columns) + options.threads
            try:
                for window in composed(steps, work, blocks, pool, ahead):
                    progress.check_cancelled()
                    if window.col + window.width == width:
                        progress.progress(window.row + window.height, height, "lines")
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise
    read = dict.fromkeys(range(len(geometry.ccds)), 0) | {s.ccd: s.strip.lines_read for s in sources}
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


def _written(raster: Raster, manner: Manner, step: CompositionStep, materials: Mapping[int, Any]) -> Window:
    raster.write(compose_window(manner, step, materials))
    return step.window


def _sources(scene: PlacedStrips, resampling: str, files: ExitStack) -> tuple[list[StripSource], str]:
    """The living CCDs, and the type of their pixels."""
    geometry, layout, radiometry = scene.geometry, scene.layout, scene.radiometry
    living = [k for k, ccd in enumerate(geometry.ccds) if ccd.path is not None]
    found: list[StripSource] = []
    dtype = ""
    for k in living:
        path = geometry.ccds[k].path
        assert path is not None
        strip = files.enter_context(open_strip(path, geometry.scale))
        dtype = dtype or strip.dtypes[0]
        greys = StripGreys(
            geometry.nodata,
            2**geometry.bit_depth - 1,
            gain=1.0 if radiometry is None else float(radiometry.gain[k]),
            offset=0.0 if radiometry is None else float(radiometry.offset[k]),
        )
        lines = StripLines(strip, path, greys, KERNEL_RADIUS_PX[resampling])
        left = layout.seams_px[k - 1] if k - 1 in living else -np.inf
        right = layout.seams_px[k] if k + 1 in living else np.inf
        found.append(StripSource(len(found), k, layout, lines, resampling, left, right))
    return found, dtype


@dataclass(frozen=True)
class _Column:
    """Raster cols of the scene that are composed together, and the reach of their seam, 0 without one."""

    first: int
    last: int
    reach_px: float


def _columns(
    geometry: StripGeometry, layout: SceneLayout, sources: Sequence[StripSource], blend: Blend
) -> list[_Column]:
    """The scene's width: where one strip is alone, and the overlaps with what a blend changes next to
    them."""
    spare = geometry.read_px - geometry.overlap_px  # by so much offsets may make the overlap narrower
    joints = []
    for left, right in pairwise(sources):
        if right.ccd == left.ccd + 1:
            first, last, seam = layout.cols(right.ccd)[0], layout.cols(left.ccd)[1], left.right_px
            half = max(min(seam - first, last - seam), 0.0)
            reach = 2.0 * (half - min(spare, 0.5 * half))
            halo = blend.halo_px(reach)
            joints.append(
                (seam, min(first, math.floor(seam)) - halo, max(last, math.ceil(seam)) + halo, reach)
            )
    columns, done = [], 0
    for k, (seam, first, last, reach) in enumerate(joints):
        if k + 1 < len(joints):
            last = min(last, round((seam + joints[k + 1][0]) / 2.0))
        if first > done:
            columns.append(_Column(done, first, 0.0))
        columns.append(_Column(max(first, done), min(last, layout.width_px), reach))
        done = columns[-1].last
    if done < layout.width_px:
        columns.append(_Column(done, layout.width_px, 0.0))
    return columns


def _steps(
    columns: Sequence[_Column], sources: Sequence[StripSource], layout: SceneLayout, blend: Blend
) -> tuple[list[CompositionStep], list[tuple[int, int]]]:
    """All windows, blocks of rows from the top and columns from the left; and the rows that blocks need."""
    steps, rows = [], []
    halo = max((blend.halo_px(c.reach_px) for c in columns), default=0)
    for top in range(0, layout.height_px, BLOCK_ROWS):
        bottom = min(top + BLOCK_ROWS, layout.height_px)
        for column in columns:
            window = Window(column.first, top, column.last - column.first, bottom - top)
            alone = sum(_cols(source, window) is not None for source in sources) < 2
            around = window if alone else window.grown(halo)
            parts = [
                SourcePart(source, slice(0, around.height), cols)
                for source in sources
                if (cols := _cols(source, around)) is not None
            ]
            steps.append(CompositionStep(window, around, column.reach_px, tuple(parts)))
            rows.append((top - halo, bottom + halo + STEP_PX))
    return steps, rows


def _cols(source: StripSource, window: Window) -> slice | None:
    """The cols of a window that a strip may fill, if any."""
    first, last = (min(max(col - window.col, 0), window.width) for col in source.layout.cols(source.ccd))
    return slice(first, last) if last > first else None


def _gaps(covered: Sequence[tuple[int, int]], width: int) -> tuple[tuple[int, int], ...]:
    gaps, at = [], 0
    for first, last in [*sorted(covered), (width, width)]:
        if first > at:
            gaps.append((at, first))
        at = max(at, last)
    return tuple(gaps)
