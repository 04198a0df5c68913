"""What is wrong with a survey, worst first: what it is, how sure that is, how to fix it.

Frames are named by the run's warnings. Wrong headings, turned images and wrong positions are compared once
more by the adjusted poses, and the likeliest explanation is named with its probability. Besides: ground
without tie points, and frames that stand against their line.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from geomosaic.adjustment.procedure.blunder_detection import headings_off_deg
from geomosaic.arrays import Floats
from geomosaic.camera.rotation import Rotation
from geomosaic.constants import tuned
from geomosaic.matching.explanations import MOST_RAD
from geomosaic.placement.graph import flight_lines
from geomosaic.placement.prior import courses_deg, heading_assumed
from geomosaic.quality import ranking
from geomosaic.quality.bare_ground import bare_ground
from geomosaic.recording.file.model import Recording
from geomosaic.recording.inspect.explained import (
    EXPLAINED,
    HEADING,
    POSITION,
    TURNED,
    Cause,
    causes,
    how_sure,
)
from geomosaic.recording.inspect.solved import Solved
from geomosaic.recording.inspect.table_figures import warned
from geomosaic.survey.names import some
from geomosaic.survey.platforms import LEAST_FRAMES

_TOGETHER = tuned(0.7, "mean length", "of unit vectors, for a usual heading: less is chance; more fails")


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong. code: stable, kebab-case; frames: whose; weight: larger is worse; probability:
    of this explanation, None where it isn't compared with others."""

    code: str
    frames: tuple[str, ...]
    text: str
    sure: str
    fix: str
    weight: float
    probability: float | None = None


_PLACED_RIGHT = (
    "no need: the images placed it right; correct it in the positions' table if they are used elsewhere"
)
_FIXES: dict[str, tuple[float, str]] = {
    "bundle-failed": (95.0, "more overlap, or positions of more frames"),
    "self-calibration-failed": (85.0, "a calibrated lens (--camera), or more overlap"),
    "not-placed": (80.0, "give its position (--pos), or leave it out"),
    "no-tie-points": (70.0, "leave it out, or fly with more overlap there"),
    "separate-part": (68.0, "frames between the parts, or control points in each"),
    "pose-not-determined": (66.0, "look at the frame; more overlap there"),
    "frame-contradicted": (64.0, "look at the frame: another flight's, or a copy under another time"),
    "position-wrong": (40.0, _PLACED_RIGHT),
    "yaw-wrong": (38.0, _PLACED_RIGHT),
    "frame-turned": (36.0, "no need: it is corrected; don't let viewers turn frames when they save them"),
    "frame-flung": (34.0, "look at the frame; leave it out if it is of another place"),
    "frame-damaged": (32.0, "copy it from the camera's card again"),
    "height-implausible": (30.0, "no need: the images set it; give heights with --pos if they are known"),
    "horizon": (12.0, "no need: only what lies on the ground is used"),
    "frame-oblique": (20.0, "no need: it was left out"),
    "frame-blurred": (20.0, "no need: it was left out"),
    "frame-copy": (18.0, "no need: one of the copies is used"),
    "frame-take-off": (18.0, "no need: it was left out"),
    "frame-other-place": (20.0, "mosaic the other flight by itself"),
    "frame-other-camera": (18.0, "choose the camera with --camera-kind"),
    "frame-other-bands": (20.0, "mosaic frames of the other kind by themselves"),
    "frame-no-camera": (20.0, "give the lens with --camera"),
}  # fmt: skip
"""How bad the faults of frames are, relative to each other, and how to fix them."""
FORMER_CODES = {"height-not-believed": "height-implausible"}
"""Present code of a warning by the code that recordings of earlier versions have."""
_TEXTS = {
    TURNED: "its pixels were turned after the flight; set by its neighbours",
    HEADING: "its heading was given wrong; set by its neighbours",
    POSITION: "its position was given wrong; placed by its neighbours",
}
"""Of explanations that the run did not name."""


def faults(recording: Recording, solved: Solved | None, frames: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What is wrong, worst first, as JSON: code, frames, text, sure, fix, probability.

    Args: frames: `frame_figures` of `solved`.
    """
    found = [*_of_run(recording), *_of_verdict(recording)]
    by_name, said = {f["frame"]: f for f in frames}, warned(recording)
    known = causes(recording, {(code, frame) for code, frame, _ in said}, frames)
    found += _of_frames(said, by_name, EXPLAINED if known else frozenset())
    found += _of_causes(known, said, by_name)
    if solved is not None:
        found += _against_their_lines(solved, {c.frame for c in known if c.code == TURNED})
        found += _bare_ground(solved)
    found.sort(key=lambda f: (-f.weight, f.code, f.frames))
    return [{k: v for k, v in asdict(f).items() if k != "weight"} | {"mend": f.fix} for f in found]


def _of_run(recording: Recording) -> Iterator[Fault]:
    """The run itself: ended early, or its recording damaged."""
    errors = [line for line in recording.log if line.level in ("error", "fatal")]
    stages, again = recording.stages, "run again: finished work is kept"
    if errors:
        text = f"{errors[-1].stage or 'the run'} ended with: {errors[-1].text}"
        yield Fault("run-failed", (), text, "certain", f"fix that and {again}", 100.0)
    elif (stages and not stages[-1].finished) or len(stages) < recording.planned:
        where = "before its first stage"
        if stages:
            where = f"{'after' if stages[-1].finished else 'in'} {stages[-1].stage_id}"
        text = f"the run was killed {where}"
        yield Fault("run-killed", (), text, "certain", again, 100.0)
    elif recording.problem:
        text = f"the recording isn't whole: {recording.problem}"
        fix = "inspect --repair OUT makes a whole file of what is there"
        yield Fault("recording-not-whole", (), text, "certain", fix, 99.0)


def _of_verdict(recording: Recording) -> Iterator[Fault]:
    """What the run's own verdict holds against its mosaic."""
    for e in recording.verdict.get("evidence", ()):
        if e.get("grade") in ("doubtful", "bad"):
            name, cause = (str(e.get(key, "")) for key in ("name", "cause"))
            fix = str(e.get("fix", e.get("mend", "")))
            figure = _figure(e.get("value"), str(e.get("unit", "")))
            text = f"{cause} ({name} {figure})" if figure else cause
            weight = 90.0 if e["grade"] == "bad" else 50.0
            yield Fault(name.replace(" ", "-"), (), text, f"the mosaic is {e['grade']}", fix, weight)


def _figure(value: Any, unit: str) -> str:
    if not unit or not isinstance(value, int | float):
        return ""
    return f"{100.0 * value:.0f} %" if unit == "share" else f"{value:.2f} {unit}"


def _of_frames(
    warned: Iterable[tuple[str, str, str]], frames: dict[str, dict[str, Any]], but: Collection[str]
) -> Iterator[Fault]:
    """Frames that the run names, once each for each thing; but for these codes."""
    said: dict[tuple[str, str], str] = {}
    for code, frame, text in ((FORMER_CODES.get(code, code), frame, text) for code, frame, text in warned):
        if frame and code in _FIXES and code not in but:
            said.setdefault((code, frame), text)
    for (code, frame), text in said.items():
        weight, fix = _FIXES[code]
        sure = "certain" if frames.get(frame, {}).get("status") == "left_out" else "as the run says"
        yield Fault(code, (frame,), text, sure, fix, weight)


def _of_causes(
    known: Iterable[Cause], warned: Iterable[tuple[str, str, str]], frames: dict[str, dict[str, Any]]
) -> Iterator[Fault]:
    """Frames with the likeliest explanation of what doesn't fit."""
    said = {(code, frame): text for code, frame, text in warned}
    for cause in known:
        frame, (weight, fix) = frames.get(cause.frame, {}), _FIXES[cause.code]
        text = said.get((cause.code, cause.frame)) or _TEXTS[cause.code]
        tied = f"{frame.get('pairs_tied', 0)} pairs with {frame.get('tie_points', 0)} tie points hold it"
        if frame.get("rms_px") is not None:
            tied += f", to {frame['rms_px']:.2f} px"
        off = f"{cause.off:.1f} m" if cause.code == POSITION else f"{cause.off:.0f} degrees"
        fits = f"its heading then fits to {off}" if cause.code == TURNED else f"{off} off"
        size = cause.off / (1.0 + cause.off)
        sure = f"{how_sure(cause.probability)}; {fits}; {tied}"
        weight += cause.probability * size
        yield Fault(cause.code, (cause.frame,), text, sure, fix, weight, cause.probability)


def _against_their_lines(solved: Solved, turned: Collection[str] = ()) -> Iterator[Fault]:
    """Frames whose image, and whose tag, stand on their head relative to the others of their line; but for
    those that are named as turned."""
    if solved.adjusted is None or solved.prior is None:
        return
    found = solved.adjusted.poses
    off_deg, most_deg = headings_off_deg((solved.placement or solved.prior).poses, found)
    lines = np.array(flight_lines(found.positions_m[:, :2]))
    course = np.radians(courses_deg(found.positions_m, tuple(lines)))
    lies_rad = Rotation(found.rotations).yaw_pitch_roll()[0] + np.pi / 2.0 * np.array(solved.turned)
    lies_rad[heading_assumed(solved.prior.poses)] = np.nan
    half = np.abs(np.abs(off_deg) - 180.0) < np.degrees(MOST_RAD)
    for line in np.unique(lines):
        mine = np.flatnonzero(lines == line)
        for i in (i for i in mine if solved.names[i] not in turned):
            if abs(solved.yawed_deg[i]) > most_deg[i]:
                continue
            others = mine[~half[mine] & (mine != i) & np.isfinite(lies_rad[mine] - course[mine])]
            usual = complex(np.mean(np.exp(1j * (lies_rad - course)[others]))) if len(others) else 0j
            if len(others) < LEAST_FRAMES or abs(usual) < _TOGETHER:
                continue
            here, there = np.degrees([lies_rad[i], np.angle(usual) + course[i]]) % 360.0
            if not abs(abs(here - there) - 180.0) < np.degrees(MOST_RAD):
                continue
            text = (
                f"its image stands on its head, unlike the others of its line (heading {here:.0f} degrees, "
                f"theirs {there:.0f}; its tags say so, too): its pixels were turned after the flight, or the "
                "camera turned about there"
            )
            sure = f"sure that it stands so: {len(others)} others of its line don't"
            fix = "no need: it is used as it stands"
            yield Fault("against-its-line", (solved.names[i],), text, sure, fix, 35.0)


def _bare_ground(solved: Solved) -> Iterator[Fault]:
    """Ground that several frames see and none of them has tie points on."""
    if solved.adjusted is None or solved.ties is None:
        return
    bare = bare_ground(solved.adjusted, solved.ties)
    if not bare.matters:
        return
    most = [solved.names[i] for i in bare.worst()]
    text = (
        f"{100.0 * bare.share:.0f} % of the ground that three frames and more see has no tie points: water, "
        f"or ground that looks alike or moves; most in {some(most)}"
    )
    fix = "no need on water; elsewhere heights are guessed: more overlap, or an elevation model (--dem)"
    yield Fault("ground-without-ties", tuple(most[:10]), text, "counted", fix, 25.0 + bare.share)


def worst_frames(frames: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Frames in the order of `quality.ranking`; of wrong tags are those that a warning names."""
    off_deg = _figures(f.get("yaw_off_deg") for f in frames)
    given_sd_deg = _figures((f.get("given") or {}).get("sd_kappa_deg") for f in frames)
    loose = [f["status"] != "tied" for f in frames]
    named = np.array([bool(f["said"]) for f in frames], dtype=bool)
    wrong = named | ranking.wrong_headings(off_deg, given_sd_deg)
    moved_m = [np.linalg.norm(_figures(f.get("moved_m", (None,))[:2])) for f in frames]
    return [frames[i] for i in ranking.worst_frames(loose, wrong, moved_m, off_deg)]


def worst_pairs(pairs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Tied pairs in the order of `quality.ranking`; then those that aren't tied."""
    order = ranking.worst_pairs(_figures(p.get("rms_m") for p in pairs))
    tied = [i for i in order if pairs[i]["tied"]]
    return [pairs[i] for i in tied] + [p for p in pairs if not p["tied"]]


def _figures(values: Iterable[float | None]) -> Floats:
    """NaN for what is unknown."""
    return np.array(list(values), dtype=np.float64)
