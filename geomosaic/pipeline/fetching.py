"""Files of a survey fetched from other machines into a folder, each whole under its name or not there."""

from __future__ import annotations

import os
import re
import shutil
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

from geomosaic.constants import tuned
from geomosaic.doors.addresses import Address
from geomosaic.doors.plain import read_json
from geomosaic.doors.remote import MOST_FILES, Remote, copy, listed, look
from geomosaic.errors import FileError, InputError, OutputError
from geomosaic.pipeline import files
from geomosaic.pipeline.folder_lock import locked_folder
from geomosaic.pipeline.reporter import Reporter

Item = TypeVar("Item")
Result = TypeVar("Result")
Stopped = Callable[[], bool]

NOTED: Final = ".fetched.json"
"""In the folder: what was fetched into it, from where, and what its server said of it then."""
_MOST_NOTED_BYTES: Final = 128 << 20
_KINDS: Final = re.compile(
    r"jpe?g|tiff?|png|dng|hei[cf]|csv|txt|pos|json|ya?ml|prj|wld|tfw|jgw|hdr|xml|ovr|msk"
    r"|asc|img|dem|hgt|dt[012]|bil|flt|vrt|gpkg|geojson|shp|shx|dbf|fgb|kml",
    re.IGNORECASE,
)
"""Frames, masks, strips; positions, control, cameras; elevation models, areas and what goes with them."""
_CONNECTIONS = tuned(6, "requests", "at once: fewer wait for answers; more are refused by servers")
_MOST_BYTES = tuned(16 << 30, "bytes", "of a file: strips have some GB; more is a mistake or fills the disk")
_SPARE_BYTES = tuned(256 << 20, "bytes", "of disk left free: a full one harms other programs")


@dataclass(frozen=True)
class Fetched:
    """Names that were fetched, with their bytes, those that were there, and those that no survey holds."""

    fetched: tuple[str, ...]
    size_bytes: int
    there: tuple[str, ...]
    skipped: tuple[str, ...]


def fetch(wanted: Iterable[Address], folder: Path, reporter: Reporter, *, overwrite: bool = False) -> Fetched:
    """Fetches files that a survey can hold; those that are there as their servers have them stay.

    Nothing is written before all of them were asked for. overwrite: files that are in the way, or were
    changed since they were fetched, may be replaced.

    Raises: `InputError` for what isn't to be had, is too large or named twice; `OutputError` for a folder or
    a disk that can't take it.
    """
    started = time.monotonic()
    reporter.stage_started(0, 1, "Fetch")
    found, skipped = _remote_files(_named_once(wanted), reporter)
    files.make_folder(folder)
    with locked_folder(folder, "fetch"):
        files.sweep(folder)
        noted = _Noted(folder)
        left = [remote for remote in found if not noted.has(remote)]
        for remote in left:
            noted.check_free(remote, overwrite)
        _check_room(left, folder)
        noted.add(left)
        _each(
            lambda remote, stopped: _fetch(remote, noted, stopped),
            left,
            lambda done: reporter.progress(done, len(left), "files"),
        )
    reporter.stage_finished(time.monotonic() - started, "work")
    fetched = tuple(remote.address.name for remote in left)
    there = tuple(sorted({remote.address.name for remote in found}.difference(fetched)))
    return Fetched(fetched, sum(remote.size_bytes for remote in left), there, tuple(skipped))


def _named_once(wanted: Iterable[Address]) -> list[Address]:
    """Addresses given twice count once."""
    return list({address.vsi: address for address in wanted}.values())


def _remote_files(wanted: Sequence[Address], reporter: Reporter) -> tuple[list[Remote], list[str]]:
    """What the servers report of wanted files, and the names of the others."""
    found: list[Remote] = []
    asked: list[Address] = []
    skipped: list[str] = []
    for address in wanted:
        if address.name:
            asked.append(address)
            continue
        inside, folders = listed(address)
        found += inside
        skipped += [f"{name}/" for name in folders]
    skipped += [a.name for a in (*asked, *(r.address for r in found)) if not _is_wanted(a)]
    found = [r for r in found if _is_wanted(r.address)]
    known = {r.address.vsi for r in found}
    asked = [a for a in asked if _is_wanted(a) and a.vsi not in known]
    _check_names([*asked, *(r.address for r in found)])
    if not asked and not found:
        named = f": {', '.join(skipped[:3])}" if skipped else ""
        fix = "give a folder or a list of JPEG, TIFF or PNG files"
        raise InputError(f"none of the addresses is a frame or another file of a survey{named}", fix=fix)
    found += _each(
        lambda address, _: look(address), asked, lambda done: reporter.progress(done, len(asked), "asking")
    )
    for remote in found:
        if remote.size_bytes > _MOST_BYTES:
            problem = f"has {remote.size_bytes / 1e9:,.1f} GB, more than {_MOST_BYTES >> 30} GiB"
            raise InputError(problem, file=remote.address.text, fix="is it the right file?")
    return found, skipped


def _is_wanted(address: Address) -> bool:
    return not address.name.startswith(".") and _KINDS.fullmatch(Path(address.name).suffix[1:]) is not None


def _check_names(addresses: Sequence[Address]) -> None:
    """`InputError` for two files of one name; capitals don't tell them apart on every disk."""
    if len(addresses) > MOST_FILES:
        raise InputError(f"more than {MOST_FILES:,} files are asked for", fix="fetch one survey at a time")
    by_name: dict[str, Address] = {}
    for address in addresses:
        other = by_name.setdefault(address.name.casefold(), address)
        if other is not address:
            problem = f"its name is that of {other.text} too"
            raise InputError(problem, file=address.text, fix="fetch them into two folders")


def _check_room(left: Sequence[Remote], folder: Path) -> None:
    needed, free = sum(remote.size_bytes for remote in left), shutil.disk_usage(folder).free
    if left and needed + _SPARE_BYTES > free:
        problem = f"{needed / 1e9:,.2f} GB are to be fetched, and {free / 1e9:,.2f} GB are free"
        raise OutputError(problem, file=folder, fix="free some or choose another folder")


class _Noted:
    """What was fetched into a folder. A file of a noted name, size and time is whole and nobody changed it:
    it is noted before it gets its name, and gets its time with it. For threads."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._path = files.path_within(folder, NOTED)
        self._lock = threading.Lock()
        self._entries: dict[str, dict[str, Any]] = self._read()
        self._later: dict[str, dict[str, Any]] = {}

    def _read(self) -> dict[str, dict[str, Any]]:
        try:
            plain = read_json(self._path, _MOST_NOTED_BYTES, "such notes", "remove it")
            return {k: v for k, v in plain["files"].items() if isinstance(v, dict)}
        except (FileError, AttributeError, KeyError, TypeError):  # none, or not ours
            return {}

    def path(self, remote: Remote) -> Path:
        """Where a file goes. Raises `OutputError` where a link stands."""
        return files.path_within(self._folder, remote.address.name)

    def has(self, remote: Remote) -> bool:
        """Whether a file is there as its server has it now."""
        entry = self._entries.get(remote.address.name, {})
        same = remote.is_same(entry.get("size_bytes"), entry.get("changed_s"), entry.get("tag"))
        return same and entry.get("address") == remote.address.text and self._is_untouched(remote)

    def _is_untouched(self, remote: Remote) -> bool:
        entry = self._entries.get(remote.address.name, {})
        try:
            status = self.path(remote).lstat()
        except OSError:
            return False
        return [status.st_size, status.st_mtime_ns] == [entry.get("size_bytes"), entry.get("time_ns")]

    def check_free(self, remote: Remote, overwrite: bool) -> None:
        """`OutputError` for a file that people put there or changed."""
        path = self.path(remote)
        if not os.path.lexists(path) or self._is_untouched(remote) or overwrite:
            return
        changed = remote.address.name in self._entries
        problem = "was changed since it was fetched" if changed else "is in the way: it was not fetched"
        raise OutputError(problem, file=path, fix="move it elsewhere, or allow it with --overwrite")

    def add(self, remotes: Sequence[Remote]) -> None:
        """Notes what is about to be fetched; of a file that is to be replaced, once the new one is whole."""
        for remote in remotes:
            name, now_s = remote.address.name, int(time.time())
            entry = {
                "address": remote.address.text,
                "size_bytes": remote.size_bytes,
                "changed_s": remote.changed_s,
                "tag": remote.tag,
                "time_ns": 10**9 * (remote.changed_s if 0 < remote.changed_s <= now_s else now_s),
            }
            self._later[name] = entry
            if not os.path.lexists(self.path(remote)):
                self._entries[name] = entry
        self._save()

    def arrive(self, remote: Remote, temporary: Path) -> None:
        """Gives a whole file its time, and makes way for it."""
        name = remote.address.name
        entry = self._later[name]
        os.utime(temporary, ns=(entry["time_ns"], entry["time_ns"]))
        with self._lock:
            if self._entries.get(name) is not entry:
                self._entries[name] = entry
                self.path(remote).unlink(missing_ok=True)
                self._save()

    def _save(self) -> None:
        files.write_json(self._path, {"files": dict(sorted(self._entries.items()))})


def _fetch(remote: Remote, noted: _Noted, stopped: Stopped) -> None:
    with files.writing(noted.path(remote)) as temporary:
        with temporary.open("xb") as file:
            copy(remote, file, stopped)
        noted.arrive(remote, temporary)


def _each(
    function: Callable[[Item, Stopped], Result], items: Sequence[Item], done: Callable[[int], None]
) -> list[Result]:
    """`function` of each item, several at once; the first failure, or Ctrl-C, ends them all."""
    stop = threading.Event()
    with ThreadPoolExecutor(_CONNECTIONS) as pool:
        running = [pool.submit(function, item, stop.is_set) for item in items]
        results: list[Result] = []
        try:
            for future in running:
                done(len(results))
                results.append(future.result())
        except BaseException:
            stop.set()
            for future in running:
                future.cancel()
            raise
    return results
