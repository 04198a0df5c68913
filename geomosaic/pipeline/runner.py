"""Runs a checked recipe into a run folder."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, BinaryIO

from geomosaic.errors import CancelledError, FileError, GeomosaicError
from geomosaic.pipeline import files
from geomosaic.pipeline.artefacts import type_name, with_texts
from geomosaic.pipeline.cache import (
    ArtefactHandle,
    CachedOutcome,
    Lineage,
    StageCache,
    file_manifest,
    lineage_of,
    stage_key,
)
from geomosaic.pipeline.context import Context
from geomosaic.pipeline.environment import versions
from geomosaic.pipeline.executor import Workers, peak_memory_bytes
from geomosaic.pipeline.hashes import FileHashes
from geomosaic.pipeline.memory_release import release_memory
from geomosaic.pipeline.plugin import blamed, code_of
from geomosaic.pipeline.provenance import commit, sizes, surroundings
from geomosaic.pipeline.recipe import RECORDING, RUN_JSON, UNFINISHED, Recipe, RecipeStep
from geomosaic.pipeline.replayed_stage import ReplayedStage, bring_files
from geomosaic.pipeline.reporter import Reporter, Silent, Source, warning_lines
from geomosaic.pipeline.run_folder import WORK, RunFolder
from geomosaic.pipeline.stage import Stage
from geomosaic.pipeline.stage_recorder import replay_calls
from geomosaic.pipeline.stage_task import StageLog, StageTask, concurrent_steps, may_be_forged_data
from geomosaic.recording.file.fingerprints import artefact_fingerprint, fingerprint_of_bytes
from geomosaic.recording.file.levels import RecordOptions
from geomosaic.recording.file.privacy import Privacy
from geomosaic.recording.file.writer import Recorder
from geomosaic.recording.rerun.live import watched


def run(
    recipe: Recipe,
    run_folder: Path,
    *,
    overwrite: bool = False,
    workers: int = 1,
    dask: str | None = None,
    fixed_time: bool = False,
    given: Mapping[int, ReplayedStage] | None = None,
    reporter: Reporter | None = None,
    cancelled: Callable[[], bool] | None = None,
    record: RecordOptions | None = None,
) -> dict[str, Any]:
    """Runs every stage, from the cache in RUN/work where nothing it depends on has changed.

    What the finished run did not use is then deleted from RUN/work, and results of an earlier run that
    this one did not make are deleted too.

    overwrite: the folder may hold files of others, and results may replace them.
    given: outcomes of steps (by index) that are not to be run, as taken from a recording.
    fixed_time: equal runs give equal bytes in run.mcap; clock times stand in run.json alone.
    record: how much is recorded, and for whom. The recording of a run that didn't finish stays beside the new
    one.
    Returns what run.json holds. Raises `CancelledError` on Ctrl-C, and whatever a stage raises; the
    recording then ends with the error, and the folder has no run.json, but finished work stays cached.
    """
    given = given or {}
    recipe.check_files(skip=given.keys(), run_folder=run_folder)
    folder = RunFolder.opened(run_folder, sorted(recipe.results()), overwrite=overwrite)
    with files.in_one_wording(folder.path), folder.locked(), Workers(workers, dask) as team:
        _put_unfinished_aside(folder)
        folder.remove(RUN_JSON)
        files.sweep(folder.path)
        bring_files(recipe, given, folder)
        hashes = FileHashes(folder.within(f"{WORK}/hashes.json"))
        record = record or RecordOptions()
        if record.level == "off":
            folder.remove(RECORDING)
        privacy = _privacy(record, recipe, folder)
        path = None if record.level == "off" else folder.claim(RECORDING)
        try:
            with (
                Recorder(
                    path,
                    fixed_time=fixed_time,
                    level=record.level,
                    memory_bytes=team.memory_bytes,
                    privacy=privacy,
                ) as recorder,
                watched(path, record.live),
            ):
                runner = _Run(
                    *(recipe, folder, team, hashes, recorder, fixed_time, reporter or Silent(), cancelled),
                    privacy,
                )
                return runner.run(given)
        finally:
            hashes.save()


def _put_unfinished_aside(folder: RunFolder) -> None:
    """A run that was killed or failed left no run.json; its recording says where it was."""
    path = folder.within(RECORDING)
    if RECORDING in folder.made() and path.is_file() and not folder.within(RUN_JSON).exists():
        path.replace(folder.claim(UNFINISHED))


def _privacy(record: RecordOptions, recipe: Recipe, folder: RunFolder) -> Privacy | None:
    if not record.hides:
        return None
    inputs = {p for step in recipe.steps for p in step.stage.files(step.params).values()}
    parents = {p.absolute().parent for p in inputs}
    named = {*inputs, *parents, folder.path, folder.path.parent, Path.cwd(), Path.home()}
    return Privacy(named, places=record.private_places)


class _Run:
    """One run in progress."""

    def __init__(
        self,
        recipe: Recipe,
        folder: RunFolder,
        workers: Workers,
        hashes: FileHashes,
        recorder: Recorder,
        fixed_time: bool,
        reporter: Reporter,
        cancelled: Callable[[], bool] | None,
        privacy: Privacy | None = None,
    ) -> None:
        self._privacy = privacy
        self._marks: dict[str, str] = {}
        self._recipe = recipe
        self._folder = folder
        self._workers = workers
        self._hashes = hashes
        self._recorder = recorder
        self._fixed_time = fixed_time
        self._reporter = reporter
        self._cancelled = cancelled
        self._cache = StageCache(folder, hashes)
        self._artefacts: dict[str, ArtefactHandle] = {}
        self._lineages: list[Lineage] = []
        self._used: list[Path] = []
        self._begun: dict[int, CachedOutcome | StageTask] = {}
        self._summary: dict[str, Any] = {}

    def run(self, given: Mapping[int, ReplayedStage]) -> dict[str, Any]:
        stage = ""
        try:
            self._begin(given)
            total = len(self._recipe.steps)
            for i, step in enumerate(self._recipe.steps):
                stage = step.stage.id
                self._reporter.stage_started(i, total, step.stage.display_name)
                started = time.monotonic()
                marks = {name: self._mark(handle) for name, handle in self._inputs(step.stage).items()}
                version = given[i].record.version if i in given else step.stage.version
                params = step.params.model_dump(mode="json")
                self._recorder.stage_started(stage, version, params, marks, reads_run=not step.stage.cached)
                self._begin_concurrent(i, given)
                finished, source, early_s = self._step(i, given.get(i))
                self._end_stage(step.stage, finished, early_s or time.monotonic() - started, source)
                self._release(self._recipe.steps[i + 1 : i + 2])
            with self._folder.writing(RUN_JSON) as path:
                files.write_json(path, self._summary)
            self._tidy()
            self._hashes.forget_unasked()
            return self._summary
        except KeyboardInterrupt:
            self._end_begun()
            self._record_failure(stage, "stopped by the user")
            raise CancelledError from None
        except Exception as error:
            self._end_begun()
            self._record_failure(stage, f"{type(error).__name__}: {error}")
            raise

    def _release(self, then: Sequence[RecipeStep]) -> None:
        """What the next step doesn't take stays on the disk alone, until a later one does."""
        taken = {name for step in then for name in (*step.stage.inputs, *step.stage.optional_inputs)}
        for name in self._artefacts.keys() - taken:
            self._artefacts[name].release()
        release_memory()

    def _begin(self, given: Mapping[int, ReplayedStage]) -> None:
        environment = {**versions(), "commit": commit()}
        if not self._fixed_time:
            environment |= surroundings(private=self._privacy is not None)
        self._recorder.begin_run(self._recipe.yaml(), environment)
        manifest: dict[str, Any] = {}
        for i, step in enumerate(self._recipe.steps):
            if i in given:
                recorded = given[i].manifest()
                self._check_recorded(given[i])
                self._lineages.append(lineage_of({name: entry["files"] for name, entry in recorded.items()}))
                manifest |= {f"{step.stage.id}.{name}": entry for name, entry in recorded.items()}
                continue
            with blamed(step.stage):
                named = step.stage.files(step.params)
            content = file_manifest(named, self._hashes, self._hashing)
            self._lineages.append(lineage_of(content))
            for name, hashes in content.items():
                entry = {"path": str(named[name]), "files": hashes, "bytes": sizes(named[name], hashes)}
                manifest[f"{step.stage.id}.{name}"] = entry
        self._hashes.save()
        self._summary = {
            "recipe": self._recipe.plain(),
            "versions": versions(),
            "inputs": manifest,
            "warnings": [],
            "metrics": {},
            "timings_s": {},
            "memory_mb": {},
            "cached_stages": [],
            "recorded_stages": [],
            "artefacts": {},
        }
        self._recorder.inputs(manifest)

    def _check_recorded(self, given: ReplayedStage) -> None:
        """What a recorded stage found holds for the files it read, and only for them."""
        for path, mark in given.read_files():
            self._reporter.progress(0, 0, "reading inputs")
            if self._hashes.of_input(path) != mark:
                raise FileError(
                    "has changed since the recording, which holds the old one",
                    file=path,
                    fix="run the recipe again, or put the old file back",
                )

    def _tidy(self) -> None:
        """Removes what earlier runs left and this one did not make or use."""
        self._cache.prune(self._used)
        made = {RUN_JSON, RECORDING, *(path.relative_to(self._folder.path).as_posix() for path in self._used)}
        for name in (self._folder.made() & self._recipe.results()) - made:
            self._folder.remove(name)

    def _hashing(self, done: int, total: int) -> None:
        if self._cancelled is not None and self._cancelled():
            raise CancelledError
        self._recorder.progress(done, total, "reading inputs")
        self._reporter.progress(done, total, "reading inputs")

    def _inputs(self, stage: type[Stage]) -> dict[str, ArtefactHandle]:
        return {
            name: self._artefacts[name]
            for name in (*stage.inputs, *stage.optional_inputs)
            if name in self._artefacts
        }

    def _begin_concurrent(self, i: int, given: Mapping[int, ReplayedStage]) -> None:
        """Begins the stages that other processes can work on while step i is worked on."""
        for k in concurrent_steps(self._recipe.steps, i) if self._workers.elsewhere else ():
            if k not in self._begun and k not in given:
                self._begun[k] = task = self._task(k, early=True)
                if isinstance(task, StageTask):
                    task.begin()

    def _end_begun(self) -> None:
        """Whatever was begun before its turn, which won't come."""
        for task in self._begun.values():
            if isinstance(task, StageTask):
                task.end()

    def _step(self, i: int, given: ReplayedStage | None) -> tuple[CachedOutcome, Source, float]:
        """A step's outcome, where it is from, and the seconds it was worked on if that was begun early."""
        stage = self._recipe.steps[i].stage
        if given is not None:
            for message in given.messages():
                self._recorder.copy(*message)
            return self._cache.keep_replayed(stage, given, self._lineage(i)), "recording", 0.0
        early = i in self._begun
        task = self._begun.pop(i) if early else self._task(i, early=False)
        if isinstance(task, CachedOutcome):
            assert task.calls is not None
            replay_calls(task.calls, self._recorder)
            return task, "cache", 0.0
        try:
            values = task.outcome()
            self._hashes.check_unchanged()
        except BaseException as error:
            self._warn(task.context.notes.warnings)
            task.end()
            if self._summary["cached_stages"] and may_be_forged_data(error):
                work = self._folder.within(WORK)
                problem = f"{stage.id} fails on results stored there ({type(error).__name__}: {error})"
                raise FileError(problem, file=work, fix="remove it and run again") from error
            raise
        kept = self._cache.keep(stage, task.key, values, task.context, task.lineage, task.log.spool)
        return kept, "work", task.seconds if early else 0.0

    def _lineage(self, i: int) -> Lineage:
        inputs = self._inputs(self._recipe.steps[i].stage)
        return self._lineages[i].union(*(handle.lineage for handle in inputs.values()))

    def _task(self, i: int, *, early: bool) -> CachedOutcome | StageTask:
        """What a step's stage has to do: nothing, if its outcome is in the cache."""
        step, lineage = self._recipe.steps[i], self._lineage(i)
        stage, inputs = step.stage, self._inputs(step.stage)
        code = code_of(stage, stage.plugged(step.params))
        key = stage_key(step, inputs, self._recipe.seed, lineage, code)
        finished = self._cache.find(stage, key, lineage) if stage.cached else None
        if finished is not None and finished.calls is not None:
            return finished
        spool = self._cache.spool(stage)
        log = StageLog(self._recorder, self._reporter, spool, stage.id, self._cancelled, early=early)
        context = Context(
            self._folder,
            stage_id=stage.id,
            version=stage.version,
            code=code,
            recorder=log.calls,
            workers=self._workers,
            hashes=self._hashes,
            seed=self._recipe.seed,
            key=key,
            fixed_time=self._fixed_time,
            on_progress=log.progress,
            on_note=log.note,
            cancelled=log.cancelled,
            summary=self._timeless_summary() if self._fixed_time else self._summary,
        )
        return StageTask(step, inputs, context, log, key, lineage)

    def _timeless_summary(self) -> dict[str, Any]:
        """The summary without what differs between equal runs."""
        clock = ("timings_s", "memory_mb", "peak_memory_mb", "cached_stages", "recorded_stages")
        return {name: value for name, value in self._summary.items() if name not in clock}

    def _warn(self, warnings: Sequence[Mapping[str, str]]) -> None:
        for line in warning_lines(warnings):
            self._reporter.warning(line)

    def _end_stage(self, stage: type[Stage], finished: CachedOutcome, seconds: float, source: Source) -> None:
        for name, handle in finished.outputs.items():
            self._record_artefact(stage, name, handle, finished)
            self._artefacts[name] = handle
            self._summary["artefacts"][name] = {
                "file": handle.path.relative_to(self._folder.path).as_posix(),
                "type": type_name(handle.type),
                "fingerprint": handle.fingerprint,
            }
        self._warn(finished.notes.warnings)
        finished.notes.add_to(self._summary)
        self._summary["timings_s"][stage.id] = round(
            seconds + self._summary["timings_s"].get(stage.id, 0.0), 3
        )
        self._summary["peak_memory_mb"] = peak_mb = round(self._peak_memory_mb(), 1)
        self._summary["memory_mb"][stage.id] = peak_mb
        if source != "work":
            self._summary["cached_stages" if source == "cache" else "recorded_stages"].append(stage.id)
        marks = {name: self._mark(handle) for name, handle in finished.outputs.items()}
        self._recorder.stage_finished(
            stage.id,
            marks,
            None if self._fixed_time else seconds,
            source != "work",
            asdict(finished.notes),
            finished.written,
            finished.lineage,
            int(1e6 * peak_mb),
        )
        if not self._fixed_time:
            how = {"work": "done", "cache": "from the cache", "recording": "from the recording"}[source]
            text = f"{how} in {seconds:.1f} s, peak memory {peak_mb:.0f} MB"
            self._recorder.log("info", text, stage=stage.id)
        self._used += finished.used
        self._hashes.save()
        self._reporter.stage_finished(seconds, source)

    def _record_artefact(
        self, stage: type[Stage], name: str, handle: ArtefactHandle, finished: CachedOutcome
    ) -> None:
        """Its bytes, or in private those without folders, which have a fingerprint of their own."""
        with handle.open() as file:
            data: BinaryIO = file
            if self._privacy is not None:
                private = with_texts(file.read(), self._privacy.text)
                content, data = fingerprint_of_bytes(private), io.BytesIO(private)
                mark = artefact_fingerprint(content, finished.written, finished.lineage)
                self._marks[handle.fingerprint] = mark
            self._recorder.artefact(stage.id, name, type_name(handle.type), self._mark(handle), data)

    def _mark(self, handle: ArtefactHandle) -> str:
        """What the recording calls an artefact."""
        return self._marks.get(handle.fingerprint, handle.fingerprint)

    def _peak_memory_mb(self) -> float:
        return (peak_memory_bytes() + sum([*self._workers.peak_memory_bytes.values()])) / 1e6

    def _record_failure(self, stage: str, text: str) -> None:
        try:
            self._recorder.log("error", text, stage=stage)
        except GeomosaicError:
            return
