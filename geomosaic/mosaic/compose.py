"""Composition: every frame is brought onto the grid once, then windows are blended, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Final

import numpy as np

from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import CHOSEN, Because
from geomosaic.doors.raster import unreferenced_is_fine
from geomosaic.errors import InputError, UnknownNameError
from geomosaic.mosaic.area import Area
from geomosaic.mosaic.blends import BLENDS
from geomosaic.mosaic.driver import InMemory, composed
from geomosaic.mosaic.frame_part import Asked, FramePart, Warping, frame_part
from geomosaic.mosaic.frame_source import FrameSource
from geomosaic.mosaic.model import Mosaic, OutputGrid
from geomosaic.mosaic.ownership import Ownership, cell_px_of, nearest_nadir
from geomosaic.mosaic.plan import Planning, asked_of, windows
from geomosaic.mosaic.raster import Raster, writing_mosaic
from geomosaic.mosaic.scene import Scene
from geomosaic.mosaic.seamlines import SeamLabels
from geomosaic.mosaic.sight import FrameOnMap, Sighting, seen_cells
from geomosaic.mosaic.spread import AtOnce, Spread
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
        "side of the windows that are blended: smaller ones are more margin than window, with 64 px about "
        "them already 1.56 times their area; larger ones take memory in each thread",
        "docs/results.md, seams and blends, a real flight of 28 frames: with 1024 px 9 % less time by "
        "bands, and 2 GB of memory",
    ),
] = 512
AUTO = "auto"
_MARGIN_BYTES: Final = np.dtype(np.float32).itemsize
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
    spread: Spread | None = None,
    progress: Callable[[int, int], None] | None = None,
    check_cancelled: Callable[[], None] | None = None,
) -> Mosaic:
    """Warps all frames in use onto the grid and blends them into one raster.

    The same bytes come out whatever the number of threads and workers and the memory. `check_cancelled`
    raises to stop.

    Args: poses, cameras, used: of each of the survey's frames. ownership: who gives which part, and the area
    that the mosaic is cut to; the frame that looks down most steeply, and no area, if not given. blend: one
    of BLENDS; auto: multi_band for images of 8 bits, feather for measured values, which stay as they are
    where one frame shows the ground. tones: how brightly frames show the ground, evened out; as they are if
    not given. memory_bytes: for what frames give; windows in work take some 100 MB more for each thread, and
    so does a frame while it is brought onto the grid. spread: who does that; the threads, as windows ask for
    it, if not given. sources_path: where the raster of frame indices goes, if at all (see
    `raster.writing_mosaic`).
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
    area, reach_px = ownership.area, feather_m / grid.gsd_m
    walk = _Walk(
        survey,
        {v.frame: FrameSource(grid, ownership, v) for v in views},
        Manner(how, kind.bands, kind.dtype),
        Warping(replace(scene, views=()), resampling, tones, kind.dtype, reach_px / 2.0),
        reach_px,
        area,
        memory_bytes,
        threads,
        spread or AtOnce(check_cancelled),
        check_cancelled,
    )
    labels = SeamLabels(grid, WINDOW_PX, cut=area is not None)
    gave_pixels: set[int] = set()
    names = [frame.name for frame in survey.frames]
    whole = windows(grid, WINDOW_PX)
    order = whole if area is None else area.touched(grid, whole)
    with (
        unreferenced_is_fine(),
        ThreadPoolExecutor(threads) as pool,
        writing_mosaic(raster_path, grid, kind.bands, kind.dtype, sources_path, names) as raster,
    ):
        for window in set(whole) - set(order):
            raster.leave_out(window)
        try:
            for done, made in enumerate(walk.windows(order, pool, raster)):
                labels.add(made)
                gave_pixels.update(made.gave)
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
        holes=labels.holes(),
        resampling=resampling,
    )


@dataclass(frozen=True)
class _Walk:
    """How windows of one scene's frames are composed.

    sources: the frames that may give pixels, by their number. area: what the windows are cut to, if anything.
    memory_bytes: for what frames give.
    """

    survey: Survey
    sources: Mapping[int, FrameSource]
    manner: Manner
    warping: Warping
    reach_px: float
    area: Area | None
    memory_bytes: int
    threads: int
    spread: Spread
    check_cancelled: Callable[[], None] | None

    def windows(
        self, order: Sequence[Window], pool: ThreadPoolExecutor, raster: Raster
    ) -> Iterator[Composed]:
        """Windows of the grid in their order, each written by the thread that composed it."""
        plan = self._plan(order, pool)
        asked = {number: Asked(self._on_map(number), boxes) for number, boxes in asked_of(plan).items()}
        make = partial(frame_part, self.warping)
        keys = [one.on_map.frame.path for one in asked.values()]
        with self.spread.spooled("frames on the map", make, list(asked.values()), keys) as kept:
            parts = dict(zip(asked, kept, strict=True))
            bytes_px = self.manner.bands * np.dtype(self.manner.dtype).itemsize + _MARGIN_BYTES
            supply = InMemory(
                [[part.source.number for part in step.parts] for step in plan],
                {n: bytes_px * sum(b.width * b.height for b in one.boxes) for n, one in asked.items()},
                self.memory_bytes,
                pool,
                lambda number: parts[number].load(),
            )
            work = partial(self._written, raster)
            yield from composed(plan, work, supply, pool, self.threads, self.check_cancelled)

    def _plan(self, order: Sequence[Window], pool: ThreadPoolExecutor) -> list[Step]:
        scene, halo_px = self.warping.scene, self.manner.blend.halo_px(self.reach_px)
        frames = [self._on_map(number) for number in self.sources]
        look = partial(seen_cells, Sighting(scene, halo_px, KERNEL_RADIUS_PX[self.warping.resampling]))
        seen = self.spread.map("what frames see", look, frames, [one.frame.path for one in frames])
        planning = Planning(
            self.sources, dict(zip(self.sources, seen, strict=True)), halo_px, self.reach_px, self.area
        )
        plan = []
        for found in pool.map(planning.step, order):
            if self.check_cancelled is not None:
                self.check_cancelled()
            plan.append(found)
        return plan

    def _on_map(self, number: int) -> FrameOnMap:
        return FrameOnMap(self.survey.frames[number], self.sources[number].view)

    def _written(self, raster: Raster, step: Step, parts: Mapping[int, FramePart]) -> Composed:
        done = compose_window(self.manner, step, parts)
        if self.area is not None:
            done = done.cut(self.area.mask(self.warping.scene.grid, step.window))
        raster.write(done)
        return done


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
