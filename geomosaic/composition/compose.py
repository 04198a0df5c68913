"""Composition: every frame is brought onto the grid once, then windows are blended, in bounded memory."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from geomosaic.composition.bands import common_kind
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
from geomosaic.composition.composed_tiles import (
    ComposedTiles,
    EarlierMosaic,
    Noting,
    TileNotes,
)
from geomosaic.composition.frame_part import Asked, Warping, frame_part
from geomosaic.composition.frame_source import FrameSource
from geomosaic.composition.kept_tile import KeptTile
from geomosaic.composition.model import Mosaic
from geomosaic.composition.occlusion import with_occlusion
from geomosaic.composition.ownership import Ownership
from geomosaic.composition.plan import Asking, Planning, windows
from geomosaic.composition.raster import MosaicFiles, Raster, index_kind, writing_mosaic
from geomosaic.composition.scene import Scene
from geomosaic.composition.seamlines import SeamLabels
from geomosaic.composition.spread import InProcessSpooler, SpooledResult, Spooler
from geomosaic.composition.tiles import TILE_PX, TileKind
from geomosaic.composition.tones import Tones
from geomosaic.composition.trim import HORIZON
from geomosaic.composition.views import FrameView, PosedFrames, frame_views
from geomosaic.composition.visibility import FrameOnMap, VisibilityTest, visible_cells
from geomosaic.composition.window import CompositionStep, Window
from geomosaic.constants import tuned
from geomosaic.doors.raster import unreferenced_is_fine
from geomosaic.errors import InputError, UnknownNameError
from geomosaic.projection.resample import KERNEL_RADIUS_PX, RESAMPLING
from geomosaic.survey.model import Survey

AUTO = "auto"
AUTO_FEATHER_PX = tuned(48, "mosaic px", "default feather: less shows lines; more doubles detail")
_MOST_FEATHER_PX = tuned(4 * TILE_PX, "mosaic px", "widest feather: more takes memory for many tiles around")


@dataclass(frozen=True)
class TileKeeping:
    """frames: of the survey, by name and content. earlier: whose tiles are kept where they would be the same.
    noted: takes the tiles' notes and how many are kept."""

    frames: tuple[str, ...]
    earlier: EarlierMosaic | None
    noted: Callable[[ComposedTiles, int], None]


@dataclass(frozen=True)
class CompositionOptions:
    """How frames become a mosaic.

    blend: one of BLENDS; auto: multi_band for images of 8 bits, feather for measured values, which stay as
    they are where one frame shows the ground. feather_m: width of a feathered blend, AUTO_FEATHER_PX if None.
    tones: how brightly frames show the ground, evened out; as they are if None. threads: that write. keeping:
    of tiles for the next mosaic, and of an earlier one's.
    """

    blend: str = AUTO
    feather_m: float | None = None
    resampling: str = "cubic"
    tones: Tones | None = None
    threads: int = 2
    keeping: TileKeeping | None = None


def compose(
    frames: PosedFrames,
    ownership: Ownership,
    files: MosaicFiles,
    options: CompositionOptions = CompositionOptions(),
    spread: Spooler | None = None,
) -> Mosaic:
    """Warps all frames in use onto the ownership's grid and blends them into one raster.

    The same bytes come out whatever the number of threads and workers.

    Args: ownership: who gives which part, and the area that the mosaic is cut to. spread: who brings frames
    onto the grid and blends windows, each of which takes some 100 MB at a time; the threads, which else only
    write, if not given.
    Raises: `InputError` if frames don't go together or can't be resampled, `UnknownNameError` for a strategy.
    """
    if options.blend not in (AUTO, *BLENDS):
        raise UnknownNameError("blend", options.blend, (AUTO, *BLENDS))
    if options.resampling not in RESAMPLING:
        raise UnknownNameError("resampling", options.resampling, RESAMPLING)
    spread = spread or InProcessSpooler()
    survey, grid, area = frames.survey, ownership.grid, ownership.area
    views = composed_views(frames, ownership)
    kind = common_kind([survey.frames[v.frame] for v in views])
    name = blend_of(options.blend, kind.dtype)
    asked_m = options.feather_m if BLENDS[name].feathered else None
    reach_px = AUTO_FEATHER_PX if asked_m is None else asked_m / grid.gsd_m
    if reach_px > _MOST_FEATHER_PX:
        raise InputError(
            f"a feathered blend of {asked_m} m is {reach_px:,.0f} pixels of {grid.gsd_m} m wide, "
            f"{_MOST_FEATHER_PX:,} at most",
            fix=f"give --set mosaic.compose.feather_m={_MOST_FEATHER_PX * grid.gsd_m:.4g} or less",
        )
    labels = SeamLabels(grid, TILE_PX, cut=area is not None and area.asked)
    names = [frame.name for frame in survey.frames]
    tiles = TileKind(kind.bands, np.dtype(kind.dtype))
    bands = {} if survey.quantity is None else {survey.band: survey.quantity}
    blending = Blending(
        name,
        grid,
        {v.frame: FrameSource(grid, ownership, v) for v in views},
        reach_px,
        area,
        labels.step_px,
        tiles,
        None if files.sources is None else index_kind(len(names)),
    )
    scene = Scene(survey.work_frame, frames.ground, grid, ())
    walk = _Walk(
        survey,
        ownership,
        blending,
        Warping(scene, options.resampling, options.tones, kind.dtype, reach_px / 2.0),
        spread,
        options.keeping,
    )
    gave_pixels: set[int] = set()
    whole = windows(grid, TILE_PX)
    order = whole if area is None else area.touched(grid, whole)
    with (
        unreferenced_is_fine(),
        ThreadPoolExecutor(options.threads) as pool,
        walk.windows(order) as made,
        writing_mosaic(files, grid, tiles, names, bands) as raster,
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
                spread.progress(done + 1, len(order), "writing")
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return Mosaic(
        grid=grid,
        raster=files.raster.name,
        bands=kind.bands,
        dtype=kind.dtype,
        nodata=None,
        seamlines=labels.seamlines(),
        frames_used=tuple(sorted(gave_pixels)),
        holes=labels.holes(),
        resampling=options.resampling,
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
    keeping: TileKeeping | None = None

    @contextmanager
    def windows(self, order: Sequence[Window]) -> Iterator[Sequence[SpooledResult[BlendedBlock]]]:
        """Windows of the grid, by the overview's tiles over them, blended by whoever is free of what frames
        give."""
        plan, cells, kept, notes = self._plan(order)
        blocks: dict[tuple[int, int], list[CompositionStep]] = {}
        for step in plan:
            blocks.setdefault(place_over(step.window), []).append(step)
        asked = {number: Asked(self._on_map(number), of) for number, of in cells.items()}
        paths = {number: one.on_map.frame.path for number, one in asked.items()}
        with ExitStack() as parts:

            def wanted() -> Iterator[WantedBlock]:
                """Frames are brought onto the grid when the first window is to be blended."""
                make = partial(frame_part, self.warping)
                of = [(paths[number], *cells[number].mark) for number in asked]
                spooled = self.spread.spooled("frames on the map", make, list(asked.values()), of)
                gives = dict(zip(asked, parts.enter_context(spooled), strict=True))
                for place, steps in blocks.items():
                    yield WantedBlock(
                        place, tuple(Wanted.of(step, gives, kept.get(step.window)) for step in steps)
                    )

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
        if notes is not None and self.keeping is not None:
            self.keeping.noted(notes.tiles(), notes.kept)

    def _plan(
        self, order: Sequence[Window]
    ) -> tuple[list[CompositionStep], dict[int, MosaicCells], dict[Window, KeptTile], TileNotes | None]:
        """The windows' steps, the cells that frames are asked for, tiles of an earlier mosaic, and notes."""
        scene, sources, reach_px = self.warping.scene, self.blending.sources, self.blending.reach_px
        halo_px = BLENDS[self.blending.blend].halo_px(reach_px)
        frames = [self._on_map(number) for number in sources]
        look = partial(
            visible_cells, VisibilityTest(scene, halo_px, KERNEL_RADIUS_PX[self.warping.resampling])
        )
        seen = self.spread.map("what frames see", look, frames, [one.frame.path for one in frames])
        lying = dict(zip(sources, seen, strict=True))
        planning = Planning(self.ownership, sources, lying, halo_px, reach_px)
        plan, asking, kept = [], Asking(lying), dict[Window, KeptTile]()
        notes = self._notes(halo_px)
        for planned in planning.steps(order):
            self.spread.check_cancelled()
            if notes is not None and (tile := notes.look(planned.step)) is not None:
                kept[planned.step.window] = tile
                plan.append(replace(planned.step, parts=()))
            else:
                asking.add(planned)
                plan.append(planned.step)
        return plan, asking.cells(), kept, notes

    def _notes(self, halo_px: int) -> TileNotes | None:
        """Of the tiles, if they are wanted."""
        how, warping = self.blending, self.warping
        if self.keeping is None:
            return None
        manner = f"{how.blend} {warping.resampling} {how.reach_px:.6g} {how.kind} {how.area is not None}"
        noting = Noting(
            *(warping.scene, self.ownership, warping.tones, self.keeping.frames),
            *(manner, halo_px, how.kind.bands, how.area),
        )
        return TileNotes(noting, self.keeping.earlier)

    def _on_map(self, number: int) -> FrameOnMap:
        return FrameOnMap(self.survey.frames[number], self.blending.sources[number].view)


def _written(raster: Raster, made: SpooledResult[BlendedBlock]) -> list[Blended]:
    """Brings windows' tiles to their files; what is left of them is small."""
    block = made.load()
    raster.put(block)
    return [replace(one, tile=None, index=None) for one in block.windows]


def composed_views(frames: PosedFrames, ownership: Ownership) -> tuple[FrameView, ...]:
    """The views of the frames in use, with what is hidden from each: up to the horizon, or of frames whose
    middle sees the ground, where edges are kept."""
    limits = None if ownership.trimmed is None else HORIZON
    return with_occlusion(frame_views(frames, ownership.grid.crs, limits), ownership.hidden)


def blend_of(blend: str, dtype: str) -> str:
    """The blend in use, by the one that is asked for and the type of the frames' pixels."""
    if blend != AUTO:
        return blend
    return "multi_band" if dtype == "uint8" else "feather"
