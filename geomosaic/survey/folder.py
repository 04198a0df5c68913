"""A folder of frames: which files are frames, and which are masks of frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Final

from geomosaic.constants import CHOSEN, Because
from geomosaic.doors.files import check_name, read_bytes
from geomosaic.doors.raster import MASK, open_raster, reading
from geomosaic.errors import FileError, InputError
from geomosaic.survey.damage import png_damage
from geomosaic.survey.header import JPEG_SUFFIXES, TIFF_SUFFIXES, FrameHeader, check_blocks
from geomosaic.survey.names import frame_name, natural_key

_SUFFIXES: Final = JPEG_SUFFIXES | TIFF_SUFFIXES
_MASK_ENDINGS: Final = ("_mask", ".mask")
_MOST_MASK_BYTES: Annotated[
    int,
    Because(
        "bytes",
        "of a PNG mask: of two values, packed, one of 200 megapixels takes less than 1 MB, unpacked 200; a "
        "larger file would take the memory",
        CHOSEN,
    ),
] = 256 << 20
_MASK_SUFFIXES: Final = frozenset({".png", ".tif", ".tiff"})


def frame_files(folder: Path, other: Collection[Path] = ()) -> list[Path]:
    """The JPEG and TIFF files of a folder, not of those inside it, in the natural order of their names.

    Hidden files, masks (`NAME_mask.png`, `NAME.mask.tif`) and other inputs of the survey (its DEM) are
    no frames. Raises: `FileError` for what is no folder, `InputError` if there are no frames.
    """
    folder = folder.absolute()
    if not folder.is_dir():
        problem = "is no folder" if folder.exists() else "there is no such folder"
        raise FileError(problem, file=folder, mend="give the folder that holds the frames")
    try:
        entries = (p for p in folder.iterdir() if p.is_file() or p.suffix.lower() in _SUFFIXES)
        files = sorted(entries, key=lambda p: natural_key(p.name))
    except OSError as error:
        raise FileError(f"can't be listed ({error.strerror})", file=folder) from error
    for path in (folder, *(p for p in files if not p.name.startswith("."))):
        check_name(path)
    inputs = {p.absolute() for p in other}
    frames = [
        p
        for p in files
        if p.suffix.lower() in _SUFFIXES
        and not p.name.startswith(".")
        and not p.stem.casefold().endswith(_MASK_ENDINGS)
        and p not in inputs
    ]
    if not frames:
        kinds = Counter(p.suffix.lower() or "no suffix" for p in files)
        held = ", ".join(f"{n} {kind}" for kind, n in kinds.most_common(4))
        raise InputError(
            f"holds no JPEG or TIFF frames ({held or 'it is empty'})",
            file=folder,
            mend="give the folder that holds the frames themselves",
        )
    alike = Counter(frame_name(p) for p in frames)
    twice = next((p for p in frames if alike[frame_name(p)] > 1), None)
    if twice is not None:
        raise InputError(
            "its name reads like that of another frame", file=frame_name(twice), mend="rename it"
        )
    return frames


def masks(headers: list[FrameHeader]) -> dict[str, str]:
    """Frame name -> path of its mask, for the frames of one folder that have one.

    Raises: `FileError` for a mask that can't be read, is damaged or isn't of its frame's size.
    """
    by_name = {p.name.casefold(): p for p in headers[0].path.parent.iterdir()}
    found = {}
    for header in headers:
        stem = header.path.stem.casefold()
        names = (f"{stem}{ending}{suffix}" for ending in _MASK_ENDINGS for suffix in sorted(_MASK_SUFFIXES))
        mask = next((by_name[n] for n in names if n in by_name), None)
        if mask is not None:
            _check_size(mask, header)
            found[header.path.name] = str(mask)
    return found


def _check_size(mask: Path, header: FrameHeader) -> None:
    with open_raster(mask, MASK) as raster:
        size = raster.width, raster.height
        if raster.driver == "GTiff":
            with reading(mask, MASK.problem, MASK.mend):
                check_blocks(raster, mask, MASK.mend)
        damage = ""
        if raster.driver == "PNG":
            damage = png_damage(read_bytes(mask, _MOST_MASK_BYTES, "a mask", MASK.mend))
    if damage:
        raise FileError(f"the mask is damaged: {damage}", file=mask, mend="copy or make it again")
    if size != (header.width_px, header.height_px):
        raise FileError(
            f"the mask has {size[0]} x {size[1]} pixels, its frame {header.width_px} x {header.height_px}",
            file=mask,
            mend="make a mask of the frame's size",
        )
