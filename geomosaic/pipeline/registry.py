"""Which stages there are, and whether their declarations are whole."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable
from functools import lru_cache
from importlib.metadata import EntryPoint

from geomosaic.errors import BindingsError, PluginError, UnknownNameError, origin_of
from geomosaic.pipeline.artefacts import dataclasses_in
from geomosaic.pipeline.entry_points import announced
from geomosaic.pipeline.params import StageParams, describe_params
from geomosaic.pipeline.stage import Stage

_ID = re.compile(r"[a-z][a-z0-9_]*\.[a-z][a-z0-9_]*")


def check_stage(stage: object, *, id: str | None = None) -> type[Stage]:
    """The class itself if its declaration is whole; `PluginError` says what isn't.

    `id` is the name it was announced by (its entry point), which must be its own.
    """
    where = getattr(stage, "__qualname__", repr(stage))

    def fail(problem: str) -> PluginError:
        return PluginError(f"stage {id or where}: {problem}")

    if not (isinstance(stage, type) and issubclass(stage, Stage)):
        raise fail(f"{where} is no subclass of Stage")
    if inspect.isabstract(stage):
        raise fail(f"{where} has no method run")
    for name in ("id", "display_name", "group"):
        if not isinstance(getattr(stage, name, None), str) or not getattr(stage, name).strip():
            raise fail(f"{where} has no {name}")
    if not _ID.fullmatch(stage.id):
        raise fail(f"its id '{stage.id}' isn't of the form group.name in small letters")
    if id is not None and stage.id != id:
        raise fail(f"{where} calls itself '{stage.id}'; entry point and id must agree")
    if not isinstance(stage.version, int) or stage.version < 1:
        raise fail(f"version {stage.version!r} is no whole number from 1")
    for name in ("inputs", "optional_inputs", "outputs"):
        artefacts = getattr(stage, name)
        if not isinstance(artefacts, dict) or not all(isinstance(key, str) for key in artefacts):
            raise fail(f"{name} is no dict of artefact types by name")
        for key, kind in artefacts.items():
            try:
                dataclasses_in(kind)
            except NameError as error:
                raise fail(f"the type of {name} '{key}' can't be resolved ({error})") from error
    if both := sorted(stage.inputs.keys() & stage.optional_inputs.keys()):
        raise fail(f"'{both[0]}' is both an input and an optional one")
    if not (isinstance(stage.Params, type) and issubclass(stage.Params, StageParams)):
        raise fail("Params is no subclass of StageParams")
    for p in describe_params(stage.Params):
        if not p.help:
            raise fail(f"parameter {p.name} has no help; declare it with param(...)")
    if len(inspect.signature(stage.run).parameters) != 4:
        raise fail("run must take (self, inputs, params, context)")
    return stage


class Registry:
    """Stages by id. A stage's module is imported when it is first asked for.

    An entry point's name is the stage's id, so clashes are found without importing anything.
    """

    def __init__(self, entries: Iterable[EntryPoint] = ()) -> None:
        self._entries: dict[str, list[EntryPoint]] = {}
        self._stages: dict[str, type[Stage]] = {}
        for entry in entries:
            others = self._entries.setdefault(entry.name, [])
            if all(other.value != entry.value for other in others):
                others.append(entry)

    def register(self, stage: type[Stage]) -> type[Stage]:
        """Adds a stage of this process; usable as a decorator. `PluginError` if the id is taken."""
        check_stage(stage)
        known = [origin_of(entry) for entry in self._entries.get(stage.id, ())]
        if stage.id in self._stages:
            known.append(self._stages[stage.id].__qualname__)
        if known:
            raise PluginError(f"stage id '{stage.id}' is claimed by {known[0]} and by {stage.__qualname__}")
        self._stages[stage.id] = stage
        return stage

    def ids(self) -> list[str]:
        """Every id announced, broken ones included."""
        return sorted({*self._entries, *self._stages})

    def get(self, id: str, *, file: str | None = None) -> type[Stage]:
        """The stage of an id.

        Raises `UnknownNameError` with the nearest id, or `PluginError` if the stage can't be loaded or
        two distributions claim its id. `file` is the recipe that asks.
        """
        if id in self._stages:
            return self._stages[id]
        if id not in self._entries:
            raise UnknownNameError("stage", id, self.ids(), file=file)
        entries = self._entries[id]
        if len(entries) > 1:
            both = " and by ".join(sorted(origin_of(entry) for entry in entries))
            raise PluginError(f"stage id '{id}' is claimed by {both}; uninstall one of them")
        try:
            stage = entries[0].load()
        except (BindingsError, PluginError):
            raise
        except Exception as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise PluginError(f"stage {id} can't be loaded from {origin_of(entries[0])}: {reason}") from error
        self._stages[id] = check_stage(stage, id=id)
        return self._stages[id]

    def all(self) -> tuple[list[type[Stage]], dict[str, str]]:
        """Every stage that works, and why each of the others doesn't, by id."""
        working, broken = [], {}
        for id in self.ids():
            try:
                working.append(self.get(id))
            except PluginError as error:
                broken[id] = str(error)
        return working, broken


@lru_cache(maxsize=1)
def installed() -> Registry:
    """geomosaic's own stages, and those of every distribution installed here."""
    return Registry(announced())
