"""Strategies by name: the room's own, and those that other distributions bring by an entry point."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Final, Generic, TypeVar

from geomosaic.errors import PluginError, origin_of

T = TypeVar("T")
BLENDS_GROUP: Final = "geomosaic.blends"
"""An entry point's object is a `composition.blends.Blend`."""
SEAMS_GROUP: Final = "geomosaic.seams"
"""An entry point's object is a `composition.seam_cut.Seam`."""


class Named(Mapping[str, T], Generic[T]):
    """The room's own strategies and a group's. A plug-in is loaded when it is first asked for.

    Raises, when a name is asked for: `KeyError` for an unknown one, `PluginError` for a plug-in that can't be
    used. The latter can't be loaded, isn't what `fits` asks for, or has a name that is taken. The error names
    the plug-in and its distribution.
    """

    def __init__(self, own: Mapping[str, T], group: str, fits: Callable[[object], bool]) -> None:
        self._own, self._group, self._fits = dict(own), group, fits

    @cached_property
    def _entries(self) -> dict[str, list[EntryPoint]]:
        """By name. Workers get the names with their task and never search all distributions."""
        found: dict[str, list[EntryPoint]] = {}
        for entry in entry_points(group=self._group):
            found.setdefault(entry.name, []).append(entry)
        return found

    def __getitem__(self, name: str) -> T:
        entries = self._entries.get(name, [])
        if not entries:
            return self._own[name]
        claims = [*(["geomosaic itself"] if name in self._own else []), *map(origin_of, entries)]
        if len(claims) > 1:
            both = " and by ".join(sorted(claims))
            raise PluginError(f"{self._group} '{name}' is claimed by {both}; uninstall one of them")
        try:
            found: Any = entries[0].load()
        except Exception as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise PluginError(f"{self._group} '{name}' can't be loaded from {claims[0]}: {reason}") from error
        if not self._fits(found):
            raise PluginError(f"{self._group} '{name}' of {claims[0]} is none: {found!r}")
        taken: T = found
        return taken

    def __iter__(self) -> Iterator[str]:
        return iter(sorted({*self._own, *self._entries}))

    def __len__(self) -> int:
        return len({*self._own, *self._entries})
