"""The commands. What is heavy is imported inside them."""

from __future__ import annotations

from collections.abc import Sequence

import typer

from geomosaic import __version__
from geomosaic.cli import recordings
from geomosaic.cli.doctor import doctor
from geomosaic.cli.fetch import fetch
from geomosaic.cli.measure import measure
from geomosaic.cli.misplacement import misplacement
from geomosaic.cli.mosaic import mosaic, name_methods, run
from geomosaic.cli.qgis_script import qgis_script
from geomosaic.cli.recipes import recipes
from geomosaic.cli.single import add_stage_commands, evaluate
from geomosaic.cli.stages import stages
from geomosaic.cli.strips import name_strip_methods, strips

_GENERATED = {
    "simulate": "Simulate surveys with known truth.",
    "export": "Export a finished run in another form; 'geomosaic export RUN' lists what suits it.",
}


def _version(asked: bool) -> None:
    if asked:
        print(f"geomosaic {__version__}")
        raise typer.Exit


def build_app(argv: Sequence[str] = ()) -> typer.Typer:
    """The application. The commands of a group made from stages are made only if `argv` asks for it."""
    app = typer.Typer(
        name="geomosaic",
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
        """Overlapping images of the ground in, one map-true mosaic out."""

    asks = bool({"-h", "--help"} & {*argv})
    if argv[:1] == ["mosaic"] and asks:
        name_methods()
    if argv[:1] == ["strips"] and asks:
        name_strip_methods()
    for command in (
        mosaic,
        strips,
        run,
        recipes,
        fetch,
        stages,
        evaluate,
        measure,
        misplacement,
        doctor,
        qgis_script,
    ):
        app.command()(command)
    app.registered_commands += recordings.app.registered_commands
    for group, help in _GENERATED.items():
        part = typer.Typer(help=help, no_args_is_help=True, rich_markup_mode=None)
        part.callback()(lambda: None)
        if argv[:1] == [group]:
            add_stage_commands(part, group, argv[1] if len(argv) > 1 else None)
        app.add_typer(part, name=group)
    return app
