"""Runs a checked recipe into a run folder."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from geomosaic.errors import CancelledError, FileError, GeomosaicError
from geomosaic.pipeline import files
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
from geomosaic.pipeline.earlier_run import EarlierRun, begun
from geomosaic.pipeline.environment import versions
from geomosaic.pipeline.executor import Workers
from geomosaic.pipeline.hashes import FileHashes
from geomosaic.pipeline.memory_release import release_memory
from geomosaic.pipeline.plugin import blamed, code_of
from geomosaic.pipeline.provenance import commit, privacy_of, sizes, surroundings
from geomosaic.pipeline.recipe import RECORDING, RUN_JSON, Recipe, RecipeStep
from geomosaic.pipeline.replayed_stage import ReplayedStage, bring_files
from geomosaic.pipeline.reporter import Reporter, Silent, Source
from geomosaic.pipeline.run_folder import WORK, RunFolder
from geomosaic.pipeline.run_options import RunOptions
from geomosaic.pipeline.run_summary import RunSummary
from geomosaic.pipeline.stage import Stage
from geomosaic.pipeline.stage_log import RunLog, StageLog
from geomosaic.pipeline.stage_recorder import replay_calls
from geomosaic.pipeline.stage_task import StageTask, concurrent_steps, may_be_forged_data
from geomosaic.recording.file.fingerprints import fingerprint_of_json
from geomosaic.recording.file.writer import Recorder
from geomosaic.recording.rerun.live import watched

_USUAL = RunOptions()


def run(
    recipe: Recipe,
    run_folder: Path,
    options: RunOptions = _USUAL,
    *,
    given: Mapping[int, ReplayedStage] | None = None,
    reporter: Reporter | None = None,
) -> dict[str, Any]:
    """Runs every stage, from the cache in RUN/work where nothing it depends on has changed.

    What the finished run did not use is then deleted from RUN/work. So are results of earlier runs of any
    recipe that this one did not make, with exports of them. A preview deletes nothing and writes no run.json.
    given: outcomes of steps (by index) that are not to be run, as taken from a recording.
    Returns what run.json holds. Raises `CancelledError` on Ctrl-C, and whatever a stage raises; the
    recording then ends with the error, and the folder has no run.json, but finished work stays cached.
    """
    given, record = given or {}, options.record
    recipe.check_files(skip=given.keys(), run_folder=run_folder)
    folder = RunFolder.opened(run_folder, sorted(recipe.results()), overwrite=options.overwrite)
    workers = Workers(options.workers, options.dask)
    with files.in_one_wording(folder.path), folder.locked(), workers as team:
        earlier = None if options.preview else begun(folder, recipe, options)
        folder.expect(recipe.results(), passing=options.preview)
        files.sweep(folder.path, folder.within(WORK))
        bring_files(recipe, given, folder)
        if record.level == "off" and not options.preview:
            folder.remove(RECORDING)
        privacy = privacy_of(record, recipe, folder)
        path = None if record.level == "off" else folder.claim(RECORDING)
        recorder = Recorder(
            path,
            fixed_time=options.fixed_time,
            level=record.level,
            memory_bytes=team.memory_bytes,
            privacy=privacy,
        )
        with recorder, watched(path, record.live):
            log = RunLog(recorder, reporter or Silent(), options.cancelled)
            return _Run(recipe, folder, team, log, earlier).run(given)


class _Run:
    """One run in progress."""

    def __init__(
        self, recipe: Recipe, folder: RunFolder, workers: Workers, log: RunLog, earlier: EarlierRun | None
    ) -> None:
        self._recipe = recipe
        self._folder = folder
        self._workers = workers
        self._log = log
        self._hashes = FileHashes(folder.within(f"{WORK}/hashes.json"))
        self._cache = StageCache(folder, self._hashes)
        self._earlier = earlier and replace(earlier, hashes=self._hashes)
        workers.serve(folder.path, self._hashes)
        self._summary = RunSummary(folder, log, workers)
        self._artefacts: dict[str, ArtefactHandle] = {}
        self._lineages: list[Lineage] = []
        self._used: list[Path] = []
        self._begun: dict[int, CachedOutcome | StageTask] = {}

    def run(self, given: Mapping[int, ReplayedStage]) -> dict[str, Any]:
        stage = ""
        try:
            self._begin(given)
            for i, step in enumerate(self._recipe.steps):
                stage = step.stage.id
                if not step.stage.cached:  # it may look into the folder
                    self._remove_stale(self._recipe.steps[i:])
                started = time.monotonic()
                self._start_step(i, given.get(i))
                self._begin_concurrent(i, given)
                finished, source, early_s = self._step(i, given.get(i))
                seconds = early_s or time.monotonic() - started
                self._summary.end_stage(step.stage, finished, seconds, source)
                self._artefacts |= finished.outputs
                self._used += finished.used
                self._hashes.save()
                self._log.reporter.stage_finished(seconds, source)
                self._release(self._recipe.steps[i + 1 : i + 2])
            if not self._folder.passing:
                with self._folder.writing(RUN_JSON) as path:
                    files.write_json(path, self._summary.plain)
                self._tidy()
            return self._summary.plain
        except KeyboardInterrupt:
            self._end_begun()
            self._record_failure(stage, "stopped by the user")
            raise CancelledError from None
        except Exception as error:
            self._end_begun()
            self._record_failure(stage, f"{type(error).__name__}: {error}")
            raise
        finally:
            self._hashes.save()

    def _start_step(self, i: int, given: ReplayedStage | None) -> None:
        """Reports and records that a step begins."""
        step = self._recipe.steps[i]
        self._log.reporter.stage_started(i, len(self._recipe.steps), step.stage.display_name)
        self._log.recorder.stage_started(
            step.stage.id,
            step.stage.version if given is None else given.record.version,
            step.params.model_dump(mode="json"),
            {name: self._summary.mark(handle) for name, handle in self._inputs(step.stage).items()},
            reads_run=not step.stage.cached,
        )

    def _release(self, then: Sequence[RecipeStep]) -> None:
        """What the next step doesn't take stays on the disk alone, until a later one does."""
        taken = {name for step in then for name in (*step.stage.inputs, *step.stage.optional_inputs)}
        for name in self._artefacts.keys() - taken:
            self._artefacts[name].release()
        release_memory()

    def _begin(self, given: Mapping[int, ReplayedStage]) -> None:
        environment = {**versions(), "commit": commit()}
        if not self._log.recorder.fixed_time:
            environment |= surroundings(private=self._log.recorder.privacy is not None)
        self._log.recorder.begin_run(self._recipe.yaml(), environment)
        manifest: dict[str, Any] = {}
        for i, step in enumerate(self._recipe.steps):
            if i in given:
                recorded = given[i].manifest()
                given[i].check_unchanged(self._hashes, partial(self._hashing, 0, 0))
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
        self._summary.begin(self._recipe, manifest)

    def _tidy(self) -> None:
        """Removes what earlier runs left and this one did not make or use."""
        self._cache.prune(self._used)
        self._remove_stale()
        self._hashes.forget_unasked()

    def _remove_stale(self, left: Sequence[RecipeStep] = ()) -> None:
        """Removes results of earlier runs, of any recipe; none where this is the last one again, so that its
        exports stay. left: steps to come, whose results stay."""
        unsure = [step.stage.outputs for step in self._recipe.steps if step in left or not step.stage.cached]
        marks = {name: handle.fingerprint for name, handle in self._artefacts.items()}
        if self._folder.repeats(marks, set().union(*unsure)):
            return
        made = {RUN_JSON, RECORDING, *(path.relative_to(self._folder.path).as_posix() for path in self._used)}
        for name in self._folder.stale(made.union(*(step.stage.results for step in left))):
            if not self._hashes.reads_within(self._folder.within(name)):
                self._folder.remove(name)

    def _hashing(self, done: int, total: int) -> None:
        if self._log.cancelled():
            raise CancelledError
        self._log.progress(done, total, "reading inputs")

    def _inputs(self, stage: type[Stage]) -> dict[str, ArtefactHandle]:
        names, there = (*stage.inputs, *stage.optional_inputs), self._artefacts
        return {name: there[name] for name in names if name in there}

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
                self._log.recorder.copy(*message)
            return self._cache.keep_replayed(stage, given, self._lineage(i)), "recording", 0.0
        early = i in self._begun
        task = self._begun.pop(i) if early else self._task(i, early=False)
        if isinstance(task, CachedOutcome):
            assert task.calls is not None
            replay_calls(task.calls, self._log.recorder)
            return task, "cache", 0.0
        try:
            values = task.outcome()
            self._hashes.check_unchanged()
        except BaseException as error:
            self._summary.warn(task.context.notes.warnings)
            task.end()
            if self._summary.plain["cached_stages"] and may_be_forged_data(error):
                work = self._folder.within(WORK)
                problem = f"{stage.id} fails on results stored there ({type(error).__name__}: {error})"
                raise FileError(problem, file=work, fix="remove it and run again") from error
            raise
        kept = self._cache.keep(stage, values, task.context, task.lineage, task.log.spool)
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
        earlier = self._earlier if stage.goes_on else None
        finished = self._cache.find(stage, key, lineage) if stage.cached else None
        if finished is None and earlier is not None:
            key = fingerprint_of_json([key, earlier.mark])
            finished = self._cache.find(stage, key, lineage)
        if finished is not None and finished.calls is not None:
            return finished
        spool = self._cache.spool(stage)
        log = StageLog(self._log, spool, stage.id, early=early)
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
            fixed_time=self._log.recorder.fixed_time,
            on_progress=log.progress,
            on_note=log.note,
            cancelled=log.cancelled,
            summary=self._summary.for_stage(),
            earlier=earlier,
        )
        return StageTask(step, inputs, context, log, lineage)

    def _record_failure(self, stage: str, text: str) -> None:
        with suppress(GeomosaicError):
            self._log.recorder.log("error", text, stage=stage)
