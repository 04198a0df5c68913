"""The command `geomosaic`. What is heavy is imported inside the commands."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import suppress

import typer

from geomosaic import __version__
from geomosaic.cli import recordings
from geomosaic.cli.doctor import doctor
from geomosaic.cli.misplacement import misplacement
from geomosaic.cli.mosaic import mosaic, name_methods, run
from geomosaic.cli.single import add_stage_commands, evaluate
from geomosaic.cli.stages import stages
from geomosaic.cli.stopping import Stop, stoppable
from geomosaic.cli.strips import name_strip_methods, strips
from geomosaic.errors import CancelledError, GeomosaicError
from geomosaic.pipeline.executor import ALGEBRA_THREADS

# Small matrices on few cores: OpenBLAS's second thread costs more than it brings (tenfold when busy).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

_GENERATED = {
    "simulate": "Simulate surveys with known truth.",
    "export": "Export a finished run in another form.",
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
        add_completion=False,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )

    @app.callback()
    def geomosaic(
        version: bool = typer.Option(
            False, "--version", callback=_version, is_eager=True, help="print the version"
        ),
    ) -> None:
        """Overlapping pictures of the ground in, one map-true picture out."""

    if argv[:1] == ["mosaic"] and "--help" in argv:
        name_methods()
    if argv[:1] == ["strips"] and "--help" in argv:
        name_strip_methods()
    for command in (mosaic, strips, run, stages, evaluate, misplacement, doctor):
        app.command()(command)
    app.registered_commands += recordings.app.registered_commands
    for group, help in _GENERATED.items():
        part = typer.Typer(help=help, no_args_is_help=True, rich_markup_mode=None)
        part.callback()(lambda: None)
        if argv[:1] == [group]:
            add_stage_commands(part, group, argv[1] if len(argv) > 1 else None)
        app.add_typer(part, name=group)
    return app


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command and returns the exit code; a failure is one line on stderr."""
    with stoppable() as stop:
        exit_code = _main(argv, stop)
    return exit_code if stop.signal is None else stop.exit_code


def _main(argv: Sequence[str] | None, stop: Stop) -> int:
    argv = list(sys.argv[1:] if argv is None else argv)
    for name in ALGEBRA_THREADS:  # many small systems: threads would only wait for each other
        os.environ.setdefault(name, "1")
    try:
        result = typer.main.get_command(build_app(argv))(argv, prog_name="geomosaic", standalone_mode=False)
        if sys.stdout is not None:
            sys.stdout.flush()
        return result if isinstance(result, int) else 0
    except (KeyboardInterrupt, typer.Abort):
        return _fail("stopped", CancelledError.exit_code)
    except (BrokenPipeError, SystemExit) as error:
        if isinstance(error, SystemExit) and not isinstance(error.__context__, BrokenPipeError):
            raise  # click turns a closed pipe into SystemExit
        return _unheard()
    except Exception as error:
        return _failed(error, stop)


def _failed(error: Exception, stop: Stop) -> int:
    """One line for what went wrong; a library's own word for having been stopped is none of them."""
    if stop.signal is not None:
        return _fail("stopped", stop.exit_code, error)
    if isinstance(error, GeomosaicError):
        return _fail(str(error), error.exit_code, error)
    usage = getattr(error, "format_message", None)
    if usage is not None and usage().startswith("Usage:"):
        print(usage(), file=sys.stderr)
        return 2
    if usage is not None:
        return _fail(usage(), 2)
    text = f"{type(error).__name__}: {error} (a fault of geomosaic; for details set GEOMOSAIC_TRACEBACK=1)"
    return _fail(text, 1, error)


def _fail(text: str, exit_code: int, error: Exception | None = None) -> int:
    if error is not None and os.environ.get("GEOMOSAIC_TRACEBACK") == "1":
        import traceback

        traceback.print_exception(error)
    line = "".join(c if c.isprintable() else " " for c in " ".join(text.split()))
    if sys.stderr is not None:
        with suppress(BrokenPipeError):
            print(f"geomosaic: {line}", file=sys.stderr, flush=True)
    return exit_code


def _unheard() -> int:
    """Whoever read the output is gone (`| head`): ends as a program does that the signal SIGPIPE ends."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.__stdout__, sys.__stderr__):
        if stream is not None:
            os.dup2(nowhere, stream.fileno())
    return 128 + 13


if __name__ == "__main__":
    sys.exit(main())
