"""Runs a checked recipe into a run folder."""

from __future__ import annotations

import fcntl
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from geomosaic.errors import CancelledError, GeomosaicError, OutputError
from geomosaic.pipeline import files
from geomosaic.pipeline.artefacts import type_name
from geomosaic.pipeline.cache import Finished, Held, StageCache, file_manifest, stage_key
from geomosaic.pipeline.context import Context
from geomosaic.pipeline.environment import versions
from geomosaic.pipeline.executor import Workers, peak_memory_bytes
from geomosaic.pipeline.given import Given
from geomosaic.pipeline.recipe import Recipe, Step
from geomosaic.pipeline.recorded import StageRecorder, record_again
from geomosaic.pipeline.reporter import Reporter, Silent, Source
from geomosaic.pipeline.single import check_outputs
from geomosaic.pipeline.stage import Stage
from geomosaic.recording.writer import Recorder

RUN_JSON = "run.json"
RECORDING = "run.mcap"


@contextmanager
def _locked(run_folder: Path) -> Iterator[None]:
    path = run_folder / "work" / "lock"
    with path.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise OutputError(
                "another run is writing here", file=run_folder, mend="wait for it or choose another folder"
            ) from error
        yield


@contextmanager
def _in_one_wording(run_folder: Path) -> Iterator[None]:
    """A disk that takes no more is told alike, whether a stage, the cache or the recorder noticed it."""
    try:
        yield
    except OSError as error:
        cause = error.__cause__ if isinstance(error, OutputError) else error
        if cause is None or not files.is_output_error(cause):
            raise
        file = error.file if isinstance(error, OutputError) else error.filename
        raise files.output_error(cause, Path(file or run_folder)) from cause


def run(
    recipe: Recipe,
    run_folder: Path,
    *,
    workers: int = 1,
    dask: str | None = None,
    fixed_time: bool = False,
    given: Mapping[int, Given] | None = None,
    reporter: Reporter | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> dict[str, Any]:
    """Runs every stage, from the cache in RUN/work where nothing it depends on has changed.

    What the finished run did not use is then deleted from RUN/work.

    given: outcomes of steps (by index) that are not to be run, as taken from a recording.
    fixed_time: equal runs give equal bytes in run.mcap; clock times stand in run.json alone.
    Returns what run.json holds. Raises `CancelledError` on Ctrl-C, and whatever a stage raises; the
    recording then ends with the error, and the folder has no run.json, but finished work stays cached.
    """
    given = given or {}
    recipe.check_files(skip=given.keys(), run_folder=run_folder)
    run_folder = run_folder.absolute()
    files.make_folder(run_folder)
    files.make_folder(run_folder / "work")
    with _locked(run_folder), _in_one_wording(run_folder), Workers(workers, dask) as team:
        (run_folder / RUN_JSON).unlink(missing_ok=True)
        files.sweep(run_folder)
        hashes = files.FileHashes(run_folder / "work" / "hashes.json")
        try:
            with Recorder(run_folder / RECORDING, fixed_time=fixed_time) as recorder:
                runner = _Run(
                    recipe, run_folder, team, hashes, recorder, fixed_time, reporter or Silent(), cancelled
                )
                return runner.run(given)
        finally:
            hashes.save()


class _Run:
    """One run in progress."""

    def __init__(
        self,
        recipe: Recipe,
        run_folder: Path,
        workers: Workers,
        hashes: files.FileHashes,
        recorder: Recorder,
        fixed_time: bool,
        reporter: Reporter,
        cancelled: Callable[[], bool] | None,
    ) -> None:
        self._recipe = recipe
        self._folder = run_folder
        self._workers = workers
        self._hashes = hashes
        self._recorder = recorder
        self._fixed_time = fixed_time
        self._reporter = reporter
        self._cancelled = cancelled
        self._cache = StageCache(run_folder, hashes)
        self._held: dict[str, Held] = {}
        self._manifests: list[dict[str, dict[str, str]]] = []
        self._used: list[Path] = []
        self._summary: dict[str, Any] = {}

    def run(self, given: Mapping[int, Given]) -> dict[str, Any]:
        stage = ""
        try:
            self._begin(given)
            total = len(self._recipe.steps)
            for i, step in enumerate(self._recipe.steps):
                stage = step.stage.id
                self._reporter.stage_started(i, total, step.stage.display_name)
                started = time.monotonic()
                inputs = self._inputs(step.stage)
                marks = {name: held.fingerprint for name, held in inputs.items()}
                version = given[i].record.version if i in given else step.stage.version
                params = step.params.model_dump(mode="json")
                self._recorder.stage_started(stage, version, params, marks, reads_run=not step.stage.cached)
                finished, source = self._step(i, step, inputs, given.get(i))
                self._end_stage(step.stage, finished, time.monotonic() - started, source)
            files.write_json(self._folder / RUN_JSON, self._summary)
            self._cache.prune(self._used)
            self._hashes.forget_unasked()
            return self._summary
        except KeyboardInterrupt:
            self._record_failure(stage, "stopped by the user")
            raise CancelledError from None
        except Exception as error:
            self._record_failure(stage, f"{type(error).__name__}: {error}")
            raise

    def _begin(self, given: Mapping[int, Given]) -> None:
        manifest: dict[str, Any] = {}
        for i, step in enumerate(self._recipe.steps):
            named = {} if i in given else step.stage.files(step.params)
            content = file_manifest(named, self._hashes, self._hashing)
            self._manifests.append(content)
            if i in given:
                manifest.update(given[i].manifest())
            for name, hashes in content.items():
                manifest[f"{step.stage.id}.{name}"] = {"path": str(named[name]), "files": hashes}
        self._hashes.save()
        self._summary = {
            "recipe": self._recipe.plain(),
            "versions": versions(),
            "inputs": manifest,
            "warnings": [],
            "metrics": {},
            "timings_s": {},
            "cached_stages": [],
            "recorded_stages": [],
            "artefacts": {},
        }
        self._recorder.begin_run(self._recipe.yaml(), self._summary["versions"], manifest)

    def _hashing(self, done: int, total: int) -> None:
        if self._cancelled is not None and self._cancelled():
            raise CancelledError
        self._reporter.progress(done, total, "reading inputs")

    def _inputs(self, stage: type[Stage]) -> dict[str, Held]:
        return {
            name: self._held[name] for name in (*stage.inputs, *stage.optional_inputs) if name in self._held
        }

    def _step(
        self, i: int, step: Step, inputs: Mapping[str, Held], given: Given | None
    ) -> tuple[Finished, Source]:
        if given is not None:
            for message in given.messages():
                self._recorder.copy(*message)
            return self._cache.keep_given(step.stage, given), "recording"
        marks = {name: held.fingerprint for name, held in inputs.items()}
        key = stage_key(step, marks, self._recipe.seed, self._manifests[i])
        spool = self._folder / "work" / step.stage.id / "calls.part"
        spool.parent.mkdir(parents=True, exist_ok=True)
        finished = self._cache.find(step.stage, key) if step.stage.cached else None
        if finished is not None and finished.calls is not None:
            record_again(finished.calls, self._recorder)
            return finished, "cache"
        recorder = StageRecorder(self._recorder, spool, step.stage.id)
        context = Context(
            self._folder,
            stage_id=step.stage.id,
            version=step.stage.version,
            recorder=recorder,
            workers=self._workers,
            hashes=self._hashes,
            seed=self._recipe.seed,
            key=key,
            fixed_time=self._fixed_time,
            on_progress=self._reporter.progress,
            on_warning=self._reporter.warning,
            cancelled=self._cancelled,
            summary=self._timeless_summary() if self._fixed_time else self._summary,
        )
        try:
            context.check_cancelled()
            values = step.stage().run({name: h.value() for name, h in inputs.items()}, step.params, context)
            check_outputs(step.stage, values)
        except BaseException:
            recorder.close()
            spool.unlink(missing_ok=True)
            raise
        recorder.close()
        return self._cache.keep(step.stage, key, values, context, self._manifests[i], spool), "work"

    def _timeless_summary(self) -> dict[str, Any]:
        """The summary without what differs between equal runs."""
        clock = ("timings_s", "peak_memory_mb", "cached_stages", "recorded_stages")
        return {name: value for name, value in self._summary.items() if name not in clock}

    def _end_stage(self, stage: type[Stage], finished: Finished, seconds: float, source: Source) -> None:
        for name, held in finished.outputs.items():
            self._recorder.artefact(stage.id, name, type_name(held.type), held.fingerprint, held.data())
            self._held[name] = held
            self._summary["artefacts"][name] = {
                "file": held.path.relative_to(self._folder).as_posix(),
                "type": type_name(held.type),
                "fingerprint": held.fingerprint,
            }
        finished.notes.add_to(self._summary)
        self._summary["timings_s"][stage.id] = round(
            seconds + self._summary["timings_s"].get(stage.id, 0.0), 3
        )
        self._summary["peak_memory_mb"] = peak_mb = round(self._peak_memory_mb(), 1)
        if source != "work":
            self._summary["cached_stages" if source == "cache" else "recorded_stages"].append(stage.id)
            for warning in finished.notes.warnings:
                self._reporter.warning(": ".join(filter(None, (warning["frame"], warning["text"]))))
        marks = {name: held.fingerprint for name, held in finished.outputs.items()}
        self._recorder.stage_finished(
            stage.id, marks, None if self._fixed_time else seconds, source != "work", asdict(finished.notes)
        )
        if not self._fixed_time:
            how = {"work": "done", "cache": "from the cache", "recording": "from the recording"}[source]
            text = f"{how} in {seconds:.1f} s, peak memory {peak_mb:.0f} MB"
            self._recorder.log("info", text, stage=stage.id)
        self._used += finished.used
        self._hashes.save()
        self._reporter.stage_finished(seconds, source)

    def _peak_memory_mb(self) -> float:
        return (peak_memory_bytes() + sum(self._workers.peak_memory_bytes.values())) / 1e6

    def _record_failure(self, stage: str, text: str) -> None:
        try:
            self._recorder.log("error", text, stage=stage)
        except GeomosaicError:
            return
