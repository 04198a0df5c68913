"""Which of a folder's images can be used: the others are left out and named."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from geomosaic.constants import tuned
from geomosaic.doors.files import check_regular
from geomosaic.errors import FileError, InputError
from geomosaic.survey.damage import FrameAppearance, Wholeness, wholeness
from geomosaic.survey.folder import masks
from geomosaic.survey.header import FrameHeader, read_header
from geomosaic.survey.model import UnusedImage, Warn

Inspect = Callable[[list[str]], list[Wholeness]]
DAMAGED: Final = ("leave_out", "mask")
_LEAST_WHOLE = tuned(0.25, "share", "of a damaged frame's rows: less hardly ties to its neighbours")


@dataclass(frozen=True)
class Usable:
    """headers of the frames that are used; whole_rows of those among them whose lower part is masked; looks,
    and paths of their masks, by the frames' names."""

    headers: list[FrameHeader]
    whole_rows: dict[str, int]
    looks: dict[str, FrameAppearance | None]
    masks: dict[str, str]
    left_out: tuple[UnusedImage, ...]
    warnings: tuple[Warn, ...]


def inspect_all(paths: list[str]) -> list[Wholeness]:
    """One after the other."""
    return [wholeness(path) for path in paths]


def usable(
    files: Mapping[Path, str],
    inspect: Inspect,
    *,
    mask_damaged: bool = False,
    strict: bool = False,
    progress: Callable[[int, int, str], None] | None = None,
) -> Usable:
    """The frames that can be read whole; of damaged ones the whole part, if asked for and if that is known.
    A frame whose mask is spoiled isn't used: what of it is valid is unknown.

    Args: files: what frames are called, by their files. Raises: `InputError` of the first that can't be used,
    if none can or if strict.
    """
    headers: list[FrameHeader] = []
    unreadable: dict[str, InputError] = {}
    for i, (file, name) in enumerate(files.items()):
        try:
            check_regular(file, "take it out of the folder")
            headers.append(replace(read_header(file), called=name))
        except InputError as error:
            unreadable[name] = error
        if progress is not None:
            progress(i + 1, len(files), "reading headers")
    valid_masks, spoiled = masks(headers)
    unreadable |= spoiled
    headers = [header for header in headers if header.name not in spoiled]
    used, whole_rows, looks, warnings = [], {}, {}, []
    for header, found in zip(headers, inspect([str(h.path) for h in headers]), strict=True):
        name, rows = header.name, found.whole_rows
        looks[name] = found.look
        if not found.damage:
            used.append(header)
        elif mask_damaged and rows >= _LEAST_WHOLE * header.height_px:
            used.append(header)
            whole_rows[name] = rows
            text = (
                f"damaged: {found.damage}; only its first {rows} of {header.height_px} rows are used; "
                "copy it again from the card"
            )
            warnings.append(Warn("frame-damaged", name, text))
        else:
            problem = f"the image data are damaged: {found.damage}"
            if mask_damaged:
                problem += f" (where is not known, or above row {_LEAST_WHOLE * header.height_px:.0f})"
            fix = "copy it again from the camera, or take it out of the folder"
            unreadable[name] = FileError(problem, file=header.path, fix=fix)
    lost = [name for name in files.values() if name in unreadable]
    if lost and (strict or not used):
        raise unreadable[lost[0]]
    left_out = tuple(UnusedImage(name, _reason(unreadable[name], spoiled.get(name))) for name in lost)
    notes = [f"left out: {o.reason}; {unreadable[o.name].fix}" for o in left_out]
    warnings = [
        *(Warn("frame-damaged", o.name, text) for o, text in zip(left_out, notes, strict=True)),
        *warnings,
    ]
    return Usable(used, whole_rows, looks, valid_masks, left_out, tuple(warnings))


def _reason(error: InputError, of_mask: InputError | None) -> str:
    """What is wrong; of a mask with its name."""
    return error.problem if of_mask is None else f"{error.problem} ({Path(str(error.file)).name})"
