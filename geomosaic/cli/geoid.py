"""`geomosaic geoid fetch`: geoid grids for heights above the sea."""

from __future__ import annotations

from typing import Annotated

import typer

from geomosaic.cli.help import HeadedCommand, HeadedGroup
from geomosaic.errors import InputError

geoid = typer.Typer(
    cls=HeadedGroup,
    help="Geoid models for heights above the sea.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@geoid.callback()
def _group() -> None:
    """Keeps the name of the only command."""


@geoid.command(cls=HeadedCommand)
def fetch(
    name: Annotated[
        str,
        typer.Argument(
            help="EGM96, EGM2008, a vertical CRS such as EPSG:7837, or a grid's file name", metavar="NAME"
        ),
    ],
    source: Annotated[
        str | None,
        typer.Option(
            "--from",
            help="the grid's file, or a folder or mirror (https://) of PROJ's collection that holds it "
            "[https://cdn.proj.org/]",
            metavar="FILE_OR_URL",
        ),
    ] = None,
) -> None:
    """Install the geoid model that a height datum needs.

    It goes into PROJ's data folder of the user. EGM96 works without: the package has it at 15 minutes of arc.
    """
    from geomosaic.pipeline.geoid_fetching import COLLECTION, fetch_grid, grid_names

    names = grid_names(name)
    if not names:
        print(f"installed  {name} is there already")
    for grid in names:
        try:
            path = fetch_grid(grid, source or COLLECTION, lambda: False)
        except InputError as error:
            if source is not None:
                raise
            fix = f"download it elsewhere and give it: geomosaic geoid fetch {grid} --from FILE"
            raise InputError(error.problem, file=f"{COLLECTION}{grid}", fix=fix) from error
        print(f"installed  {path}")
