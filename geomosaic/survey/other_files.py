"""Files of a survey's folder that are no frames but could be made into some: raw images, HEIC, videos."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Final

from geomosaic.doors.camera_formats import CAMERA_FORMATS
from geomosaic.doors.files import printable
from geomosaic.survey.model import Warn
from geomosaic.survey.names import natural_key

_OTHER_KINDS: Final = (
    (
        frozenset({".arw", ".cr2", ".cr3", ".nef", ".orf", ".raf", ".rw2", ".raw"}),
        "convert raw images to JPEG or TIFF first, with their tags (exiftool -tagsFromFile RAW JPEG)",
    ),
    (
        frozenset({".mp4", ".mov", ".avi", ".mkv", ".m4v"}),
        "take frames out of the video first: geomosaic frames FILE -o FRAMES",
    ),
)
"""Suffixes of files that people give for frames, and how to make frames of them."""
_AMONG_FRAMES: Final = (
    *((its.suffixes, f"{its.convert}, or map them from a folder of their own") for its in CAMERA_FORMATS),
    *_OTHER_KINDS,
)
"""The same of files in a folder of other frames."""


def advice(files: Iterable[Path]) -> str:
    """What to do with a folder that holds no frames, by the files that it holds."""
    there = {path.suffix.lower() for path in files}
    for suffixes, what in _OTHER_KINDS:
        if there & suffixes:
            return what
    return "give the folder that holds the frames themselves"


def unused_files(frames: Collection[Path]) -> list[Warn]:
    """One warning of the raw images, HEIC files and videos in the folders of frames.

    A file with a frame's name and another suffix is the same photograph and is not counted, nor is any of
    the frames' own kind.
    """
    stems = {(frame.parent, frame.stem.casefold()) for frame in frames}
    own = {frame.suffix.lower() for frame in frames}
    files = [path for folder in {frame.parent for frame in frames} for path in folder.iterdir()]
    left = [
        path
        for path in sorted(files, key=lambda path: natural_key(path.name))
        if not path.name.startswith(".")
        and path.suffix.lower() not in own
        and (path.parent, path.stem.casefold()) not in stems
    ]
    fixes = {
        what: [path for path in left if path.suffix.lower() in suffixes] for suffixes, what in _AMONG_FRAMES
    }
    unused = [path for paths in fixes.values() for path in paths]
    if not unused:
        return []
    kinds = ", ".join(f"{n} {kind}" for kind, n in Counter(p.suffix.lower() for p in unused).items())
    number = f"{len(unused)} files are" if len(unused) > 1 else "1 file is"
    todo = "; ".join(what for what, paths in fixes.items() if paths)
    text = f"{number} not used ({kinds}), such as {printable(unused[0].name)}, so ground may be missing"
    return [Warn("files-not-used", "", f"{text}; to add them, {todo}")]
