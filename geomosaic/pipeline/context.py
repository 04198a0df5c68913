"""What a stage gets besides its inputs: folders, recorder, progress, workers, randomness, notes."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, TypeVar, Unpack

import numpy as np

from geomosaic.errors import CancelledError, FileError
from geomosaic.pipeline.executor import Workers
from geomosaic.pipeline.hashes import FileHashes
from geomosaic.pipeline.items import Items, Progress
from geomosaic.pipeline.run_folder import WORK, RunFolder
from geomosaic.pipeline.stage_recorder import StageRecorder
from geomosaic.pipeline.stored_result import OptionalCache, StoredResult, without_bytes
from geomosaic.recording.file.fingerprints import fingerprint_of_bytes, fingerprint_of_json

if TYPE_CHECKING:
    from geomosaic.pipeline.earlier_run import EarlierRun

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True)
class RunFile:
    """An artefact that is a file: its name relative to the run folder, and the hash of its contents."""

    name: str
    fingerprint: str


@dataclass
class Notes:
    """What a stage adds to run.json besides its artefacts; kept with them in the cache."""

    warnings: list[dict[str, str]] = field(default_factory=list)
    metrics: dict[str, Any] = field(default_factory=dict)
    report: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Notes:
        """Notes as `dataclasses.asdict` gave them. Raises `FileError` for anything else."""
        notes = cls(**{name: copy.deepcopy(plain[name]) for name in cls().__dict__ if name in plain})
        warnings = notes.warnings if isinstance(notes.warnings, list) else [None]
        whole = isinstance(notes.metrics, dict) and isinstance(notes.report, dict)
        for warning in warnings:
            texts = list(warning.values()) if isinstance(warning, dict) else []
            named = isinstance(warning, dict) and warning.keys() == {"code", "frame", "text"}
            whole = whole and named and all(isinstance(text, str) for text in texts)
        if not whole:
            raise FileError("a stage's notes aren't what a run writes")
        return notes

    def add_to(self, summary: dict[str, Any]) -> None:
        """Adds these notes to a summary of the shape of run.json."""
        summary.setdefault("warnings", []).extend(copy.deepcopy(self.warnings))
        _merge(summary.setdefault("metrics", {}), self.metrics)
        summary.update(copy.deepcopy(self.report))


def _merge(into: dict[str, Any], other: Mapping[str, Any]) -> None:
    for name, value in other.items():
        if isinstance(value, dict) and isinstance(into.get(name), dict):
            _merge(into[name], value)
        else:
            into[name] = copy.deepcopy(value)


def plain(value: Any) -> Any:
    """A value as JSON knows it: numpy numbers and arrays as plain ones, not-a-number as None."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"{type(value).__name__} has no place in run.json")


class Surroundings(TypedDict, total=False):
    """What a run gives a stage's `Context`.

    seed: the recipe's, for a stage that reports it; randomness comes from `Context.rng`.
    key: the fingerprint of the stage's work; nothing is kept without one. earlier: see `Stage.goes_on`.
    """

    stage_id: str
    version: int
    code: str
    work_folder: Path
    recorder: StageRecorder
    workers: Workers
    hashes: FileHashes
    seed: int
    key: str
    fixed_time: bool
    on_progress: Progress
    on_note: Callable[[str], None]
    cancelled: Callable[[], bool]
    summary: Mapping[str, Any]
    earlier: EarlierRun | None


class Context:
    """A stage's surroundings. Only `run_folder` is needed to run a stage by hand, as in a test.

    lasting_items: where `map` keeps results that outlive the stage's own outcome. optional_caches: see
    `Items.caches`.
    """

    def __init__(self, run_folder: Path | RunFolder, **given: Unpack[Surroundings]) -> None:
        if isinstance(run_folder, Path):
            run_folder = RunFolder(run_folder, overwrite=True)
        self._folder = run_folder
        self.run_folder = self._folder.path
        self.stage_id = given.get("stage_id", "stage")
        self.work_folder = given.get("work_folder") or self._folder.within(f"{WORK}/{self.stage_id}")
        self.work_folder.mkdir(parents=True, exist_ok=True)
        self.recorder = given.get("recorder") or StageRecorder(stage=self.stage_id)
        self.fixed_time = given.get("fixed_time", False)
        self.notes = Notes()
        self.kept: list[Path] = []
        self._workers = given.get("workers") or Workers()
        self._hashes = given.get("hashes") or FileHashes()
        self.key = given.get("key", "")
        self.seed = given.get("seed", 0)
        self.earlier = given.get("earlier")
        self._on_progress = given.get("on_progress")
        self._on_note = given.get("on_note")
        self._cancelled = given.get("cancelled")
        self._summary = given.get("summary", {})
        made_by = self.stage_id, given.get("version", 1), given.get("code", ""), self.key
        self._items = Items(
            self.work_folder, *made_by, self._workers, self._hashes, self.progress, self.inform
        )
        self.lasting_items = self._items.lasting
        self.optional_caches = self._items.caches

    def progress(self, done: int, total: int, text: str = "") -> None:
        """Says how far the stage is; raises `CancelledError` if the user stopped the run."""
        self.check_cancelled()
        if self._on_progress is not None:
            self._on_progress(done, total, text)

    def check_cancelled(self) -> None:
        """Raises `CancelledError` if the user stopped the run; long loops call it."""
        if self._cancelled is not None and self._cancelled():
            raise CancelledError

    def warn(self, code: str, frame: str, text: str) -> None:
        """Something the user should know: a stable kebab-case code, the frame (or ''), one line."""
        self.notes.warnings.append({"code": code, "frame": frame, "text": text})
        self.recorder.log("warning", f"{code}: {text}", frame=frame)

    def inform(self, text: str) -> None:
        """What the user wants to know while the run is on: one line on the screen and in the recording.

        Not there with `fixed_time`: it may depend on the machine.
        """
        if not self.fixed_time:
            self.recorder.log("info", text)
        if self._on_note is not None:
            self._on_note(text)

    @property
    def workers(self) -> int:
        """How many processes `map` spreads its work over."""
        return self._workers.workers

    def metric(self, name: str, value: Any) -> None:
        """A number for run.json's `metrics`; dots in the name nest: `adjustment.rounds`."""
        *path, last = name.split(".")
        at = self.notes.metrics
        for part in path:
            at = at.setdefault(part, {})
        at[last] = plain(value)
        self.recorder.metric(name, at[last])

    def report(self, key: str, value: Any) -> None:
        """A whole entry of run.json: `frames`, `camera`, `mosaic`."""
        self.notes.report[key] = plain(value)
        self.recorder.metric(key, self.notes.report[key])

    def summary(self) -> dict[str, Any]:
        """What run.json will hold so far, this stage's notes included."""
        summary = copy.deepcopy(dict(self._summary))
        self.notes.add_to(summary)
        return summary

    def rng(self, purpose: str) -> np.random.Generator:
        """A random generator of the recipe's seed, this stage and this purpose alone."""
        name = int(fingerprint_of_bytes(f"{self.stage_id}/{purpose}".encode()), 16)
        return np.random.default_rng(np.random.SeedSequence([self.seed, name]))

    @contextmanager
    def writing(self, filename: str) -> Iterator[Path]:
        """A temporary path that becomes RUN/filename if the block succeeds (see `files.writing`).

        The file, or the folder made there, is one of the stage's outputs. A name such as
        `work/mosaic.compose/raster.tif` puts it into the work folder.
        """
        with self._folder.writing(filename) as temporary:
            yield temporary
        self.keep(self._folder.within(filename))

    def keep(self, path: Path) -> None:
        """Says that a file the stage wrote by itself belongs to its outputs.

        The stage is taken from the cache only as long as all such files are unchanged, and their
        contents enter the fingerprints of its outputs.
        """
        if path not in self.kept:
            self.kept.append(path)

    def run_file(self, filename: str) -> RunFile:
        """The artefact of a file in the run folder."""
        return RunFile(filename, self._hashes.of_written(self._folder.within(filename)))

    def content_of(self, path: Path) -> str:
        """Names the content of an input and of its companion files."""
        return fingerprint_of_json(sorted(self._hashes.named([str(path)]).values()))

    def copied_file(self, filename: str, original: RunFile) -> RunFile:
        """The artefact of a file that was written as a copy of another one."""
        path = self._folder.within(filename)
        return RunFile(filename, self._hashes.of_copy(path, self._folder.within(original.name)))

    def path_of(self, file: RunFile) -> Path:
        """Where a file artefact lies. Raises `FileError` if it isn't there any more."""
        path = self._folder.within(file.name)
        if not path.exists():
            raise FileError("the file is gone", file=path, fix="run the recipe again")
        return path

    def map(
        self,
        name: str,
        function: Callable[[Item], Result],
        items: Iterable[Item],
        keys: Sequence[Any] | None = None,
    ) -> list[Result]:
        """`[function(item) for item in items]`, spread over the workers, each result kept on disk.

        `function` is a module-level function (or a partial of one) whose result depends on its arguments and
        the files that these name alone. It says what it returns in its annotation. A killed run finds the
        finished results again.

        Results are named by the function, what a partial binds, the item, and the contents of all files that
        these name. Any text or path in them that is a file counts, with its companion files. So results
        outlive whatever doesn't change these: other parameters, new frames. What no run wants any more goes
        when a run is finished. Give a function what it needs and nothing else. A number that depends on all
        frames together (a place in the work frame, a median) makes every item new when a frame comes.

        With `keys`, which distinguish the items, results are named by the stage's own fingerprint, `name` and
        key. Any change to the stage's parameters or inputs redoes them all, and they go when the run is
        finished. Items are then made one after the other, as workers take them.
        """
        return self._items.mapped(name, function, items, keys, StoredResult.load)

    def stored(
        self, name: str, function: Callable[[Item], Result], items: Iterable[Item]
    ) -> list[StoredResult[Result]]:
        """As `map`, but results stay on the disk and are referred to.

        A `StoredResult` may stand in the items of a later `map` instead of the result. Only its file's name
        is sent, and identifies the item. The function calls `recall`, which reads the file once per worker.
        """
        return self._items.mapped(name, function, items, None, without_bytes)

    def optional_cache(self, returns: type[Result], path: str, version: int = 1) -> OptionalCache[Result]:
        """A cache entry for a result of this type and this file's content, shared between stages. version: of
        how the result is made."""
        if not self.key:
            return OptionalCache(returns, None)
        mark = fingerprint_of_json([returns.__name__, version, self._hashes.of_file(Path(path))])
        return OptionalCache(returns, self._folder.within(f"{WORK}/spared/items/{mark[:2]}/{mark[2:]}"))

    @contextmanager
    def spooled(
        self, name: str, function: Callable[[Item], Result], items: Iterable[Item], keys: Sequence[Any]
    ) -> Iterator[list[StoredResult[Result]]]:
        """As `map` with `keys`, for results that are too large for memory at once: see `stored`.

        They are there until the block ends; if it fails, the next run finds them.
        """
        kept = self._items.mapped(name, function, items, keys, without_bytes)
        yield kept
        for one in kept:
            one.forget()
