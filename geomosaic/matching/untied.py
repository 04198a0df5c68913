"""Why frames are tied to no other, in words for their warnings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from geomosaic.matching.match import PairMatch

Pair = tuple[int, int]


def mostly(faint: float) -> bool:
    """Whether a frame is faint by the share of its tiles that are: at least half."""
    return faint >= 0.5


def untied_reasons(
    looks: Mapping[Pair, PairMatch], keypoints: Sequence[int], faint: Sequence[float], least: int
) -> tuple[tuple[int, str], ...]:
    """Frames without a tied pair, each with the reason.

    Args: looks: every pair that was tried. keypoints, faint: of each frame their number, and the share of its
        tiles that are faint. least: fewest tie points of a pair.
    """
    tried: dict[int, list[PairMatch]] = {i: [] for i in range(len(keypoints))}
    for pair, match in looks.items():
        for i in pair:
            tried[i].append(match)
    return tuple(
        (i, _reason(matches, keypoints[i], mostly(faint[i]), least))
        for i, matches in tried.items()
        if not any(len(m.left) for m in matches)
    )


def _reason(matches: Sequence[PairMatch], keypoints: int, faint: bool, least: int) -> str:
    """Of one frame."""
    if keypoints < least:
        return f"only {keypoints} keypoints: its image has little {'contrast' if faint else 'texture'}"
    if not matches:
        return "no other frame overlaps it or looks like it"
    best = max(matches, key=lambda m: (m.agreeing, m.alike))
    overlaps = "1 frame that may overlap" if len(matches) == 1 else f"{len(matches)} frames that may overlap"
    contrast = f"; {keypoints} keypoints, its image has little contrast" if faint else ""
    return f"compared with {overlaps}, {best.why_not(least)}{contrast}"
