"""The same files in two folders: what differs between two recordings by the folders' names alone."""

from __future__ import annotations

import difflib
import io
import json
import zipfile
from collections import Counter
from pathlib import PurePath
from typing import Any

import yaml

from geomosaic.doors.plain import plain_yaml
from geomosaic.errors import FileError
from geomosaic.recording.file.fingerprints import fingerprint_of_bytes
from geomosaic.recording.file.model import Recording, StageRecord
from geomosaic.recording.file.reader import artefact_data

_TREE = "tree.json"
_NO_ARTEFACT = (FileError, ValueError, RuntimeError, OSError, zipfile.BadZipFile, EOFError)


class Places:
    """Inputs of two recordings by parameter, as `survey.read.frames`: where they lay, and their files.

    Files count by content: other names for the same are no difference.
    """

    def __init__(self, a: Recording, b: Recording) -> None:
        self._both = a, b
        self._of = tuple(_inputs(r.manifest) for r in (a, b))
        alike = [n for n in self._of[0] if n in self._of[1] and not self._other_files(n)]
        self._moved = [n for n in alike if self._of[0][n] != self._of[1][n]]
        self._texts = tuple(self._named(i) for i in range(2))
        self._contents: dict[tuple[int, str], str] = {}

    def elsewhere(self) -> dict[str, list[str]]:
        """Inputs that are the same files in other places, or under other names: the places [of a, of b]."""
        return {name: [of[name][0] for of in self._of] for name in self._moved}

    def other_files(self) -> dict[str, list[Any]]:
        """Input files with other contents, or that one run alone had, by parameter and name: [of a, of b]."""
        out: dict[str, list[Any]] = {}
        for name in dict.fromkeys([*self._of[0], *self._of[1]]):
            out |= self._other_files(name)
        return out

    def _other_files(self, name: str) -> dict[str, list[Any]]:
        files = [dict(of[name][1]) if name in of else {} for of in self._of]
        contents = [Counter(map(str, f.values())) for f in files]
        if contents[0] == contents[1]:
            return {}
        marks = {file: [f.get(file) for f in files] for file in dict.fromkeys([*files[0], *files[1]])}
        return {f"{name}.{file}": both for file, both in marks.items() if both[0] != both[1]}

    def _named(self, which: int) -> list[tuple[str, str]]:
        """Texts that name moved inputs, and what stands for them, the longest first."""
        out: dict[str, str] = {}
        params = {s.stage_id: s.params for s in self._both[which].stages}
        for name in self._moved:
            place, files = self._of[which][name]
            stage, _, param = name.rpartition(".")
            for text in (place, params.get(stage, {}).get(param)):
                if isinstance(text, str) and text:
                    out[text] = f"<{name}>"
            out |= {str(PurePath(place) / file): f"<{mark}>" for file, mark in files.items()}
        return sorted(out.items(), key=lambda item: -len(item[0]))

    def recipe_lines(self) -> list[str]:
        """The difference of the recipes but for their descriptions, with moved inputs by their names."""
        a, b = (self._placeless(_plain(r.recipe_yaml), i).splitlines() for i, r in enumerate(self._both))
        return list(difflib.unified_diff(a, b, "a", "b", lineterm="", n=1))

    def same_params(self, a: StageRecord, b: StageRecord) -> tuple[dict[str, Any], dict[str, Any]]:
        """Both stages' parameters without those that name moved inputs."""
        moved = {n.removeprefix(f"{a.stage_id}.") for n in self._moved}
        return tuple({k: v for k, v in s.params.items() if k not in moved} for s in (a, b))  # type: ignore[return-value]

    def explain(self, name: str, marks: list[Any]) -> bool:
        """Whether an artefact's fingerprints differ only since it names moved inputs; where the artefacts
        aren't recorded, that is assumed."""
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
                tree = self._placeless(members[names.index(_TREE)].decode(), which, in_json=True)
                members[names.index(_TREE)] = tree.encode()
                marks = [fingerprint_of_bytes(m) for m in members]
            except _NO_ARTEFACT:
                marks = [mark]
            self._contents[which, mark] = " ".join(marks)
        return self._contents[which, mark]

    def _placeless(self, text: str, which: int, in_json: bool = False) -> str:
        for named, instead in self._texts[which]:
            text = text.replace(json.dumps(named)[1:-1] if in_json else named, instead)
        return text


def _plain(recipe: str) -> str:
    """A recipe but for its description, no line broken."""
    try:
        plain = plain_yaml(recipe, None, "")
        plain.pop("description", None)
        return str(yaml.safe_dump(plain, sort_keys=False, width=10**9))
    except (FileError, AttributeError, yaml.YAMLError):
        return recipe


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
