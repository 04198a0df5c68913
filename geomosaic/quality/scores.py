"""People's scores: the five levels of CCIR Recommendation 500-1, as table 1 of Yue et al. 2021 uses them, and
what several viewers made of several runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from geomosaic.constants import sourced
from geomosaic.doors.addresses import NAME_BYTES
from geomosaic.doors.files import TEXT_BYTES, printable
from geomosaic.doors.plain import read_json
from geomosaic.errors import FileError


@dataclass(frozen=True)
class ScoreLevel:
    """One level: the words for quality and for how far the defects hinder viewing."""

    score: int
    quality: str
    obstruction: str


@dataclass(frozen=True)
class ScoreQuestion:
    """Something a viewer scores on the mosaic: a key for the file, a question for the page."""

    key: str
    question: str


CCIR_500_1 = sourced(
    (
        ScoreLevel(5, "Excellent", "no loss of quality to be seen"),
        ScoreLevel(4, "Good", "a loss can be seen but does not hinder viewing"),
        ScoreLevel(3, "Fair", "a clear loss that hinders viewing slightly"),
        ScoreLevel(2, "Poor", "hinders viewing"),
        ScoreLevel(1, "Bad", "hinders viewing very seriously"),
    ),
    "scores",
    "levels of people's scores, as in the paper",
    "CCIR 500-1; Yue et al. 2021, table 1",
)

CRITERIA = (
    ScoreQuestion("geometry", "Lines that cross seams (roads, roofs, field edges) run on unbroken"),
    ScoreQuestion("seams", "Seams cannot be seen as lines"),
    ScoreQuestion("tone", "Brightness and colour run evenly from frame to frame"),
    ScoreQuestion("detail", "Detail is sharp, without ghosts or smear"),
    ScoreQuestion("overall", "The mosaic as a whole"),
)

_FIX: Final = "give files that a report's score form saved"


@dataclass(frozen=True)
class Opinion:
    """What one viewer scored of one run, by the criteria's keys, and when it was saved."""

    run: str
    viewer: str
    date: str
    scores: dict[str, int]


@dataclass(frozen=True)
class RunScores:
    """Of one run: how many viewers, and the mean of their scores by the criteria's keys."""

    run: str
    viewers: int
    mean: dict[str, float]


def read_opinion(path: Path) -> Opinion:
    """A file of a report's form. Raises: `FileError` where it is anything else."""
    content = read_json(path, TEXT_BYTES, "scores", _FIX)
    given = content.get("scores") if isinstance(content, dict) else None
    if not isinstance(given, dict):
        raise FileError("holds no scores", file=path, fix=_FIX)
    levels, scores = {level.score for level in CCIR_500_1}, {}
    for criterion in CRITERIA:
        score: Any = given.get(criterion.key)
        if type(score) is not int or score not in levels:
            raise FileError(f"has no score of 1 to 5 for {criterion.key!r}", file=path, fix=_FIX)
        scores[criterion.key] = score
    run, viewer, date = (printable(str(content.get(k) or ""))[:NAME_BYTES] for k in ("run", "viewer", "date"))
    return Opinion(run or printable(path.stem), viewer, date, scores)


def gathered(opinions: Sequence[Opinion]) -> list[RunScores]:
    """By run, the best overall first; of a viewer who scored a run twice, the later saving counts."""
    latest: dict[tuple[str, str], Opinion] = {}
    for opinion in sorted(opinions, key=lambda o: o.date):
        latest[opinion.run, opinion.viewer] = opinion
    runs: dict[str, list[Opinion]] = {}
    for opinion in latest.values():
        runs.setdefault(opinion.run, []).append(opinion)
    out = [
        RunScores(run, len(of), {c.key: sum(o.scores[c.key] for o in of) / len(of) for c in CRITERIA})
        for run, of in runs.items()
    ]
    return sorted(out, key=lambda r: (-r.mean["overall"], r.run))
