"""What a run was given and where it ran, besides the recipe."""

from __future__ import annotations

import getpass
import json
import os
import platform
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any, Final

from pyproj import CRS
from pyproj.exceptions import CRSError

import geomosaic
from geomosaic.pipeline.recipe import Recipe
from geomosaic.pipeline.run_folder import RunFolder
from geomosaic.recording.file.levels import RecordOptions
from geomosaic.recording.file.privacy import Privacy

_SYSTEMS: Final = frozenset({"crs", "pos_crs", "height_datum", "heights"})
"""Parameters that name reference systems."""


def surroundings(*, private: bool) -> dict[str, Any]:
    """The command line, the machine, and unless it is `private` who ran it where."""
    memory_bytes = 0
    with suppress(ValueError, OSError, AttributeError):
        memory_bytes = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    machine = {"processors": os.cpu_count(), "cpu": _processor(), "memory_bytes": memory_bytes}
    here: dict[str, Any] = {"command": [Path(sys.argv[0]).name, *sys.argv[1:]], "machine": machine}
    if private:
        return here | {"command": [without_folders(word) for word in here["command"]]}
    user = ""
    with suppress(OSError, KeyError):
        user = getpass.getuser()
    return here | {"host": platform.node(), "user": user, "folder": str(Path.cwd())}


def without_folders(word: str) -> str:
    """A word of the command line with the last name alone of its path, be it relative or behind an `=`."""
    name, equals, value = word.rpartition("=")
    return name + equals + Path(value.replace("\\", "/")).name if value.strip("/\\") else word


def commit() -> str:
    """The commit of the program, where it was installed from one or runs in a checkout; else empty."""
    with suppress(PackageNotFoundError, OSError, ValueError, AttributeError):
        url = json.loads(distribution("geomosaic-ortho").read_text("direct_url.json") or "{}")
        if named := url.get("vcs_info", {}).get("commit_id"):
            return str(named)
    git = Path(geomosaic.__file__).parent.parent / ".git"
    with suppress(OSError, UnicodeDecodeError):
        head = (git / "HEAD").read_text().strip()
        if not head.startswith("ref: "):
            return head
        ref = head.removeprefix("ref: ")
        if (git / ref).is_file():
            return (git / ref).read_text().strip()
        packed = (line.split(" ") for line in (git / "packed-refs").read_text().splitlines())
        return next((parts[0] for parts in packed if parts[1:] == [ref]), "")
    return ""


def sizes(place: Path, names: Iterable[str]) -> dict[str, int]:
    """Bytes of the files that an input stands for, by their names in the manifest (`FileHashes.manifest`)."""
    folder = place if place.is_dir() else place.parent
    return {name: (folder / name).stat().st_size for name in names if (folder / name).is_file()}


def _processor() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor()


def privacy_of(record: RecordOptions, recipe: Recipe, folder: RunFolder) -> Privacy | None:
    """What a recording leaves out; None where nothing is."""
    if not record.hides:
        return None
    inputs = {p for step in recipe.steps for p in step.stage.files(step.params).values()}
    parents = {p.absolute().parent for p in inputs}
    texts = [text for step in recipe.steps for text in _texts(step.params.model_dump())]
    listed = {Path(text.rpartition("=")[2]).absolute().parent for _, text in texts if "/" in text}
    named = {*inputs, *parents, *listed, folder.path, folder.path.parent, Path.cwd(), Path.home()}
    systems = [s for name, text in texts if name in _SYSTEMS for s in _names_of(text)]
    return Privacy(named, systems, places=record.private_places)


def _texts(params: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The texts among a stage's parameters, each with the parameter's name."""
    for name, value in params.items():
        for one in value if isinstance(value, list | tuple) else (value,):
            if isinstance(one, str):
                yield name, one


def _names_of(system: str) -> list[str]:
    """A reference system as it was given, and by its name."""
    with suppress(CRSError):
        crs = CRS.from_user_input(system)
        return [system, crs.name, *(part.name for part in crs.sub_crs_list)]
    return []
