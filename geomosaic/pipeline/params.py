"""Declared parameters: type, unit, bounds, choices and one line of help, as GIS users know them."""

from __future__ import annotations

import difflib
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, Self, TypedDict, Union, Unpack

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import PydanticUndefined

from geomosaic.errors import InputError, UnknownNameError

Choices = Iterable[str] | Mapping[str, Any] | Callable[[], Iterable[str]]

_TYPE_TEXT = {
    float: "number",
    int: "whole number",
    bool: "true or false",
    str: "text",
    Path: "path",
    types.NoneType: "nothing",
}


class ParamLimits(TypedDict, total=False):
    """What may be said of a parameter besides its default and help: see `param`."""

    unit: str
    ge: float | None
    le: float | None
    choices: Choices | None
    affects_output: bool


def param(
    default: Any = ...,
    *,
    help: str,
    **limits: Unpack[ParamLimits],
) -> Any:
    """One field of a `StageParams`; without a default the recipe must give it.

    Bounds hold for numbers and for each number of a tuple; in a `float | Literal["auto"]` the word is
    free of them. `choices` may be a dict of strategies (its keys are read) or a callable giving the
    names, asked only when needed. `affects_output=False` keeps a parameter out of the fingerprint.
    """
    return Field(default, description=help, json_schema_extra=typing.cast("dict[str, Any]", limits))


@dataclass(frozen=True)
class ParamDescription:
    """What `geomosaic stages` and every front end show of a parameter."""

    name: str
    type: str
    unit: str
    default: Any
    required: bool
    ge: float | None
    le: float | None
    choices: tuple[str, ...]
    help: str
    affects_output: bool
    is_file: bool

    @property
    def wanted(self) -> str:
        """The values it takes, in words: `a number in m, at least 0.01, or 'auto'`."""
        article = "a " if self.type.startswith(("number", "whole", "path", "list")) else ""
        text = f"one of {', '.join(self.choices)}" if self.choices else article + self.type
        text += f" in {self.unit}" if self.unit else ""
        if self.ge is not None and self.le is not None:
            return f"{text}, {self.ge:g} to {self.le:g}"
        if self.ge is not None:
            return f"{text}, at least {self.ge:g}"
        return f"{text}, at most {self.le:g}" if self.le is not None else text


class StageParams(BaseModel):
    """A stage's parameters: frozen, unknown keys refused, every field declared by `param`.

    `FORMERLY` maps names that parameters had in earlier versions to those they have.
    """

    FORMERLY: ClassVar[dict[str, str]] = {}
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, coerce_numbers_to_str=True)

    @model_validator(mode="after")
    def _within_bounds(self) -> Self:
        for p in describe_params(type(self)):
            value = getattr(self, p.name)
            for v in value if isinstance(value, tuple | list) else (value,):
                if isinstance(v, int | float) and not isinstance(v, bool):
                    low, high = p.ge is not None and v < p.ge, p.le is not None and v > p.le
                    if low or high:
                        raise ValueError(f"{p.name} = {v!r}: must be {p.wanted}")
                elif p.choices and v is not None and v not in p.choices:
                    near = difflib.get_close_matches(str(v), p.choices, n=1, cutoff=0.5)
                    mean = f" (did you mean '{near[0]}'?)" if near else ""
                    raise ValueError(f"{p.name} = {v!r}: must be {p.wanted}{mean}")
        return self


def _type_text(annotation: Any) -> str:
    origin = typing.get_origin(annotation)
    if origin in (Union, types.UnionType):
        return " or ".join(_type_text(a) for a in typing.get_args(annotation) if a is not types.NoneType)
    if origin is Literal:
        return " or ".join(repr(a) for a in typing.get_args(annotation))
    if origin in (tuple, list):
        kinds = dict.fromkeys(_type_text(a) for a in typing.get_args(annotation) if a is not Ellipsis)
        return f"list of {', '.join(kinds)}"
    return _TYPE_TEXT.get(annotation, getattr(annotation, "__name__", str(annotation)))


def accepts(annotation: Any, wanted: type) -> bool:
    """Whether an annotation is `wanted` or a union that holds it."""
    return annotation is wanted or any(accepts(a, wanted) for a in typing.get_args(annotation))


def describe_params(params: type[StageParams]) -> list[ParamDescription]:
    """Every declared parameter, in order of declaration."""
    out = []
    for name, field in params.model_fields.items():
        extra: Any = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
        choices = extra.get("choices")
        choices = choices() if callable(choices) else choices
        required = field.is_required()
        out.append(
            ParamDescription(
                name=name,
                type=_type_text(field.annotation),
                unit=extra.get("unit", ""),
                default=None if required or field.default is PydanticUndefined else field.default,
                required=required,
                ge=extra.get("ge"),
                le=extra.get("le"),
                choices=tuple(choices or ()),
                help=field.description or "",
                affects_output=extra.get("affects_output", True),
                is_file=accepts(field.annotation, Path),
            )
        )
    return out


def check_params(
    params: type[StageParams], values: Mapping[str, Any], *, stage: str, file: str | Path | None = None
) -> StageParams:
    """The parameters made of plain values; the first fault as one readable line.

    Raises `UnknownNameError` for a key that isn't declared, `InputError` for a value that doesn't fit.
    """
    values = {params.FORMERLY.get(key, key): value for key, value in values.items()}
    unknown = [key for key in values if key not in params.model_fields]
    if unknown:
        raise UnknownNameError(f"parameter of stage {stage}", str(unknown[0]), params.model_fields, file=file)
    try:
        return params.model_validate(dict(values))
    except ValidationError as error:
        raise InputError(_fault(error, params, values, stage), file=file) from error


def _fault(error: ValidationError, params: type[StageParams], values: Mapping[str, Any], stage: str) -> str:
    first = error.errors(include_url=False)[0]
    if not first["loc"]:
        return f"stage {stage}: {first['ctx']['error'] if 'error' in first.get('ctx', {}) else first['msg']}"
    name = str(first["loc"][0])
    p = next(p for p in describe_params(params) if p.name == name)
    if first["type"] == "missing":
        return f"stage {stage}: {name} is missing; give {p.wanted} ({p.help})"
    return f"stage {stage}: {name} = {values[name]!r}: must be {p.wanted}"


def output_values(params: StageParams) -> dict[str, Any]:
    """The values that change a stage's output, as JSON knows them: what enters its fingerprint."""
    affects = {p.name for p in describe_params(type(params)) if p.affects_output}
    return params.model_dump(mode="json", include=affects)


def file_values(params: StageParams) -> dict[str, Path]:
    """The files and folders the parameters name, by parameter (`name[i]` in a list)."""
    found = {}
    for p in describe_params(type(params)):
        value = getattr(params, p.name)
        if isinstance(value, Path):
            found[p.name] = value
        elif isinstance(value, tuple | list):
            found.update({f"{p.name}[{i}]": v for i, v in enumerate(value) if isinstance(v, Path)})
    return found
