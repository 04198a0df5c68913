"""A field of a request: how it is asked for, and which parameter of a stage it sets."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import Field, dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Any, Final, get_args, get_origin, get_type_hints

from geomosaic.errors import InputError

INPUTS: Final = "Inputs"
SURFACE: Final = "Ground and surface"
ACCURACY: Final = "Adjustment and accuracy"
OUTPUT: Final = "Output"
RUNNING: Final = "Running"
RARE: Final = "Rarely needed"
"""The heading of options that only `--help-all` shows; `RARE: the camera` is one of several."""
_LENGTHS_M: Final = {"mm": 0.001, "cm": 0.01, "m": 1.0}
_KEY: Final = "option"


@dataclass(frozen=True)
class Option:
    """help: as the command line's help shows it. metavar: its value in the help. heading: of the help, ''
    for an argument without a flag. sets: STAGE.PARAMETER that takes the value. value: what a switch sets, if
    not true. flags: if they are others than the field's name. parse: of a text that the command line gives.
    least, most: of a number. methods: whether the help names the choices of the parameter. toolbox: whether
    QGIS offers it too."""

    help: str
    metavar: str | None = None
    heading: str = ""
    sets: str = ""
    value: str | None = None
    flags: tuple[str, ...] = ()
    parse: Callable[[str], Any] | None = None
    least: float | None = None
    most: float | None = None
    methods: bool = False
    toolbox: bool = True


def asked(option: Option, default: Any = None) -> Any:
    """A field of a request with a default."""
    return field(default=default, metadata={_KEY: option})


def required(option: Option) -> Any:
    """A field of a request that has to be given."""
    return field(metadata={_KEY: option})


def option_of(its: Field[Any]) -> Option:
    """The option of a request's field."""
    option: Option = its.metadata[_KEY]
    return option


def choices_of(option: Option) -> tuple[str, ...]:
    """The values that an option may have, by its metavar; none where it takes others."""
    values = tuple((option.metavar or "").split("|"))
    return values if len(values) > 1 and all(re.fullmatch("[a-z_]+", value) for value in values) else ()


@cache
def kinds_of(request: type) -> Mapping[str, Any]:
    """The types of a request's fields, by name."""
    hints = get_type_hints(request)
    return {its.name: hints[its.name] for its in fields(request)}


def flag_of(its: Field[Any]) -> str:
    """The long flag of a request's field, such as `--pos-crs`."""
    usual = f"--{its.name.replace('_', '-')}"
    return next((flag for flag in option_of(its).flags if flag.startswith("--")), usual)


def checked(name: str, option: Option, kind: Any, value: Any) -> Any:
    """A value as its field takes it. Raises: `InputError` for one of another type or out of bounds."""
    if value is None:
        return None
    if type(value).__module__ == "numpy" and getattr(value, "ndim", None) == 0:  # a number out of an array
        value = value.item()
    if isinstance(value, str) and option.parse is not None:
        try:
            return option.parse(value)
        except ValueError as error:
            raise InputError(f"{name}: {error}") from error
    if get_origin(kind) is tuple:
        if isinstance(value, list | tuple):
            return tuple(str(v) for v in value)
        raise InputError(f"{name} is {value!r}", fix="give a list of texts")
    kinds = set(get_args(kind)) or {kind}
    if Path in kinds and isinstance(value, str | os.PathLike):
        if not os.fspath(value):
            raise InputError(f"{name} is empty", fix="give a path; '.' is the current folder")
        return Path(value)
    if str in kinds and isinstance(value, str | int | float) and not isinstance(value, bool):
        return str(value)
    if bool in kinds and isinstance(value, bool):
        return value
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if (float in kinds and number) or (int in kinds and isinstance(value, int) and number):
        if option.least is not None and value < option.least:
            raise InputError(f"{name} is {value}", fix=f"give at least {option.least:g}")
        if option.most is not None and value > option.most:
            raise InputError(f"{name} is {value}", fix=f"give at most {option.most:g}")
        return value
    raise InputError(f"{name} is {value!r}", fix=f"give {_wanted(kinds)}")


def _wanted(kinds: set[Any]) -> str:
    names = {Path: "a path", str: "a text", bool: "True or False", float: "a number", int: "a whole number"}
    return next(text for kind, text in names.items() if kind in kinds)


def length_given(text: str) -> float:
    """Metres of a length such as 5cm, 0.05m or 0.05. Raises: `ValueError` for another text."""
    number, unit = text.strip().lower(), "m"
    for name in _LENGTHS_M:
        if number.endswith(name):
            number, unit = number.removesuffix(name), name
            break
    with suppress(ValueError):
        metres = float(number) * _LENGTHS_M[unit]
        if 0.0 < metres < float("inf"):
            return metres
    raise ValueError(f"{text!r} is no length; give metres, or a unit: 5cm, 50mm, 0.05m")


def folder_given(text: str) -> Path:
    """A folder's path. Raises: `ValueError` for an empty name and one that no file system takes."""
    if not text.strip():
        raise ValueError("give the folder to write to; '.' is the current one")
    if "\0" in text or any("\ud800" <= c <= "\udfff" for c in text):
        raise ValueError(f"{text!r} is no name in UTF-8")
    return Path(text)
