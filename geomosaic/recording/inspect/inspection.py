"""What a person asks of a recording: a stage, a frame, a pair, the worst of all, and where a run ended."""

from __future__ import annotations

from typing import Any

import numpy as np

from geomosaic.errors import InputError, UnknownNameError
from geomosaic.quality.solved_tables import DOWN_WEIGHTED
from geomosaic.recording.file.model import LogLine, Recording, StageRecord
from geomosaic.recording.file.plain import picked
from geomosaic.recording.inspect.solved import Solved, frame_figures, known, pair_figures, status_counts
from geomosaic.recording.inspect.table_figures import table_frames, table_pairs
from geomosaic.recording.inspect.worst import faults, worst_frames, worst_pairs

SHOWN = 5
"""Faults that are shown where nobody asks for more."""
_LAST_LINES = 3


class Inspection:
    """The answers of one recording, each as values that JSON knows.

    solved: None of strips, and where the recording holds no artefacts: then frames and pairs are as its
    tables have them. unreadable: why its survey can't be read.
    """

    def __init__(self, recording: Recording, solved: Solved | None, unreadable: str = "") -> None:
        self.recording, self.solved, self.unreadable = recording, solved, unreadable
        reasons = {(t.row[i], t.other[i]): t.note[i] for t in _tried(recording) for i in range(len(t.note))}
        self.pairs = table_pairs(recording) if solved is None else pair_figures(solved)
        for pair in (pair for pair in self.pairs if not pair["tied"]):
            why = reasons.get((pair["left"], pair["right"]))
            pair["why_not"] = why or "tried, and no tie points agree"
        if solved is None:
            self.frames = table_frames(recording, self.pairs)
        else:
            self.frames = frame_figures(solved, self.pairs)

    def ended(self) -> dict[str, Any]:
        """How the run ended: `finished`, or the stage it was in, how far, and its last words."""
        stages = self.recording.stages
        last = stages[-1] if stages else None
        errors = [w for w in self.recording.log if w.level in ("error", "fatal")]
        out: dict[str, Any] = {"finished": bool(stages) and last is not None and last.finished and not errors}
        if out["finished"] and self.recording.whole and len(stages) >= self.recording.planned:
            return out
        out["finished"] = False
        in_stage = "" if last is None else last.stage_id
        out["in_stage"] = in_stage or None
        if last is not None and last.finished:
            out |= {"in_stage": None, "after_stage": in_stage}
        progress = self.recording.progress
        if progress is not None and progress.stage_id == in_stage and not (last and last.finished):
            out |= {
                "done": progress.done,
                "total": progress.total,
                "doing": progress.text,
                "seconds": known(progress.seconds),
                "memory_mb": progress.memory_bytes / 1e6 if progress.memory_bytes else None,
            }
        out["error"] = errors[-1].text if errors else None
        out["last_words"] = [line.text for line in self.recording.log[-_LAST_LINES:]]
        return out | {"text": _ended_text(out)}

    def worst(self, count: int) -> dict[str, Any]:
        """The worst faults, frames and pairs, each at most `count`, and how many there are of each."""
        found = faults(self.recording, self.solved, self.frames)
        return {
            "faults": found[:count],
            "faults_found": len(found),
            "frames": worst_frames(self.frames)[:count],
            "frames_by_status": status_counts(self.frames),
            "pairs": [p for p in worst_pairs(self.pairs) if p["tied"]][:count],
            "pairs_tied": sum(p["tied"] for p in self.pairs),
            "untied": [p for p in self.pairs if not p["tied"]][:count],
            "pairs_untied": sum(not p["tied"] for p in self.pairs),
        }

    def stage(self, id: str) -> dict[str, Any]:
        """All that a stage was given, made and said. Raises `UnknownNameError`."""
        record = self._stage(id)
        notes = record.notes if isinstance(record.notes, dict) else {}
        sizes = {a.name: a.total_bytes for a in self.recording.artefacts if a.stage_index == record.index}
        return {
            "index": record.index,
            "id": record.stage_id,
            **picked(record, "version", "finished", "cached", "seconds", "params", "inputs"),
            "outputs": {n: {"fingerprint": f, "bytes": sizes.get(n)} for n, f in record.outputs.items()},
            "written": record.written,
            "warnings": notes.get("warnings", []),
            "metrics": notes.get("metrics", {}),
            "iterations": [i for i in self.recording.iterations if i["stage_index"] == record.index],
            "log": [_line(line) for line in self.recording.log if line.stage == record.stage_id],
        }

    def frame(self, name: str) -> dict[str, Any]:
        """All that is known of a frame, and its pairs, the worst first. Raises as `_known`."""
        name = self._known(name)
        (figures,) = (f for f in self.frames if f["frame"] == name)
        mine = [p for p in worst_pairs(self.pairs) if name in (p["left"], p["right"])]
        log = [_line(line) for line in self.recording.log if line.frame == name]
        about = [f for f in faults(self.recording, self.solved, self.frames) if name in f["frames"]]
        return {**figures, "pairs": mine, "faults": about, "log": log}

    def pair(self, a: str, b: str) -> dict[str, Any]:
        """All that is known of a pair, with its residuals' spread. Raises `InputError` if it wasn't tried."""
        names = {self._known(a), self._known(b)}
        found = [p for p in self.pairs if {p["left"], p["right"]} == names]
        if not found:
            problem = f"{a} and {b} were not compared: by their positions they don't overlap"
            raise InputError(problem, file=self.recording.path, fix="give a pair of neighbours")
        return found[0] | self._residuals(found[0])

    def _residuals(self, pair: dict[str, Any]) -> dict[str, Any]:
        solved = self.solved
        if not pair["tied"] or solved is None or solved.ties is None:
            return {}
        at = self.pairs.index(pair)
        left_m = solved.adjusted.residuals_m[at] if solved.adjusted else np.zeros((0, 2))
        length = np.hypot(*left_m.T)
        length = length[np.isfinite(length)]
        weight = solved.weights[at]
        out: dict[str, Any] = {"down_weighted": int((weight < DOWN_WEIGHTED).sum())}
        if length.size:
            shares = {"median_m": 0.5, "p90_m": 0.9, "p99_m": 0.99}
            out |= {name: float(np.quantile(length, share)) for name, share in shares.items()}
        return out

    def _stage(self, id: str) -> StageRecord:
        for record in reversed(self.recording.stages):
            if record.stage_id == id:
                return record
        ids = [s.stage_id for s in self.recording.stages]
        raise UnknownNameError("stage of this recording", id, ids, file=self.recording.path)

    def readable(self) -> Solved:
        """The survey. Raises `InputError` where there is none."""
        if self.solved is None:
            fix = "give a recording of frames that holds artefacts"
            problem = self.unreadable or "no frames are recorded"
            raise InputError(problem, file=self.recording.path, fix=fix)
        return self.solved

    def _known(self, name: str) -> str:
        """A frame's name, also without its suffix. Raises `InputError` where frames aren't recorded."""
        if not self.frames:
            self.readable()
        names = [f["frame"] for f in self.frames]
        near = [n for n in names if name in (n, n.rpartition(".")[0])]
        if not near:
            raise UnknownNameError("frame of this recording", name, names, file=self.recording.path)
        return str(near[0])


def _tried(recording: Recording) -> list[Any]:
    return [
        t for t in recording.tables if t.name == "pairs.tried" and len(t.row) == len(t.other) == len(t.note)
    ]


def _ended_text(ended: dict[str, Any]) -> str:
    where = f"in {ended['in_stage']}" if ended["in_stage"] else "before its first stage"
    if "after_stage" in ended:
        where = f"after {ended['after_stage']}"
    if ended.get("total"):
        doing = f" {ended['doing']}" if ended["doing"] else ""
        where += f", at {ended['done']} of {ended['total']}{doing}"
    if ended.get("seconds") is not None:
        where += f", {ended['seconds']:.0f} s after it began"
    return where + (f": {ended['error']}" if ended["error"] else "")


def _line(line: LogLine) -> dict[str, Any]:
    return picked(line, "level", "stage", "frame", "text")
