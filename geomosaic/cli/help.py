"""Help for people: commands and options under headings, rare options only with `--help-all`."""

from __future__ import annotations

import inspect
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from typer.core import TyperCommand, TyperGroup

from geomosaic.errors import FileError, InputError, UnknownNameError
from geomosaic.requests.option import ACCURACY, INPUTS, OUTPUT, RARE, RUNNING, SURFACE

_ORDER: Final = (INPUTS, SURFACE, ACCURACY, OUTPUT, RUNNING, RARE, "Help")
_ALL: Final = "geomosaic.help_all"


def _show_all(context: typer.Context, asked: bool) -> None:
    if asked and not context.resilient_parsing:
        context.meta[_ALL] = True
        print(context.get_help())
        raise typer.Exit


_HelpAll = Annotated[
    bool,
    typer.Option(
        "--help-all", callback=_show_all, is_eager=True, help="Show all options, also rarely needed ones."
    ),
]


def with_help_all(command: Callable[..., Any]) -> Callable[..., Any]:
    """The function as Typer takes it, with `--help-all` as its last option; from Python it takes no such
    option."""
    signature = inspect.signature(command, eval_str=True)

    @wraps(command)
    def headed(*, help_all: bool, **options: Any) -> Any:
        return command(**options)

    keyword = inspect.Parameter.KEYWORD_ONLY
    help_all = inspect.Parameter("help_all", keyword, default=False, annotation=_HelpAll)
    parameters = [*signature.parameters.values(), help_all]
    headed.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    headed.__annotations__ = {p.name: p.annotation for p in parameters}
    return headed


class HeadedCommand(TyperCommand):
    """A command whose options stand below the headings that they name as `rich_help_panel`, if it has
    `--help-all`; else in one list."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Raises: `InputError` for an option that takes one value and is given twice."""
        if not ctx.resilient_parsing:
            _check_once(self.make_parser(ctx).parse_args(args=list(args))[2])
        return super().parse_args(ctx, args)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Writes the sections in the order of `_ORDER`, headings of the command's own before them."""
        sections: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if parameter.param_type_name == "argument":
                heading = "Arguments"
            else:
                heading = (_heading(parameter) or "Help") if self._rare() else "Options"
            if record is not None and (not heading.startswith(RARE) or ctx.meta.get(_ALL)):
                sections.setdefault(heading, []).append(_plain(*record))
        _write(formatter, dict(sorted(sections.items(), key=lambda section: _rank(section[0]))))

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Writes how to see the options that are left out."""
        if self._rare() and not ctx.meta.get(_ALL):
            formatter.write_paragraph()
            formatter.write(f"For {self._rare()} rarely needed options: {ctx.command_path} --help-all\n")

    def _rare(self) -> int:
        """How many options only `--help-all` shows; 0 without `--help-all`."""
        if not any(parameter.name == "help_all" for parameter in self.params):
            return 0
        return sum(_heading(parameter).startswith(RARE) for parameter in self.params)


class HeadedGroup(TyperGroup):
    """A group whose commands stand below the headings that they name as `rich_help_panel`."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Writes the commands, each with its first sentence in full, and then the group's own options."""
        sections: dict[str, list[tuple[str, str]]] = {}
        for name, command in self.commands.items():
            if not command.hidden:
                short = command.get_short_help_str(limit=1000)
                sections.setdefault(_heading(command) or "Commands", []).append((name, short))
        _write(formatter, sections)
        records = [parameter.get_help_record(ctx) for parameter in self.get_params(ctx)]
        _write(formatter, {"Options": [record for record in records if record is not None]})

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command of the first argument. Raises `InputError` with the command to type for a path,
        `UnknownNameError` for another name."""
        if args[0] not in self.commands and not args[0].startswith("-") and not ctx.resilient_parsing:
            if ctx.parent is None:
                _propose(args)
            raise UnknownNameError("command", args[0], self.commands)
        return super().resolve_command(ctx, args)


def _check_once(given: Sequence[Any]) -> None:
    """Raises: `InputError` for the first option that stands twice among the given parameters and takes one
    value: the parser would take the last."""
    for number, option in enumerate(given):
        many = option.param_type_name == "argument" or option.multiple or option.is_flag
        if not many and option in given[:number]:
            flag = max(option.opts, key=len)
            join = ", or join both files" if option.metavar == "FILE" else ""
            raise InputError(f"{flag} is given twice and takes one value", fix=f"give {flag} once{join}")


def _heading(declared: Any) -> str:
    """The heading that an option or a command names, or ''."""
    return getattr(declared, "rich_help_panel", None) or ""


def _plain(name: str, text: str) -> tuple[str, str]:
    """An option's name and help without types and bounds, and a default as `[auto]`: Typer writes
    `[default: auto; x>=0]`."""
    name = re.sub(r" <[^>]+>$", "", name)
    added = re.search(r"  \[([^][]*)\]$", text)
    if added is None:
        return name, text
    parts = [part for part in added[1].split("; ") if not re.search(r"x[<>]|[<>]=?x", part)]
    return name, text[: added.start()] + "".join(f" [{part.removeprefix('default: ')}]" for part in parts)


def _rank(heading: str) -> int:
    kind = heading.partition(":")[0]
    return _ORDER.index(kind) if kind in _ORDER else -1


def _write(formatter: Any, sections: Mapping[str, Sequence[tuple[str, str]]]) -> None:
    """Sections whose second columns begin at the same place."""
    width = min(30, max((len(name) for rows in sections.values() for name, _ in rows), default=0))
    for heading, rows in sections.items():
        with formatter.section(heading):
            formatter.write_dl([(name.ljust(width), text) for name, text in rows])


def _propose(arguments: Sequence[str]) -> None:
    """Raises `InputError` with the command to type where a command's name is missing before a path."""
    from geomosaic.doors.camera_formats import camera_format
    from geomosaic.survey.header import JPEG_SUFFIXES, PNG_SUFFIXES, TIFF_SUFFIXES

    path, more = Path(arguments[0]), arguments[1:]
    if not path.exists():
        if path.name != arguments[0]:
            raise FileError(
                "no such file or folder", file=path, fix="check the path: geomosaic mosaic FOLDER"
            )
        return
    if (path / "run.json").is_file() or path.suffix == ".mcap":
        command = ["inspect", str(path), *more]
    elif path.is_file() and path.suffix in (".yaml", ".yml"):
        command = ["run", str(path), *more]
    elif path.is_dir():
        command = ["mosaic", str(path), *more]
    elif path.suffix.lower() in JPEG_SUFFIXES | TIFF_SUFFIXES | PNG_SUFFIXES or camera_format(path):
        command = ["mosaic", str(path.parent)]
    else:
        return
    kind = "folder" if path.is_dir() else "file"
    raise InputError(f"is a {kind}, not a command", file=path, fix=f"type: geomosaic {shlex.join(command)}")
