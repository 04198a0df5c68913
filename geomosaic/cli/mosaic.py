"""`geomosaic mosaic` and `geomosaic run`: from frames, or from a recipe, to a run folder."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geomosaic.cli.help import ACCURACY, INPUTS, OUTPUT, RARE, SURFACE, HelpAll
from geomosaic.cli.options import (
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
    cores,
    length_given,
    name_choices,
    record_options,
)
from geomosaic.cli.recipes import completed
from geomosaic.cli.running import execute
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

SURFACES = ("ties", "dense")

Adjust = Annotated[
    str | None,
    typer.Option(
        metavar="METHOD",
        help="adjustment method; 'geomosaic stages adjustment.solve' lists them",
        rich_help_panel=RARE,
    ),
]

Aoi = Annotated[
    Path | None,
    typer.Option(
        help="cut the mosaic to the polygons in this file (GeoPackage, GeoJSON, ...)",
        metavar="F",
        rich_help_panel=OUTPUT,
    ),
]
AlignTo = Annotated[
    Path | None,
    typer.Option(
        help="use CRS, pixel size and grid of this raster, so that pixels coincide",
        metavar="TIF",
        rich_help_panel=RARE,
    ),
]


def name_methods() -> None:
    """Puts the adjustment methods into the help."""
    name_choices(Adjust, "adjustment.solve", "method")


def mosaic(
    frames: Annotated[Path, typer.Argument(help="folder of frames (JPEG or TIFF)", metavar="FRAMES_DIR")],
    output: RunFolderBeside = None,
    pos: Annotated[
        Path | None,
        typer.Option(
            help="positions and attitudes of the frames (CSV, geo.txt) [the frames' tags]",
            metavar="F",
            rich_help_panel=INPUTS,
        ),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            help="interior orientation of the camera (cameras.json, YAML) [the frames' tags]",
            metavar="F",
            rich_help_panel=INPUTS,
        ),
    ] = None,
    dem: Annotated[
        Path | None,
        typer.Option(
            help="elevation model of the ground (GeoTIFF or another raster file)",
            metavar="F",
            rich_help_panel=INPUTS,
        ),
    ] = None,
    dem_offset: Annotated[
        float | None,
        typer.Option(
            help="metres to add to the DEM's heights to make them ellipsoidal",
            metavar="M",
            rich_help_panel=RARE,
        ),
    ] = None,
    pos_crs: Annotated[
        str | None,
        typer.Option(help="CRS of x and y in the --pos file", metavar="EPSG:n", rich_help_panel=INPUTS),
    ] = None,
    ground_height: Annotated[
        float | None,
        typer.Option(
            help="ellipsoidal height of flat ground, in metres [measured in the frames]",
            metavar="M",
            rich_help_panel=SURFACE,
        ),
    ] = None,
    gcp: Annotated[
        Path | None,
        typer.Option(
            help="control and check points with their image positions (gcp_list.txt, CSV)",
            metavar="F",
            rich_help_panel=INPUTS,
        ),
    ] = None,
    gcp_optional: Annotated[
        bool,
        typer.Option(
            "--gcp-optional",
            help="go on without control where no point of --gcp can be used",
            rich_help_panel=INPUTS,
        ),
    ] = False,
    accuracy: Annotated[
        float | None,
        typer.Option(
            help="horizontal RMSE that you need, such as 5cm [what the positions can give]",
            metavar="LENGTH",
            parser=length_given,
            rich_help_panel=ACCURACY,
        ),
    ] = None,
    accuracy_vertical: Annotated[
        float | None,
        typer.Option(
            help="vertical RMSE that you need, such as 10cm",
            metavar="LENGTH",
            parser=length_given,
            rich_help_panel=ACCURACY,
        ),
    ] = None,
    accuracy_relative: Annotated[
        float | None,
        typer.Option(
            help="RMSE of distances that you need, in per mille [what the positions can give]",
            metavar="PERMILLE",
            min=0.0,
            rich_help_panel=ACCURACY,
        ),
    ] = None,
    damaged: Annotated[
        str | None,
        typer.Option(
            help="damaged frames: leave_out drops them, mask only their damaged parts [leave_out]",
            metavar="leave_out|mask",
            rich_help_panel=RARE,
        ),
    ] = None,
    crs: Annotated[
        str,
        typer.Option(
            help="map CRS of the mosaic; auto is the UTM zone",
            metavar="auto|EPSG:n",
            rich_help_panel=OUTPUT,
        ),
    ] = "auto",
    gsd: Annotated[
        str,
        typer.Option(
            help="pixel size of the mosaic in metres; auto is that of the frames",
            metavar="auto|M",
            rich_help_panel=OUTPUT,
        ),
    ] = "auto",
    aoi: Aoi = None,
    align_to: AlignTo = None,
    edges: Annotated[
        str | None,
        typer.Option(
            help="trim leaves out ground seen obliquely, coarsely or with a guessed height; keep keeps it "
            "[trim]",
            metavar="trim|keep",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    adjust: Adjust = None,
    surface: Annotated[
        str,
        typer.Option(
            help="ground onto which frames are projected: ties is smooth through the tie points, dense is "
            "matched between frames",
            metavar="|".join(SURFACES),
            rich_help_panel=SURFACE,
        ),
    ] = "ties",
    ortho: Annotated[
        str | None,
        typer.Option(
            help="with --surface dense, project onto the surface (roofs in place) or the terrain below it; "
            "auto takes the surface if frames differ clearly less on it [auto]",
            metavar="auto|surface|terrain",
            rich_help_panel=SURFACE,
        ),
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option(
            help="orthophoto or satellite image to compare the mosaic with",
            metavar="TIF",
            rich_help_panel=ACCURACY,
        ),
    ] = None,
    surface_reference: Annotated[
        Path | None,
        typer.Option(
            help="elevation model or point cloud to compare the surface of --surface dense with",
            metavar="F",
            rich_help_panel=ACCURACY,
        ),
    ] = None,
    pdf: Annotated[
        bool,
        typer.Option(
            "--pdf", help="also print the report to report.pdf (needs Chromium)", rich_help_panel=OUTPUT
        ),
    ] = False,
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
    help_all: HelpAll = False,
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
            "crs": crs if align_to is None else _crs_of(align_to, crs),
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


def run(
    recipe: Annotated[
        str,
        typer.Argument(
            help="recipe file (YAML), or the name of one that 'geomosaic recipes' lists",
            metavar="RECIPE",
            autocompletion=completed,
        ),
    ],
    input: Annotated[
        Path | None,
        typer.Argument(help="folder of frames, or geometry of strips (YAML)", metavar="INPUT"),
    ] = None,
    output: RunFolderBeside = None,
    frames: Annotated[
        Path | None,
        typer.Option(
            help="folder of frames, as --set survey.read.frames=DIR", metavar="DIR", rich_help_panel=INPUTS
        ),
    ] = None,
    strips: Annotated[
        Path | None,
        typer.Option(
            help="geometry of strips, as --set survey.strips.geometry=F", metavar="F", rich_help_panel=INPUTS
        ),
    ] = None,
    aoi: Aoi = None,
    align_to: AlignTo = None,
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
    help_all: HelpAll = False,
) -> None:
    """Run a recipe: a YAML file of stages and their parameters."""
    from dataclasses import replace

    from geomosaic.pipeline.named import recipe_path
    from geomosaic.pipeline.params import file_values
    from geomosaic.pipeline.recipe import load_recipe
    from geomosaic.pipeline.registry import installed

    file = recipe_path(recipe)
    if input is not None and input.suffix in (".yaml", ".yml"):
        strips = strips or input
    else:
        frames = frames or input
    inputs = {
        "survey.read.frames": frames,
        "survey.strips.geometry": strips,
        "mosaic.seams.aoi": aoi,
        "mosaic.seams.align_to": align_to,
    }
    overrides = [*(f"{name}={path}" for name, path in inputs.items() if path is not None), *(set or ())]
    checked = load_recipe(file, installed(), overrides)
    if strict:
        able = [step.stage.id for step in checked.steps if "strict" in step.stage.Params.model_fields]
        overrides += [f"{id}.strict=true" for id in able]
        checked = load_recipe(file, installed(), overrides)
    if align_to is not None:
        (read,) = (step.params.model_dump() for step in checked.steps if step.stage.id == "survey.read")
        overrides.append(f"survey.read.crs={_crs_of(align_to, read['crs'])}")
        checked = load_recipe(file, installed(), overrides)
    if seed is not None:
        checked = replace(checked, seed=seed)
    if output is None:
        named = [path for step in checked.steps for path in file_values(step.params).values()]
        output = beside(input or (named or [file])[0], file.stem.replace("_", "-"))
    prepare([step.stage.id for step in checked.steps], workers, dask)
    recorded = record_options(record, private, private_places, live)
    how: dict[str, Any] = {
        "strict": strict,
        "dry_run": dry_run,
        "as_json": as_json,
        "quiet": quiet,
        "record": recorded,
    }
    execute(checked, output, workers, dask, fixed_time, overwrite, **how)


def _crs_of(align_to: Path, asked: str) -> str:
    """The CRS of a raster, or the one that was asked for if it is the same; else `InputError`."""
    from geomosaic.mosaic.alignment import read_alignment

    alignment = read_alignment(align_to)
    if asked == "auto":
        return alignment.crs
    alignment.check_crs(asked)
    return asked


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


def prepare(stages: Iterable[str], workers: int | None, dask: str | None) -> None:
    """Has workers made ready, if there are to be some on this machine, while the recipe is read."""
    from geomosaic.pipeline.announced import modules_of
    from geomosaic.pipeline.executor import prepare_workers

    if dask is None and (workers or cores()) > 1:
        prepare_workers(modules_of(stages))
