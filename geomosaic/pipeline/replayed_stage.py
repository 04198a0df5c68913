"""Stages whose outcome is taken from a recording."""

from __future__ import annotations

import dataclasses
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from stat import S_ISREG
from typing import Any

from foxglove_schemas_protobuf.Log_pb2 import Log

from geomosaic.camera.exterior import Poses
from geomosaic.doors.files import mode_of
from geomosaic.errors import FileError
from geomosaic.pipeline.artefact_reader import decode
from geomosaic.pipeline.artefacts import encode
from geomosaic.pipeline.context import Notes, RunFile
from geomosaic.pipeline.files import path_within
from geomosaic.pipeline.hashes import FileHashes
from geomosaic.pipeline.input_files import files_of
from geomosaic.pipeline.recipe import Recipe
from geomosaic.pipeline.run_folder import RunFolder
from geomosaic.recording.file.fingerprints import artefact_fingerprint, fingerprint_of_bytes
from geomosaic.recording.file.model import ArtefactEntry, Recording, StageRecord
from geomosaic.recording.file.reader import artefact_data, stage_messages
from geomosaic.survey.model import Survey


@dataclass(frozen=True)
class ReplayedStage:
    """A stage's outcome in a recording: outputs, messages, notes and input files.

    replaced: bytes of outputs that aren't the recorded ones, see `with_outputs`. places: where files that it
    read lie now, by where they lay. brought: files that it needs in the run folder and whose bytes are made
    when they are written, by name. added: warnings that the stage didn't give when it ran.
    """

    recording: Recording
    record: StageRecord
    entries: Mapping[str, ArtefactEntry]
    outputs: Mapping[str, Any]
    notes: Notes
    replaced: Mapping[str, bytes] = field(default_factory=dict)
    places: Mapping[Path, Path] = field(default_factory=dict)
    brought: Mapping[str, Callable[[], bytes]] = field(default_factory=dict)
    added: tuple[str, ...] = ()

    def data(self, name: str) -> bytes:
        """An output's bytes, as they were recorded, or as what they were replaced by."""
        if name in self.replaced:
            return self.replaced[name]
        return artefact_data(self.recording, self.entries[name])

    def with_outputs(self, change: Callable[[Any], Any]) -> ReplayedStage:
        """The same with other outputs, under fingerprints of their own; `change` gives what it leaves alone
        as it is."""
        outputs, entries, replaced = dict(self.outputs), dict(self.entries), dict(self.replaced)
        for name, value in self.outputs.items():
            new = change(value)
            if new is not value:
                outputs[name], replaced[name] = new, encode(new)
                content = fingerprint_of_bytes(replaced[name])
                mark = artefact_fingerprint(content, self.record.written, self.record.lineage)
                entries[name] = dataclasses.replace(entries[name], fingerprint=mark)
        return dataclasses.replace(self, outputs=outputs, entries=entries, replaced=replaced)

    def messages(self) -> Iterator[tuple[str, str, bytes, bool]]:
        """All the stage recorded, for `Recorder.copy`."""
        yield from stage_messages(self.recording, self.record.index)
        for text in self.added:
            line = Log(level=Log.Level.WARNING, message=text, name=self.record.stage_id)
            yield "/log", Log.DESCRIPTOR.full_name, line.SerializeToString(), False

    def with_warning(self, code: str, text: str) -> ReplayedStage:
        """The same with one more warning, in its notes and in its log."""
        warning = {"code": code, "frame": "", "text": text}
        notes = dataclasses.replace(self.notes, warnings=[*self.notes.warnings, warning])
        return dataclasses.replace(self, notes=notes, added=(*self.added, f"{code}: {text}"))

    def files(self) -> list[str]:
        """Names of the files in the run folder that its outputs stand for, or that are brought there."""
        named = [name for output in self.outputs.values() for name in _named_files(output)]
        return [*named, *self.brought]

    def manifest(self) -> dict[str, Any]:
        """The stage's part of the recorded input manifest, by parameter."""
        own = f"{self.record.stage_id}."
        found = {
            name.removeprefix(own): entry
            for name, entry in self.recording.manifest.items()
            if name.startswith(own)
        }
        for entry in found.values():
            if not (isinstance(entry, dict) and isinstance(entry.get("files"), dict) and "path" in entry):
                raise FileError(
                    "its list of inputs isn't what a run writes",
                    file=self.recording.path,
                    fix="run the recipe again",
                )
        return {name: moved(entry, self.places) for name, entry in found.items()} if self.places else found

    def check_unchanged(self, hashes: FileHashes, progress: Callable[[], None]) -> None:
        """What a recorded stage found holds for the files that it read. Raises: `FileError` for one of those
        that are still there which has changed."""
        for path, mark in (file for entry in self.manifest().values() for file in files_of(entry)):
            if not S_ISREG(mode_of(path)):
                continue
            progress()
            if hashes.of_input(path) != mark:
                raise FileError(
                    "has changed since the recording, which holds the old one",
                    file=path,
                    fix="run the recipe again, or put the old file back",
                )


def moved(entry: Mapping[str, Any], places: Mapping[Path, Path]) -> dict[str, Any]:
    """An input of a manifest whose files lie elsewhere now; their sizes are those that they had."""
    files = [(places.get(path, path), mark) for path, mark in files_of(entry)]
    if all(path not in places for path, _ in files_of(entry)):
        return dict(entry)
    folder = Path(os.path.commonpath([path.parent for path, _ in files]))
    named = {path.name if path.parent == folder else str(path): mark for path, mark in files}
    return {**{k: v for k, v in entry.items() if k != "bytes"}, "path": str(folder), "files": named}


def replayed_stages(recording: Recording, recipe: Recipe, count: int) -> dict[int, ReplayedStage]:
    """The recorded outcomes of a recipe's first steps. Raises `FileError` if one isn't there, whole, or if
    they tell of different frames."""
    given = {i: replayed_stage(recording, recipe, i) for i in range(count)}
    artefacts = [a for stage in given.values() for a in stage.outputs.values()]
    surveys = {tuple(f.name for f in a.frames) for a in artefacts if isinstance(a, Survey)}
    counts = {len(a.poses) for a in artefacts if isinstance(getattr(a, "poses", None), Poses)}
    if len(surveys) > 1 or len(counts | {len(s) for s in surveys}) > 1:
        problem = "its surveys and poses are of different frames"
        raise FileError(problem, file=recording.path, fix="run the recipe itself")
    return given


def replayed_stage(recording: Recording, recipe: Recipe, index: int) -> ReplayedStage:
    """The recorded outcome of a recipe's step. Raises `FileError` if it isn't there, whole."""
    stage = recipe.steps[index].stage
    fix = f"replay with --from {stage.id} or an earlier stage"
    record = next(
        (s for s in recording.stages if s.index == index and s.stage_id == stage.id and s.finished), None
    )
    recorded = {a.name: a for a in recording.artefacts if a.stage_index == index}
    entries = {
        name: recorded[old]
        for name in stage.outputs
        for old in (name, stage.formerly.get(name))
        if old in recorded
    }
    if record is None or not entries.keys() >= stage.outputs.keys():
        problem = f"the recording lacks results of stage {stage.id}"
        raise FileError(problem, file=recording.path, fix=fix)
    try:
        outputs: dict[str, Any] = {
            name: decode(_as_recorded(recording, record, entries[name]), kind)
            for name, kind in stage.outputs.items()
        }
        notes = Notes.from_plain(record.notes)
    except FileError as error:
        raise FileError(error.problem, file=recording.path, fix=fix) from error
    return ReplayedStage(recording, record, entries, outputs, notes)


def _as_recorded(recording: Recording, record: StageRecord, entry: ArtefactEntry) -> bytes:
    """An artefact's bytes, checked by its fingerprint. Raises: `FileError` where they differ."""
    data = artefact_data(recording, entry)
    content = fingerprint_of_bytes(data)
    if record.lineage and artefact_fingerprint(content, record.written, record.lineage) != entry.fingerprint:
        problem = f"artefact '{entry.name}' of stage {record.stage_id} isn't what its fingerprint says"
        raise FileError(
            f"{problem}: it was altered since", file=recording.path, fix="take another copy of the recording"
        )
    return data


def bring_files(recipe: Recipe, given: Mapping[int, ReplayedStage], folder: RunFolder) -> None:
    """Copies into a new run folder the files that given artefacts name, from their recording's folder.

    A file that a later stage takes must be there (`FileError`); another is copied if it is one of the
    run's results, and still lies there.
    """
    later = [step for i, step in enumerate(recipe.steps) if i not in given]
    wanted = {name for step in later for name in (*step.stage.inputs, *step.stage.optional_inputs)}
    for index, stage in given.items():
        for file, data in stage.brought.items():
            with folder.writing(file) as temporary:
                temporary.write_bytes(data())
        recorded_folder = stage.recording.path.absolute().parent
        for name, artefact in stage.outputs.items():
            for file in _named_files(artefact):
                try:
                    source = path_within(recorded_folder, file)
                except ValueError as error:
                    raise FileError(str(error), file=recorded_folder, fix="run the recipe again") from error
                if S_ISREG(mode_of(source)) and (name in wanted or not file.startswith("work/")):
                    with folder.writing(file) as temporary:
                        shutil.copyfile(source, temporary, follow_symlinks=False)
                elif name in wanted:
                    fix = f"replay with --from {recipe.steps[index].stage.id} or an earlier stage"
                    raise FileError(f"the file of '{name}' is gone", file=source, fix=fix)


def _named_files(artefact: Any) -> list[str]:
    """Names of files in the run folder that an artefact stands for: of `RunFile`s, and below work/."""
    if isinstance(artefact, RunFile):
        return [artefact.name]
    if isinstance(artefact, str):
        return [artefact] if artefact.startswith("work/") else []
    if dataclasses.is_dataclass(artefact):
        return [n for f in dataclasses.fields(artefact) for n in _named_files(getattr(artefact, f.name))]
    return [n for item in artefact for n in _named_files(item)] if isinstance(artefact, tuple) else []


def missing_inputs(given: Iterable[ReplayedStage]) -> list[Path]:
    """Files and folders that given stages read and that are no longer where they were."""
    paths = [Path(str(entry["path"])) for stage in given for entry in stage.manifest().values()]
    return [path for path in dict.fromkeys(paths) if not mode_of(path)]
