"""Finished stages on disk: artefacts, files and recorded calls under a fingerprint of all they depend on."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from pyproj import proj_version_str
from pyproj.datadir import get_data_dir, get_user_data_dir  # type: ignore[attr-defined]

from geomosaic.pipeline import files
from geomosaic.pipeline.artefact_reader import decode, texts_in
from geomosaic.pipeline.artefacts import fingerprint_of_file, write
from geomosaic.pipeline.context import Context, Notes
from geomosaic.pipeline.hashes import FileHashes
from geomosaic.pipeline.params import output_values
from geomosaic.pipeline.recipe import RecipeStep
from geomosaic.pipeline.replayed_stage import ReplayedStage
from geomosaic.pipeline.run_folder import WORK, RunFolder
from geomosaic.pipeline.stage import Stage
from geomosaic.recording.file.fingerprints import artefact_fingerprint, fingerprint_of_json

_KEY = re.compile(r"(given-)?[0-9a-f]{40}")
_ITEM = (re.compile(r"[0-9a-f]{2}"), re.compile(r"[0-9a-f]{38}"))
_GRIDS = frozenset({".tif", ".gtx", ".gsb"})
_MOST_ENTRY_BYTES = 64 << 20
_ENTRY, _CALLS, _ARTEFACT, _SPOOL, _ITEMS = "entry.json", "messages", ".artefact", "calls.part", "items"

Manifest = Mapping[str, Mapping[str, str]]
Lineage = frozenset[str]
"""Fingerprints of the contents of all files that something goes back to, one for each stage with files."""

_MISSING = object()


@dataclass
class ArtefactHandle:
    """An artefact of a run: its file, and its value, decoded on first use.

    fingerprint: of the bytes, of the files the stage wrote with them, and of the lineage. So a stage that
    takes the artefact is redone if any file changes that it goes back to, through all stages.
    """

    type: Any
    fingerprint: str
    path: Path
    lineage: Lineage
    _value: Any = field(default=_MISSING, repr=False)

    def open(self) -> AbstractContextManager[BinaryIO]:
        """The artefact's bytes, to be read."""
        return files.open_own(self.path)

    def value(self) -> Any:
        """The artefact itself."""
        if self._value is _MISSING:
            with files.open_own(self.path) as file:
                self._value = decode(file, self.type)
        return self._value

    def release(self) -> None:
        """Drops the decoded value; it is decoded again on the next use."""
        self._value = _MISSING


@dataclass(frozen=True)
class CachedOutcome:
    """A stage's outcome on disk.

    calls: what it recorded; None for a stage from a recording, whose messages are copied.
    used: the folders and files it lives on.
    written: hashes of the files that the stage wrote, by name; with the lineage part of each fingerprint.
    """

    outputs: dict[str, ArtefactHandle]
    notes: Notes
    calls: Path | None
    used: tuple[Path, ...]
    written: Mapping[str, str]
    lineage: Iterable[str]


def file_manifest(
    named: Mapping[str, Path], hashes: FileHashes, progress: Callable[[int, int], None] | None = None
) -> dict[str, dict[str, str]]:
    """For each of a stage's files and folders, the names and hashes of the files it stands for."""
    return {name: hashes.manifest(path, progress) for name, path in named.items()}


def lineage_of(manifest: Manifest) -> Lineage:
    """The lineage of what a stage makes of files."""
    if not manifest:
        return frozenset()
    return frozenset({fingerprint_of_json({n: dict(hashes) for n, hashes in manifest.items()})})


def stage_key(
    step: RecipeStep, inputs: Mapping[str, ArtefactHandle], seed: int, lineage: Lineage, code: str
) -> str:
    """The fingerprint of a stage's work: whatever it depends on, and nothing else. code: `plugin.code_of`."""
    return fingerprint_of_json(
        {
            **({"code": code} if code else {}),
            "stage": step.stage.id,
            "version": step.stage.version,
            "params": output_values(step.params),
            "seed": seed,
            "inputs": {name: handle.fingerprint for name, handle in inputs.items()},
            "files": sorted(lineage),
            "proj": [proj_version_str, _grids()],
        }
    )


def _grids() -> list[tuple[str, int]]:
    """Names and sizes of PROJ's grids, which heights and datums are transformed by where they are there."""
    folders = {*get_data_dir().split(os.pathsep), get_user_data_dir()}
    found = (path for folder in folders for path in Path(folder).glob("*") if path.suffix in _GRIDS)
    return sorted({(path.name, path.stat().st_size) for path in found})


class StageCache:
    """RUN/work: a folder for each finished stage, whole once its `entry.json` is there.

    What lies there may have been cut by a power failure or put there by a stranger. It counts only if every
    hash is right, no link stands on the way, and no artefact names a file that this run was not given.
    """

    def __init__(self, folder: RunFolder, hashes: FileHashes) -> None:
        self._folder = folder
        self._hashes = hashes

    def find(self, stage: type[Stage], key: str, lineage: Lineage) -> CachedOutcome | None:
        """The outcome, if it is there, whole, and the files the stage wrote are unchanged."""
        try:
            folder = self._folder.within(f"{WORK}/{stage.id}/{key}")
            entry = json.loads(files.read_own(folder / _ENTRY, _MOST_ENTRY_BYTES))
            json.dumps(entry, allow_nan=False)  # as it was written, whatever stands there now
            written = {str(name): str(mark) for name, mark in entry["files"].items()}
            for name, mark in written.items():
                if self._hashes.of_written(self._folder.within(name)) != mark:
                    return None
            outputs = {}
            for name, kind in stage.outputs.items():
                path = folder / f"{name}{_ARTEFACT}"
                with files.open_own(path) as file:
                    content = fingerprint_of_file(file)
                    if content != entry["outputs"][name] or not self._names_only_inputs(file):
                        return None
                outputs[name] = ArtefactHandle(
                    kind, artefact_fingerprint(content, written, lineage), path, lineage
                )
            calls = folder / _CALLS
            with files.open_own(calls) as file:
                if fingerprint_of_file(file) != entry["calls"]:
                    return None
            stored = [self._folder.within(name) for name in (*written, *entry["items"])]
            notes = Notes.from_plain(entry["notes"])
            self._folder.note(written)
            return CachedOutcome(outputs, notes, calls, (folder, *stored), written, lineage)
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError, MemoryError):
            return None

    def _names_only_inputs(self, artefact: BinaryIO) -> bool:
        """Whether every file on this machine that an artefact names is one this run reads."""
        inputs = self._hashes.inputs()
        allowed = inputs | {path.parent for path in inputs}
        named = (Path(os.path.normpath(text)) for text in texts_in(artefact) if text.startswith(os.sep))
        return all(path in allowed or not _exists(path) for path in named)

    def keep(
        self,
        stage: type[Stage],
        values: Mapping[str, Any],
        context: Context,
        lineage: Lineage,
        calls: Path,
    ) -> CachedOutcome:
        """Stores the outcome of a stage that ran in a context; `calls` moves into the cache."""
        folder = self._folder.within(f"{WORK}/{stage.id}/{context.key}")
        with files.refusals_named(folder / _ENTRY):
            folder.mkdir(parents=True, exist_ok=True)
            (folder / _ENTRY).unlink(missing_ok=True)
        written = {self._name(path): self._hashes.of_written(path) for path in context.kept}
        outputs, contents = {}, {}
        for name, kind in stage.outputs.items():
            path = folder / f"{name}{_ARTEFACT}"
            with files.writing(path) as temporary, temporary.open("wb") as file:
                write(values[name], file)
            with files.open_own(path) as file:
                contents[name] = fingerprint_of_file(file)
            mark = artefact_fingerprint(contents[name], written, lineage)
            outputs[name] = ArtefactHandle(kind, mark, path, lineage, values[name])
        with files.open_own(calls) as file:
            recorded = fingerprint_of_file(file)
        with files.refusals_named(folder / _CALLS):
            calls = calls.replace(folder / _CALLS)
        entry = {
            "outputs": contents,
            "files": written,
            "items": [self._name(path) for path in context.lasting_items],
            "calls": recorded,
            "notes": asdict(context.notes),
        }
        self._folder.note(written)
        files.write_json(folder / _ENTRY, entry)
        used = (folder, *context.kept, *context.lasting_items)
        return CachedOutcome(outputs, context.notes, calls, used, written, lineage)

    def keep_replayed(self, stage: type[Stage], given: ReplayedStage, lineage: Lineage) -> CachedOutcome:
        """Stores the outputs of a stage as a recording has them, under their recorded fingerprints."""
        marks = {name: given.entries[name].fingerprint for name in stage.outputs}
        folder = self._folder.within(f"{WORK}/{stage.id}/given-{fingerprint_of_json(marks)}")
        folder.mkdir(parents=True, exist_ok=True)
        outputs = {}
        for name, kind in stage.outputs.items():
            path = folder / f"{name}{_ARTEFACT}"
            files.write_bytes(path, given.data(name))
            outputs[name] = ArtefactHandle(kind, marks[name], path, lineage, given.outputs[name])
        brought = [self._folder.within(name) for name in given.files()]
        record = given.record
        return CachedOutcome(outputs, given.notes, None, (folder, *brought), record.written, record.lineage)

    def spool(self, stage: type[Stage]) -> Path:
        """Where a stage's calls go while it runs."""
        path = self._folder.within(f"{WORK}/{stage.id}/{_SPOOL}")
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def prune(self, used: Iterable[Path]) -> None:
        """Deletes from RUN/work what geomosaic put there and the finished run did not use; nothing else."""
        kept = set(used)
        for name in self._folder.made():
            if name.startswith(f"{WORK}/") and self._folder.within(name) not in kept:
                self._folder.remove(name)
        for stage in _folders(self._folder.within(WORK)):
            for folder in _folders(stage):
                if folder.name == _ITEMS:
                    _prune_items(folder, kept)
                elif _KEY.fullmatch(folder.name) and folder in kept:
                    files.sweep(folder)
                elif _KEY.fullmatch(folder.name):
                    _remove_entry(folder)
            files.sweep(stage)
            files.remove(stage / _SPOOL)
            _remove_if_empty(stage)

    def _name(self, path: Path) -> str:
        return path.relative_to(self._folder.path).as_posix()


def _exists(path: Path) -> bool:
    try:
        return os.path.lexists(path)
    except ValueError:  # a name that no file can have
        return False


def _folders(folder: Path) -> Iterator[Path]:
    yield from [path for path in folder.iterdir() if path.is_dir() and not path.is_symlink()]


def _prune_items(items: Path, kept: set[Path]) -> None:
    for part in _folders(items):
        if _ITEM[0].fullmatch(part.name):
            for item in list(part.iterdir()):
                if _ITEM[1].fullmatch(item.name) and item not in kept:
                    files.remove(item)
            files.sweep(part)
            _remove_if_empty(part)
    _remove_if_empty(items)


def _remove_entry(folder: Path) -> None:
    for path in list(folder.iterdir()):
        if path.name in (_ENTRY, _CALLS) or path.suffix == _ARTEFACT:
            files.remove(path)
    files.sweep(folder)
    _remove_if_empty(folder)


def _remove_if_empty(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()
