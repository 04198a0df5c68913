"""Files that a run read, as the manifest of its inputs names them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path, PurePath
from stat import S_ISDIR
from typing import Any, Final

from geomosaic.doors.files import mode_of

_FRAMES: Final = "survey.read.frames"


def files_of(entry: Mapping[str, Any]) -> Iterator[tuple[Path, str]]:
    """The files of an input in a manifest, where they lay, and their hashes."""
    place, names = Path(str(entry["path"])), entry["files"]
    alone = place.name in names and not S_ISDIR(mode_of(place))
    for name, mark in names.items():
        within = name if PurePath(name).is_absolute() else PurePath(name).name
        yield (place.parent if alone else place) / within, str(mark)


def frame_files(manifest: Mapping[str, Any]) -> Iterator[tuple[Path, str]]:
    """The files in all folders of frames, where they lay, and their hashes."""
    for name, entry in manifest.items():
        here = name == _FRAMES or name.startswith(f"{_FRAMES}/")
        if here and isinstance(entry, dict) and isinstance(entry.get("files"), dict) and "path" in entry:
            yield from files_of(entry)
