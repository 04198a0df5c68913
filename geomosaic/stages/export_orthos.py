"""orthos/: each frame by itself on the mosaic's grid."""

from __future__ import annotations

from functools import partial

import numpy as np

from geomosaic.composition.compose import AUTO
from geomosaic.composition.model import Mosaic
from geomosaic.composition.orthos import plan_orthos
from geomosaic.composition.views import PosedFrames
from geomosaic.errors import InputError
from geomosaic.export.cog import COMPRESSIONS, CogOptions
from geomosaic.export.orthos import OrthoStyle, ortho_file, ortho_names, write_orthos_vrt
from geomosaic.matching.band_registration import RigPoses
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, RunFile, StageParams, param
from geomosaic.projection.resample import RESAMPLING
from geomosaic.stages.input_groups import AdjustedSurvey, FrameShares

ORTHOS = "orthos"
VRT = "orthos.vrt"


class OrthosParams(StageParams):
    """See each parameter's help."""

    resampling: str = param(
        AUTO,
        help="how frames are resampled; auto: as for the mosaic, cubic without one",
        choices=(AUTO, *RESAMPLING),
    )
    compression: str = param(
        "deflate", help="as export.cog's; webp and jpeg are smaller", choices=COMPRESSIONS
    )
    quality: int = param(90, help="of webp and jpeg", unit="%", ge=1, le=100)
    threads: int = param(2, help="threads at work", ge=1, le=256, affects_output=False)


@stage(
    "export.orthos", "Write the frames' orthos", group="Export", version=7, outputs="orthos_folder",
    results=(ORTHOS,), wants_frames=True,
)  # fmt: skip
def export_orthos(
    of: AdjustedSurvey,
    shares: FrameShares,
    params: OrthosParams,
    context: Context,
    mosaic: Mosaic | None = None,
) -> RunFile:
    """Writes orthos/FRAME.tif, a COG with a mask of each frame in use, and orthos/orthos.vrt over them.

    On the mosaic's grid and in its tones, cut to its area; of a rig with all its bands. In the VRT the frames
    that give most of the mosaic lie on top.
    """
    resampling = params.resampling
    if resampling == AUTO:
        resampling = "cubic" if mosaic is None else mosaic.resampling
    survey, ownership, rig = of.survey, shares.ownership, shares.rig or RigPoses()
    names = ortho_names([f.name for f in survey.frames])
    if survey.other_bands and not rig.bands:
        text = (
            f"orthos show only {survey.band} of the rig's bands, as this recipe aligns no others: make the "
            "run with geomosaic mosaic, or put the stage adjustment.rig into the recipe"
        )
        context.warn("bands-left-out", "", text)
    adjusted, used = of.adjusted, ownership.used.tolist()
    posed = PosedFrames(survey, adjusted.poses, adjusted.cameras, used, of.ground)
    plan = plan_orthos(posed, ownership, rig, resampling, shares.tones)
    how = CogOptions(params.compression, params.quality, threads=params.threads)
    style = OrthoStyle(plan.warping, plan.area, plan.names, how, context.work_folder)
    cells = np.bincount(ownership.owner.ravel(), minlength=len(survey.frames) + 1)[1:]
    written = []
    make, frames = partial(ortho_file, style), list(plan.frames.values())
    with (
        context.spooled("orthos", make, frames, list(plan.frames)) as made,
        context.writing(ORTHOS) as folder,
    ):
        folder.mkdir()
        for number, one in zip(plan.frames, made, strict=True):
            context.check_cancelled()
            if cog := one.load().cog:
                (folder / names[number]).write_bytes(cog)
                written.append((int(cells[number]), -number))
        if not written:
            problem = "no frame shows anything of the mosaic's area"
            raise InputError(problem, fix="run the recipe again")
        lowest_first = [folder / names[-number] for _, number in sorted(written)]
        write_orthos_vrt(lowest_first, folder / VRT)
    context.metric("orthos.frames", len(written))
    return context.run_file(ORTHOS)
