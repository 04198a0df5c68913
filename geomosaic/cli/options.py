"""Options that commands share which are no requests."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import MISSING, fields
from typing import Annotated, Any, TypeVar, get_type_hints

import typer

from geomosaic.cli.requested import Terminal, typed, typer_option, typer_parser
from geomosaic.requests.option import folder_given
from geomosaic.requests.run_request import RunRequest

Options = TypeVar("Options")
Sets = Annotated[list[str] | None, typer_option(RunRequest, "set")]
Workers = Annotated[int | None, typer_option(RunRequest, "workers")]
Overwrite = Annotated[bool, typer_option(RunRequest, "overwrite")]
Quiet = Annotated[bool, typer_option(Terminal, "quiet")]
AsJson = Annotated[bool, typer.Option("--json", help="print JSON")]
Port = Annotated[
    int, typer.Option(help="port on this machine; 0 is any free one", metavar="N", min=0, max=65535)
]


def output_option(help: str, metavar: str = "FOLDER") -> Any:
    """`-o`: the folder to write to."""
    parser = typer_parser(folder_given)
    return typer.Option("-o", "--output", help=help, metavar=metavar, parser=parser)


def with_options(options: type[Options]) -> Callable[[Callable[[Options], None]], Callable[..., None]]:
    """Makes a command of a function that takes its options as one dataclass of annotated fields."""
    hints = get_type_hints(options, include_extras=True)
    keyword, required = inspect.Parameter.KEYWORD_ONLY, inspect.Parameter.empty
    parameters = [
        inspect.Parameter(
            its.name,
            keyword,
            default=required if its.default is MISSING else its.default,
            annotation=hints[its.name],
        )
        for its in fields(options)  # type: ignore[arg-type]
    ]

    def decorated(function: Callable[[Options], None]) -> Callable[..., None]:
        @functools.wraps(function)
        def command(**given: Any) -> None:
            function(options(**given))

        return typed(command, parameters)

    return decorated
