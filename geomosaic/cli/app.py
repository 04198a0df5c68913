"""The commands. What is heavy is imported inside them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import typer

from geomosaic import __version__
from geomosaic.cli.compare import compare
from geomosaic.cli.control import control
from geomosaic.cli.doctor import doctor
from geomosaic.cli.fetch import fetch
from geomosaic.cli.frames import frames
from geomosaic.cli.geoid import geoid
from geomosaic.cli.help import HeadedCommand, HeadedGroup, with_help_all
from geomosaic.cli.inspection import diff, inspect
from geomosaic.cli.measure import measure
from geomosaic.cli.misplacement import misplacement
from geomosaic.cli.open import open as open_run
from geomosaic.cli.push import push
from geomosaic.cli.qgis_script import qgis_script
from geomosaic.cli.recipes import completed, recipes
from geomosaic.cli.recordings import view
from geomosaic.cli.requested import RequestCommand
from geomosaic.cli.single import add_stage_commands, evaluate
from geomosaic.cli.stages import stages
from geomosaic.cli.watch import until_all_have_come
from geomosaic.requests.mosaic_request import MosaicRequest
from geomosaic.requests.recipe_request import RecipeRequest
from geomosaic.requests.replay_request import ReplayRequest
from geomosaic.requests.strips_request import StripsRequest
from geomosaic.requests.watch_request import WatchRequest

_MOSAIC = RequestCommand(MosaicRequest, "mosaic", "Make one map-true mosaic of a folder of aerial frames.")
_WATCH = RequestCommand(
    WatchRequest,
    "watch",
    """Make a mosaic while frames are still being copied.

    Frames are matched as they arrive, and RUN/preview.html shows them on the map. The whole run begins once
    none has come for some time; its result is that of 'geomosaic mosaic'.
    """,
    before=until_all_have_come,
)
_STRIPS = RequestCommand(StripsRequest, "strips", "Make one scene of the strips of a satellite's CCDs.")
_RUN = RequestCommand(
    RecipeRequest, "run", "Run a recipe: a YAML file of stages and their parameters.", {"name": completed}
)
_REPLAY = RequestCommand(
    ReplayRequest,
    "replay",
    """Run a recorded recipe again from any stage on.

    Results of earlier stages are taken from the recording. Stages that read pixels need the frames in their
    old folder or in --frames. From the adjustment on, recorded thumbnails replace missing frames. Trust a
    recording as you would a recipe: it names the files to read.
    """,
    plans=False,
)

_COMMANDS: Mapping[str, Sequence[RequestCommand | Callable[..., Any]]] = {
    "Make a mosaic": (_MOSAIC, _WATCH, _STRIPS, _RUN),
    "Before a run": (fetch, frames, control, recipes, stages),
    "After a run": (open_run, inspect, view, measure, compare, push, evaluate, _REPLAY, diff, misplacement),
    "Installation and simulation": (doctor, qgis_script),
}
"""Commands by their heading in the help, in the order of work."""

_GENERATED = {
    "export": (
        "After a run",
        "Export a finished run in another form.\n\n'geomosaic export RUN' lists what suits it.",
    ),
    "simulate": ("Installation and simulation", "Simulate surveys with known truth."),
}
"""Groups made from stages: heading and help."""


def _version(asked: bool) -> None:
    if asked:
        print(f"geomosaic {__version__}")
        raise typer.Exit


def _name(command: RequestCommand | Callable[..., Any]) -> str:
    """As it's typed."""
    named = command.name if isinstance(command, RequestCommand) else command.__name__
    return named.replace("_", "-")


def _function(
    command: RequestCommand | Callable[..., Any], helping: bool, argv: Sequence[str]
) -> Callable[..., Any]:
    """As Typer takes it. helping: whether help is asked for."""
    if not isinstance(command, RequestCommand):
        return command
    function = command.function(naming=helping and argv[:1] == [command.name])
    return with_help_all(function) if command.plans else function


def build_app(argv: Sequence[str] = ()) -> typer.Typer:
    """The application; of its commands the one that `argv` asks for, and all where it names none."""
    app = typer.Typer(
        name="geomosaic",
        cls=HeadedGroup,
        epilog="Start with: geomosaic mosaic FOLDER. For options: geomosaic COMMAND --help",
        no_args_is_help=True,
        context_settings={"help_option_names": ["-h", "--help"]},
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )

    @app.callback()
    def geomosaic(
        version: bool = typer.Option(
            False, "--version", callback=_version, is_eager=True, help="print the version"
        ),
    ) -> None:
        """Make one map-true mosaic (orthomosaic) of overlapping aerial frames."""

    helping = bool({"-h", "--help", "--help-all"} & {*argv})
    named = {_name(command): (heading, command) for heading, all in _COMMANDS.items() for command in all}
    asked = {*argv[:1]} & named.keys()
    for heading, command in (named[name] for name in asked or named):
        app.command(cls=HeadedCommand, rich_help_panel=heading)(_function(command, helping, argv))
    app.add_typer(geoid, name="geoid", rich_help_panel="Before a run")
    for group, (heading, help) in _GENERATED.items():
        part = typer.Typer(cls=HeadedGroup, help=help, no_args_is_help=True, rich_markup_mode=None)
        part.callback()(lambda: None)
        if argv[:1] == [group]:
            add_stage_commands(part, group, argv[1] if len(argv) > 1 else None)
        app.add_typer(part, name=group, rich_help_panel=heading)
    return app
