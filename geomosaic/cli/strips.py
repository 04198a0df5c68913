"""`geomosaic strips`: from the strips of staggered CCDs to one scene."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from geomosaic.cli.help import ACCURACY, OUTPUT
from geomosaic.cli.mosaic import recipe_of
from geomosaic.cli.options import (
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
    Workers,
    beside,
    name_choices,
    record_options,
)
from geomosaic.cli.running import execute

STAGES = (
    "survey.strips",
    "mosaic.estimate_strips",
    "ccd.offsets",
    "ccd.radiometry",
    "mosaic.strips",
    "quality.strips",
    "export.cog",
    "export.map",
    "export.offsets",
    "export.strip_layers",
    "export.project",
    "export.strip_report",
)
"""What `geomosaic strips` does, `export.map` where it is asked for."""

Method = Annotated[
    str | None,
    typer.Option(
        metavar="METHOD",
        help="how offsets are estimated; 'geomosaic stages ccd.offsets' lists the methods",
        rich_help_panel=ACCURACY,
    ),
]


def name_strip_methods() -> None:
    """Puts the methods into the help."""
    name_choices(Method, "ccd.offsets", "method")


def strips(
    geometry: Annotated[
        Path, typer.Argument(help="YAML file of the focal plane and its strips", metavar="GEOMETRY.yaml")
    ],
    output: RunFolderBeside = None,
    method: Method = None,
    map: Annotated[
        bool,
        typer.Option(
            "--map",
            help="also write mosaic_map.tif, the scene in map coordinates on the geometry's DEM",
            rich_help_panel=OUTPUT,
        ),
    ] = False,
    set: Sets = None,
    workers: Workers = None,
    fixed_time: FixedTime = False,
    seed: Seed = None,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
    as_json: PlanJson = False,
    quiet: Quiet = False,
    record: Record = "normal",
    private: Private = False,
    private_places: PrivatePlaces = False,
    live: Live = False,
) -> None:
    """Make one scene of the strips of a satellite's CCDs."""
    given: dict[str, dict[str, Any]] = {
        "survey.strips": {"geometry": geometry},
        "ccd.offsets": {"method": method},
    }
    stages = [id for id in STAGES if map or id != "export.map"]
    recipe = recipe_of("strips", f"strips of {geometry.name}", stages, given, seed, set)
    output = output or beside(geometry, "scene")
    recorded = record_options(record, private, private_places, live)
    how: dict[str, Any] = {"dry_run": dry_run, "as_json": as_json, "quiet": quiet, "record": recorded}
    execute(recipe, output, workers, None, fixed_time, overwrite, **how)
