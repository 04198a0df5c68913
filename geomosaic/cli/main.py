"""The command `geomosaic`: it can be stopped from its first moment on, and fails in one line."""

from __future__ import annotations

import atexit
import errno
import gc
import os
import sys
from collections.abc import Sequence
from contextlib import suppress

from geomosaic.cli.memory import keep_freed_memory
from geomosaic.cli.stopping import Stop, stoppable
from geomosaic.errors import GeomosaicError, InputError

_SHOWN = 60
"""Characters of a name that is too long."""
_OPTIONAL = {
    "rerun": "pip install 'geomosaic-ortho[view]'",
    "rerun_cli": "pip install 'geomosaic-ortho[view]'",
    "geomosaic_simulate": "run make setup in a clone of geomosaic, or pip install ./geomosaic_simulate there",
}
"""How to install what is optional, by the module that is missing without it."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command and returns the exit code; a failure is one line on stderr."""
    with stoppable() as stop:
        if argv is None:  # the program itself: registered first, so that it comes last
            atexit.register(stop.leave)
        exit_code = stop.ended = _main(argv, stop)
    return exit_code if stop.signal is None else stop.exit_code


def _main(argv: Sequence[str] | None, stop: Stop) -> int:
    argv = list(sys.argv[1:] if argv is None else argv)
    gc.set_threshold(100_000)  # imports make twice as many objects, and nearly all stay
    keep_freed_memory()
    try:
        if "" in argv:
            raise InputError("an argument is empty", fix="give it; a variable of the shell may be unset")
        import typer

        from geomosaic.cli.app import build_app
        from geomosaic.pipeline.worker_process import ALGEBRA_THREADS

        for name in ALGEBRA_THREADS:  # many small systems: threads would only wait for each other
            os.environ.setdefault(name, "1")

        asked = argv or _being_completed()
        result = typer.main.get_command(build_app(asked))(argv, prog_name="geomosaic", standalone_mode=False)
        if sys.stdout is not None:
            sys.stdout.flush()
        if stop.signal is not None:
            return _fail("stopped", stop.exit_code)
        return result if isinstance(result, int) else 0
    except KeyboardInterrupt:
        return _fail("stopped", stop.exit_code)
    except (BrokenPipeError, SystemExit) as error:
        if isinstance(error, SystemExit) and not isinstance(error.__context__, BrokenPipeError):
            raise  # click turns a closed pipe into SystemExit
        return _unheard()
    except Exception as error:
        return _failed(error, stop)


def _being_completed() -> list[str]:
    """The words of the line that a shell wants completed: zsh and fish hand them over in one name, bash in
    another."""
    words = os.environ.get("_TYPER_COMPLETE_ARGS") or os.environ.get("COMP_WORDS") or ""
    return words.split()[1:] if "_GEOMOSAIC_COMPLETE" in os.environ else []


def _failed(error: Exception, stop: Stop) -> int:
    """One line for what went wrong; a library's own word for having been stopped is none of them."""
    if stop.signal is not None or type(error).__name__ == "Abort":
        return _fail("stopped", stop.exit_code, error)
    if isinstance(error, GeomosaicError):
        return _fail(str(error), error.exit_code, error)
    usage = getattr(error, "format_message", None)
    if usage is not None and usage().startswith("Usage:"):
        print(usage(), file=sys.stderr)
        return 2
    if usage is not None:
        return _fail(usage(), 2)
    if isinstance(error, ModuleNotFoundError) and error.name in _OPTIONAL:
        return _fail(f"{error.name} isn't installed; {_OPTIONAL[error.name]}", 2, error)
    if isinstance(error, MemoryError):
        text = f"out of memory ({error}): take fewer --workers or a coarser --gsd; finished work is kept"
        return _fail(text, 1, error)
    if isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG:
        name = max(str(error.filename or "").rsplit("/"), key=len)[:_SHOWN]
        return _fail(f"{name}...: the name is too long for the file system; give a shorter one", 2, error)
    if isinstance(error, FileNotFoundError) and _nowhere():
        return _fail("the current folder was removed; change to another one (cd) and run again", 2, error)
    from geomosaic.pipeline.files import is_output_error

    if is_output_error(error):
        where = error.filename or "standard output"
        return _fail(f"{where}: can't be written ({error.strerror}); free some space", 2, error)
    text = f"{type(error).__name__}: {error} (a fault of geomosaic; for details set GEOMOSAIC_TRACEBACK=1)"
    return _fail(text, 1, error)


def _nowhere() -> bool:
    """Whether the current folder is gone."""
    try:
        os.getcwd()  # noqa: PTH109 - without pathlib, which the first moments do not load
    except FileNotFoundError:
        return True
    return False


def _fail(text: str, exit_code: int, error: Exception | None = None) -> int:
    if error is not None and os.environ.get("GEOMOSAIC_TRACEBACK") == "1":
        import traceback

        traceback.print_exception(error)
    line = "".join(c if c.isprintable() else " " for c in " ".join(text.split()))
    if sys.stderr is not None:
        with suppress(OSError):
            if sys.stdout is not None:
                sys.stdout.flush()  # the error is the last line, also where both go into one file
        with suppress(OSError):
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
