"""`geomosaic mosaic` and `geomosaic run`: from frames, or from a recipe, to a run folder."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from geomosaic.cli.options import Dask, FixedTime, Overwrite, RunFolder, Seed, Sets, Workers, cores
from geomosaic.errors import GeomosaicError

if TYPE_CHECKING:
    from geomosaic.pipeline.given import Given
    from geomosaic.pipeline.recipe import Recipe

STAGES = (
    "survey.read",
    "projection.ground",
    "placement.pos",
    "mosaic.estimate",
    "matching.sift",
    "adjustment.solve",
    "adjustment.rig",
    "mosaic.tones",
    "mosaic.seams",
    "mosaic.compose",
    "quality.verdict",
    "export.cog",
    "export.layers",
    "quality.compare",
    "export.report",
)
"""What `geomosaic mosaic` does; quality.compare only against a reference."""

RESULTS = {
    "mosaic": "mosaic.tif",
    "layers": "layers.gpkg",
    "positions": "positions.csv",
    "offsets": "offsets.csv",
    "report": "report.html",
    "recording": "run.mcap",
}

Adjust = Annotated[
    str | None,
    typer.Option(metavar="METHOD", help="adjustment method; 'geomosaic stages adjustment.solve' lists them"),
]


def name_methods() -> None:
    """Puts the adjustment methods into the help, as the stage declares them."""
    from geomosaic.pipeline.params import describe_params
    from geomosaic.pipeline.registry import installed

    with suppress(GeomosaicError):
        (method,) = (
            p for p in describe_params(installed().get("adjustment.solve").Params) if p.name == "method"
        )
        get_args(Adjust)[1].help = f"{method.help}: {', '.join(method.choices)} [{method.default}]"


def mosaic(
    frames: Annotated[Path, typer.Argument(help="folder of frames (JPEG or TIFF)", metavar="FRAMES_DIR")],
    output: RunFolder,
    pos: Annotated[
        Path | None, typer.Option(help="positions and attitudes: CSV, geo.txt", metavar="F")
    ] = None,
    camera: Annotated[
        Path | None, typer.Option(help="interior orientation: cameras.json, YAML", metavar="F")
    ] = None,
    dem: Annotated[
        Path | None, typer.Option(help="elevation model: GeoTIFF and other local rasters", metavar="F")
    ] = None,
    dem_offset: Annotated[
        float | None, typer.Option(help="what to add to the DEM to have ellipsoidal heights", metavar="M")
    ] = None,
    pos_crs: Annotated[
        str | None, typer.Option(help="CRS of x and y in the POS file", metavar="EPSG:n")
    ] = None,
    ground_height: Annotated[
        float | None, typer.Option(help="ellipsoidal height of flat ground [by the frames]", metavar="M")
    ] = None,
    gcp: Annotated[Path | None, typer.Option(help="control and check points", metavar="F")] = None,
    damaged: Annotated[
        str | None,
        typer.Option(help="damaged frames: leave_out, or mask the damage [leave_out]", metavar="HOW"),
    ] = None,
    crs: Annotated[str, typer.Option(help="map CRS of the mosaic: auto (UTM) or EPSG:n")] = "auto",
    gsd: Annotated[str, typer.Option(help="the mosaic's pixel: auto or metres", metavar="auto|M")] = "auto",
    adjust: Adjust = None,
    reference: Annotated[
        Path | None, typer.Option(help="true ortho or satellite picture to compare with", metavar="TIF")
    ] = None,
    set: Sets = None,
    workers: Workers = None,
    dask: Dask = None,
    fixed_time: FixedTime = False,
    seed: Seed = None,
    overwrite: Overwrite = False,
) -> None:
    """Make one map-true mosaic of a folder of aerial frames."""
    from geomosaic.pipeline.recipe import recipe_from
    from geomosaic.pipeline.registry import installed

    given: dict[str, dict[str, Any]] = {
        "survey.read": {
            "frames": frames,
            "pos": pos,
            "camera": camera,
            "dem": dem,
            "dem_offset_m": dem_offset,
            "gcp": gcp,
            "crs": crs,
            "pos_crs": pos_crs,
            "damaged": damaged,
        },
        "projection.ground": {"height_m": ground_height},
        "adjustment.solve": {"method": adjust},
        "mosaic.seams": {"gsd_m": gsd},
        "quality.compare": {"reference": reference},
    }
    stages = [
        {"stage": id, "params": {k: v for k, v in given.get(id, {}).items() if v is not None}}
        for id in STAGES
        if id != "quality.compare" or reference is not None
    ]
    plain = {"name": "mosaic", "description": f"frames of {frames.name}", "seed": seed or 0, "stages": stages}
    recipe = recipe_from(plain, installed(), set or ())
    execute(recipe, output, workers, dask, fixed_time, overwrite)


def run(
    recipe: Annotated[Path, typer.Argument(help="a recipe in YAML", metavar="RECIPE.yaml")],
    output: RunFolder,
    frames: Annotated[
        Path | None,
        typer.Option(help="folder of frames: short for --set survey.read.frames=DIR", metavar="DIR"),
    ] = None,
    strips: Annotated[
        Path | None,
        typer.Option(help="geometry of strips: short for --set survey.strips.geometry=F", metavar="F"),
    ] = None,
    set: Sets = None,
    workers: Workers = None,
    dask: Dask = None,
    fixed_time: FixedTime = False,
    seed: Seed = None,
    overwrite: Overwrite = False,
) -> None:
    """Run a recipe."""
    from dataclasses import replace

    from geomosaic.pipeline.recipe import load_recipe
    from geomosaic.pipeline.registry import installed

    inputs = {"survey.read.frames": frames, "survey.strips.geometry": strips}
    overrides = [*(f"{name}={path}" for name, path in inputs.items() if path is not None), *(set or ())]
    checked = load_recipe(recipe, installed(), overrides)
    if seed is not None:
        checked = replace(checked, seed=seed)
    execute(checked, output, workers, dask, fixed_time, overwrite)


def execute(
    recipe: Recipe,
    output: Path,
    workers: int | None,
    dask: str | None,
    fixed_time: bool,
    overwrite: bool = False,
    given: Mapping[int, Given] | None = None,
) -> None:
    """Runs a checked recipe with progress on stderr, and says on stdout where the results lie."""
    from geomosaic.cli.progress import progress
    from geomosaic.pipeline.runner import run

    with progress() as reporter:
        summary = run(
            recipe,
            output,
            overwrite=overwrite,
            workers=workers or cores(),
            dask=dask,
            fixed_time=fixed_time,
            given=given,
            reporter=reporter,
        )
    verdict = summary.get("verdict")
    if isinstance(verdict, dict):
        why = f" {verdict['cause']};" if verdict["cause"] else ""
        print(f"{'verdict':<10} {verdict['grade']}:{why} {verdict['text']}")
        if verdict["mend"]:
            print(f"{'mend':<10} {verdict['mend']}")
    for name, file in RESULTS.items():
        if (output / file).exists():
            print(f"{name:<10} {output / file}")
    frames = summary.get("frames")
    if isinstance(frames, dict):
        print("frames     " + ", ".join(f"{count} {name}" for name, count in frames.items()))
    for line in _figures(summary["metrics"]):
        print(line)
    if summary["warnings"]:
        print(f"warnings   {len(summary['warnings'])}, see above and run.json")


def _figures(metrics: Mapping[str, Any]) -> list[str]:
    """How well the frames agree and how true the map is, as far as it was measured."""
    lines = []
    reprojection_px = metrics.get("adjustment", {}).get("reprojection_mean_px")
    if reprojection_px is not None:
        lines.append(f"agreement  {reprojection_px:.2f} px mean reprojection error")
    quality = metrics.get("quality", {})
    rmse_m, ce90_m = quality.get("absolute_rmse_m"), quality.get("ce90_m")
    if rmse_m is not None and ce90_m is not None:
        lines.append(
            f"accuracy   {rmse_m:.3g} m RMSE, 90 % within {ce90_m:.3g} m, "
            f"at {quality['measured']} places of the reference"
        )
    return lines
