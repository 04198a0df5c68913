"""`geomosaic recipes`: those that come with it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from geomosaic.errors import UnknownNameError


def recipes(
    name: Annotated[str | None, typer.Argument(help="a recipe's name", metavar="NAME")] = None,
    makefile: Annotated[
        bool, typer.Option("--makefile", help="print the path of survey.mk, which a Makefile can include")
    ] = False,
) -> None:
    """List the recipes that come with geomosaic, or print one.

    A printed recipe can be saved, changed and run as a file.
    """
    from geomosaic.doors.plain import read_yaml
    from geomosaic.pipeline.recipe_names import FOLDER, MAKEFILE, recipe_names, recipe_path

    if makefile:
        print(MAKEFILE)
        return
    if name is not None:
        path = recipe_path(name)
        if path.parent != FOLDER:
            raise UnknownNameError("recipe", name, recipe_names())
        print(path.read_text(encoding="utf-8"), end="")
        return
    names = recipe_names()
    width = max(map(len, names))
    for known in names:
        plain = read_yaml(recipe_path(known), 1 << 20, "a recipe", "install geomosaic again")
        print(f"{known:<{width}}  {plain['description']}")


def completed(incomplete: str) -> list[str]:
    """Names of recipes, and recipe files, that begin so."""
    from geomosaic.pipeline.recipe_names import recipe_names

    folder = Path(incomplete).parent if "/" in incomplete else Path()
    there = folder.glob("*") if folder.is_dir() else ()
    files = [str(folder / p.name) + ("/" if p.is_dir() else "") for p in there]
    known = [*recipe_names(), *(f for f in files if f.endswith((".yaml", ".yml", "/")))]
    return [name for name in known if name.startswith(incomplete)]
