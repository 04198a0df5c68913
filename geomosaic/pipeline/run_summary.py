"""What a run came to: the content of run.json, and each stage's end in the recording."""

from __future__ import annotations

import copy
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, BinaryIO

from geomosaic.pipeline.artefact_reader import with_texts
from geomosaic.pipeline.artefacts import type_name
from geomosaic.pipeline.cache import ArtefactHandle, CachedOutcome
from geomosaic.pipeline.earlier_run import STAGE_VERSIONS, stage_versions
from geomosaic.pipeline.environment import versions
from geomosaic.pipeline.executor import Workers, peak_memory_bytes
from geomosaic.pipeline.recipe import Recipe
from geomosaic.pipeline.reporter import Source, warning_lines
from geomosaic.pipeline.run_folder import RunFolder
from geomosaic.pipeline.stage import Stage
from geomosaic.pipeline.stage_log import RunLog
from geomosaic.recording.file.fingerprints import artefact_fingerprint, fingerprint_of_bytes
from geomosaic.recording.file.writer import StageEnd


class RunSummary:
    """The summary of a run in progress. plain: what run.json holds so far."""

    def __init__(self, folder: RunFolder, log: RunLog, workers: Workers) -> None:
        self._folder = folder
        self._log = log
        self._workers = workers
        self._marks: dict[str, str] = {}
        self.plain: dict[str, Any] = {}

    def begin(self, recipe: Recipe, manifest: Mapping[str, Any]) -> None:
        """Before the first stage. manifest: of the files that are read."""
        self.plain = {
            "recipe": recipe.plain(),
            STAGE_VERSIONS: stage_versions(recipe),
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
        self._log.recorder.inputs(manifest)

    def for_stage(self) -> Mapping[str, Any]:
        """What stages may report of it: with fixed time nothing that differs between equal runs. It is a
        copy, as concurrent stages read it while others end."""
        clock = ("timings_s", "memory_mb", "peak_memory_mb", "cached_stages", "recorded_stages")
        left_out = clock if self._log.recorder.fixed_time else ()
        return copy.deepcopy({name: value for name, value in self.plain.items() if name not in left_out})

    def mark(self, handle: ArtefactHandle) -> str:
        """What the recording calls an artefact."""
        return self._marks.get(handle.fingerprint, handle.fingerprint)

    def warn(self, warnings: Sequence[Mapping[str, str]]) -> None:
        """Shows a stage's warnings."""
        for line in warning_lines(warnings):
            self._log.reporter.warning(line)

    def end_stage(self, stage: type[Stage], finished: CachedOutcome, seconds: float, source: Source) -> None:
        """Adds a stage's outcome, and records it."""
        for name, handle in finished.outputs.items():
            self._record_artefact(stage, name, handle, finished)
            self.plain["artefacts"][name] = {
                "file": handle.path.relative_to(self._folder.path).as_posix(),
                "type": type_name(handle.type),
                "fingerprint": handle.fingerprint,
            }
        self.warn(finished.notes.warnings)
        finished.notes.add_to(self.plain)
        self.plain["timings_s"][stage.id] = round(seconds + self.plain["timings_s"].get(stage.id, 0.0), 3)
        self.plain["peak_memory_mb"] = peak_mb = round(self._peak_memory_mb(), 1)
        self.plain["memory_mb"][stage.id] = peak_mb
        if source != "work":
            self.plain["cached_stages" if source == "cache" else "recorded_stages"].append(stage.id)
        end = StageEnd(
            {name: self.mark(handle) for name, handle in finished.outputs.items()},
            None if self._log.recorder.fixed_time else seconds,
            source != "work",
            asdict(finished.notes),
            finished.written,
            finished.lineage,
            int(1e6 * peak_mb),
        )
        self._log.recorder.stage_finished(stage.id, end)
        if not self._log.recorder.fixed_time:
            how = {"work": "done", "cache": "from the cache", "recording": "from the recording"}[source]
            text = f"{how} in {seconds:.1f} s, peak memory {peak_mb:.0f} MB"
            self._log.recorder.log("info", text, stage=stage.id)

    def _record_artefact(
        self, stage: type[Stage], name: str, handle: ArtefactHandle, finished: CachedOutcome
    ) -> None:
        """Its bytes, or in private those without folders, which have a fingerprint of their own."""
        recorder = self._log.recorder
        with handle.open() as file:
            data: BinaryIO = file
            if recorder.privacy is not None:
                private = with_texts(file.read(), recorder.privacy.text)
                content, data = fingerprint_of_bytes(private), io.BytesIO(private)
                mark = artefact_fingerprint(content, finished.written, finished.lineage)
                self._marks[handle.fingerprint] = mark
            recorder.artefact(stage.id, name, type_name(handle.type), self.mark(handle), data)

    def _peak_memory_mb(self) -> float:
        return (peak_memory_bytes() + sum([*self._workers.peak_memory_bytes.values()])) / 1e6
