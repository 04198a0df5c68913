"""What a raster makes GDAL open besides itself, looked at first: its sidecars and the sources of a VRT."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Final
from xml.etree.ElementTree import Element, ParseError

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import fromstring

from geomosaic.doors.files import SHORT_BYTES
from geomosaic.errors import FileError

_MOST_XML_BYTES: Final = 16 << 20  # a VRT of 10,000 tiles has some 5 MB
_MOST_SOURCES: Final = 10_000  # opening each takes about 1 ms
_MOST_DEPTH: Final = 4
_HEAD_BYTES: Final = 4096  # GDAL looks for <VRTDataset in the first 1 to 4 kB, wherever it stands
_VRT_FIX: Final = "make one file of it with gdal_translate"
_TEXTS: Final = frozenset({".prj", ".wld", ".clr", ".hdr", ".stx", ".txt", ".qpj"})
_SIDECAR_FIX: Final = "remove it"
_TIFF: Final = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_MOSAIC_TAGS = """
    VRTDataset SRS GeoTransform Metadata MDI BlockXSize BlockYSize OverviewList VRTRasterBand
    Description UnitType Offset Scale NoDataValue HideNoDataValue ColorInterp ColorTable Entry
    Histograms HistItem HistMin HistMax BucketCount IncludeOutOfRange Approximate HistCounts
    CategoryNames Category MaskBand Overview SimpleSource ComplexSource AveragedSource
    NoDataFromMaskSource SourceFilename SourceBand SourceProperties SrcRect DstRect NODATA
    ScaleOffset ScaleRatio LUT UseMaskBand MaskValueThreshold RemappedValue
"""  # gdalbuildvrt, gdal_translate
_WARP_TAGS = """
    GDALWarpOptions WarpMemoryLimit ResampleAlg WorkingDataType Option SourceDataset Transformer
    ApproxTransformer MaxError BaseTransformer GenImgProjTransformer SrcGeoTransform
    SrcInvGeoTransform DstGeoTransform DstInvGeoTransform ReprojectTransformer
    ReprojectionTransformer SourceSRS TargetSRS Reverse BandList BandMapping SrcNoDataReal
    SrcNoDataImag DstNoDataReal DstNoDataImag SrcAlphaBand DstAlphaBand
"""  # gdalwarp -of VRT
_VRT_TAGS: Final = frozenset((_MOSAIC_TAGS + _WARP_TAGS).split())
_PATH_TAGS: Final = frozenset({"SourceFilename", "SourceDataset"})
_SUBCLASSES: Final = frozenset({"", "VRTWarpedDataset", "VRTSourcedRasterBand", "VRTWarpedRasterBand"})


_COMPANION: Final = re.compile(
    r"\.(\w{1,3}w|wld|aux|rrd|ovr|msk|hdr|prj|stx|clr|xml|csvt|cpg|dbf|shx|shp|qix|sbn|sbx|dat|map|id|ind|tab)"
)
"""Suffixes of what GDAL's raster and vector drivers read with a file: world files first."""


def check_sidecars(path: Path) -> None:
    """`FileError` where a file that goes with path could lead GDAL to another place than this folder.

    World files and .prj are plain text. Overviews and masks must be TIFF or Imagine files themselves; an
    .aux.xml may not name a file.
    """
    name, stem = path.name.lower(), path.stem.lower()
    for file in path.parent.iterdir():
        lower = file.name.lower()
        if not lower.startswith(f"{stem}.") or file.name == path.name or file.is_dir():
            continue
        if not file.is_file():
            raise FileError(f"is no regular file next to {path.name}", file=file, fix=_SIDECAR_FIX)
        if lower.endswith(".aux.xml"):
            _check_aux(file)
        elif lower.endswith((".ovr", ".msk")) and lower.startswith(f"{name}."):
            _check_plain(file, _TIFF)
        elif lower.endswith((".aux", ".rrd")):
            _check_plain(file, (b"EHFA",))
        elif file.suffix.lower() in _TEXTS and file.stat().st_size > SHORT_BYTES:
            raise FileError(f"is over {SHORT_BYTES >> 20} MB", file=file, fix=_SIDECAR_FIX)


def companions_of(path: Path) -> list[Path]:
    """The companion files that are read with a file: of the same stem, and of a kind that goes with rasters,
    shapefiles and tables. A log or an archive of the same stem is none."""
    near = (p for p in path.parent.iterdir() if p.name.startswith(f"{path.stem}.") and p != path)
    return sorted(p for p in near if _COMPANION.fullmatch(p.suffix.lower()) and p.is_file())


def sources_of(path: Path) -> list[Path]:
    """The files that a VRT is made of, those of the VRTs among them too; of any other file none.

    Raises: `FileError` as `check_sources` does.
    """
    return check_sources(path, lambda _: None)


def check_sources(path: Path, check_file: Callable[[Path], None]) -> list[Path]:
    """Looks at every source of a VRT, of the VRTs among them too; any other file is passed over.

    check_file raises for a source that isn't a VRT and is no raster either. Returns the sources.

    Raises: `FileError` for a source that isn't there or isn't local, VRTs in themselves or more than four
    deep, more than 10,000 sources, anything but mosaics and warps.
    """
    waiting, seen = [(path, 0)], {path}
    while waiting:
        file, depth = waiting.pop()
        if not _is_vrt(file):
            if depth:
                _check_once(check_file, file)
            continue
        if depth >= _MOST_DEPTH:
            raise FileError(f"VRTs lie more than {_MOST_DEPTH} deep in it", file=path, fix=_VRT_FIX)
        if depth:
            check_sidecars(file)
        for text, is_relative in _named(file, *_state(file)):
            source = _local(file, text, is_relative)
            if source in (path, file):
                raise FileError("the VRT is a source of itself", file=path, fix=_VRT_FIX)
            if source not in seen:
                seen.add(source)
                waiting.append((source, depth + 1))
        if len(seen) > _MOST_SOURCES:
            raise FileError(f"has more than {_MOST_SOURCES:,} sources", file=path, fix=_VRT_FIX)
    return sorted(seen - {path})


_checked: set[tuple[Path, tuple[int, ...]]] = set()


def _check_once(check_file: Callable[[Path], None], file: Path) -> None:
    key = file, _state(file)
    if key not in _checked:
        check_file(file)
        _checked.add(key)


def _state(path: Path) -> tuple[int, int, int]:
    found = path.stat()
    return found.st_ino, found.st_size, found.st_mtime_ns


def _local(vrt: Path, text: str, is_relative: bool) -> Path:
    """The regular local file that a VRT names."""
    shown = text if len(text) < 200 else f"{text[:200]}..."
    source = vrt.parent / text if is_relative else Path(text)
    if "\0" in text or "://" in text or str(source).startswith("/vsi") or not source.is_absolute():
        problem = f"its source '{shown}' is no file on this machine"
        raise FileError(problem, file=vrt, fix="name a local file")
    try:
        regular = stat.S_ISREG(source.stat().st_mode)
    except OSError as error:
        problem = f"its source '{shown}' is not there"
        raise FileError(problem, file=vrt, fix="copy it too, or correct the VRT") from error
    if not regular:
        raise FileError(f"its source '{shown}' is no regular file", file=vrt, fix="name a local file")
    return Path(os.path.abspath(source))  # noqa: PTH100 - GDAL follows no links in the name either


@lru_cache(maxsize=64)
def _named(path: Path, *_state: int) -> tuple[tuple[str, bool], ...]:
    """The sources a VRT names, each with whether it counts from the VRT's folder."""
    return tuple(_sources(_parsed(path, "VRT", _VRT_FIX), path))


def _sources(root: Element, path: Path) -> Iterator[tuple[str, bool]]:
    for element in root.iter():
        tag = str(element.tag)
        subclass = element.get("subClass", "")
        known = tag in _VRT_TAGS and subclass in _SUBCLASSES
        if tag == "Option":  # of a warp: numbers, words, outlines
            known = not set("/\\<") & set(element.text or "")
        if tag == "Metadata":
            known = element.get("domain", "") != "GEOLOCATION"
        if not known:
            what = f"{tag} {subclass or element.get('name', '') or element.get('domain', '')}".strip()[:80]
            raise FileError(f"the VRT holds a {what}, which isn't followed", file=path, fix=_VRT_FIX)
        if tag in _PATH_TAGS:
            is_relative = element.get("relativeToVRT", element.get("relativetoVRT", "0")).strip()
            yield (element.text or "").strip(), is_relative not in ("", "0")


def _check_aux(path: Path) -> None:
    for element in _parsed(path, "sidecar", _SIDECAR_FIX).iter():
        names = element.get("domain", "").upper(), element.get("key", "").upper()
        if "OVERVIEWS" in names or "OVERVIEW_FILE" in names:
            raise FileError("the sidecar refers to another file", file=path, fix=_SIDECAR_FIX)


def _parsed(path: Path, what: str, fix: str) -> Element:
    with path.open("rb") as file:
        text = file.read(_MOST_XML_BYTES + 1)
    if len(text) > _MOST_XML_BYTES:
        raise FileError(f"the {what} is over {_MOST_XML_BYTES >> 20} MB", file=path, fix=fix)
    try:
        root: Element = fromstring(text, forbid_dtd=True)
    except (ParseError, DefusedXmlException, ValueError, LookupError) as error:
        raise FileError(f"the {what} is no well-formed XML", file=path, fix=fix) from error
    return root


def _check_plain(path: Path, magics: tuple[bytes, ...]) -> None:
    head = _head(path)
    if not head.startswith(magics) or b"<VRTDataset" in head or b"<GDAL_" in head:
        raise FileError("is not the overview or mask its name says", file=path, fix=_SIDECAR_FIX)


def _is_vrt(path: Path) -> bool:
    return b"<VRTDataset" in _head(path)


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(_HEAD_BYTES)
    except OSError as error:
        raise FileError(
            f"can't be read ({error.strerror})", file=path, fix="is it the right file?"
        ) from error
