"""What users call a parameter: the option that they typed, or the argument in Python.

Texts of errors name options of `geomosaic mosaic` (`--gcp`), and parameters that have none as
`--set STAGE.PARAMETER=VALUE`. Here both become what the command or the function at hand takes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from collections.abc import Set as AbstractSet
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, Final

from geomosaic.errors import GeomosaicError
from geomosaic.requests.mosaic_request import MosaicRequest
from geomosaic.requests.option import Option, choices_of, flag_of, option_of
from geomosaic.requests.run_request import RunRequest
from geomosaic.requests.strips_request import StripsRequest

_VALUE: Final = r"(?:[A-Z]{2,}(?::\w+)?|-?\d[\d.]*)(?![\w.])"
_FLAG: Final = re.compile(rf"(?<![\w-])(--[a-z][a-z-]*)(?: ({_VALUE}|[a-z_]+))?")
_SET: Final = re.compile(r"--set (\w+\.\w+\.\w+)(?:=([^\s,;)]+))?")
_PLAIN: Final = re.compile(
    r"(?<![\w./'-])(?:[a-z][a-z0-9]*(?:_[a-z0-9]+)+|(?<=^)[a-z]+(?= is |: "
    r"))(?![\w./'-])"
)
"""A parameter's bare name: of two words, or first in a text."""
_FAULT: Final = re.compile(r"(?:^|(?<=: ))stage (\w+\.\w+): (\w+) = ")


@contextmanager
def named_as_typed(request: type[RunRequest], given: Mapping[str, Any]) -> Iterator[None]:
    """Errors raised inside name the options of a command. given: their values by field."""
    own = {sets: flag_of(its) for its in fields(request) if (sets := _takes(option_of(its)))}
    typed = {sets for its in fields(request) if (sets := _given(its.name, _takes(option_of(its)), given))}
    by_set = {text.partition("=")[0].strip() for text in given.get("set") or ()}
    with _reworded(_TypedOptions(request, own, typed, by_set).named):
        yield


@contextmanager
def named_as_options(stage: str, options: Mapping[str, str] | None = None) -> Iterator[None]:
    """Errors raised inside name the options of a command that runs one stage. options: by parameter, if not
    each parameter is one of its own name."""

    from geomosaic.pipeline.registry import installed

    def flag(name: str) -> str | None:
        return f"--{name.replace('_', '-')}" if options is None else options.get(name)

    def option(found: re.Match[str]) -> str:
        of, _, name = found[1].rpartition(".")
        return f"{flag(name)} {found[2] or ''}".strip() if of == stage and flag(name) else found[0]

    def plain(found: re.Match[str]) -> str:
        return f"--{found[0].replace('_', '-')}" if found[0] in parameters else found[0]

    parameters = installed().get(stage).Params.model_fields if options is None else {}

    def named(text: str, file: str) -> str:
        fault = _FAULT.search(text)
        if fault and fault[1] == stage and flag(fault[2]):
            return _FAULT.sub(f"{flag(fault[2])} ", text.removeprefix(file))
        return _PLAIN.sub(plain, _SET.sub(option, text))

    with _reworded(named):
        yield


@contextmanager
def named_as_arguments(request: type[RunRequest]) -> Iterator[None]:
    """Errors raised inside name the arguments of the function that takes a request's fields."""
    with _reworded(lambda text, _: in_python(text, request)):
        yield


@contextmanager
def _reworded(change: Callable[[str, str], str]) -> Iterator[None]:
    """Changes the texts of errors. change: of a text and the prefix of it that names the file."""
    try:
        yield
    except GeomosaicError as error:
        file = f"{file}: " if (file := getattr(error, "file", None)) else ""
        error.reword(lambda text: change(text, file))
        raise


def in_python(text: str, request: type[RunRequest]) -> str:
    """A message whose options are named as arguments: `pos_crs` for `--pos-crs`."""
    flags = {flag_of(its): its.name for its in fields(request)}
    own = {sets: its.name for its in fields(request) if (sets := _takes(option_of(its)))}

    def argument(parameter: str, name: str | None, value: str | None) -> str:
        if name is not None:
            return f"{name}={_literal(value)}" if value else name
        return f"set={{'{parameter}': {_literal(value or _switched().get(parameter) or 'VALUE')}}}"

    def option(found: re.Match[str]) -> str:
        name, parameter = flags.get(found[1]), _elsewhere().get(found[1], "")
        value, rest = _value(found)
        return argument(parameter, name, value) + rest if name or parameter else found[0]

    text = re.sub(r"(?<![\w-])-o(?![\w-])", "output", text)
    text = _FLAG.sub(lambda found: found[0] if found[1] == "--set" else option(found), text)
    text = _SET.sub(lambda found: argument(found[1], own.get(found[1]), found[2]), text)
    text = re.sub(r"(?<![\w-])--set(?![\w-])", "set", text)
    return _FAULT.sub(lambda f: f"{own[name]} = " if (name := f"{f[1]}.{f[2]}") in own else f[0], text)


@dataclass(frozen=True)
class _TypedOptions:
    """How a command was typed. own: its options by the parameter that they set; typed: parameters set by
    options; sets: those set by `--set`."""

    request: type[RunRequest]
    own: Mapping[str, str]
    typed: AbstractSet[str]
    sets: AbstractSet[str]

    def named(self, text: str, file: str) -> str:
        """A message with parameters named as they were typed. file: the prefix of it that names the file."""
        flags = {flag_of(its) for its in fields(self.request)}
        fault = _FAULT.search(text)
        name = f"{fault[1]}.{fault[2]}" if fault else ""
        if name in self.typed or name in self.sets:
            start = f"--set {name}=" if name in self.sets else f"{self.own[name]} "
            text = _FAULT.sub(lambda _: start, text.removeprefix(file))
        else:
            text = _SET.sub(self._option, text)
        for its in (f for f in fields(self.request) if not option_of(f).heading):  # an argument has no flag
            text = text.replace(f"with {flag_of(its)} PATH", f"as {option_of(its).metavar}")
        return _FLAG.sub(lambda found: found[0] if found[1] in flags else _set_instead(found), text)

    def _option(self, found: re.Match[str]) -> str:
        if found[1] in self.sets or found[1] not in self.own:
            return found[0]
        return f"{self.own[found[1]]} {found[2] or ''}".strip()


def _set_instead(found: re.Match[str]) -> str:
    """What sets the parameter of an option that the command at hand does not take."""
    parameter, (value, rest) = _elsewhere().get(found[1]), _value(found)
    return f"--set {parameter}={value or _metavars()[parameter]}{rest}" if parameter else found[0]


def _value(found: re.Match[str]) -> tuple[str | None, str]:
    """The value that a text names after an option, and the rest: a word is one if the option has that
    choice."""
    word = found[2]
    if word is None or not re.fullmatch("[a-z_]+", word) or word in _choices().get(found[1], ()):
        return word, ""
    return None, f" {word}"


@cache
def _elsewhere() -> Mapping[str, str]:
    """The parameter that each option of `geomosaic mosaic` and `geomosaic strips` sets, by the option."""
    every = [its for kind in (MosaicRequest, StripsRequest) for its in fields(kind)]
    return {flag_of(its): sets for its in every if option_of(its).heading and (sets := option_of(its).sets)}


@cache
def _choices() -> Mapping[str, tuple[str, ...]]:
    """The choices of each option that has some, by the option."""
    every = [its for kind in (MosaicRequest, StripsRequest) for its in fields(kind)]
    return {flag_of(its): choices_of(option_of(its)) for its in every}


@cache
def _metavars() -> Mapping[str, str]:
    every = [option_of(its) for kind in (MosaicRequest, StripsRequest) for its in fields(kind)]
    return {option.sets: option.value or option.metavar or "true" for option in every}


@cache
def _switched() -> Mapping[str, str]:
    """The value that a switch gives to its parameter, where that is a text."""
    every = [option_of(its) for its in fields(MosaicRequest)]
    return {option.sets: option.value for option in every if option.value is not None}


def _takes(option: Option) -> str:
    """The parameter that takes the option's value as it is typed."""
    return "" if option.value is not None else option.sets


def _given(name: str, sets: str, given: Mapping[str, Any]) -> str:
    """The parameter that a field sets, '' where it was not given."""
    return sets if given.get(name) not in (None, False) else ""


def _literal(value: str) -> str:
    """A value as it stands in Python; a word in capitals stands for one."""
    return value if re.fullmatch(r"-?\d[\d.]*|[A-Z]+", value) else repr(value)
