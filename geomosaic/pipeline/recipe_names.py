"""Recipes that come with geomosaic are known by name."""

from __future__ import annotations

from pathlib import Path

from geomosaic.errors import UnknownNameError

FOLDER = Path(__file__).parents[1] / "recipes"
MAKEFILE = FOLDER / "survey.mk"
"""Rules from a folder of frames to every product, to be included by people's own Makefiles."""


def recipe_names() -> list[str]:
    """The names, as people write them: `quick-look`."""
    return sorted(path.stem.replace("_", "-") for path in FOLDER.glob("*.yaml"))


def recipe_path(text: str) -> Path:
    """The file of a recipe that is named, or the path that was given.

    Raises: `UnknownNameError` for what is neither a name nor looks like a path.
    """
    path = Path(text)
    if path.suffix or path.exists() or len(path.parts) > 1:
        return path
    name = text.replace("_", "-")
    if name not in recipe_names():
        raise UnknownNameError("recipe", text, recipe_names())
    return FOLDER / f"{name.replace('-', '_')}.yaml"
