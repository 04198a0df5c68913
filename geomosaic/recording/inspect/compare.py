"""What differs between two recordings: first what came of it, then what was done, last the fingerprints."""

from __future__ import annotations

import difflib
import math
from collections import Counter
from collections.abc import Iterator
from typing import Any

from geomosaic.recording.file.fingerprints import altered_artefacts
from geomosaic.recording.file.model import Recording, StageRecord
from geomosaic.recording.inspect import compare_frames
from geomosaic.recording.inspect.compare_offsets import offsets
from geomosaic.recording.inspect.compare_strips import strip_residuals, strips
from geomosaic.recording.inspect.places import Places
from geomosaic.recording.inspect.solved import Solved

_CLOCKS = ("estimate",)
"""Metrics that depend on the machine."""


def compare(
    a: Recording, b: Recording, solved_a: Solved | None = None, solved_b: Solved | None = None
) -> dict[str, Any]:
    """What `geomosaic diff --json` prints: only what differs, values as [of a, of b], the worst first.

    `equal` says whether the runs did the same and came to the same. Where the same files lay in other folders
    nothing differs. Durations, what came from the cache, the outputs of stages that report the run itself
    (the report), and the environment don't count; durations and the environment's differences are listed.
    `altered`: artefacts whose bytes aren't those that their fingerprints name; nothing is equal to them.
    `first_stage` names the first stage that differs.
    """
    places = Places(a, b)
    stages = _stages(a.stages, b.stages, places)
    solved = solved_a is not None and solved_b is not None
    marks = _fingerprints(a.stages, b.stages, places)
    counting: dict[str, Any] = {
        "frames": compare_frames.frames(solved_a, solved_b) if solved_a and solved_b else [],
        "offsets": [] if solved else offsets(a, b),
        "pairs": compare_frames.pairs(solved_a, solved_b) if solved_a and solved_b else [],
        "verdict": _changes(_verdict(a), _verdict(b)),
        "figures": _figures(a, b),
        "strips": strips(a, b),
        "strip_residuals": strip_residuals(a, b),
        "warnings": _warnings(a, b),
        "recipe": places.recipe_lines(),
        "stages": stages,
        "manifest": places.other_files(),
        "whole": [] if a.whole == b.whole else [a.whole, b.whole],
        "altered": [
            {"in": where, "stage": stage, "artefact": name}
            for where, recording in (("a", a), ("b", b))
            for stage, name in altered_artefacts(recording)
        ],
    }
    order = [s.stage_id for s in (*a.stages, *b.stages)]
    differing = {e["stage"] for e in (*stages, *marks)}
    return {
        "equal": not any(counting.values()) and not marks,
        "paths": [str(a.path), str(b.path)],
        "first_stage": next((id for id in order if id in differing), None),
        **counting,
        "seconds": _seconds(a.stages, b.stages),
        "environment": _changes(a.environment, b.environment),
        "elsewhere": places.elsewhere(),
        "fingerprints": marks,
    }


def _matched(
    a: list[StageRecord], b: list[StageRecord]
) -> Iterator[tuple[StageRecord | None, StageRecord | None]]:
    """Stages in order; those of equal id are compared."""
    matcher = difflib.SequenceMatcher(None, [s.stage_id for s in a], [s.stage_id for s in b], autojunk=False)
    for kind, a0, a1, b0, b1 in matcher.get_opcodes():
        if kind == "equal":
            yield from zip(a[a0:a1], b[b0:b1], strict=True)
        else:
            yield from ((s, None) for s in a[a0:a1])
            yield from ((None, s) for s in b[b0:b1])


def _stages(a: list[StageRecord], b: list[StageRecord], places: Places) -> list[dict[str, Any]]:
    """Stages of one run alone, and those with other versions or parameters, or that one didn't finish."""
    out: list[dict[str, Any]] = []
    for left, right in _matched(a, b):
        if left is None or right is None:
            only = left or right
            assert only is not None
            out.append({"stage": only.stage_id, "only_in": "a" if right is None else "b"})
            continue
        changes = {
            "version": _changes(left.version, right.version),
            "params": _changes(*places.same_params(left, right)),
            "finished": _changes(left.finished, right.finished),
        }
        if any(changes.values()):
            out.append({"stage": left.stage_id} | {k: v for k, v in changes.items() if v})
    return out


def _fingerprints(a: list[StageRecord], b: list[StageRecord], places: Places) -> list[dict[str, Any]]:
    """Stages whose inputs or outputs have other fingerprints, though not for the folders' names alone."""
    out = []
    for left, right in _matched(a, b):
        if left is None or right is None:
            continue
        changes = {
            name: {
                k: v
                for k, v in _changes(getattr(left, name), getattr(right, name)).items()
                if not places.explain(k, v)
            }
            for name in ("inputs", "outputs")
            if name != "outputs" or not (left.reads_run and right.reads_run)
        }
        if any(changes.values()):
            out.append({"stage": left.stage_id} | {k: v for k, v in changes.items() if v})
    return out


def _changes(a: Any, b: Any, name: str = "") -> dict[str, list[Any]]:
    """Dotted names of differing values with [of a, of b]; None where one lacks it."""
    if isinstance(a, dict) and isinstance(b, dict):
        out: dict[str, list[Any]] = {}
        for key in dict.fromkeys([*a, *b]):
            out |= _changes(a.get(key), b.get(key), f"{name}.{key}" if name else str(key))
        return out
    return {} if a == b else {name: [a, b]}


def _verdict(recording: Recording) -> dict[str, Any]:
    """Grade, cause, and the evidence's values and grades by name."""
    verdict = recording.verdict
    if not verdict:
        return {}
    figures = {str(e.get("name")): {k: e.get(k) for k in ("value", "grade")} for e in verdict["evidence"]}
    return {k: verdict.get(k) for k in ("grade", "cause")} | {"evidence": figures}


def _figures(a: Recording, b: Recording) -> dict[str, list[Any]]:
    """The stages' metrics, those that changed by the largest part first."""
    changed = _changes(_metrics(a), _metrics(b))

    def badness(name: str) -> float:
        first, second = changed[name]
        if not all(isinstance(v, int | float) and not isinstance(v, bool) for v in (first, second)):
            return math.inf
        return abs(second - first) / (abs(first) + abs(second))  # type: ignore[no-any-return]

    return {name: changed[name] for name in sorted(changed, key=badness, reverse=True)}


def _metrics(recording: Recording) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for stage in recording.stages:
        metrics = stage.notes.get("metrics")
        if isinstance(metrics, dict):
            out[stage.stage_id] = {k: v for k, v in metrics.items() if k not in _CLOCKS}
    return out


def _seconds(a: list[StageRecord], b: list[StageRecord]) -> list[dict[str, Any]]:
    """How long each stage took in both, the largest difference first; and all of them together."""
    pairs = [
        (left.stage_id, left.seconds, right.seconds)
        for left, right in _matched(a, b)
        if left is not None and right is not None and left.seconds is not None and right.seconds is not None
    ]
    pairs.sort(key=lambda p: -abs(p[2] - p[1]))
    rows = [{"stage": stage, "seconds": [s, t]} for stage, s, t in pairs if s != t]
    total = [sum(p[1] for p in pairs), sum(p[2] for p in pairs)]
    return [{"stage": "all", "seconds": total}, *rows] if rows else []


def _warnings(a: Recording, b: Recording) -> list[dict[str, str]]:
    of_a, of_b = (
        Counter((w.level, w.stage, w.frame, w.text) for w in recording.warnings) for recording in (a, b)
    )
    return [
        {"only_in": where, "level": level, "stage": stage, "frame": frame, "text": text}
        for where, only in (("a", of_a - of_b), ("b", of_b - of_a))
        for level, stage, frame, text in only.elements()
    ]
