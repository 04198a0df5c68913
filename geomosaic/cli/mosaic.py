"""`geomosaic mosaic`: from a folder of frames to a run folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geomosaic.cli.mosaic_options import (
    SURFACES,
    Adjust,
    CameraPath,
    Damaged,
    DemOffset,
    DemPath,
    EdgeRule,
    GcpOptional,
    GcpPath,
    GroundHeight,
    MapCrs,
    MosaicReference,
    NeededHorizontal,
    NeededRelative,
    NeededVertical,
    OrthoGround,
    Pdf,
    PixelSize,
    PosCrs,
    PosPath,
    SurfaceKind,
    SurfaceReference,
)
from geomosaic.cli.options import (
    AlignTo,
    Aoi,
    Dask,
    DryRun,
    FixedTime,
    Live,
    Overwrite,
    PlanJson,
    Private,
    PrivatePlaces,
    Quiet,
    Record,
    RunFolderBeside,
    Seed,
    Sets,
    Strict,
    Workers,
    beside,
    crs_of,
    record_options,
)
from geomosaic.cli.running import execute, prepare
from geomosaic.errors import InputError, UnknownNameError

if TYPE_CHECKING:
    from geomosaic.pipeline.recipe import Recipe

STAGES = (
    "survey.read",
    "matching.flying_height",
    "projection.ground",
    "placement.pos",
    "mosaic.estimate",
    "matching.sift",
    "adjustment.solve",
    "adjustment.rig",
    "surface.dense",
    "surface.terrain",
    "mosaic.ground",
    "mosaic.tones",
    "mosaic.seams",
    "mosaic.compose",
    "export.cog",
    "export.surface",
    "quality.compare",
    "quality.surface",
    "quality.verdict",
    "quality.accuracy",
    "export.layers",
    "export.project",
    "mosaic.given",
    "export.report",
)
"""What `geomosaic mosaic` does."""

OPTIONAL = (
    "matching.flying_height",
    "surface.dense",
    "surface.terrain",
    "mosaic.ground",
    "export.surface",
    "quality.compare",
    "quality.surface",
)
"""Of these what it does only where it is asked for: against a reference, with a matched surface; the flying
height it measures unless the ground's is given."""


def mosaic(
    frames: Annotated[Path, typer.Argument(help="folder of frames (JPEG or TIFF)", metavar="FRAMES_DIR")],
    output: RunFolderBeside = None,
    pos: PosPath = None,
    pos_crs: PosCrs = None,
    camera: CameraPath = None,
    dem: DemPath = None,
    dem_offset: DemOffset = None,
    ground_height: GroundHeight = None,
    gcp: GcpPath = None,
    gcp_optional: GcpOptional = False,
    accuracy: NeededHorizontal = None,
    accuracy_vertical: NeededVertical = None,
    accuracy_relative: NeededRelative = None,
    damaged: Damaged = None,
    crs: MapCrs = "auto",
    gsd: PixelSize = "auto",
    aoi: Aoi = None,
    align_to: AlignTo = None,
    edges: EdgeRule = None,
    adjust: Adjust = None,
    surface: SurfaceKind = "ties",
    ortho: OrthoGround = None,
    reference: MosaicReference = None,
    surface_reference: SurfaceReference = None,
    pdf: Pdf = False,
    set: Sets = None,
    workers: Workers = None,
    dask: Dask = None,
    fixed_time: FixedTime = False,
    seed: Seed = None,
    overwrite: Overwrite = False,
    strict: Strict = False,
    dry_run: DryRun = False,
    as_json: PlanJson = False,
    quiet: Quiet = False,
    record: Record = "normal",
    private: Private = False,
    private_places: PrivatePlaces = False,
    live: Live = False,
) -> None:
    """Make one map-true mosaic of a folder of aerial frames."""
    if pdf:
        from geomosaic.report.pdf import browser

        browser()
    given: dict[str, dict[str, Any]] = {
        "survey.read": {
            "frames": frames,
            "pos": pos,
            "camera": camera,
            "dem": dem,
            "dem_offset_m": dem_offset,
            "gcp": gcp,
            "gcp_optional": gcp_optional or None,
            "crs": crs if align_to is None else crs_of(align_to, crs),
            "pos_crs": pos_crs,
            "damaged": damaged,
            "strict": strict or None,
        },
        "projection.ground": {"height_m": ground_height},
        "adjustment.solve": {"method": adjust},
        "mosaic.ground": {"ortho": ortho},
        "mosaic.seams": {"gsd_m": gsd, "aoi": aoi, "align_to": align_to, "edges": edges},
        "quality.verdict": {
            "accuracy_m": accuracy,
            "accuracy_vertical_m": accuracy_vertical,
            "accuracy_relative_permille": accuracy_relative,
        },
        "export.report": {"pdf": pdf or None},
        "quality.compare": {"reference": reference},
        "quality.surface": {"reference": surface_reference},
    }
    if surface not in SURFACES:
        raise UnknownNameError("surface", surface, SURFACES)
    if surface_reference is not None and surface != "dense":
        raise InputError("there is no surface to compare", file=surface_reference, mend="add --surface dense")
    if ortho is not None and surface != "dense":
        raise InputError(
            "--ortho chooses between a surface and the ground below it", mend="add --surface dense"
        )
    unasked = {
        "quality.compare": reference is None,
        "quality.surface": surface_reference is None,
        "matching.flying_height": ground_height is not None,
        "surface.dense": surface != "dense",
        "surface.terrain": surface != "dense",
        "mosaic.ground": surface != "dense",
        "export.surface": surface != "dense",
    }
    stages = [id for id in STAGES if not unasked.get(id)]
    prepare(stages, workers, dask)
    recipe = recipe_of("mosaic", f"frames of {frames.name}", stages, given, seed, set)
    output = output or beside(frames, "mosaic")
    recorded = record_options(record, private, private_places, live)
    how: dict[str, Any] = {
        "strict": strict,
        "dry_run": dry_run,
        "as_json": as_json,
        "quiet": quiet,
        "record": recorded,
    }
    execute(recipe, output, workers, dask, fixed_time, overwrite, **how)


def recipe_of(
    name: str,
    description: str,
    stages: Sequence[str],
    given: Mapping[str, Mapping[str, Any]],
    seed: int | None,
    sets: Sequence[str] | None,
) -> Recipe:
    """The recipe of a command. given: its options by stage and parameter; those that are None aren't set."""
    from geomosaic.pipeline.recipe import recipe_from
    from geomosaic.pipeline.registry import installed

    steps = [
        {"stage": id, "params": {k: v for k, v in given.get(id, {}).items() if v is not None}}
        for id in stages
    ]
    plain = {"name": name, "description": description, "seed": seed or 0, "stages": steps}
    return recipe_from(plain, installed(), sets or ())
