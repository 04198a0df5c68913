"""The same files in two folders: what differs between two recordings by the folders' names alone."""

from __future__ import annotations

import difflib
import io
import re
import zipfile
from typing import Any

from geomosaic.errors import FileError
from geomosaic.recording.fingerprints import fingerprint_of_bytes
from geomosaic.recording.model import Recording, StageRecord
from geomosaic.recording.reader import artefact_data

_TREE = "tree.json"
_DESCRIPTION = re.compile(r"^description:.*\n(?:[ \t]+.*\n)*", re.MULTILINE)
_NO_ARTEFACT = (FileError, ValueError, RuntimeError, OSError, zipfile.BadZipFile, EOFError)


class Places:
    """Inputs of two recordings by parameter, as `survey.read.frames`: where they lay, and their files."""

    def __init__(self, a: Recording, b: Recording) -> None:
        self._both = a, b
        self._of = tuple(_inputs(r.manifest) for r in (a, b))
        same = [n for n in self._of[0] if n in self._of[1] and self._of[0][n][1] == self._of[1][n][1]]
        self._moved = {n: (self._of[0][n][0], self._of[1][n][0]) for n in same}
        self._moved = {n: both for n, both in self._moved.items() if both[0] != both[1]}
        self._contents: dict[tuple[int, str], str] = {}

    def elsewhere(self) -> dict[str, list[str]]:
        """Inputs that are the same files in other places: [of a, of b]."""
        return {name: list(both) for name, both in self._moved.items()}

    def other_files(self) -> dict[str, list[Any]]:
        """Input files with other contents, or that one run alone had, by parameter and name: [of a, of b]."""
        out: dict[str, list[Any]] = {}
        for name in dict.fromkeys([*self._of[0], *self._of[1]]):
            files = [of[name][1] if name in of else {} for of in self._of]
            for file in dict.fromkeys([*files[0], *files[1]]):
                marks = [f.get(file) for f in files]
                if marks[0] != marks[1]:
                    out[f"{name}.{file}"] = marks
        return out

    def recipe_lines(self) -> list[str]:
        """The difference of the recipes but for their descriptions, with moved inputs by their names."""
        a, b = (
            self._placeless(_DESCRIPTION.sub("", r.recipe_yaml), i).splitlines()
            for i, r in enumerate(self._both)
        )
        return list(difflib.unified_diff(a, b, "a", "b", lineterm="", n=1))

    def same_params(self, a: StageRecord, b: StageRecord) -> tuple[dict[str, Any], dict[str, Any]]:
        """Both stages' parameters without those that name moved inputs."""
        moved = {n.removeprefix(f"{a.stage_id}.") for n in self._moved}
        return tuple({k: v for k, v in s.params.items() if k not in moved} for s in (a, b))  # type: ignore[return-value]

    def explain(self, name: str, marks: list[Any]) -> bool:
        """Whether an artefact's fingerprints differ only since it names moved inputs; where the artefacts
        aren't recorded, that is believed."""
        if not self._moved or None in marks:
            return False
        contents = [self._content(i, name, mark) for i, mark in enumerate(marks)]
        return None in contents or contents[0] == contents[1]

    def _content(self, which: int, name: str, mark: str) -> str | None:
        """What an artefact holds but for the names of moved inputs; None where it isn't recorded."""
        recording = self._both[which]
        entry = next((e for e in recording.artefacts if e.fingerprint == mark and e.complete), None)
        if entry is None:
            return None
        if (which, mark) not in self._contents:
            try:
                names, members = _members(artefact_data(recording, entry))
                tree = self._placeless(members[names.index(_TREE)].decode(), which)
                members[names.index(_TREE)] = tree.encode()
                marks = [fingerprint_of_bytes(m) for m in members]
            except _NO_ARTEFACT:
                marks = [mark]
            self._contents[which, mark] = " ".join(marks)
        return self._contents[which, mark]

    def _placeless(self, text: str, which: int) -> str:
        for name, both in sorted(self._moved.items(), key=lambda item: -len(item[1][which])):
            text = text.replace(both[which], f"<{name}>")
        return text


def _members(data: bytes) -> tuple[list[str], list[bytes]]:
    """Names and contents of what an artefact's bytes hold. Raises of `_NO_ARTEFACT`."""
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        infos = file.infolist()
        packed = any(m.compress_type != zipfile.ZIP_STORED for m in infos)
        if packed or sum(m.file_size for m in infos) > len(data):
            raise ValueError("it takes more than it is")
        return [m.filename for m in infos], [file.read(m) for m in infos]


def _inputs(manifest: dict[str, Any]) -> dict[str, tuple[str, dict[str, Any]]]:
    """Place and hashes by file of each input."""
    out = {}
    for name, entry in manifest.items():
        if (
            isinstance(entry, dict)
            and isinstance(entry.get("files"), dict)
            and isinstance(entry.get("path"), str)
        ):
            out[name] = entry["path"], {str(n): m for n, m in entry["files"].items()}
        elif isinstance(entry, dict):
            out[name] = "", {str(n): m for n, m in entry.items()}
    return out
