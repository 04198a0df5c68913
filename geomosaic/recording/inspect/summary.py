"""A recording in short, as values that JSON knows."""

from __future__ import annotations

from typing import Any

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.recording.file.fingerprints import altered_artefacts
from geomosaic.recording.file.model import Jitter, Recording, RoundOffsets, StripCurve, StripResidual
from geomosaic.recording.file.plain import picked

_PEAKS = 3
_OF_STAGES = ("version", "params", "inputs", "outputs", "seconds", "cached", "finished")


def summary(recording: Recording) -> dict[str, Any]:
    """What `geomosaic inspect --json` prints.

    Keys: path, whole, problem, recipe, environment, manifest, stages, rounds, strips, strip_residuals,
    jitter, warnings, altered, artefacts, topics.
    """
    ids = {stage.index: stage.stage_id for stage in recording.stages}
    return {
        "path": str(recording.path),
        **picked(recording, "whole", "problem"),
        "recipe": recording.recipe_yaml,
        **picked(recording, "environment", "manifest"),
        "stages": [{"index": s.index, "id": s.stage_id, **picked(s, *_OF_STAGES)} for s in recording.stages],
        "rounds": [
            {
                "stage": offsets.stage,
                "round": offsets.round_index,
                "pairs": len(offsets.pairs),
                "largest_misalignment_m": largest_length(offsets.misalignments_m),
                "rms_misalignment_m": rms_length(offsets.misalignments_m),
                "largest_move_m": largest_length(offsets.moves_m),
                "worst_pair": worst_pair(offsets),
            }
            for offsets in recording.rounds
        ],
        "strips": [{"stage": ids.get(c.stage_index, ""), **_curve(c)} for c in recording.strips],
        "strip_residuals": [
            {"stage": ids.get(r.stage_index, ""), **_residual(r)} for r in recording.strip_residuals
        ],
        "jitter": [{"stage": ids.get(j.stage_index, ""), **_jitter(j)} for j in recording.jitter],
        "warnings": [picked(w, "level", "stage", "frame", "text") for w in recording.warnings],
        "altered": [{"stage": stage, "artefact": name} for stage, name in altered_artefacts(recording)],
        "artefacts": [
            {
                "stage": ids.get(a.stage_index, a.stage_id),
                "name": a.name,
                "type": a.type_name,
                "fingerprint": a.fingerprint,
                "bytes": a.total_bytes,
                "whole": a.complete,
            }
            for a in recording.artefacts
        ],
        "topics": [
            {"topic": t.name, "schema": t.schema, "messages": t.messages} for t in recording.topics.values()
        ],
    }


def _curve(curve: StripCurve) -> dict[str, Any]:
    share = [float((curve.label == k).mean()) if curve.label.size else None for k in range(3)]
    known = curve.offset_px[np.isfinite(curve.offset_px).all(axis=1)]
    sd = curve.sd_px[np.isfinite(curve.sd_px)]
    return {
        **picked(curve, "pair", "left", "right"),
        "lines": len(curve.line),
        "dcol_px": [float(known[:, 0].min()), float(known[:, 0].max())] if len(known) else None,
        "dline_px": [float(known[:, 1].min()), float(known[:, 1].max())] if len(known) else None,
        "largest_sd_px": float(sd.max()) if sd.size else None,
        "share_measured": share[0],
        "share_bridged": share[1],
        "share_unreliable": share[2],
    }


def _residual(left: StripResidual) -> dict[str, Any]:
    """The RMS counts every block that was measured alike, however many of its lines were."""
    return {
        **picked(left, "pair", "left", "right"),
        "blocks": len(left.line),
        "blocks_measured": int(np.isfinite(left.residual_px).all(axis=1).sum()),
        "rms_px": rms_length(left.residual_px),
        "largest_px": largest_length(left.residual_px),
    }


def _jitter(jitter: Jitter) -> dict[str, Any]:
    """The three strongest peaks, by the larger of both amplitudes, strongest first."""
    strength = np.maximum(jitter.across_px, jitter.along_px)
    edged = np.concatenate([[-np.inf], strength, [-np.inf]])
    tops = np.flatnonzero((strength > edged[:-2]) & (strength >= edged[2:]))
    strongest = tops[np.argsort(-strength[tops], kind="stable")][:_PEAKS]
    return {
        "what": jitter.what,
        "peaks": [
            {name: float(getattr(jitter, name)[k]) for name in ("frequency_hz", "across_px", "along_px")}
            for k in strongest
        ],
    }


def largest_length(vectors: Floats) -> float | None:
    """The greatest length of (n, 2) vectors; None if none is known."""
    known = _known_lengths(vectors)
    return float(known.max()) if known.size else None


def rms_length(vectors: Floats) -> float | None:
    """The root mean square length of (n, 2) vectors; None if none is known."""
    known = _known_lengths(vectors)
    return float(np.sqrt(np.mean(known**2))) if known.size else None


def worst_pair(offsets: RoundOffsets) -> list[str] | None:
    """The names of the two frames with the largest misalignment; None if none is known."""
    lengths = np.hypot(*offsets.misalignments_m.T)
    return list(offsets.pairs[int(np.nanargmax(lengths))]) if np.isfinite(lengths).any() else None


def _known_lengths(vectors: Floats) -> Floats:
    lengths = np.hypot(*vectors.T)
    return np.asarray(lengths[np.isfinite(lengths)])
