"""One exception tree. Each error is also the builtin it resembles and knows its exit code.

The command line prints `str(error)` as its one line and exits with `error.exit_code`.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


class GeomosaicError(Exception):
    """Anything the package raises on purpose."""

    exit_code = 1

    def reword(self, change: Callable[[str], str]) -> None:
        """Changes its texts, such as to name an option as it was typed."""
        self.args = (change(str(self)), *self.args[1:])
        for name in ("problem", "fix"):
            if isinstance(text := getattr(self, name, None), str):
                setattr(self, name, change(text))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled as it is: constructors take other arguments than the one line they make."""
        return _restored, (type(self), self.args, self.__dict__)


def _restored(kind: type[GeomosaicError], args: tuple[Any, ...], state: dict[str, Any]) -> GeomosaicError:
    new: Any = OSError.__new__ if issubclass(kind, OSError) else Exception.__new__
    error: GeomosaicError = new(kind, *args)
    error.args = args
    error.__dict__.update(state)
    return error


class InputError(GeomosaicError, ValueError):
    """What the user gave can't be used.

    `problem` says what is wrong, `file` names where, `fix` says what to do about it.
    """

    exit_code = 2

    def __init__(self, problem: str, *, file: str | Path | None = None, fix: str | None = None) -> None:
        self.problem = problem
        self.file = None if file is None else str(file)
        self.fix = fix
        text = problem if file is None else f"{file}: {problem}"
        super().__init__(" ".join(f"{text}; {fix}".split()) if fix else " ".join(text.split()))


class FileError(InputError, OSError):
    """A file can't be read, or is not what its name says."""

    def __str__(self) -> str:
        return str(self.args[0])


class UnknownNameError(InputError, LookupError):
    """A name (stage, parameter, method, frame) that doesn't exist; says which are near."""

    def __init__(self, kind: str, name: str, known: Iterable[str], *, file: str | Path | None = None) -> None:
        names = sorted(known)
        near = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
        fix = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(names) or 'none'}"
        super().__init__(f"unknown {kind} '{name}'", file=file, fix=fix)


class OutputError(GeomosaicError, OSError):
    """A result can't be written: no permission, disk full, the target is in the way."""

    exit_code = 2

    def __init__(self, problem: str, *, file: str | Path, fix: str | None = None) -> None:
        self.file = str(file)
        super().__init__(" ".join(f"{file}: {problem}{'; ' + fix if fix else ''}".split()))


class LinkError(OutputError):
    """A link stands in a folder of geomosaic's, where none is followed."""


class NotSolvableError(GeomosaicError, ArithmeticError):
    """The observations don't determine what was asked for; `frames`: at which it shows, if any."""

    def __init__(self, problem: str, *, frames: Iterable[int] = ()) -> None:
        self.frames = tuple(frames)
        super().__init__(problem)


class BindingsError(GeomosaicError, ImportError):
    """GDAL's Python bindings are missing, or were built for another libgdal or without numpy."""

    exit_code = 2


class PluginError(GeomosaicError, ImportError):
    """A third-party stage that can't be loaded, or that claims an id already taken."""

    exit_code = 2


def origin_of(entry: EntryPoint) -> str:
    """The plug-in of an entry point and its distribution, as messages name it."""
    dist = entry.dist
    return f"{entry.value} ({dist.name} {dist.version})" if dist is not None else entry.value


class StageFaultError(GeomosaicError, RuntimeError):
    """A third-party stage that failed otherwise than on purpose."""


class PoorResultError(GeomosaicError, RuntimeError):
    """A strict run that was finished, and whose result is not to be trusted."""

    exit_code = 3


class CancelledError(GeomosaicError):
    """The user stopped the run."""

    exit_code = 130

    def __init__(self, text: str = "stopped") -> None:
        super().__init__(text)
