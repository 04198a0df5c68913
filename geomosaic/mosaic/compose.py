"""Composition by windows: memory does not grow with the mosaic, and every pixel is resampled once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Annotated

from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import CHOSEN, Because
from geomosaic.doors.raster import unreferenced_is_fine
from geomosaic.errors import InputError, UnknownNameError
from geomosaic.mosaic.blends import BLENDS
from geomosaic.mosaic.driver import composed
from geomosaic.mosaic.frame_source import FrameSource
from geomosaic.mosaic.frames import Decoded, DecodedFrames, decode, decoded_bytes, may_be_masked
from geomosaic.mosaic.model import Mosaic, OutputGrid
from geomosaic.mosaic.ownership import Ownership, cell_px_of, nearest_nadir
from geomosaic.mosaic.plan import Planning, windows
from geomosaic.mosaic.raster import writing_mosaic
from geomosaic.mosaic.scene import Scene
from geomosaic.mosaic.seamlines import SeamLabels
from geomosaic.mosaic.tones import Tones
from geomosaic.mosaic.views import frame_views
from geomosaic.mosaic.window import DTYPES, Composed, Manner, Step, Window, compose_window
from geomosaic.projection.ground import GroundSurface
from geomosaic.projection.resample import KERNEL_RADIUS_PX, RESAMPLING
from geomosaic.survey.model import Frame, Survey

WINDOW_PX: Annotated[
    int,
    Because(
        "px",
        "side of the windows that are composed: smaller ones are more margin than window, with 64 px about "
        "them already 1.56 times their area; larger ones take memory in each thread",
        "docs/results.md, seams and blends, a real flight of 28 frames: with 1024 px 9 % less time by "
        "bands, and 2 GB of memory",
    ),
] = 512
AUTO = "auto"
AUTO_FEATHER_PX: Annotated[
    int,
    Because(
        "px of the mosaic",
        "the feather's width where none is given: with less, steps of brightness are seen as lines; with "
        "more, detail that doesn't fit is doubled along a wider strip",
        CHOSEN,
    ),
] = 48


def compose(
    survey: Survey,
    poses: Poses,
    cameras: Sequence[Camera],
    used: Sequence[bool],
    ground: GroundSurface,
    grid: OutputGrid,
    raster_path: Path,
    *,
    ownership: Ownership | None = None,
    blend: str = "auto",
    feather_m: float | None = None,
    resampling: str = "cubic",
    tones: Tones | None = None,
    memory_bytes: int = 1 << 30,
    sources_path: Path | None = None,
    threads: int = 2,
    progress: Callable[[int, int], None] | None = None,
    check_cancelled: Callable[[], None] | None = None,
) -> Mosaic:
    """Warps all frames in use onto the grid and blends them into one raster.

    The same bytes come out whatever the number of threads and the memory. `check_cancelled` raises to stop.

    Args: poses, cameras, used: of each of the survey's frames. ownership: who gives which part, and the area
    that the mosaic is cut to; the frame that looks down most steeply, and no area, if not given. blend: one
    of BLENDS; auto: multi_band for images of 8 bits, feather for measured values, which stay as they are
    where one frame shows the ground. tones: how brightly frames show the ground, evened out; as they are if
    not given. memory_bytes: for decoded frames; windows in work take some 100 MB more for each thread.
    sources_path: where the raster of frame indices goes, if at all (see `raster.writing_mosaic`).
    Raises: `InputError` if frames don't go together or can't be resampled, `UnknownNameError` for a strategy.
    """
    if blend not in (AUTO, *BLENDS):
        raise UnknownNameError("blend", blend, (AUTO, *BLENDS))
    if resampling not in RESAMPLING:
        raise UnknownNameError("resampling", resampling, RESAMPLING)
    feather_m = AUTO_FEATHER_PX * grid.gsd_m if feather_m is None else feather_m
    views = frame_views(survey.work_frame, grid.crs, poses, cameras, used, ground)
    kind = common_kind([survey.frames[v.frame] for v in views])
    scene = Scene(survey.work_frame, ground, grid, views)
    ownership = ownership or nearest_nadir(scene, used, cell_px_of(scene))[0]
    how = BLENDS[blend if blend != AUTO else "multi_band" if kind.dtype == "uint8" else "feather"]
    manner = Manner(how, kind.bands, kind.dtype, scene.lattice)
    sources = {v.frame: FrameSource(scene, ownership, v, resampling, tones) for v in views}
    area = ownership.area
    planning = Planning(sources, how.halo_px(feather_m / grid.gsd_m), feather_m / grid.gsd_m, area)
    labels = SeamLabels(grid, WINDOW_PX, cut=area is not None)
    gave_pixels: set[int] = set()
    names = [frame.name for frame in survey.frames]
    order = windows(grid, WINDOW_PX)
    if area is not None:
        order = area.touched(grid, order)
    with (
        unreferenced_is_fine(),
        ThreadPoolExecutor(threads) as pool,
        writing_mosaic(raster_path, grid, kind.bands, kind.dtype, sources_path, names) as raster,
    ):
        try:
            frames, done_windows = walk(
                planning,
                manner,
                scene.grid,
                survey.frames,
                order,
                resampling,
                memory_bytes=memory_bytes,
                pool=pool,
                threads=threads,
                check_cancelled=check_cancelled,
            )
            for done, window in enumerate(done_windows):
                raster.write(window)
                labels.add(window)
                gave_pixels.update(window.gave)
                if progress is not None:
                    progress(done + 1, len(order))
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return Mosaic(
        grid=grid,
        raster=raster_path.name,
        bands=kind.bands,
        dtype=kind.dtype,
        nodata=None,
        seamlines=labels.seamlines(),
        frames_used=tuple(sorted(gave_pixels)),
        decodes=frames.decodes,
        holes=labels.holes(),
        resampling=resampling,
    )


def walk(
    planning: Planning,
    manner: Manner,
    grid: OutputGrid,
    frames: Sequence[Frame],
    order: Sequence[Window],
    resampling: str,
    *,
    memory_bytes: int,
    pool: ThreadPoolExecutor,
    threads: int,
    check_cancelled: Callable[[], None] | None,
) -> tuple[DecodedFrames, Iterator[Composed]]:
    """Windows of the grid composed in their order, and the supply of decoded frames that they take.

    Args: frames: all of the survey's; planning says which of them take part.
    """
    plan = _plan(planning, frames, order, pool, check_cancelled)
    supply = DecodedFrames(
        [[p.source.number for p in step.parts] for step in plan],
        {number: decoded_bytes(frames[number]) for number in planning.sources},
        memory_bytes,
        pool,
        lambda i: decode(frames[i], KERNEL_RADIUS_PX[resampling]),
    )
    work = partial(_composed, manner, planning, grid)
    return supply, composed(plan, work, supply, pool, threads, check_cancelled)


def _plan(
    planning: Planning,
    frames: Sequence[Frame],
    order: Sequence[Window],
    pool: ThreadPoolExecutor,
    check_cancelled: Callable[[], None] | None,
) -> list[Step]:
    valid = {number: None for number in planning.sources if not may_be_masked(frames[number])}
    plan = []
    for found in pool.map(lambda w: planning.step(w, valid), order):
        if check_cancelled is not None:
            check_cancelled()
        plan.append(found)
    return plan


def _composed(
    manner: Manner, planning: Planning, grid: OutputGrid, step: Step, decoded: Mapping[int, Decoded]
) -> Composed:
    """A window, planned again where frames turn out to have masks, and cut to the area."""
    masks = {frame: d.mask_distance_px for frame, d in decoded.items()}
    if any(mask is not None for mask in masks.values()):
        step = planning.step(step.window, masks, [p.source.number for p in step.parts])
    done = compose_window(manner, step, decoded)
    return done if planning.area is None else done.cut(planning.area.mask(grid, step.window))


def common_kind(frames: Sequence[Frame]) -> Frame:
    """A frame whose bands and data type all share."""
    if not frames:
        raise InputError("no frame is left to make a mosaic of", mend="check the positions and attitudes")
    first = frames[0]
    for frame in frames:
        if (frame.bands, frame.dtype) != (first.bands, first.dtype):
            raise InputError(
                f"has {frame.bands} bands of {frame.dtype}, {first.name} {first.bands} of {first.dtype}",
                file=frame.path,
                mend="mosaic frames of one kind at a time",
            )
    if first.dtype not in DTYPES:
        raise InputError(
            f"pixels of type {first.dtype} can't be resampled",
            file=first.path,
            mend=f"convert the frames to one of {', '.join(DTYPES)}",
        )
    return first
