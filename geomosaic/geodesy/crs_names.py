"""Coordinate reference systems as people write them: codes, PROJ strings, WKT, and names."""

from __future__ import annotations

import difflib
import os
import re
import sqlite3
import unicodedata
from collections import defaultdict
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

from pyproj import CRS, Transformer, datadir
from pyproj.crs import CompoundCRS
from pyproj.database import query_crs_info
from pyproj.enums import PJType
from pyproj.exceptions import CRSError, ProjError

from geomosaic.doors.plain import shown
from geomosaic.errors import InputError

_EPSG: Final = re.compile(r"EPSG[\s:_]*(\d{3,7})(?!\d)", re.IGNORECASE)
_HEIGHTS: Final = re.compile(r"\s*\)?\s*(?:\([^()]*\)\s*)?(?:\+|,\s*crs:)\s*(.*)", re.IGNORECASE)
"""What follows a code where heights are named too."""
_VERTICAL: Final = re.compile(r"(?:EPSG[\s:_]*|^)(\d{3,7})(?!\d)", re.IGNORECASE)
_WKT: Final = re.compile(
    r"(PROJ(CS|CRS|ECTEDCRS)|GEOG(CS|CRS|RAPHICCRS)|GEOD(CRS|ETICCRS)|COMP(D_CS|OUNDCRS)|BOUNDCRS)\s*[\[(]",
    re.IGNORECASE,
)
_UTM: Final = re.compile(
    r"(.*?)[\s/,_-]*UTM[\s_-]*(?:zone)?[\s_-]*(\d{1,2})[\s_-]*([A-Z]|north|south)?", re.IGNORECASE
)
_BANDS: Final = "CDEFGHJKLMNPQRSTUVWX"
_AUTHORITIES: Final = ("EPSG", "ESRI", "IGNF")
_KNOWN_AS: Final[Mapping[str, tuple[str, ...]]] = {
    "puwg1992": ("EPSG:2180",),
    "puwg92": ("EPSG:2180",),
    "puwg2000": ("EPSG:2176", "EPSG:2177", "EPSG:2178", "EPSG:2179"),
    "gaussboaga": ("EPSG:3003", "EPSG:3004"),
    "bng": ("EPSG:27700",),
    "etrstm35fin": ("EPSG:3067",),
    "lest97": ("EPSG:3301",),
    "egsa87": ("EPSG:2100",),
}
"""Names in common use that PROJ's database lacks, as `_plain` has them."""


class AmbiguousCrsError(InputError):
    """A name that several coordinate reference systems have, and nothing tells which is meant."""


@dataclass(frozen=True)
class StatedCrs:
    """What a text says of a CRS: codes or WKT of all systems it may mean, in groups, the likeliest first.

    vertical: of its heights where the text names it apart. by_name: it is no code, PROJ string or WKT. line:
    of the table that states it, None where it is given otherwise.
    """

    text: str
    groups: tuple[tuple[str, ...], ...]
    vertical: str | None = None
    by_name: bool = False
    line: int | None = None

    def meant(self, group: Iterable[str]) -> list[CRS]:
        """The systems of a group, with heights where the text names their datum."""
        if self.vertical is None:
            return [crs_of(code) for code in group]
        heights = crs_of(self.vertical)
        names = ((crs, f"{crs.name} + {heights.name}") for crs in map(crs_of, group))
        return [CRS(CompoundCRS(name=name, components=[crs, heights]).to_wkt()) for crs, name in names]

    def is_name_of(self, crs: CRS) -> bool:
        """Whether it says no less than the system itself: its code, definition or own name."""
        return not self.by_name or _plain(self.text) == _plain(crs.name)

    def ambiguous(self, which: Iterable[CRS], fix: str) -> AmbiguousCrsError:
        """The error that lists what the text may mean."""
        names = [label(crs) for crs in which]
        more = f" and {len(names) - 6} more" if len(names) > 6 else ""
        return AmbiguousCrsError(f"{shown(self.text)} may be any of {', '.join(names[:6])}{more}", fix=fix)


@lru_cache(maxsize=512)
def crs_of(code: str) -> CRS:
    """A CRS by code, PROJ string or WKT."""
    return CRS.from_user_input(code)


def label(crs: CRS) -> str:
    """`EPSG:2180 (ETRF2000-PL / CS92)`; of a system without a code its name."""
    code = crs.to_authority()
    return f"{':'.join(code)} ({crs.name})" if code else crs.name


def stated_crs(text: str) -> StatedCrs | None:
    """What a text says of a CRS; None where it is neither code, PROJ string, WKT nor a known name.

    Raises: `InputError` for a code, PROJ string or WKT that PROJ doesn't know.
    """
    text = text.strip()
    if found := coded_crs(text):
        return found
    if groups := _named(text):
        return StatedCrs(text, groups, by_name=True)
    horizontal, plus, vertical = (part.strip() for part in text.rpartition("+"))
    if plus and (height := _heights(vertical)) and (over := stated_crs(horizontal)):
        return StatedCrs(text, over.groups, height, by_name=True)
    return None


def is_wkt(text: str) -> bool:
    """Whether a text begins as the WKT of a geographic, projected, compound or bound CRS does."""
    return _WKT.match(text.strip()) is not None


def coded_crs(text: str) -> StatedCrs | None:
    """`stated_crs` of a code, PROJ string or WKT; None for what is none of them by its form."""
    text = text.strip()
    code = text
    if not is_wkt(text):
        epsg = _EPSG.search(text)
        if epsg and not text[: epsg.start()].rstrip().endswith("+"):
            code = f"EPSG:{epsg[1]}"
            if not text.startswith("+") and (named := _HEIGHTS.match(text, epsg.end())):
                if (height := _heights(named[1])) is None:
                    raise InputError(
                        f"{shown(named[1])} in {shown(text)} is no vertical datum that PROJ knows"
                    )
                code += f"+{height.removeprefix('EPSG:')}"
        elif re.fullmatch(r"\d{4,6}", text):
            code = f"EPSG:{text}"
        elif not re.match(r"\+proj=\w|(ESRI|IGNF|OGC):\w+$", text, re.IGNORECASE):
            return None
    try:
        crs = crs_of(code)
    except CRSError as error:
        raise InputError(f"{shown(text)} is no coordinate reference system that PROJ knows") from error
    if not (crs.is_geographic or crs.is_projected):
        raise InputError(f"{label(crs)} is a {crs.type_name}, neither geographic nor a map projection")
    return StatedCrs(text, (((_code_of_unreachable(crs) if is_wkt(text) else None) or code,),))


def _code_of_unreachable(crs: CRS) -> str | None:
    """The code that a system states of itself, where PROJ knows no way into it as it is written: Metashape
    misspells a parameter of oblique Mercator projections. None elsewhere."""
    try:
        Transformer.from_crs("EPSG:4979", crs)
    except ProjError:
        stated = ((crs.source_crs if crs.is_bound else None) or crs).to_json_dict().get("id")
        return f"{stated['authority']}:{stated['code']}" if stated else None
    return None


def required_crs(text: str, fix: str) -> StatedCrs:
    """What a text that must name a CRS says.

    Raises: `InputError` with the nearest names; fix: what to do where none is near.
    """
    try:
        found = stated_crs(text)
    except InputError as error:
        raise InputError(error.problem, fix=fix) from error
    if found is None:
        near = nearest_names(text)
        raise InputError(
            f"{shown(text)} is no known coordinate reference system",
            fix=f"did you mean {near}? Else {fix}" if near else fix,
        )
    return found


def nearest_names(text: str) -> str:
    """The systems whose names are most like a text, `EPSG:2180 (ETRF2000-PL / CS92) or ...`; may be empty."""
    index = _index()
    near = difflib.get_close_matches(_plain(text), [*_KNOWN_AS, *index], n=3, cutoff=0.7)
    ranks = [dict.fromkeys(_KNOWN_AS[n], 0) if n in _KNOWN_AS else index[n] for n in near]
    codes = dict.fromkeys(min(of, key=lambda code: _order(code, of)) for of in ranks)
    return " or ".join(label(crs_of(code)) for code in codes)


def _named(text: str) -> tuple[tuple[str, ...], ...]:
    """Codes by name: the system's own, an alias, its projection's alone, its datum's alone."""
    name = _plain(text)
    if name in _KNOWN_AS:
        return (_KNOWN_AS[name],)
    if utm := _UTM.fullmatch(text):
        return _utm(utm[1] or "WGS 84", int(utm[2]), (utm[3] or "").upper())
    ranks = _index().get(name, {})
    ordered = sorted(ranks, key=lambda code: _order(code, ranks))
    groups = (tuple(c for c in ordered if ranks[c] == rank) for rank in range(4))
    return tuple(group for group in groups if group)


def _utm(datum: str, zone: int, letter: str) -> tuple[tuple[str, ...], ...]:
    """A UTM zone; its letter is N or S of the hemisphere, else the latitude band.

    S is first the southern hemisphere, as in OpenDroneMap's files, then the band from 32 to 40 degrees north.
    """
    if len(letter) == 1 and letter not in _BANDS:
        return ()
    half = "S" if letter == "SOUTH" or letter < "N" else "N"
    halves = ("S", "N") if letter in ("S", "") else (half,)
    index = _index()
    found = [index.get(_plain(f"{datum} UTM {zone}{half}"), {}) for half in halves]
    likeliest = [min(ranks, key=lambda code: _order(code, ranks)) for ranks in found if ranks]
    if not letter and likeliest:
        return (tuple(likeliest),)
    return tuple((code,) for code in likeliest)


def _heights(text: str) -> str | None:
    """The code of a vertical CRS by its code, or by its name with or without `height`."""
    if code := _VERTICAL.search(text):
        return f"EPSG:{code[1]}"
    known = _verticals()
    return known.get(_plain(text)) or known.get(_plain(f"{text} height"))


def _plain(text: str) -> str:
    """A name for comparing: small letters, digits and `+`, without `zone`."""
    ascii_only = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode().lower()
    joined = "".join(word for word in re.findall(r"[a-z]+|[0-9+]+", ascii_only) if word != "zone")
    return re.sub("^wgs1984", "wgs84", joined)


def _order(code: str, ranks: Mapping[str, int]) -> tuple[int, int, int, str]:
    authority, _, number = code.partition(":")
    return ranks.get(code, 0), _AUTHORITIES.index(authority), int(number) if number.isdigit() else 0, number


@lru_cache(maxsize=1)
def _index() -> Mapping[str, Mapping[str, int]]:
    """Names and aliases of geographic and projected systems, and how much of the name each is (`_named`)."""
    index: dict[str, dict[str, int]] = defaultdict(dict)
    aliases = _aliases()
    for info in query_crs_info(pj_types=[PJType.PROJECTED_CRS, PJType.GEOGRAPHIC_2D_CRS]):
        if info.auth_name not in _AUTHORITIES:
            continue
        code = f"{info.auth_name}:{info.code}"
        for name in (info.name, *aliases.get(code, ())):
            datum, slash, projection = name.partition("/")
            whole = 0 if name == info.name else 1
            for part, rank in ((name, whole), (projection, 2), (datum, 3))[: 3 if slash else 1]:
                known = index[_plain(part)]
                known[code] = min(rank, known.get(code, rank))
    return index


@lru_cache(maxsize=1)
def _verticals() -> Mapping[str, str]:
    return {
        _plain(info.name): f"{info.auth_name}:{info.code}"
        for info in query_crs_info(auth_name="EPSG", pj_types=PJType.VERTICAL_CRS)
    }


def _aliases() -> Mapping[str, list[str]]:
    """Other names of systems, which pyproj doesn't give; none where PROJ's database isn't a file."""
    found: dict[str, list[str]] = defaultdict(list)
    query = (
        "SELECT auth_name || ':' || code, alt_name FROM alias_name "
        "WHERE table_name IN ('projected_crs', 'geodetic_crs')"
    )
    for folder in datadir.get_data_dir().split(os.pathsep):
        file = Path(folder) / "proj.db"
        if not file.is_file():
            continue
        try:
            with closing(sqlite3.connect(f"{file.as_uri()}?mode=ro&immutable=1", uri=True)) as database:
                for code, name in database.execute(query):
                    found[code].append(name)
        except sqlite3.Error:
            continue
        break
    return found
