"""A folder of frames: which files in it and its folders are frames, and which are masks of frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from pathlib import Path
from typing import Final

from geomosaic.constants import tuned
from geomosaic.doors.camera_formats import CAMERA_FORMATS
from geomosaic.doors.files import RUN_MARKER, TEXT_BYTES, check_name, printable, read_bytes
from geomosaic.doors.raster import MASK, open_raster, reading
from geomosaic.errors import FileError, InputError
from geomosaic.survey.header import (
    JPEG_SUFFIXES,
    PNG_SUFFIXES,
    TIFF_SUFFIXES,
    FrameHeader,
    check_blocks,
    mask_size_error,
)
from geomosaic.survey.model import Warn
from geomosaic.survey.names import FrameNames, frame_name, natural_key, some
from geomosaic.survey.other_files import advice
from geomosaic.survey.png import png_damage
from geomosaic.survey.timestamp_mrk import matches

_SUFFIXES: Final = JPEG_SUFFIXES | TIFF_SUFFIXES
_MASK_ENDINGS: Final = ("_mask", ".mask")
_HOMES: Final = ("images", "dcim")
"""Where OpenDroneMap's projects and cameras' cards hold frames; what else they hold is made of them."""
_PROJECT_FILES: Final = {"pos": "geo.txt", "gcp": "gcp_list.txt"}
_DEEPEST = tuned(4, "folders", "DCIM has two, MicaSense three: deeper ones are another survey's")
_MOST_FOLDERS = tuned(2000, "folders", "1000 flights of two: more is a whole disk, searched for minutes")
_MASK_SUFFIXES: Final = frozenset({".png", ".tif", ".tiff", *JPEG_SUFFIXES})


class NoFramesError(InputError):
    """A folder holds no frames; some may still come."""


def frame_files(folder: Path, other: Collection[Path] = ()) -> dict[Path, str]:
    """The frames of a folder, in the natural order of their paths, and what each is called. They are its JPEG
    and TIFF files, else its PNG files, else its DNG or its HEIC files. Next to JPEG and TIFF files, PNG files
    are previews and masks.

    Where its folder `images` or `DCIM` has more, they are those of it. If neither has any, they are those of
    all folders in it, four deep. A frame is called by its file's name; where several folders have it, with
    its folders' before it (`100MEDIA_DJI_0001.JPG`). Hidden files and folders, links to folders, folders of
    runs, masks (`NAME_mask.png`, `NAME.mask.tif`) and other inputs of the survey (its DEM) are no frames.
    Raises: `FileError` for what is no folder, `InputError` if there are no frames or their reader is missing.
    """
    folder = folder.absolute()
    if not folder.is_dir():
        problem = "is no folder" if folder.exists() else "there is no such folder"
        raise FileError(problem, file=folder, fix="give the folder that holds the frames")
    check_name(folder)
    inputs = {p.absolute() for p in other}
    frames, top = _found(folder, inputs, _SUFFIXES)
    if not frames:
        frames, top = _found(folder, inputs, PNG_SUFFIXES)
    for camera_format in CAMERA_FORMATS:
        if not frames:
            frames, top = _found(folder, inputs, camera_format.suffixes)
            if frames:
                camera_format.check(folder)
    if not frames:
        files, folders = _listed(folder)
        kinds = Counter(p.suffix.lower() or "no suffix" for p in files)
        there = [f"{n} {kind}" for kind, n in kinds.most_common(4)]
        there += [f"{len(folders)} folder{'s' * (len(folders) > 1)} without any"] * bool(folders)
        problem = f"holds no JPEG, TIFF or PNG frames ({', '.join(there) or 'it is empty'})"
        others = [p for f in _below(folder) for p in _listed(f)[0]]
        raise NoFramesError(problem, file=folder, fix=advice(others))
    return _called(frames, top)


def _found(folder: Path, inputs: Collection[Path], suffixes: Collection[str]) -> tuple[list[Path], Path]:
    """Frames with such suffixes and the folder to call them from: a home's, where it has more than the folder
    itself, else the folder's own, else those below it."""
    files, folders = _listed(folder)
    own = _frames(files, inputs, suffixes)
    for home in (f for f in folders if f.name.casefold() in _HOMES):
        frames = _frames_below(home, inputs, suffixes)
        if len(frames) > len(own):
            return frames, home
    return own or _frames_below(folder, inputs, suffixes), folder


def _frames_below(folder: Path, inputs: Collection[Path], suffixes: Collection[str]) -> list[Path]:
    return [p for f in _below(folder) for p in _frames(_listed(f)[0], inputs, suffixes)]


def frame_folders(folder: Path, other: Collection[Path] = ()) -> dict[str, Path]:
    """The folders that hold the frames of `frame_files`, by their paths from `folder`; "" is that itself."""
    folder = folder.absolute()
    found = dict.fromkeys(p.parent for p in frame_files(folder, other))
    return {p.relative_to(folder).as_posix() if p != folder else "": p for p in found}


def project_files(folder: Path) -> dict[str, Path]:
    """The POS and the control file of an OpenDroneMap project, as far as its folder holds them. Without such
    a POS file it is the drone's own Timestamp.MRK, where there is one that matches the frames."""
    named = {kind: folder / name for kind, name in _PROJECT_FILES.items()}
    found = {kind: path for kind, path in named.items() if path.is_file()}
    by_drone = sorted(path for path in folder.glob("*.[mM][rR][kK]") if path.is_file())
    if "pos" in found or len(by_drone) != 1:
        return found
    names = FrameNames(frame_files(folder).values())
    return {"pos": by_drone[0], **found} if matches(by_drone[0], names) else found


def unused_images(folder: Path, frames: Collection[Path], other: Collection[Path] = ()) -> list[Warn]:
    """One warning of the JPEG and TIFF files that are no frames since they lie elsewhere.

    They lie in folders next to the frames, or in a folder whose home holds the frames.

    Args: frames and other: what `frame_files` found in the folder, and the survey's other inputs.
    """
    folder = folder.absolute()
    files, folders = _listed(folder)
    own = _frames(files, {p.absolute() for p in other})
    if not own:
        return []
    if not set(own) <= set(frames):
        home = next(iter(frames)).relative_to(folder).parts[0]
        number = f"{len(own)} files are" if len(own) > 1 else "1 file is"
        named = some(printable(p.name) for p in own)
        text = f"{number} not used, as the folder {home} holds the frames: {named}"
        return [Warn("files-not-used", "", f"{text}; to add them, move them there")]
    inner = [f.name for f in folders if _frames(_listed(f)[0], ())]
    if not inner:
        return []
    text = f"images in folders next to the frames are not used: {some(inner)}"
    fix = f"to map those alone, give {folder.name}/{inner[0]}; to map all, move them into one folder"
    return [Warn("frames-in-folders", "", f"{text}; {fix}")]


def _listed(folder: Path) -> tuple[list[Path], list[Path]]:
    """Files and folders in a folder, in natural order; not the hidden, nor links to folders, nor runs."""
    files, folders = [], []
    try:
        for path in sorted(folder.iterdir(), key=lambda p: natural_key(p.name)):
            if path.name.startswith("."):
                continue
            if path.is_dir() and path.suffix.lower() not in _SUFFIXES:
                folders += [path] * (not path.is_symlink() and not (path / RUN_MARKER).exists())
            elif path.is_file() or path.suffix.lower() in _SUFFIXES:
                files.append(path)
    except OSError as error:
        raise FileError(f"can't be listed ({error.strerror})", file=folder, fix="make it readable") from error
    for path in files:
        check_name(path)
    return files, folders


def _below(folder: Path) -> list[Path]:
    """A folder and those inside it, four deep; `InputError` where there are too many."""
    found, level = [folder], [folder]
    for _ in range(_DEEPEST):
        level = [inner for outer in level for inner in _listed(outer)[1]]
        found += level
        if len(found) > _MOST_FOLDERS:
            raise InputError(
                f"holds no frames, but more than {_MOST_FOLDERS} folders to look for them",
                file=folder,
                fix="give the folder of the flight",
            )
    return found


def _frames(
    files: Collection[Path], inputs: Collection[Path], suffixes: Collection[str] = _SUFFIXES
) -> list[Path]:
    return [
        p
        for p in files
        if p.suffix.lower() in suffixes and not p.stem.casefold().endswith(_MASK_ENDINGS) and p not in inputs
    ]


def _called(frames: Collection[Path], top: Path) -> dict[Path, str]:
    alike = Counter(frame_name(p) for p in frames)
    called = {
        p: frame_name(p)
        if alike[frame_name(p)] == 1 or p.parent == top
        else printable("_".join(p.relative_to(top).parts))
        for p in frames
    }
    again = Counter(called.values())
    twice = next((name for name in called.values() if again[name] > 1), None)
    if twice is not None:
        raise InputError("its name looks like that of another frame", file=twice, fix="rename one of them")
    return called


def masks(headers: list[FrameHeader]) -> tuple[dict[str, str], dict[str, InputError]]:
    """Two mappings by frame name, of the frames that have a mask: the path of the mask, and what is wrong
    with it. The latter is of masks that can't be read, are damaged or aren't of their frame's size."""
    folders = {header.path.parent for header in headers}
    by_name = {(f, p.name.casefold()): p for f in folders for p in f.iterdir()}
    found: dict[str, str] = {}
    spoiled: dict[str, InputError] = {}
    for header in headers:
        stem = header.path.stem.casefold()
        names = (f"{stem}{ending}{suffix}" for ending in _MASK_ENDINGS for suffix in sorted(_MASK_SUFFIXES))
        folder = header.path.parent
        mask = next((by_name[folder, n] for n in names if (folder, n) in by_name), None)
        if mask is not None:
            try:
                _check_size(mask, header)
                found[header.name] = str(mask)
            except InputError as error:
                spoiled[header.name] = error
    return found, spoiled


def _check_size(mask: Path, header: FrameHeader) -> None:
    with open_raster(mask, MASK) as raster:
        size = raster.width, raster.height
        if raster.driver == "GTiff":
            with reading(mask, MASK.problem, MASK.fix):
                check_blocks(raster, mask, MASK.fix)
        damage = ""
        if raster.driver == "PNG":
            damage = png_damage(read_bytes(mask, TEXT_BYTES, "a mask", MASK.fix))
    if damage:
        raise FileError(f"the mask is damaged: {damage}", file=mask, fix="copy or make it again")
    if size != (header.width_px, header.height_px):
        raise mask_size_error(mask, size, (header.width_px, header.height_px))
