"""What differs between two recordings."""

from __future__ import annotations

import difflib
from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomosaic.recording.fingerprints import altered_artefacts
from geomosaic.recording.model import Recording, StageRecord, StripCurve, StripResidual
from geomosaic.recording.summary import largest_length, rms_length


def compare(a: Recording, b: Recording) -> dict[str, Any]:
    """What `geomosaic diff --json` prints: only what differs, values as [of a, of b].

    `equal` says whether the runs did the same and came to the same: the recipe, the inputs, the stages
    with their versions, parameters and fingerprints, the moves of the frames, the strips' offsets and
    what they leave, the warnings, and how far each got. Durations, what came from the cache, the outputs
    of stages that report the run itself (the report), and the environment don't count; the environment's
    differences are listed.
    `altered`: artefacts whose bytes aren't those that their fingerprints name; nothing is equal to them.
    `first_stage` names the first stage that differs.
    """
    stages = _stages(a.stages, b.stages)
    out: dict[str, Any] = {
        "whole": [] if a.whole == b.whole else [a.whole, b.whole],
        "altered": [
            {"in": where, "stage": stage, "artefact": name}
            for where, recording in (("a", a), ("b", b))
            for stage, name in altered_artefacts(recording)
        ],
        "recipe": list(
            difflib.unified_diff(
                a.recipe_yaml.splitlines(), b.recipe_yaml.splitlines(), "a", "b", lineterm="", n=1
            )
        ),
        "manifest": _changes(a.manifest, b.manifest),
        "first_stage": stages[0]["stage"] if stages else None,
        "stages": stages,
        "offsets": _offsets(a, b),
        "strips": _strips(a, b),
        "strip_residuals": _strip_residuals(a, b),
        "warnings": _warnings(a, b),
    }
    equal = not any(out.values())
    return {
        "equal": equal,
        "paths": [str(a.path), str(b.path)],
        **out,
        "environment": _changes(a.environment, b.environment),
    }


def _stages(a: list[StageRecord], b: list[StageRecord]) -> list[dict[str, Any]]:
    """Stages that differ, in order; those of equal id are held against each other."""
    out: list[dict[str, Any]] = []
    matcher = difflib.SequenceMatcher(None, [s.stage_id for s in a], [s.stage_id for s in b], autojunk=False)
    for kind, a0, a1, b0, b1 in matcher.get_opcodes():
        if kind != "equal":
            out += [{"stage": s.stage_id, "only_in": "a"} for s in a[a0:a1]]
            out += [{"stage": s.stage_id, "only_in": "b"} for s in b[b0:b1]]
            continue
        for left, right in zip(a[a0:a1], b[b0:b1], strict=True):
            changes = {
                name: _changes(getattr(left, name), getattr(right, name))
                for name in ("version", "params", "inputs", "outputs", "finished")
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


def _offsets(a: Recording, b: Recording) -> list[dict[str, Any]]:
    """For each stage that moved frames: by how much further b moved each, and the rounds of both."""
    moved_a, moved_b = _moves_m(a), _moves_m(b)
    out = []
    for stage in dict.fromkeys([*moved_a, *moved_b]):
        rounds_a, of_a = moved_a.get(stage, (0, {}))
        rounds_b, of_b = moved_b.get(stage, (0, {}))
        frames = []
        for frame in dict.fromkeys([*of_a, *of_b]):
            if frame not in of_a or frame not in of_b:
                frames.append({"frame": frame, "only_in": "a" if frame in of_a else "b"})
            elif not np.array_equal(of_a[frame], of_b[frame], equal_nan=True):
                east_m, north_m = np.nan_to_num(of_b[frame] - of_a[frame]).tolist()
                frames.append({"frame": frame, "d_east_m": east_m, "d_north_m": north_m})
        if frames or rounds_a != rounds_b:
            lengths = [np.hypot(f["d_east_m"], f["d_north_m"]) for f in frames if "d_east_m" in f]
            out.append(
                {
                    "stage": stage,
                    "rounds": [rounds_a, rounds_b],
                    "largest_m": float(max(lengths, default=0.0)),
                    "frames": frames,
                }
            )
    return out


def _moves_m(recording: Recording) -> dict[str, tuple[int, dict[str, NDArray[np.float64]]]]:
    """By stage: the number of rounds, and each frame's moves summed (east, north)."""
    out: dict[str, tuple[int, dict[str, NDArray[np.float64]]]] = {}
    for offsets in recording.rounds:
        count, sums = out.get(offsets.stage, (0, {}))
        for frame, move in zip(offsets.frames, offsets.moves_m, strict=True):
            sums[frame] = sums.get(frame, np.zeros(2)) + move
        out[offsets.stage] = count + 1, sums
    return out


def _strips(a: Recording, b: Recording) -> list[dict[str, Any]]:
    """For each pair of strips whose offsets differ: by how much, at the lines that both recorded."""
    curves_a, curves_b = _curves(a), _curves(b)
    out: list[dict[str, Any]] = []
    for stage, pair in dict.fromkeys([*curves_a, *curves_b]):
        of_a, of_b = curves_a.get((stage, pair)), curves_b.get((stage, pair))
        if of_a is None or of_b is None:
            out.append({"stage": stage, "pair": pair, "only_in": "b" if of_a is None else "a"})
            continue
        _, at_a, at_b = np.intersect1d(of_a.line, of_b.line, return_indices=True)
        equal = len(at_a) == len(of_a.line) == len(of_b.line) and all(
            np.array_equal(getattr(of_a, name), getattr(of_b, name), equal_nan=True)
            for name in ("offset_px", "sd_px", "label")
        )
        if not equal:
            change = of_b.offset_px[at_b] - of_a.offset_px[at_a]
            relabelled = of_b.label[at_b] != of_a.label[at_a]
            out.append(
                {
                    "stage": stage,
                    "pair": pair,
                    "lines": [len(of_a.line), len(of_b.line)],
                    "largest_px": largest_length(change),
                    "rms_px": rms_length(change),
                    "share_relabelled": float(relabelled.mean()) if relabelled.size else None,
                }
            )
    return out


def _curves(recording: Recording) -> dict[tuple[str, int], StripCurve]:
    ids = {stage.index: stage.stage_id for stage in recording.stages}
    return {(ids.get(c.stage_index, ""), c.pair): c for c in recording.strips}


def _strip_residuals(a: Recording, b: Recording) -> list[dict[str, Any]]:
    """For each pair of strips of which something else is left: blocks and RMS of both, the largest change."""
    left_a, left_b = _residuals(a), _residuals(b)
    out: list[dict[str, Any]] = []
    for stage, pair in dict.fromkeys([*left_a, *left_b]):
        of_a, of_b = left_a.get((stage, pair)), left_b.get((stage, pair))
        if of_a is None or of_b is None:
            out.append({"stage": stage, "pair": pair, "only_in": "b" if of_a is None else "a"})
            continue
        equal = all(
            np.array_equal(getattr(of_a, name), getattr(of_b, name), equal_nan=True)
            for name in ("line", "residual_px", "sd_px")
        )
        if not equal:
            _, at_a, at_b = np.intersect1d(of_a.line, of_b.line, return_indices=True)
            both = of_a.residual_px, of_b.residual_px
            out.append(
                {
                    "stage": stage,
                    "pair": pair,
                    "blocks_measured": [int(np.isfinite(r).all(axis=1).sum()) for r in both],
                    "rms_px": [rms_length(r) for r in both],
                    "largest_px": largest_length(both[1][at_b] - both[0][at_a]),
                }
            )
    return out


def _residuals(recording: Recording) -> dict[tuple[str, int], StripResidual]:
    ids = {stage.index: stage.stage_id for stage in recording.stages}
    return {(ids.get(r.stage_index, ""), r.pair): r for r in recording.strip_residuals}


def _warnings(a: Recording, b: Recording) -> list[dict[str, str]]:
    of_a, of_b = (
        Counter((w.level, w.stage, w.frame, w.text) for w in recording.warnings) for recording in (a, b)
    )
    return [
        {"only_in": where, "level": level, "stage": stage, "frame": frame, "text": text}
        for where, only in (("a", of_a - of_b), ("b", of_b - of_a))
        for level, stage, frame, text in only.elements()
    ]
