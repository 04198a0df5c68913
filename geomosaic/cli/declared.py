"""Command-line options made from a stage's declared parameters."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from geomosaic.cli.requested import typed
from geomosaic.pipeline.params import ParamDescription, describe_params
from geomosaic.pipeline.recipe import Recipe, unwired_recipe
from geomosaic.pipeline.stage import Stage


def help_line(p: ParamDescription) -> str:
    """Help, values with unit and bounds, and the default: `Flying height (number in m, at least 1) [80]`."""
    default = "required" if p.required else "none" if p.default is None else shown(p.default)
    return f"{p.help} ({p.wanted}) [{default}]"


def shown(value: Any) -> str:
    """A default as one would write it on the command line."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def option_values(stage: type[Stage], options: Mapping[str, Any]) -> dict[str, Any]:
    """What the user gave of a stage's parameters, as the recipe reader takes it."""
    from geomosaic.doors.plain import plain_yaml

    values = {}
    given = {stage.Params.FORMERLY.get(k, k): v for k, v in options.items() if v is not None}
    for p in describe_params(stage.Params):
        value = given.get(p.name)
        if value is not None:
            textual = p.is_file or p.type.startswith("text") or p.choices
            values[p.name] = (
                value
                if textual or isinstance(value, bool)
                else plain_yaml(value, f"--{p.name.replace('_', '-')}", f"give {p.wanted}")
            )
    return values


def command_of(
    stage: type[Stage],
    place: tuple[str, str],
    run: Callable[..., int | None],
    more: Mapping[str, Any],
    headings: Mapping[str, str],
) -> Callable[..., int | None]:
    """A function that Typer turns into a command: `place` (name, help), one option a parameter, and `more`.

    `run` is called with the folder and everything else by name. `more` gives the annotation and the
    default of further options, `headings` the heading in the help by parameter.
    """
    name, help = place
    keyword = inspect.Parameter.KEYWORD_ONLY
    argument = typer.Argument(help=help, metavar=name.upper())
    parameters = [inspect.Parameter(name, keyword, annotation=Annotated[Path, argument])]
    declared = describe_params(stage.Params)
    present = {p.name: p for p in declared}
    former = [replace(present[new], name=old) for old, new in stage.Params.FORMERLY.items()]
    for p in [*declared, *former]:
        flag = f"--{p.name.replace('_', '-')}"
        how: dict[str, Any] = {"help": help_line(p), "show_default": False, "hidden": p in former}
        how["rich_help_panel"] = headings.get(p.name)
        if p.type == "true or false":
            kind: Any = bool | None
            option = typer.Option(f"{flag}/--no-{flag[2:]}", **how)
        else:
            kind = str | None
            option = typer.Option(flag, metavar=p.unit or "VALUE", **how)
        parameters.append(
            inspect.Parameter(p.name, keyword, default=None, annotation=Annotated[kind, option])
        )
    for key, (annotation, default) in more.items():
        parameters.append(inspect.Parameter(key, keyword, default=default, annotation=annotation))

    def command(**options: Any) -> int | None:
        return run(options.pop(name), **options)

    command.__doc__ = inspect.getdoc(stage) if stage.__doc__ else stage.display_name
    return typed(command, parameters)


def recipe_of_options(stage: type[Stage], options: Mapping[str, Any], seed: int) -> Recipe:
    """The checked recipe of one stage from command-line options."""
    from geomosaic.pipeline.registry import installed

    plain = {"stages": [{"stage": stage.id, "params": option_values(stage, options)}]}
    return replace(unwired_recipe(plain, installed()), seed=seed)
