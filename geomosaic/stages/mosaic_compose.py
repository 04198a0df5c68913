"""Adjusted poses in, the mosaic out: every pixel resampled once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar, Literal

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.adjustment.rig import RigPoses
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.mosaic.bands import compose_bands
from geomosaic.mosaic.compose import AUTO_FEATHER_PX, compose
from geomosaic.mosaic.grid import MAX_GIGAPIXELS, auto_gsd_m, output_grid, without_flung
from geomosaic.mosaic.model import Mosaic, OutputGrid
from geomosaic.mosaic.seams import SEAMS
from geomosaic.mosaic.tones import Tones
from geomosaic.mosaic.views import frame_views
from geomosaic.pipeline.stage import Context, RunFile, Stage, StageParams, param
from geomosaic.placement.model import Placement
from geomosaic.projection.ground import GroundSurface
from geomosaic.projection.resample import RESAMPLING
from geomosaic.survey.model import Survey

RASTER = "work/mosaic.compose/mosaic.tif"
SOURCES = "sources.tif"


class MosaicCompose(Stage):
    """Warps the frames onto the map and blends them."""

    id = "mosaic.compose"
    display_name = "Compose the mosaic"
    group = "Mosaic"
    version = 6
    inputs: ClassVar[dict[str, type]] = {
        "survey": Survey,
        "ground": GroundSurface,
        "placement": Placement,
        "adjusted": Adjusted,
    }
    optional_inputs: ClassVar[dict[str, type]] = {"rig": RigPoses, "tones": Tones}
    outputs: ClassVar[dict[str, type]] = {"mosaic": Mosaic, "raster_file": RunFile}
    results: ClassVar[tuple[str, ...]] = (SOURCES,)

    class Params(StageParams):
        """See each parameter's help."""

        gsd_m: float | Literal["auto"] = param(
            "auto",
            help="ground pixel; auto: the frames' median by POS, the same for every method; where none has a "
            "position, that of the adjusted frames",
            unit="m",
            ge=0.0005,
            le=1000.0,
        )
        seam: str = param("nearest_nadir", help="who gives a pixel where frames overlap", choices=SEAMS)
        feather_m: float | Literal["auto"] = param(
            "auto",
            help=f"width of the blend along seams and edges; auto: {AUTO_FEATHER_PX} ground pixels, 0: none",
            unit="m",
            ge=0.0,
            le=1000.0,
        )
        resampling: str = param("cubic", help="how frames are resampled", choices=RESAMPLING)
        max_gigapixels: float = param(
            MAX_GIGAPIXELS,
            help="largest mosaic; a larger one is refused before the frames are matched",
            unit="gigapixels",
            ge=0.001,
            le=1e6,
        )
        sources: bool = param(True, help=f"also write {SOURCES}: which frame made each pixel")
        memory_mb: int = param(
            1024, help="memory for decoded frames", unit="MB", ge=64, le=1_000_000, affects_output=False
        )
        threads: int = param(2, help="threads at work", ge=1, le=256, affects_output=False)

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        """Settles the grid, composes into RUN/work, and tells run.json what came out."""
        survey: Survey = inputs["survey"]
        adjusted: Adjusted = inputs["adjusted"]
        ground, names = inputs["ground"], [f.name for f in survey.frames]
        used = [s != "rejected" for s in adjusted.status]
        views = frame_views(survey.work_frame, survey.map_crs, adjusted.poses, adjusted.cameras, used, ground)
        for i in sorted({i for i, use in enumerate(used) if use} - {v.frame for v in views}):
            context.warn("looks-past-ground", names[i], "its middle doesn't see the ground; left out")
        ground_pixel_m = inputs["placement"].ground_pixel_m
        if not any(survey.located):
            ground_pixel_m = float(np.median([v.gsd_m for v in views])) if views else np.nan
        gsd_m = auto_gsd_m(ground_pixel_m) if params.gsd_m == "auto" else params.gsd_m
        views, flung = without_flung(views, gsd_m, params.max_gigapixels)
        for view in flung:
            used[view.frame] = False
            moved = adjusted.poses.positions_m[view.frame] - inputs["placement"].poses.positions_m[view.frame]
            away = f"{np.linalg.norm(moved) / 1000.0:,.1f} km from where its position says"
            context.warn("frame-flung", names[view.frame], f"the adjustment put it {away}; left out")
        grid = output_grid(survey.map_crs, views, gsd_m, names, params.max_gigapixels)

        def composing(
            of: Survey,
            poses: Poses,
            cameras: Sequence[Camera],
            use: Sequence[bool],
            to: Path,
            by: Path | None,
        ) -> Mosaic:
            return compose(
                of,
                poses,
                cameras,
                use,
                ground,
                grid,
                to,
                seam=params.seam,
                feather_m=None if params.feather_m == "auto" else params.feather_m,
                resampling=params.resampling,
                tones=tones,
                memory_bytes=params.memory_mb << 20,
                sources_path=by,
                threads=params.threads,
                progress=lambda done, total: context.progress(done, total, "windows"),
                check_cancelled=context.check_cancelled,
            )

        tones: Tones | None = inputs.get("tones")
        rig = inputs.get("rig", RigPoses())
        if survey.other_bands and not rig.bands:
            text = f"only {survey.band} of the rig's bands: the recipe has no stage adjustment.rig"
            context.warn("bands-left-out", "", text)
        poses, cameras = adjusted.poses, adjusted.cameras
        with ExitStack() as files:
            sources = files.enter_context(context.writing(SOURCES)) if params.sources else None
            raster = files.enter_context(context.writing(RASTER))
            if rig.bands:
                folder = Path(files.enter_context(TemporaryDirectory(dir=context.work_folder)))
                mosaic = compose_bands(composing, survey, poses, cameras, used, rig, folder, raster, sources)
            else:
                mosaic = composing(survey, poses, cameras, used, raster, sources)
        mosaic = replace(mosaic, raster=RASTER)
        self._tell(context, grid, mosaic)
        return {"mosaic": mosaic, "raster_file": context.run_file(RASTER)}

    @staticmethod
    def _tell(context: Context, grid: OutputGrid, mosaic: Mosaic) -> None:
        size = {"width": grid.width_px, "height": grid.height_px}
        context.report("mosaic", {"crs": grid.crs, "gsd_m": grid.gsd_m, **size})
        context.metric("mosaic.frames_used", len(mosaic.frames_used))
        context.metric("mosaic.decodes", mosaic.decodes)
