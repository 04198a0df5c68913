"""Finding the frame that a file means by a name."""

from __future__ import annotations

import difflib
import re
import unicodedata
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import Final

from geomosaic.doors.files import printable
from geomosaic.errors import InputError

_IMAGE = re.compile(
    r"\.(jpe?g|tiff?|png|dng|hei[cf]|hif|raw|3fr|arw|cr[23]|fff|gpr|iiq|nef|orf|pef|raf|rw[2l]|srw|x3f)$",
    re.IGNORECASE,
)
_REPLACED = re.compile(r"[\W_]+")
"""What file systems and programs replace in names, such as colons and blanks."""


def _folded(name: str) -> str:
    """A name without regard to capitals, or to how accents are written: macOS takes them apart."""
    return unicodedata.normalize("NFC", name).casefold()


def frame_name(path: Path) -> str:
    """What a frame is called everywhere: its file's name, without what spoils a page or a terminal."""
    return printable(path.name)


class FrameNames:
    """A folder's frame names, found also without folders, in other capitals, with another extension, or with
    other characters between letters and digits."""

    def __init__(self, names: Iterable[str], captures: Iterable[Sequence[str]] = ()) -> None:
        """captures: all names in order of capture, those that a rig took at once together."""
        self._names = tuple(names)
        self._captures = tuple(captures)
        self._exact = frozenset(self._names)
        self._by_name: dict[str, list[str]] = {}
        self._by_stem: dict[str, list[str]] = {}
        self._by_plain: dict[str, list[str]] = {}
        for name in self._names:
            folded = _folded(name)
            self._by_name.setdefault(folded, []).append(name)
            stem = _IMAGE.sub("", folded)
            self._by_stem.setdefault(stem, []).append(name)
            self._by_plain.setdefault(_REPLACED.sub("_", stem), []).append(name)
        self._most_words = max((len(n.split()) for n in self._names), default=0)

    @property
    def all(self) -> tuple[str, ...]:
        """Every name, as the frames bear it."""
        return self._names

    @property
    def in_order(self) -> tuple[str, ...]:
        """Every name in order of capture, else by the numbers in the names: a counter may begin anew."""
        captured = tuple(name for capture in self._captures for name in capture)
        return captured or tuple(sorted(self._names, key=natural_key))

    def exposed(self, count: int) -> Sequence[Sequence[str]] | None:
        """The names of each of so many exposures in order of capture: all that a rig took at once, else one
        each. None for another number."""
        each = [(name,) for name in self.in_order]
        return next((found for found in (self._captures, each) if len(found) == count), None)

    def find(self, text: str) -> str | None:
        """The frame meant; None if there is none. `InputError` if several could be."""
        *folders, name = PurePosixPath(text.replace("\\", "/")).parts or ("",)
        joined = ["_".join([*folders[i:], name]) for i in range(len(folders) + 1)]
        for whole in joined:  # a name that several folders have stands with them
            if whole in self._exact:
                return whole
        found = next(filter(None, map(self._alike, joined)), [])
        if len(found) > 1:
            raise InputError(
                f"'{text}' may be any of {', '.join(found)}", fix="write its extension and capitals"
            )
        return found[0] if found else None

    def _alike(self, name: str) -> list[str]:
        """The frames called so, by what matters least last."""
        folded = _folded(name)
        stem = _IMAGE.sub("", folded)
        found = self._by_name.get(folded) or self._by_stem.get(folded) or self._by_stem.get(stem)
        return found or self._by_plain.get(_REPLACED.sub("_", stem), [])

    def quoted(self, text: str) -> str:
        """A line separated by blanks, with the longest frame name that holds some in quotes."""
        if self._most_words < 2 or '"' in text:
            return text
        words = [(m.start(), m.end()) for m in re.finditer(r"\S+", text)]
        for count in range(min(self._most_words, len(words)), 1, -1):
            for (start, _), (_, end) in zip(words, words[count - 1 :], strict=False):
                name = _folded(text[start:end])
                if name in self._by_name or _IMAGE.sub("", name) in self._by_stem:
                    return f'{text[:start]}"{text[start:end]}"{text[end:]}'
        return text

    def near(self, text: str) -> str:
        """A hint at the most similar name, or at the folder's first one."""
        near = difflib.get_close_matches(text, self._names, n=1, cutoff=0.6)
        return f"did you mean {near[0]}?" if near else f"the frames are named like {self._names[0]}"


NO_NAMES: Final = FrameNames(())


def some(names: Iterable[str], most: int = 3) -> str:
    """A few names of many: `a, b, c and 12 more`."""
    names = [*names]
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def natural_key(name: str) -> tuple[tuple[int, int | str], ...]:
    """Sorts DJI_9 before DJI_10."""
    parts = re.split(r"(\d+)", Path(name).name.casefold())
    return tuple((0, int(p)) if p.isdecimal() else (1, p) for p in parts if p)
