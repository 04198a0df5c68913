"""The decorator `stage`: a function with annotations as a stage."""

from __future__ import annotations

import inspect
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, ClassVar, TypedDict, Unpack

from geomosaic.errors import PluginError
from geomosaic.pipeline.former_names import FORMER_DECLARATIONS
from geomosaic.pipeline.stage import Context, Stage, StageParams

_NONE = (None, types.NoneType)


_Lines = Callable[[Mapping[str, Any]], list[tuple[str, str]]]


class Declaration(TypedDict, total=False):
    """What `stage` takes by keyword: attributes of `Stage`, and functions for its class methods."""

    version: int
    formerly: dict[str, str]
    cached: bool
    concurrent: bool
    goes_on: bool
    looks_ahead: bool
    wants_frames: bool
    results: tuple[str, ...]
    check: Callable[[Any], None]
    files: Callable[[Any], dict[str, Path]]
    plugged: Callable[[Any], list[tuple[str, str]]]
    conclusions: _Lines
    plans: _Lines
    shortcoming: Callable[[Mapping[str, Any]], str]


@dataclass(frozen=True)
class InputGroup:
    """Inputs that stages take together. A subclass is a frozen dataclass whose fields are inputs."""


class FunctionStage(Stage):
    """A stage made of a function by `stage`; `function` is that function, to be called in a test."""

    function: ClassVar[Callable[..., Any]]
    _roles: ClassVar[Mapping[str, str]]
    _groups: ClassVar[Mapping[str, type[InputGroup]]]
    _single: ClassVar[tuple[str, ...]]
    _outputs: ClassVar[str | tuple[str, ...]]

    def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
        """The function's result under the names of its outputs."""
        roles = {"params": params, "context": context}
        given = {name: inputs.get(name) for name in self._single}
        given |= {name: _group_of(group, inputs) for name, group in self._groups.items()}
        given |= {name: roles[role] for name, role in self._roles.items()}
        made = self.function(**given)
        if isinstance(self._outputs, str):
            return {self._outputs: made}
        return dict(zip(self._outputs, made if isinstance(made, tuple) else (), strict=False))


def stage(
    id: str,
    display_name: str,
    *,
    group: str,
    outputs: str | tuple[str, ...] = (),
    **declared: Unpack[Declaration],
) -> Callable[[Callable[..., Any]], type[FunctionStage]]:
    """Makes a stage of a function. The function's docstring describes the stage.

    A parameter annotated with a subclass of `StageParams` takes the parameters, one annotated `Context` the
    context, with one of `InputGroup` the inputs that are its fields. Every other one is an input under its
    name, of the type in its annotation; `X | None = None` is an optional input. An optional group is None
    unless all its inputs without a default are there.

    Args: outputs: the name of what the function returns; several names for a tuple, as annotated.
    Raises: `PluginError` for a function whose annotations don't say this.
    """

    def make(function: Callable[..., Any]) -> type[FunctionStage]:
        present = {FORMER_DECLARATIONS.get(n, n): v for n, v in declared.items()}
        if unknown := sorted(present.keys() - Declaration.__annotations__.keys()):
            raise _unfit(id, f"'{unknown[0]}' is nothing that a stage declares")
        about: dict[str, Any] = {"id": id, "display_name": display_name, "group": group}
        about |= {n: staticmethod(v) if callable(v) else v for n, v in present.items()}
        about |= {name: getattr(function, name) for name in ("__doc__", "__module__", "__qualname__")}
        about |= {"function": staticmethod(function), "_outputs": outputs}
        about |= _taken(id, function) | {"outputs": _given(id, function, outputs)}
        return type(function.__name__, (FunctionStage,), about)

    return make


def _unfit(id: str, problem: str) -> PluginError:
    return PluginError(f"stage {id}: {problem}")


def _taken(id: str, function: Callable[..., Any]) -> dict[str, Any]:
    """Inputs, optional inputs and the class of the parameters, as attributes of a `FunctionStage`."""
    inputs: dict[str, type] = {}
    optional: dict[str, type] = {}
    roles: dict[str, str] = {}
    groups: dict[str, type[InputGroup]] = {}
    single: list[str] = []
    params: type[StageParams] = StageParams
    for name, hint, there in _parameters(id, function):
        role = "context" if _is(hint, Context) else "params" if _is(hint, StageParams) else ""
        if role and role in roles.values():
            raise _unfit(id, f"parameter '{name}' is the second {hint.__name__}; a stage takes one")
        if role:
            roles[name] = role
            params = hint if role == "params" else params
            continue
        if _is(there, InputGroup):
            groups[name] = there
            for field, field_hint, kind in _parameters(id, there):
                needed = there is hint and kind is field_hint
                (inputs if needed else optional)[field] = _artefact(id, f"field '{field}'", kind)
            continue
        single.append(name)
        (inputs if there is hint else optional)[name] = _artefact(id, f"parameter '{name}'", there)
    optional = {name: kind for name, kind in optional.items() if name not in inputs}
    return {
        "inputs": inputs, "optional_inputs": optional, "Params": params,
        "_roles": roles, "_groups": groups, "_single": tuple(single),
    }  # fmt: skip


def _parameters(id: str, made: Callable[..., Any]) -> Iterator[tuple[str, Any, Any]]:
    """Each parameter of a function, or field of a group: its name, its annotation, and that without None."""
    hints = _hints(id, made)
    for name, parameter in inspect.signature(made).parameters.items():
        if parameter.kind not in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY):
            raise _unfit(id, f"parameter '{name}' has no name of its own; an input is taken by its name")
        if name not in hints:
            raise _unfit(id, f"parameter '{name}' has no annotation; annotate it with its type")
        hint = hints[name]
        there = _without_none(hint)
        role = _is(hint, Context) or _is(hint, StageParams)
        if not role and parameter.default not in (parameter.empty if there is hint else None,):
            raise _unfit(
                id, f"parameter '{name}': an optional input is annotated X | None and has the default None"
            )
        yield name, hint, there


def _group_of(kind: type[InputGroup], inputs: Mapping[str, Any]) -> InputGroup | None:
    """The group; None where an input without a default is missing."""
    given = {field.name: (inputs.get(field.name), field.default) for field in fields(kind)}
    if any(value is None and default is MISSING for value, default in given.values()):
        return None
    return kind(**{name: value for name, (value, _) in given.items()})


def _given(id: str, function: Callable[..., Any], outputs: str | tuple[str, ...]) -> dict[str, type]:
    """The outputs by name, of the types in the annotation of what the function returns."""
    returned = _hints(id, function).get("return")
    names: tuple[str, ...] = (outputs,) if isinstance(outputs, str) else outputs
    kinds = (returned,) if isinstance(outputs, str) else typing.get_args(returned)
    if not isinstance(outputs, str):
        whole = typing.get_origin(returned) is tuple if names else returned in _NONE
        if not whole or len(kinds) != len(names):
            wanted = (
                f"a tuple of {len(names)} types for {', '.join(names)}"
                if names
                else "None: it names no output"
            )
            text = "nothing" if returned in _NONE else inspect.formatannotation(returned)
            raise _unfit(id, f"its function is annotated to return {text}, and must return {wanted}")
    return {name: _artefact(id, f"output '{name}'", kind) for name, kind in zip(names, kinds, strict=True)}


def _hints(id: str, function: Callable[..., Any]) -> dict[str, Any]:
    try:
        return typing.get_type_hints(function)
    except (NameError, TypeError, AttributeError, SyntaxError) as error:
        raise _unfit(id, f"an annotation of {function.__qualname__} can't be resolved ({error})") from error


def _is(hint: Any, kind: type) -> bool:
    return isinstance(hint, type) and issubclass(hint, kind)


def _without_none(hint: Any) -> Any:
    """X of X | None; any other annotation as it is."""
    kinds = [kind for kind in typing.get_args(hint) if kind is not types.NoneType]
    union = typing.get_origin(hint) in (types.UnionType, typing.Union)
    return kinds[0] if union and len(kinds) == 1 else hint


def _artefact(id: str, what: str, hint: Any) -> type:
    if isinstance(hint, type) and is_dataclass(hint):
        return hint
    text = "nothing" if hint in _NONE else inspect.formatannotation(hint)
    raise _unfit(id, f"{what} is annotated {text}; an artefact is a frozen dataclass or a RunFile")
