"""Composition: every frame is brought onto the grid once, then windows are blended, in bounded memory."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.composition.blended import (
    Blended,
    BlendedBlock,
    Blending,
    Wanted,
    WantedBlock,
    blended,
    place_over,
)
from geomosaic.composition.blends import BLENDS
from geomosaic.composition.cells import MosaicCells
from geomosaic.composition.frame_part import Asked, Warping, frame_part
from geomosaic.composition.frame_source import FrameSource
from geomosaic.composition.model import Mosaic, OutputGrid
from geomosaic.composition.occlusion import with_occlusion
from geomosaic.composition.ownership import Ownership, cell_px_of, nearest_nadir
from geomosaic.composition.plan import Asking, Planning, windows
from geomosaic.composition.pyramid import TileKind
from geomosaic.composition.raster import Raster, index_kind, writing_mosaic
from geomosaic.composition.scene import Scene
from geomosaic.composition.seamlines import SeamLabels
from geomosaic.composition.spread import InProcessSpooler, SpooledResult, Spooler
from geomosaic.composition.tones import Tones
from geomosaic.composition.views import frame_views
from geomosaic.composition.visibility import FrameOnMap, VisibilityTest, visible_cells
from geomosaic.composition.window import DTYPES, CompositionStep, Window
from geomosaic.constants import tuned
from geomosaic.doors.raster import unreferenced_is_fine
from geomosaic.errors import InputError, UnknownNameError
from geomosaic.projection.ground import GroundSurface
from geomosaic.projection.resample import KERNEL_RADIUS_PX, RESAMPLING
from geomosaic.survey.model import Frame, Survey

WINDOW_PX = tuned(512, "px", "blended window: smaller is mostly margin; 1024 is 9 % faster but takes 2 GB")
AUTO = "auto"
AUTO_FEATHER_PX = tuned(48, "mosaic px", "default feather: less shows lines; more doubles detail")


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
    sources_path: Path | None = None,
    threads: int = 2,
    spread: Spooler | None = None,
    progress: Callable[[int, int], None] | None = None,
    check_cancelled: Callable[[], None] | None = None,
) -> Mosaic:
    """Warps all frames in use onto the grid and blends them into one raster.

    The same bytes come out whatever the number of threads and workers. `check_cancelled`
    raises to stop.

    Args: poses, cameras, used: of each of the survey's frames. ownership: who gives which part, and the area
    that the mosaic is cut to; the frame that looks down most steeply, and no area, if not given. blend: one
    of BLENDS; auto: multi_band for images of 8 bits, feather for measured values, which stay as they are
    where one frame shows the ground. tones: how brightly frames show the ground, evened out; as they are if
    not given. spread: who brings frames onto the grid and blends windows, each of which takes some 100 MB at
    a time; the threads, which else only write, if not given. sources_path: where the raster of frame indices
    goes, if at all (see `raster.writing_mosaic`).
    Raises: `InputError` if frames don't go together or can't be resampled, `UnknownNameError` for a strategy.
    """
    if blend not in (AUTO, *BLENDS):
        raise UnknownNameError("blend", blend, (AUTO, *BLENDS))
    if resampling not in RESAMPLING:
        raise UnknownNameError("resampling", resampling, RESAMPLING)
    feather_m = AUTO_FEATHER_PX * grid.gsd_m if feather_m is None else feather_m
    views = frame_views(survey.work_frame, grid.crs, poses, cameras, used, ground)
    views = views if ownership is None else with_occlusion(views, ownership.hidden)
    kind = common_kind([survey.frames[v.frame] for v in views])
    scene = Scene(survey.work_frame, ground, grid, views)
    ownership = ownership or nearest_nadir(scene, used, cell_px_of(scene))[0]
    name = blend if blend != AUTO else "multi_band" if kind.dtype == "uint8" else "feather"
    area, reach_px = ownership.area, feather_m / grid.gsd_m
    labels = SeamLabels(grid, WINDOW_PX, cut=area is not None and area.asked)
    names = [frame.name for frame in survey.frames]
    blending = Blending(
        name,
        grid,
        {v.frame: FrameSource(grid, ownership, v) for v in views},
        reach_px,
        area,
        labels.step_px,
        TileKind(kind.bands, np.dtype(kind.dtype)),
        None if sources_path is None else index_kind(len(names)),
    )
    walk = _Walk(
        survey,
        ownership,
        blending,
        Warping(replace(scene, views=()), resampling, tones, kind.dtype, reach_px / 2.0),
        spread or InProcessSpooler(check_cancelled),
        check_cancelled,
    )
    gave_pixels: set[int] = set()
    whole = windows(grid, WINDOW_PX)
    order = whole if area is None else area.touched(grid, whole)
    with (
        unreferenced_is_fine(),
        ThreadPoolExecutor(threads) as pool,
        walk.windows(order) as made,
        writing_mosaic(raster_path, grid, kind.bands, kind.dtype, sources_path, names) as raster,
    ):
        begun = {place_over(window) for window in order}
        for window in whole:
            if place_over(window) not in begun:
                raster.leave_out(window)
        try:
            blocks = pool.map(partial(_written, raster), made)
            for done, one in enumerate(itertools.chain.from_iterable(blocks)):
                labels.add(one.window, one.labels, one.wanted)
                gave_pixels.update(one.gave)
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
        trimmed=ownership.trimmed,
    )


@dataclass(frozen=True)
class _Walk:
    """How windows of one scene's frames are composed."""

    survey: Survey
    ownership: Ownership
    blending: Blending
    warping: Warping
    spread: Spooler
    check_cancelled: Callable[[], None] | None

    @contextmanager
    def windows(self, order: Sequence[Window]) -> Iterator[Sequence[SpooledResult[BlendedBlock]]]:
        """Windows of the grid, by the overview's tiles over them, blended by whoever is free of what frames
        give."""
        plan, cells = self._plan(order)
        blocks: dict[tuple[int, int], list[CompositionStep]] = {}
        for step in plan:
            blocks.setdefault(place_over(step.window), []).append(step)
        asked = {number: Asked(self._on_map(number), of) for number, of in cells.items()}
        paths = {number: one.on_map.frame.path for number, one in asked.items()}
        with ExitStack() as parts:

            def wanted() -> Iterator[WantedBlock]:
                """Frames are brought onto the grid when the first window is to be blended."""
                make = partial(frame_part, self.warping)
                spooled = self.spread.spooled(
                    "frames on the map", make, list(asked.values()), list(paths.values())
                )
                gives = dict(zip(asked, parts.enter_context(spooled), strict=True))
                for place, steps in blocks.items():
                    yield WantedBlock(place, tuple(Wanted.of(step, gives) for step in steps))

            keys = [
                (
                    *place,
                    *((s.window.col, s.window.row, [paths[p.source.number] for p in s.parts]) for s in of),
                )
                for place, of in blocks.items()
            ]
            with self.spread.spooled("windows", partial(blended, self.blending), wanted(), keys) as made:
                parts.close()
                yield made

    def _plan(self, order: Sequence[Window]) -> tuple[list[CompositionStep], dict[int, MosaicCells]]:
        """The windows' steps, and the cells that frames are asked for."""
        scene, sources, reach_px = self.warping.scene, self.blending.sources, self.blending.reach_px
        halo_px = BLENDS[self.blending.blend].halo_px(reach_px)
        frames = [self._on_map(number) for number in sources]
        look = partial(
            visible_cells, VisibilityTest(scene, halo_px, KERNEL_RADIUS_PX[self.warping.resampling])
        )
        seen = self.spread.map("what frames see", look, frames, [one.frame.path for one in frames])
        lying = dict(zip(sources, seen, strict=True))
        planning = Planning(self.ownership, sources, lying, halo_px, reach_px)
        plan, asking = [], Asking(lying)
        for planned in planning.steps(order):
            if self.check_cancelled is not None:
                self.check_cancelled()
            asking.add(planned)
            plan.append(planned.step)
        return plan, asking.cells()

    def _on_map(self, number: int) -> FrameOnMap:
        return FrameOnMap(self.survey.frames[number], self.blending.sources[number].view)


def _written(raster: Raster, made: SpooledResult[BlendedBlock]) -> list[Blended]:
    """Brings windows' tiles to their files; what is left of them is small."""
    block = made.load()
    raster.put(block)
    return [replace(one, tile=None, index=None) for one in block.windows]


def common_kind(frames: Sequence[Frame]) -> Frame:
    """A frame whose bands and data type all share."""
    if not frames:
        raise InputError(
            ("no frame can be used, so there is no mosaic"), fix="correct the positions in the --pos file"
        )
    first = frames[0]
    for frame in frames:
        if (frame.bands, frame.dtype) != (first.bands, first.dtype):
            raise InputError(
                f"has {frame.bands} bands of {frame.dtype}, {first.name} {first.bands} of {first.dtype}",
                file=frame.path,
                fix="mosaic frames of one kind at a time",
            )
    if first.dtype not in DTYPES:
        raise InputError(
            f"pixels of type {first.dtype} can't be resampled",
            file=first.path,
            fix=f"convert the frames to one of {', '.join(DTYPES)}",
        )
    return first
