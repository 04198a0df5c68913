"""Summary and artefacts of a finished run folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from geomosaic.doors.plain import read_json
from geomosaic.errors import FileError
from geomosaic.pipeline import files
from geomosaic.pipeline.artefact_reader import decode
from geomosaic.pipeline.artefacts import type_name
from geomosaic.pipeline.former_names import present_name
from geomosaic.pipeline.recipe import RECORDING, RUN_JSON
from geomosaic.recording.file.reader import artefact_data, read_recording

_MAX_BYTES = 64 << 20  # names and hashes of 400,000 frames


def read_summary(run_folder: Path, name: str = RUN_JSON) -> dict[str, Any]:
    """run.json of a finished run. Raises `FileError` if there is none, `LinkError` for a link."""
    path = files.path_within(run_folder, name)
    if not path.exists():
        raise FileError(f"is no finished run ({name} is missing)", file=run_folder, fix="give a run's folder")
    summary = read_json(path, _MAX_BYTES, "a run's summary", "run the recipe again")
    if not isinstance(summary, dict) or not isinstance(summary.get("artefacts"), dict):
        raise FileError("doesn't describe a run", file=path, fix="run the recipe again")
    return summary


def load_artefact(run_folder: Path, summary: dict[str, Any], name: str, kind: type) -> Any:
    """An artefact of a finished run: from RUN/work, or from the recording if work/ was deleted.

    Raises `FileError` if the run made none of that name and type, or if it is in neither place.
    """
    entry = summary["artefacts"].get(name)
    if not isinstance(entry, dict) or present_name(str(entry.get("type"))) != type_name(kind):
        raise FileError(f"this run made no '{name}'", file=run_folder, fix="run a recipe that does")
    try:
        with files.open_own(files.path_within(run_folder, str(entry.get("file")))) as file:
            return decode(file, kind)
    except (OSError, ValueError):
        recording = read_recording(files.path_within(run_folder, RECORDING))
    for kept in reversed(recording.artefacts):
        if kept.name == name and kept.fingerprint == entry.get("fingerprint"):
            return decode(artefact_data(recording, kept), kind)
    raise FileError(f"holds no '{name}' any more", file=run_folder, fix="run the recipe again")
