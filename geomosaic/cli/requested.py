"""Commands made from requests: one option a field, then the run with its progress and its last lines."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, Field, dataclass, field, fields
from typing import Annotated, Any

import typer

from geomosaic.cli.running import execute
from geomosaic.errors import GeomosaicError
from geomosaic.requests.naming import named_as_typed
from geomosaic.requests.option import RARE, RUNNING, Option, asked, flag_of, kinds_of, option_of
from geomosaic.requests.run_request import RunRequest


@dataclass(frozen=True)
class Terminal:
    """Options of the command line that are no part of a request."""

    dry_run: bool = asked(
        Option(
            "report what the run would do and its size, memory, disk and time; write nothing", None, RUNNING
        ),
        False,
    )
    as_json: bool = asked(
        Option("with --dry-run: print its figures as JSON", None, RARE, flags=("--json",)), False
    )
    quiet: bool = asked(Option("print nothing but errors", None, RUNNING, flags=("-q", "--quiet")), False)


@dataclass(frozen=True)
class RequestCommand:
    """A command that fills a request. complete: what a shell proposes, by argument; plans: whether it has
    `--dry-run`; before: what is done with the request, and `quiet`, before the run."""

    request: type[RunRequest]
    name: str
    help: str
    complete: Mapping[str, Callable[..., Any]] = field(default_factory=dict)
    plans: bool = True
    before: Callable[..., None] | None = None

    def function(self, naming: bool = False) -> Callable[..., None]:
        """A function that Typer turns into the command. naming: whether its help names the methods to choose
        from."""
        shown = [its for its in fields(Terminal) if self.plans or its.name == "quiet"]

        def command(**options: Any) -> None:
            how = {its.name: options.pop(its.name) for its in shown}
            options["set"] = options["set"] or ()
            with named_as_typed(self.request, options):
                request = self.request(**options)
                if self.before is not None and not how.get("dry_run"):
                    self.before(request, quiet=how["quiet"])
                execute(request.job(), **how)

        kinds, complete = {**kinds_of(self.request), **kinds_of(Terminal)}, self.complete
        own = sorted(fields(self.request), key=lambda its: bool(option_of(its).heading))
        parameters = [
            _parameter(its, kinds[its.name], complete.get(its.name), naming) for its in (*own, *shown)
        ]
        command.__name__ = command.__qualname__ = self.name
        command.__doc__ = self.help
        return typed(command, parameters)


def typed(command: Callable[..., Any], parameters: Sequence[inspect.Parameter]) -> Callable[..., Any]:
    """The function with the parameters that Typer reads."""
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {p.name: p.annotation for p in parameters}
    return command


def typer_option(request: type, name: str) -> Any:
    """The option of a request's field as Typer takes it, for a command that is no request."""
    (its,) = (its for its in fields(request) if its.name == name)
    return _declared(its, kinds_of(request)[name], None, False)


def _parameter(
    its: Field[Any], kind: Any, complete: Callable[..., Any] | None, naming: bool
) -> inspect.Parameter:
    default = inspect.Parameter.empty if its.default is MISSING else its.default
    declared = _declared(its, kind, complete, naming)
    if its.name == "set":
        kind, default = list[str] | None, None
    keyword = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(its.name, keyword, default=default, annotation=Annotated[kind, declared])


def _declared(its: Field[Any], kind: Any, complete: Callable[..., Any] | None, naming: bool) -> Any:
    option = option_of(its)
    help = _methods(option.sets) if naming and option.methods else option.help
    how: dict[str, Any] = {"help": help or option.help, "metavar": option.metavar}
    if not option.heading:
        return typer.Argument(**how, autocompletion=complete)
    how |= {"rich_help_panel": option.heading, "min": option.least, "max": option.most}
    if option.parse is not None:
        how["parser"] = typer_parser(option.parse)
    if its.default is None:
        how["show_default"] = False
    flags = option.flags or ((flag_of(its),) if kind is bool or its.name == "set" else ())
    return typer.Option(*flags, **how)


def typer_parser(parse: Callable[[str], Any]) -> Callable[[str], Any]:
    """As Typer takes it: what is wrong with a text is a `BadParameter`."""

    def parser(text: str) -> Any:
        try:
            return parse(text)
        except ValueError as error:
            raise typer.BadParameter(str(error)) from error

    return parser


def _methods(sets: str) -> str:
    """What a stage says of a parameter and its choices; nothing of a broken stage, which says so when run."""
    from geomosaic.pipeline.params import describe_params
    from geomosaic.pipeline.registry import installed

    id, _, name = sets.rpartition(".")
    with suppress(GeomosaicError):
        (found,) = (p for p in describe_params(installed().get(id).Params) if p.name == name)
        return f"{found.help}: {', '.join(found.choices)} [{found.default}]"
    return ""
