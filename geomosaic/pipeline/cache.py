"""Finished stages on disk: artefacts, files and recorded calls under a fingerprint of all they depend on."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from geomosaic.errors import FileError
from geomosaic.pipeline import files
from geomosaic.pipeline.artefacts import decode, encode, fingerprint_of_bytes, fingerprint_of_json
from geomosaic.pipeline.context import Context, Notes
from geomosaic.pipeline.given import Given
from geomosaic.pipeline.params import output_values
from geomosaic.pipeline.recipe import Step
from geomosaic.pipeline.stage import Stage

_MISSING = object()


@dataclass
class Held:
    """An artefact of a run: its bytes, and the value they stand for, made when it is first asked for.

    fingerprint: of the bytes, of the files the stage wrote beside them, and of the files its
    parameters name, so that whoever takes the artefact is redone if any of these changes.
    """

    type: Any
    fingerprint: str
    path: Path
    _value: Any = field(default=_MISSING, repr=False)

    def data(self) -> bytes:
        """The artefact's bytes."""
        return self.path.read_bytes()

    def value(self) -> Any:
        """The artefact itself."""
        if self._value is _MISSING:
            self._value = decode(self.data(), self.type)
        return self._value


@dataclass(frozen=True)
class Finished:
    """A stage's outcome on disk.

    calls: what it told; None for a stage from a recording, whose messages are copied.
    used: the folders and files it lives on.
    """

    outputs: dict[str, Held]
    notes: Notes
    calls: Path | None
    used: tuple[Path, ...]


def file_manifest(
    named: Mapping[str, Path], hashes: files.FileHashes, progress: Callable[[int, int], None] | None = None
) -> dict[str, dict[str, str]]:
    """For each of a stage's files and folders, the names and hashes of the files it stands for."""
    return {name: hashes.manifest(path, progress) for name, path in named.items()}


def stage_key(
    step: Step, inputs: Mapping[str, str], seed: int, manifest: Mapping[str, Mapping[str, str]]
) -> str:
    """The fingerprint of a stage's work: whatever it depends on, and nothing else."""
    return fingerprint_of_json(
        {
            "stage": step.stage.id,
            "version": step.stage.version,
            "params": output_values(step.params),
            "seed": seed,
            "inputs": dict(inputs),
            "files": {name: dict(content) for name, content in manifest.items()},
        }
    )


class StageCache:
    """RUN/work: a folder for each finished stage, whole once its `entry.json` is there."""

    def __init__(self, run_folder: Path, hashes: files.FileHashes) -> None:
        self._run_folder = run_folder
        self._hashes = hashes

    def folder(self, stage_id: str, key: str) -> Path:
        """Where a stage's outcome is kept."""
        return self._run_folder / "work" / stage_id / key

    def find(self, stage: type[Stage], key: str) -> Finished | None:
        """The outcome, if it is there, whole, and the files the stage wrote are unchanged."""
        folder = self.folder(stage.id, key)
        try:
            entry = json.loads((folder / "entry.json").read_text())
            for name, mark in entry["files"].items():
                if self._hashes.of_written(files.path_within(self._run_folder, name)) != mark:
                    return None
            outputs = {}
            for name, kind in stage.outputs.items():
                content, mark = entry["outputs"][name]
                path = folder / f"{name}.artefact"
                if fingerprint_of_bytes(path.read_bytes()) != content:
                    return None
                outputs[name] = Held(kind, mark, path)
            calls = folder / "calls"
            calls.stat()
            beside = [
                files.path_within(self._run_folder, name) for name in (*entry["files"], *entry["items"])
            ]
            return Finished(outputs, Notes.from_plain(entry["notes"]), calls, (folder, *beside))
        except (OSError, ValueError, KeyError, TypeError, AttributeError, FileError):
            return None

    def keep(
        self,
        stage: type[Stage],
        key: str,
        values: Mapping[str, Any],
        context: Context,
        manifest: Mapping[str, Mapping[str, str]],
        calls: Path,
    ) -> Finished:
        """Stores the outcome of a stage that ran in a context; `calls` moves into the cache."""
        folder = self.folder(stage.id, key)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "entry.json").unlink(missing_ok=True)
        written = {
            path.relative_to(self._run_folder).as_posix(): self._hashes.of_written(path)
            for path in context.kept
        }
        beside = [written, {name: dict(content) for name, content in manifest.items()}]
        outputs, entry_outputs = {}, {}
        for name, kind in stage.outputs.items():
            data = encode(values[name])
            content = fingerprint_of_bytes(data)
            mark = fingerprint_of_json([content, *beside]) if any(beside) else content
            path = folder / f"{name}.artefact"
            files.write_bytes(path, data)
            outputs[name] = Held(kind, mark, path, values[name])
            entry_outputs[name] = (content, mark)
        calls = calls.replace(folder / "calls")
        items = [path.relative_to(self._run_folder).as_posix() for path in context.lasting_items]
        entry = {"outputs": entry_outputs, "files": written, "items": items, "notes": asdict(context.notes)}
        files.write_json(folder / "entry.json", entry)
        return Finished(outputs, context.notes, calls, (folder, *context.kept, *context.lasting_items))

    def keep_given(self, stage: type[Stage], given: Given) -> Finished:
        """Stores the outputs of a stage as a recording has them, under their recorded fingerprints."""
        marks = {name: given.entries[name].fingerprint for name in stage.outputs}
        folder = self.folder(stage.id, f"given-{fingerprint_of_json(marks)}")
        folder.mkdir(parents=True, exist_ok=True)
        outputs = {}
        for name, kind in stage.outputs.items():
            path = folder / f"{name}.artefact"
            files.write_bytes(path, given.data(name))
            outputs[name] = Held(kind, marks[name], path, given.outputs[name])
        brought = [files.path_within(self._run_folder, name) for name in given.files()]
        return Finished(outputs, given.notes, None, (folder, *brought))

    def prune(self, used: Iterable[Path]) -> None:
        """Deletes everything in RUN/work but these folders and files, the lock and the hashes."""
        work = self._run_folder / "work"
        kept = {*used, work / "lock", work / "hashes.json"}
        above = {folder for path in kept for folder in path.parents}
        _prune(work, kept, above)


def _prune(folder: Path, kept: set[Path], above: set[Path]) -> None:
    for path in folder.iterdir():
        if path in kept:
            continue
        with suppress(OSError):
            if path.is_symlink() or not path.is_dir():
                path.unlink()
            elif path in above:
                _prune(path, kept, above)
            else:
                shutil.rmtree(path)
