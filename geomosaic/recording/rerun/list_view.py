"""The texts next to the plan: what is wrong, the worst pairs, the frames moved most, each frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np

from geomosaic.quality import ranking
from geomosaic.recording.file.model import Recording
from geomosaic.recording.file.reader import printable
from geomosaic.recording.inspect.plan import headings_off_deg, moves_m, wrong_headings

LISTS: Final = "/lists"
PICK: Final = "pick"
"""The timeline that picks a frame and a pair, worst first."""
_MOST: Final = 14


def draw_lists(recording: Recording, stream: Any) -> None:
    """Writes the lists anew."""
    import rerun

    texts = {
        "said": _said(recording),
        "pairs": _pairs(recording),
        "frames": _frames(recording),
        "strips": _strips(recording),
    }
    for name, text in texts.items():
        if text:
            stream.log(f"{LISTS}/{name}", rerun.TextDocument(text, media_type="text/markdown"), static=True)


def worst_frames(recording: Recording) -> list[int]:
    """Rows of frames.adjusted in the order of `quality.ranking`; of wrong tags are those that a warning
    names."""
    placed, adjusted = recording.table("frames.placed"), recording.table("frames.adjusted")
    warned = {line.frame for line in recording.log if line.level == "warning"}
    off_deg = headings_off_deg(placed, adjusted)
    named = np.array([name in warned for name in adjusted.row], dtype=bool)
    loose = [k < len(adjusted.note) and adjusted.note[k] != "tied" for k in range(len(adjusted.row))]
    wrong = named | wrong_headings(placed, adjusted)
    return ranking.worst_frames(loose, wrong, moves_m(adjusted), off_deg)


def frame_text(recording: Recording, row: int, said: Iterable[str]) -> str:
    """One frame in figures, and what was said of it."""
    placed, adjusted = recording.table("frames.placed"), recording.table("frames.adjusted")
    name = adjusted.row[row]
    given = placed.number.get(name)
    lines = [
        f"**{_cell(name)}** {adjusted.note[row] if adjusted.note else ''}",
        "",
        "| | given | found |",
        "|--|--|--|",
    ]
    for column in ("east_m", "north_m", "up_m", "yaw_deg", "pitch_deg", "roll_deg"):
        before = np.nan if given is None else placed.column(column)[given]
        lines.append(f"| {column} | {_figure(before, 2)} | {_figure(adjusted.column(column)[row], 2)} |")
    for column, digits in (("pairs", 0), ("tie_points", 0), ("share_down_weighted", 3)):
        lines.append(f"| {column} | | {_figure(adjusted.column(column)[row], digits)} |")
    return "\n".join([*lines, "", *(f"- {_cell(text)}" for text in said)])


def _said(recording: Recording) -> str:
    """The verdict, and every warning; those of a kind together."""
    verdict = recording.metrics.get("verdict")
    lines = []
    if isinstance(verdict, dict):
        lines += [f"**{_cell(verdict.get('grade'))}**: {_cell(verdict.get('text'))}", ""]
        if verdict.get("cause"):
            lines += [f"{_cell(verdict['cause'])}; {_cell(verdict.get('fix', verdict.get('mend')))}", ""]
    elif recording.progress is not None and recording.stages and not recording.stages[-1].finished:
        b = recording.progress
        at = f"{_cell(b.text)} {b.done} of {b.total}, {b.seconds:.0f} s in"
        lines += [f"not finished; last sign of life: **{_cell(b.stage_id)}**, {at}", ""]
    warned = sorted(recording.warnings, key=lambda line: not line.frame)
    for line in warned[:_MOST]:
        about = f"**{_cell(line.frame)}** " if line.frame else ""
        lines.append(f"- {about}{_cell(line.text)}")
    if len(warned) > _MOST:
        lines.append(f"- and {len(warned) - _MOST} more in the log")
    return "\n".join(lines) or "nothing was warned of"


def _pairs(recording: Recording) -> str:
    tied, tried = recording.table("pairs.adjusted"), recording.table("pairs.tried")
    if not tied.row and not tried.row:
        return ""
    rms_m = tied.column("rms_m")
    rows = [
        (
            f"{_cell(tied.row[k])} - {_cell(tied.other[k])}",
            *(_figure(tied.column(c)[k], d) for c, d in _OF_PAIRS),
        )
        for k in ranking.worst_pairs(rms_m, _MOST)
    ]
    vain = [note for note in tried.note if note]
    kinds = Counter(note.split(":")[0] for note in vain)
    said = ", ".join(f"{_cell(kind)} {n}" for kind, n in kinds.most_common(3))
    head = f"{len(vain)} of {len(tried.row)} tried didn't tie" + (f": {said}" if said else "")
    return _markdown(head, ("pair", "ties", "rms m", "largest m", "down-weighted"), rows)


_OF_PAIRS: Final = (("tie_points", 0), ("rms_m", 3), ("largest_m", 2), ("share_down_weighted", 2))


def _frames(recording: Recording) -> str:
    placed, adjusted = recording.table("frames.placed"), recording.table("frames.adjusted")
    if not adjusted.row:
        return ""
    moved, off = moves_m(adjusted), headings_off_deg(placed, adjusted)
    up, ties, pairs = (adjusted.column(name) for name in ("moved_u_m", "tie_points", "pairs"))
    shown = ((moved, 1), (up, 1), (off, 0), (ties, 0), (pairs, 0))
    rows = [
        (
            _cell(adjusted.row[k]),
            *(_figure(column[k], digits) for column, digits in shown),
            adjusted.note[k] if adjusted.note else "",
        )
        for k in worst_frames(recording)[:_MOST]
    ]
    columns = ("frame", "moved m", "up m", "heading off", "ties", "pairs", "")
    return _markdown("frames moved most", columns, rows)


def _strips(recording: Recording) -> str:
    greys, bridged = recording.table("strips.greys"), recording.table("strips.bridged")
    parts = []
    if greys.row:
        columns = [greys.column("gain"), greys.column("offset")]
        rows = [(_cell(n), *(_figure(c[k], 3) for c in columns)) for k, n in enumerate(greys.row)]
        parts.append(_markdown("greys", ("strip", "gain", "offset"), rows))
    if bridged.row:
        length = bridged.column("last_line") - bridged.column("first_line")
        rows = [
            (
                f"{_cell(bridged.row[k])} - {_cell(bridged.other[k])}",
                " - ".join(_figure(bridged.column(c)[k], 0) for c in ("first_line", "last_line")),
                _cell(bridged.note[k]),
            )
            for k in np.argsort(-length, kind="stable")[:_MOST]
        ]
        parts.append(
            _markdown(f"{len(bridged.row)} runs of lines not measured", ("seam", "lines", "why"), rows)
        )
    return "\n\n".join(parts)


def _markdown(head: str, columns: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = [head, "", "|" + "|".join(columns) + "|", "|" + "--|" * len(columns)]
    return "\n".join([*lines, *("|" + "|".join(row) + "|" for row in rows)])


def _figure(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else ""


def _cell(text: Any) -> str:
    """A stranger's text where Markdown would obey it."""
    return "".join(f"\\{c}" if c in "|*`[]<>\\" else c for c in printable(str(text)))
