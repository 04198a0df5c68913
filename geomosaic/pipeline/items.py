"""A stage's items, spread over the workers, each result kept on the disk under what it was made of."""

from __future__ import annotations

import functools
import itertools
import os
import typing
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from geomosaic.errors import FileError
from geomosaic.pipeline import files
from geomosaic.pipeline.artefacts import content_of
from geomosaic.pipeline.executor import Workers
from geomosaic.pipeline.hashes import FileHashes
from geomosaic.pipeline.stored_result import (
    EncodedFunction,
    OptionalCache,
    SharedFunction,
    SpoolingFunction,
    StoredResult,
    without_bytes,
)
from geomosaic.recording.file.fingerprints import fingerprint_of_json

Item = TypeVar("Item")
Result = TypeVar("Result")
Taken = TypeVar("Taken")
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class _Place:
    """Where an item's result is kept, if anywhere; what names it; the files that count for it."""

    path: Path | None = None
    mark: str = ""
    files: Mapping[Path, str] = field(default_factory=dict)


@dataclass
class Items:
    """Does a stage's items; see `Context.map` for what is promised.

    code: of a plug-in's stage, what its source is. key: the stage's own fingerprint; nothing is kept without
    one. lasting: where results lie that outlive the stage's own outcome.
    """

    folder: Path
    stage_id: str
    version: int
    code: str
    key: str
    workers: Workers
    hashes: FileHashes
    progress: Progress
    inform: Callable[[str], None]
    lasting: list[Path] = field(default_factory=list)

    def mapped(
        self,
        name: str,
        function: Callable[[Item], Result],
        items: Iterable[Item],
        keys: Sequence[Any] | None,
        take: Callable[[StoredResult[Result]], Taken],
    ) -> list[Taken]:
        """What is taken of each result. With `without_bytes` other processes leave results on the disk."""
        stay = take is without_bytes
        if keys is None:
            items = list(items)
        returns = _returns(function)
        places = self._by_content(name, function, items) if keys is None else self._by_key(name, keys)
        done = _from_before(places, returns, take, stay)
        if done:
            self.inform(f"{name}: {len(done)} of {len(places)} are there from before")
        left = () if len(done) == len(places) else enumerate(items)  # none is made for nothing
        waiting = ((i, item) for i, item in left if i not in done)
        running: dict[Future[Any], int] = {}
        self.workers.new_step()
        with self._for_workers(name, function, len(done) < len(places)) as work:
            while True:
                self.progress(len(done), len(places), name)
                most = 2 * self.workers.workers if self.workers.elsewhere else 1
                for i, item in itertools.islice(waiting, max(0, most - len(running))):
                    running[self._submitted(work, item, places[i].path if stay else None)] = i
                if not running:
                    break
                for future in self._finished(running):
                    i = running.pop(future)
                    done[i] = take(self._kept(returns, places[i], self.workers.result(future)))
        return [done[i] for i in range(len(places))]

    def caches(
        self, name: str, function: Callable[[Item], Result], items: Iterable[Item]
    ) -> list[OptionalCache[Result]]:
        """Cache entries for what a function makes of items, named as by `mapped`: for results that whoever
        wants one first makes, since perhaps nobody does."""
        returns = _returns(function)
        return [OptionalCache(returns, place.path) for place in self._by_content(name, function, items)]

    def _submitted(self, work: Callable[[Item], Any], item: Item, left_at: Path | None) -> Future[Any]:
        """An item on its way; other processes leave its result next to `left_at`, if that is given."""
        if left_at is not None and self.workers.elsewhere:
            return self.workers.submit(SpoolingFunction(work), (item, left_at))
        return self.workers.submit(EncodedFunction(work), item)

    def _finished(self, running: Collection[Future[Any]]) -> Collection[Future[Any]]:
        """Those that are done after a second at most; if none is, whether anybody is at work."""
        finished = wait(running, timeout=1.0, return_when=FIRST_COMPLETED).done
        if not finished:
            self.workers.check()
        return finished

    def _kept(self, returns: Any, place: _Place, made: bytes | Path) -> StoredResult[Any]:
        """A result in its place, as its bytes come or where it was left, if nothing changed meanwhile."""
        try:
            if place.path is not None:
                self.hashes.check_unchanged(place.files)
                if isinstance(made, Path):
                    made.replace(place.path)
                else:
                    files.write_bytes(place.path, made)
        finally:
            if isinstance(made, Path):
                files.remove(made)
        return StoredResult(returns, place.mark, place.path, made if isinstance(made, bytes) else None)

    @contextmanager
    def _for_workers(
        self, name: str, function: Callable[[Item], Result], wanted: bool
    ) -> Iterator[Callable[[Item], Result]]:
        """The function as workers get it: with what it shares for all items sent to each of them once."""
        if not (wanted and self.workers.elsewhere):
            yield function
            return
        path = self.folder / f".{name}.{os.getpid()}.geomosaic.part"
        try:
            yield SharedFunction.of(function, path)
        finally:
            files.remove(path)

    def _by_key(self, name: str, keys: Sequence[Any]) -> list[_Place]:
        """Where results are kept that go by the stage and a key."""
        base = [self.stage_id, name, self.key]
        return [self._place([*base, content_of(key)[0]]) for key in keys]

    def _by_content(self, name: str, function: Callable[..., Any], items: Iterable[Any]) -> list[_Place]:
        """Where results are kept that go by what the function is given."""
        if not self.key:
            return [_Place() for _ in items]
        what, *bound = _taken_apart(function)
        shared, texts = content_of(bound)
        read = self.hashes.named(texts)
        base = [
            self.stage_id,
            self.version,
            self.code,
            name,
            f"{what.__module__}:{what.__qualname__}",
            shared,
            *sorted(read.values()),
        ]
        places = []
        for item in items:
            mark, texts = content_of(item)
            mine = self.hashes.named(texts)
            places.append(self._place([*base, mark, *sorted(mine.values())], read | mine))
        self.lasting += [place.path for place in places if place.path is not None]
        return places

    def _place(self, named: Sequence[Any], read: Mapping[Path, str] | None = None) -> _Place:
        if not self.key:
            return _Place()
        mark = fingerprint_of_json(named)
        return _Place(self.folder / "items" / mark[:2] / mark[2:], mark, read or {})


def _from_before(
    places: Sequence[_Place], returns: Any, take: Callable[[StoredResult[Result]], Taken], stay: bool
) -> dict[int, Taken]:
    """What is taken of results that are in their places; one that isn't whole goes, and is made again."""
    done: dict[int, Taken] = {}
    for i, place in enumerate(places):
        if place.path is not None and os.path.lexists(place.path):
            try:
                found = StoredResult[Result](returns, place.mark, place.path)
                if stay:
                    found.load()
                done[i] = take(found)
            except (OSError, FileError):
                files.remove(place.path)
    return done


def _taken_apart(function: Callable[..., Any]) -> list[Any]:
    """The function itself, then all that partials of it bind, in their order."""
    bound = []
    while isinstance(function, functools.partial):
        bound += [function.args, function.keywords]
        function = function.func
    return [function, *bound]


def _returns(function: Callable[..., Any]) -> Any:
    """The type a function says it returns. Raises `TypeError` if it doesn't say."""
    function = _taken_apart(function)[0]
    hints = typing.get_type_hints(function)
    if "return" not in hints:
        raise TypeError(f"{function.__qualname__} must say in its annotation what it returns")
    return hints["return"]
