"""The finished run in a folder that the next one goes on from."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from geomosaic import __version__
from geomosaic.errors import FileError, InputError
from geomosaic.pipeline import files
from geomosaic.pipeline.hashes import FileHashes
from geomosaic.pipeline.input_files import frame_files
from geomosaic.pipeline.params import output_values
from geomosaic.pipeline.recipe import RECORDING, RUN_JSON, UNFINISHED, Recipe
from geomosaic.pipeline.run_folder import WORK, RunFolder
from geomosaic.pipeline.run_options import RunOptions
from geomosaic.pipeline.run_results import load_artefact, read_summary
from geomosaic.recording.file.fingerprints import fingerprint_of_json

EARLIER: Final = f"{WORK}/earlier.json"
"""The summary of the run that one which isn't finished goes on from."""
STAGE_VERSIONS: Final = "stage_versions"
"""In run.json: the version of each stage."""
_WHOLE: Final = "leave out --incremental to run it whole"
_MOST_ENTRY_BYTES: Final = 64 << 20


@dataclass(frozen=True)
class EarlierRun:
    """What a finished run made, until the run that goes on from it is finished. summary: its run.json."""

    folder: RunFolder
    summary: Mapping[str, Any] = field(repr=False)
    hashes: FileHashes = field(default_factory=FileHashes, repr=False)

    @property
    def mark(self) -> str:
        """What names all that it made."""
        return fingerprint_of_json(_marks(self.summary))

    def artefact(self, name: str, kind: type) -> Any:
        """What a stage made of it; None where it made none, or not of this type."""
        with suppress(FileError):
            return load_artefact(self.folder.path, dict(self.summary), name, kind)
        return None

    def file(self, artefact: str, name: str) -> Path | None:
        """A file that the stage wrote which made an artefact, if it is as it was."""
        with suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
            entry = self.folder.within(str(self.summary["artefacts"][artefact]["file"])).parent
            written = json.loads(files.read_own(entry / "entry.json", _MOST_ENTRY_BYTES))["files"]
            path = self.folder.within(name)
            if self.hashes.of_written(path) == written[name]:
                return path
        return None

    def unchanged(self, frames: Mapping[str, Path]) -> frozenset[str]:
        """The names of those frames that it read with the content that they have. frames: by their names."""
        with suppress(KeyError, TypeError, AttributeError):
            read = {path.absolute(): mark for path, mark in frame_files(self.summary["inputs"])}
            same = (n for n, p in frames.items() if read.get(p.absolute()) == self.hashes.of_file(p))
            return frozenset(same)
        return frozenset()


def begun(folder: RunFolder, recipe: Recipe, options: RunOptions) -> EarlierRun | None:
    """A folder without the last run's summary, but for `RunFolder.last`; the finished run that this one goes
    on from, if it does. Its summary is kept until the next one is finished.

    The recording of a run that was killed or failed, and so left no summary, says where it was: it stays.
    Raises: as `finished`.
    """
    earlier = finished(folder, recipe) if options.incremental else None
    if earlier is not None and folder.within(RUN_JSON).exists():
        with folder.writing(EARLIER) as path:
            files.write_json(path, earlier.summary)
    recording = folder.within(RECORDING)
    if RECORDING in folder.made() and recording.is_file() and not folder.within(RUN_JSON).exists():
        recording.replace(folder.claim(UNFINISHED))
    with suppress(FileError, KeyError, TypeError, AttributeError):
        folder.last = _marks(read_summary(folder.path))
    folder.remove(RUN_JSON)
    if earlier is None:
        folder.remove(EARLIER)
    return earlier


def _marks(summary: Mapping[str, Any]) -> dict[str, str]:
    """The fingerprints of a run's artefacts, by name."""
    return {name: of["fingerprint"] for name, of in summary["artefacts"].items()}


def finished(folder: RunFolder, recipe: Recipe) -> EarlierRun:
    """The finished run in a folder, which is left as it is.

    Raises: `InputError` if there is none, or one by other options or another version.
    """
    name = RUN_JSON if folder.within(RUN_JSON).exists() else EARLIER
    try:
        summary = read_summary(folder.path, name)
        known = {of["stage"]: of["params"] for of in summary["recipe"]["stages"]}
        made_by = summary["versions"]["geomosaic"], summary[STAGE_VERSIONS], summary["recipe"]["seed"]
        there = all(folder.within(str(of["file"])).exists() for of in summary["artefacts"].values())
    except (FileError, KeyError, TypeError, AttributeError) as error:
        problem = "there is no finished run to go on from"
        raise InputError(problem, file=folder.path, fix=_WHOLE) from error
    if made_by[:2] != (__version__, stage_versions(recipe)):
        if known.keys() != stage_versions(recipe).keys():
            raise _by_other_options(folder, "its stages are others")
        raise InputError("the run there was made by another version", file=folder.path, fix=_WHOLE)
    if made_by[2] != recipe.seed:
        raise _by_other_options(folder, f"its --seed is {made_by[2]}")
    for step in recipe.steps:
        for option, value in output_values(step.params).items():
            before = known[step.stage.id].get(option)
            if before != value and f"{step.stage.id}.{option}" != "survey.read.frames":
                raise _by_other_options(folder, f"its {step.stage.id}.{option} is {before}")
    if not there:
        raise InputError(f"{WORK} has lost results of the run there", file=folder.path, fix=_WHOLE)
    return EarlierRun(folder, summary)


def stage_versions(recipe: Recipe) -> dict[str, int]:
    """The versions of a recipe's stages."""
    return {step.stage.id: step.stage.version for step in recipe.steps}


def _by_other_options(folder: RunFolder, what: str) -> InputError:
    problem = f"the run there was made with other options: {what}"
    return InputError(problem, file=folder.path, fix=f"give the same options, or {_WHOLE}")
