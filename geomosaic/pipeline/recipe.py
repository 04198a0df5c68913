"""Recipes: an ordered list of stages with parameters, checked as a whole before the first pixel.

name: error sharing
description: the paper's method
seed: 1
stages:
  - projection.ground
  - stage: adjustment.solve
    params: {method: error_sharing}
"""

from __future__ import annotations

import types
import typing
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from geomosaic.doors.addresses import address_in
from geomosaic.doors.files import check_name, printable
from geomosaic.doors.plain import plain_yaml, read_yaml, shown
from geomosaic.errors import FileError, InputError, UnknownNameError
from geomosaic.pipeline.params import StageParams, accepts, check_params, file_values
from geomosaic.pipeline.plugin import blamed
from geomosaic.pipeline.registry import Registry
from geomosaic.pipeline.stage import Stage

RUN_JSON = "run.json"
RECORDING = "run.mcap"
UNFINISHED = "run.unfinished.mcap"
_MAX_BYTES = 1 << 20
_FIX = "write a list of stages (stages: [survey.read, ...]); geomosaic stages names them"
_CORRECT = "correct it"
_NOTHING = ("", "~", "null", "Null", "NULL")
_KEYS = ("name", "description", "seed", "stages")


@dataclass(frozen=True)
class RecipeStep:
    """A stage with its parameters."""

    stage: type[Stage]
    params: StageParams


@dataclass(frozen=True)
class Recipe:
    """A checked recipe. `file` is where it was read, for messages."""

    name: str
    description: str
    seed: int
    steps: tuple[RecipeStep, ...]
    file: str | None = None

    def plain(self) -> dict[str, Any]:
        """The recipe with every parameter as plain values, defaults included and paths absolute."""
        stages = [{"stage": s.stage.id, "params": s.params.model_dump(mode="json")} for s in self.steps]
        return {"name": self.name, "description": self.description, "seed": self.seed, "stages": stages}

    def yaml(self) -> str:
        """`plain` as YAML: a recipe again."""
        return yaml.safe_dump(self.plain(), sort_keys=False, allow_unicode=True)

    def check_files(self, skip: Collection[int] = (), run_folder: Path | None = None) -> None:
        """`InputError` for the first file that can't be what a stage wants; steps in `skip` aren't asked.

        Files must be there, apart from the results if `run_folder` is given, and pass `Stage.check`.
        """
        steps = [step for i, step in enumerate(self.steps) if i not in skip]
        for step in steps:
            for name, path in file_values(step.params).items():
                check_name(path)
                if (address := address_in(path)) is not None and not _exists(path):
                    fix = "files at URLs are fetched first: geomosaic fetch LIST_OR_URL -o FOLDER"
                    raise FileError("is no file on this machine", file=address, fix=fix)
                if not _exists(path):
                    fix = f"give an existing one with --set {step.stage.id}.{name}=PATH"
                    raise FileError("no such file or folder", file=path, fix=fix)
                if run_folder is not None:
                    self._check_apart(path, run_folder)
        for step in steps:
            with blamed(step.stage):
                step.stage.check(step.params)
                named = {} if run_folder is None else step.stage.files(step.params)
            if run_folder is not None:
                for path in named.values():
                    self._check_apart(path, run_folder)

    def results(self) -> frozenset[str]:
        """Names of all that a run of the recipe may write next to RUN/work."""
        return frozenset({RUN_JSON, RECORDING, *(name for s in self.steps for name in s.stage.results)})

    def _check_apart(self, given: Path, run_folder: Path) -> None:
        """No folder is read and written to at once, and nothing is read where the cache is tidied."""
        path, folder = given.resolve(), run_folder.resolve()
        fix = "give another output folder"
        if path == folder:
            problem = "is read and written at once, and the next run would take results for frames"
            raise InputError(problem, file=given, fix=fix)
        if path == folder / "work" or folder / "work" in path.parents:
            problem = f"lies in {folder / 'work'}, which the run empties"
            raise InputError(problem, file=given, fix=fix)
        if path.parent == folder and path.name in self.results():
            problem = "would be overwritten by the run's own file of that name"
            raise InputError(problem, file=given, fix=fix)


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # a name that no file can have
        return False


def load_recipe(path: Path, registry: Registry, overrides: Iterable[str] = ()) -> Recipe:
    """A recipe file. Paths in it are relative to its folder, those of `overrides` to the current one."""
    plain = read_yaml(path, _MAX_BYTES, "a recipe", "give a recipe; geomosaic recipes lists some")
    return recipe_from(plain, registry, overrides, file=str(path), base=path.absolute().parent)


def parse_recipe(
    text: str,
    registry: Registry,
    overrides: Iterable[str] = (),
    *,
    file: str | None = None,
    base: Path | None = None,
) -> Recipe:
    """A recipe from YAML, see `recipe_from`."""
    return recipe_from(plain_yaml(text, file, _CORRECT), registry, overrides, file=file, base=base)


def recipe_from(
    plain: Any,
    registry: Registry,
    overrides: Iterable[str] = (),
    *,
    file: str | None = None,
    base: Path | None = None,
) -> Recipe:
    """A recipe from plain values, everything checked but whether its files exist (`check_files`).

    overrides: `stage.id.param=value`; the value is a YAML scalar. base: the folder that relative paths
    start from (default: the current one).
    Raises `InputError` and its kin with one line that names the file, the stage and the fix.
    """
    recipe = unwired_recipe(plain, registry, overrides, file=file, base=base)
    check_wiring([step.stage for step in recipe.steps], file)
    return recipe


def unwired_recipe(
    plain: Any,
    registry: Registry,
    overrides: Iterable[str] = (),
    *,
    file: str | None = None,
    base: Path | None = None,
) -> Recipe:
    """As `recipe_from`, of stages whose inputs may come from a finished run."""
    if not isinstance(plain, dict) or not isinstance(plain.get("stages"), list) or not plain["stages"]:
        raise InputError("has no list 'stages'", file=file, fix=_FIX)
    if unknown := [key for key in plain if key not in _KEYS]:
        raise UnknownNameError("key", shown(unknown[0]).strip("'"), _KEYS, file=file)
    seed = plain.get("seed", 0)
    if not isinstance(seed, int) or isinstance(seed, bool) or not 0 <= seed < 1 << 63:
        raise InputError(f"seed = {shown(seed)}: must be a whole number from 0", file=file)
    entries = [_entry(entry, i, file) for i, entry in enumerate(plain["stages"])]
    stages = [registry.get(id, file=file) for id, _ in entries]
    values = [
        {key: _absolute(stage, key, value, base or Path.cwd()) for key, value in params.items()}
        for stage, (_, params) in zip(stages, entries, strict=True)
    ]
    for override in overrides:
        _override(override, stages, values)
    steps = tuple(
        RecipeStep(stage, check_params(stage.Params, v, stage=stage.id, file=file))
        for stage, v in zip(stages, values, strict=True)
    )
    name, description = (printable(str(plain.get(key, ""))) for key in ("name", "description"))
    return Recipe(name, description, seed, steps, file)


def _entry(entry: Any, i: int, file: str | None) -> tuple[str, dict[str, Any]]:
    if isinstance(entry, str):
        return entry, {}
    if not isinstance(entry, dict) or not isinstance(entry.get("stage"), str):
        raise InputError(f"stage number {i + 1} has no name", file=file, fix="write '- stage: ID'")
    if unknown := [key for key in entry if key not in ("stage", "params")]:
        kind = f"key of stage {entry['stage']}"
        raise UnknownNameError(kind, str(unknown[0]), ("stage", "params"), file=file)
    params = entry.get("params") or {}
    if not isinstance(params, dict):
        raise InputError(f"stage {entry['stage']}: params is no mapping", file=file, fix="write 'key: value'")
    return entry["stage"], {str(key): value for key, value in params.items()}


def _absolute(stage: type[Stage], name: str, value: Any, base: Path) -> Any:
    """A path parameter's text as an absolute path; any other value as it is."""
    field = stage.Params.model_fields.get(name)
    if field is None or not accepts(field.annotation, Path):
        return value
    if isinstance(value, list | tuple):
        return [_absolute(stage, name, v, base) for v in value]
    if isinstance(value, int | float) and not isinstance(value, bool):
        value = str(value)
    words = [w for a in typing.get_args(field.annotation) for w in typing.get_args(a)]
    return base / _expanded(Path(value)) if isinstance(value, str | Path) and value not in words else value


def _expanded(path: Path) -> Path:
    """A path with the home folder for `~`; as it is where there is no such user."""
    try:
        return path.expanduser()
    except RuntimeError:
        return path


def _override(override: str, stages: Sequence[type[Stage]], values: list[dict[str, Any]]) -> None:
    target, equals, text = override.partition("=")
    id, dot, name = target.strip().rpartition(".")
    if not (equals and dot and id and name):
        raise InputError(f"--set {override}: not understood", fix="write --set stage.id.parameter=value")
    if id not in (stage.id for stage in stages):
        raise UnknownNameError(
            "stage of this recipe", id, (stage.id for stage in stages), file=f"--set {override}"
        )
    for stage, params in zip(stages, values, strict=True):
        if stage.id == id:
            name = stage.Params.FORMERLY.get(name, name)
            field = stage.Params.model_fields.get(name)
            if field is None:
                raise UnknownNameError(
                    f"parameter of stage {id}", name, stage.Params.model_fields, file=f"--set {override}"
                )
            stands = _stands_for_itself(field.annotation, text)
            value = text if stands else plain_yaml(text, f"--set {override}", _CORRECT)
            params[name] = _absolute(stage, name, value, Path.cwd())


def _stands_for_itself(annotation: Any, text: str) -> bool:
    """Whether an override's text is the value, whatever YAML would make of it: a folder may be named
    `2024-05-01` or `a: b`. A list is YAML, and so is nothing: an empty text, or null where it is allowed."""
    kinds = (annotation, *typing.get_args(annotation))
    if any(typing.get_origin(kind) in (list, tuple) for kind in kinds):
        return False
    nothing = text.strip() in (_NOTHING if types.NoneType in kinds else _NOTHING[:1])
    return not nothing and any(kind in (Path, str) for kind in kinds)


def check_wiring(stages: Sequence[type[Stage]], file: str | None = None) -> None:
    """`InputError` unless each stage finds its inputs, of the right types, among earlier outputs."""
    there: dict[str, tuple[Any, str]] = {}
    for i, stage in enumerate(stages):
        for name, wanted in {**stage.inputs, **stage.optional_inputs}.items():
            if name not in there:
                if name in stage.optional_inputs:
                    continue
                later = [s.id for s in stages[i + 1 :] if name in s.outputs]
                fix = f"move {later[0]} before it" if later else f"add a stage that gives '{name}' before it"
                raise InputError(
                    f"stage {stage.id} needs '{name}', which no earlier stage gives", file=file, fix=fix
                )
            kind, source = there[name]
            if not _fits(kind, wanted):
                raise InputError(
                    f"stage {stage.id} wants '{name}' as {_name(wanted)}, but {source} gives {_name(kind)}",
                    file=file,
                    fix="put another stage before it",
                )
        taken = {*stage.inputs, *stage.optional_inputs}
        for name in stage.outputs:
            if name in there and name not in taken:
                problem = f"gives '{name}', which {there[name][1]} has given and it doesn't take"
                raise InputError(f"stage {stage.id} {problem}", file=file, fix="leave one of them out")
        there.update({name: (kind, stage.id) for name, kind in stage.outputs.items()})


def _fits(kind: Any, wanted: Any) -> bool:
    if isinstance(kind, type) and isinstance(wanted, type):
        return issubclass(kind, wanted)
    return bool(kind == wanted)


def _name(kind: Any) -> str:
    return getattr(kind, "__name__", str(kind))
