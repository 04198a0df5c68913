"""Frames whose pixels were turned after the flight: found from where their neighbours lie."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from geomosaic.arrays import Bools, Complexes, Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation, about_z
from geomosaic.constants import tuned
from geomosaic.matching.explanations import WRONG, HeadingEvidence, explained, usual_angle
from geomosaic.matching.model import TiePair
from geomosaic.matching.relative import MOST_TIES, averaged, joints_of
from geomosaic.placement.graph import connected_parts
from geomosaic.placement.prior import (
    COURSE_YAW_SD_DEG,
    heading_assumed,
    heading_limits_rad,
    smooth_courses_deg,
)
from geomosaic.projection.footprint import ground_from_images
from geomosaic.projection.ground import GroundSurface

_MISPLACED = tuned(4.0, "usual gaps", "beyond which it gives no course: less drops good ones; more keeps bad")
_QUARTERS = [np.array([[c, -s], [s, c]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))]


@dataclass(frozen=True)
class PairOnMap:
    """A tied pair: the frames, and the (k, 2) east and north where each places its tie points."""

    left: int
    right: int
    left_m: Floats
    right_m: Floats


def seen_pairs(
    pairs: Sequence[TiePair],
    poses: Poses,
    cameras: Sequence[Camera],
    ground: GroundSurface,
    located: Sequence[bool],
) -> list[PairOnMap]:
    """Where both frames of each pair place their tie points, if both have a position and see ground; of a
    pair as many as a median asks for."""
    known = [t for t in pairs if located[t.left] and located[t.right]]
    if not known:
        return []
    some = [np.linspace(0, len(t) - 1, min(len(t), MOST_TIES)).astype(np.intp) for t in known]
    frame = np.concatenate([np.repeat([t.left, t.right], len(s)) for t, s in zip(known, some, strict=True)])
    px = np.concatenate([p[s] for t, s in zip(known, some, strict=True) for p in (t.left_px, t.right_px)])
    places_m = ground_from_images(frame, px, poses, cameras, ground)[:, :2]
    out = []
    for t, both in zip(known, np.split(places_m, np.cumsum([2 * len(s) for s in some])[:-1]), strict=True):
        here, there = np.split(both, 2)
        hit = np.isfinite(here).all(axis=1) & np.isfinite(there).all(axis=1)
        if hit.any():
            out.append(PairOnMap(t.left, t.right, here[hit], there[hit]))
    return out


def found_turned(
    seen: Sequence[PairOnMap],
    poses: Poses,
    sizes_px: Sequence[tuple[int, int]],
    cap_m: float,
) -> tuple[dict[int, int], dict[int, float]]:
    """Quarter turns of the images turned after the flight, and headings (rad) of frames whose wrong heading
    looks like a turn. The headings are those by the neighbours' images. The likelier explanation is taken,
    see `explained`. A heading that nobody observed is never found wrong, nor its image turned.

    Args: sizes_px: width and height of each frame; cap_m: see `turned_frames`.
    """
    n, nadir = len(poses), poses.positions_m[:, :2]
    assumed, possible = heading_assumed(poses), possible_quarters(sizes_px)
    turns = turned_frames(n, _costs_m(seen, nadir), cap_m, possible)
    turns = {i: quarters for i, quarters in turns.items() if not assumed[i]}
    if not turns:
        return {}, {}
    lie = lying(n, seen, nadir, turns)
    upright = [
        replace(s, left_m=_turned_about(s.left_m, nadir[s.left], lie[s.left]),
                right_m=_turned_about(s.right_m, nadir[s.right], lie[s.right]))
        for s in seen
    ]  # fmt: skip
    yaw = Rotation(poses.rotations).yaw_pitch_roll()[0]
    image = yaw - np.angle(lie)
    course = np.where(assumed, np.nan, flown_courses_rad(nadir, _costs_m(upright, nadir), upright))
    given = np.where(assumed, np.nan, yaw)
    evidence = HeadingEvidence(given, image, course, heading_limits_rad(poses) / 4.0, possible)
    causes = explained(evidence).reshape(n, 8).argmax(axis=1)
    headings = {i: float(image[i] % (2.0 * np.pi)) for i in turns if causes[i] == WRONG}
    return {i: int(causes[i] % 4) for i in turns if causes[i] % 4}, headings


def lying(n: int, seen: Sequence[PairOnMap], nadir_m: Floats, turns: dict[int, int]) -> Complexes:
    """Turns (n,) of the frames' images about their nadir points, each a number of length 1. Each takes an
    image from where its tag places it to how its neighbours' images lie. Most frames of a connected part lie
    as their tags say, once those of `turns` are turned by so many quarters.

    The turns between frames are averaged (`relative.averaged`): as sure as all their pairs together.
    """
    edges = [(s.left, s.right) for s in seen]
    both = (((s.left_m - nadir_m[s.left]) @ [1, 1j], (s.right_m - nadir_m[s.right]) @ [1, 1j]) for s in seen)
    shape = averaged(n, joints_of(edges, both))
    lie = shape / np.abs(shape)
    for part in connected_parts(n, edges):
        off = np.angle(lie[part] * (-1j) ** np.array([turns.get(i, 0) for i in part]))
        lie[part] *= np.exp(-1j * usual_angle(off))
    return np.asarray(lie)


def _turned_about(at_m: Floats, nadir_m: Floats, turn: complex) -> Floats:
    away = np.asarray(((at_m - nadir_m) @ [1, 1j]) * turn, np.complex128)
    return np.asarray(nadir_m + _plane(away))


def _costs_m(seen: Sequence[PairOnMap], nadir_m: Floats) -> list[tuple[int, int, Floats]]:
    """See `turn_costs_m`, of each pair."""
    return [
        (s.left, s.right, turn_costs_m(s.left_m, s.right_m, nadir_m[s.left], nadir_m[s.right])) for s in seen
    ]


def flown_courses_rad(
    nadir_m: Floats, costs_m: Sequence[tuple[int, int, Floats]], seen: Sequence[PairOnMap] = ()
) -> Floats:
    """Courses over ground (n,) by positions that agree with the images. A frame whose position contradicts
    its neighbours' images gets its place from theirs. Its course is NaN where no good neighbour sees it.

    A wrong position bends the courses of the frames before and after, and cuts their line in two. Its pairs
    are all as far apart as it is off.

    Args: costs_m: see `turned_frames`; seen: pairs of which every image lies as its neighbours'.
    """
    apart_m: list[list[float]] = [[] for _ in nadir_m]
    for a, b, cost in costs_m:
        for i in (a, b):
            apart_m[i].append(float(cost[0, 0]))
    usual_m = np.array([np.median(mine) if mine else 0.0 for mine in apart_m])
    known = usual_m[usual_m > 0.0]
    good = usual_m <= (_MISPLACED * np.median(known) if len(known) else 0.0)
    places_m: dict[int, list[Floats]] = {}
    for s in seen:
        if good[s.left] != good[s.right]:
            both = (s.left, s.left_m), (s.right, s.right_m)
            base, other = both if good[s.left] else both[::-1]
            places_m.setdefault(other[0], []).append(_seen_from_m(*base, *other, nadir_m))
    lies_m = np.where(good[:, None], nadir_m, np.nan)
    for frame, at in places_m.items():
        lies_m[frame] = np.median(at, axis=0)
    out, known = np.full(len(nadir_m), np.nan), ~np.isnan(lies_m[:, 0])
    if known.any():
        out[known] = np.radians(smooth_courses_deg(lies_m[known]))
    return out


def _seen_from_m(base: int, base_m: Floats, other: int, other_m: Floats, nadir_m: Floats) -> Floats:
    """Where a frame lies, (2,), by its image and that of a base frame, which lies right: whatever the other's
    own heading and place."""
    z, w = ((at - nadir_m[i]) @ [1, 1j] for i, at in ((base, base_m), (other, other_m)))
    turn = joints_of([(base, other)], [(z, w)]).turn[0]
    return np.asarray(nadir_m[base] + np.median(_plane(z - turn * w), axis=0))


def _plane(along: Complexes) -> Floats:
    """East and north, (k, 2)."""
    return np.column_stack([along.real, along.imag])


def turn_costs_m(left_en: Floats, right_en: Floats, left_nadir: Floats, right_nadir: Floats) -> Floats:
    """Misalignment of a pair under each hypothesis of quarter turns, (4, 4): [left, right].

    A frame whose image is turned puts its ground points on the wrong side of its nadir point.
    Turning its points back by k quarters about the nadir point rights them; that is exact for a
    camera that looks straight down, and good to the tilt's displacement otherwise. Two frames turned
    alike also show: their overlap then lies on the sides facing away from each other.

    Args: (k, 2) east and north of tie points as each frame places them; nadir points (2,).
    """
    a, b = left_en - left_nadir, right_en - right_nadir
    base = right_nadir - left_nadir
    a, b = (np.stack([side @ turn.T for turn in _QUARTERS]) for side in (a, b))
    miss = b + base - a[:, None]
    return np.asarray(np.median(np.linalg.norm(miss, axis=-1), axis=-1))


def possible_quarters(sizes_px: Sequence[tuple[int, int]]) -> Bools:
    """Which quarter turns (n, 4) each image can have had: by 90 degrees only if its width and height are
    those of most images the other way round, or alike."""
    usual, _ = Counter(sizes_px).most_common(1)[0]
    out = np.tile([True, False, True, False], (len(sizes_px), 1))
    out[[w == h or (h, w) == usual != (w, h) for w, h in sizes_px]] = True
    return out


def turned_frames(
    n: int,
    costs_m: list[tuple[int, int, Floats]],
    cap_m: float,
    possible: Bools | None = None,
) -> dict[int, int]:
    """Quarter turns (1 to 3, counter-clockwise on the ground) of frames that need them.

    Minimises the sum over pairs of the misalignment, each capped, plus a quarter of the cap for every turned
    frame. Coordinate descent starts from the pairs' own votes. Then groups of neighbours that gain less by
    their turns than those cost go back together. So where the evidence is level, a frame counts as it was
    tagged.

    Args: costs_m: (left, right, (4, 4) costs) per pair. cap_m: beyond this a pair says no more. possible (n,
        4): see `possible_quarters`; all if it isn't given.
    """
    never = np.zeros((n, 4)) if possible is None else np.where(possible, 0.0, 4.0 * cap_m)
    capped = [(a, b, np.minimum(c, cap_m) + never[a][:, None] + never[b][None, :]) for a, b, c in costs_m]
    turn = _descent(n, capped, _votes(n, capped), cap_m / 4.0)
    links = [(a, b) for a, b, _ in capped if turn[a] and turn[b]]
    of: dict[int, list[tuple[int, int, Floats]]] = {}
    for pair in capped:
        of.setdefault(pair[0], []).append(pair)
        of.setdefault(pair[1], []).append(pair)
    for group in connected_parts(n, links):
        if turn[group].any():
            own = list({(a, b): (a, b, c) for i in group for a, b, c in of.get(i, [])}.values())
            back = turn.copy()
            back[group] = 0
            if _total(own, back, cap_m / 4.0) < _total(own, turn, cap_m / 4.0):
                turn = back
    turn = _descent(n, capped, turn, cap_m / 4.0)
    return {int(i): int(turn[i]) for i in np.flatnonzero(turn)}


def _votes(n: int, costs: list[tuple[int, int, Floats]]) -> Ints:
    """The turn that each frame's pairs would best like, weighed by how much they gain."""
    votes = np.zeros((n, 4))
    for a, b, c in costs:
        i, j = np.unravel_index(int(c.argmin()), c.shape)
        weight = float(c[0, 0] - c[i, j])
        votes[a, i] += weight
        votes[b, j] += weight
    return np.asarray(np.where(votes.max(axis=1) > 0.0, votes.argmax(axis=1), 0))


def _descent(n: int, costs: list[tuple[int, int, Floats]], start: Ints, fee_m: float) -> Ints:
    """Each frame in turn takes what is best given its neighbours' present turns, until none changes."""
    turn = start.copy()
    mine: list[list[tuple[int, Floats]]] = [[] for _ in range(n)]
    for a, b, c in costs:
        mine[a].append((b, c))
        mine[b].append((a, c.T))
    for _ in range(20):
        before = turn.copy()
        for frame in range(n):
            if not mine[frame]:
                continue
            cost = np.sum([c[:, turn[other]] for other, c in mine[frame]], axis=0)
            cost[1:] += fee_m
            turn[frame] = int(cost.argmin())
        if np.array_equal(turn, before):
            break
    return turn


def _total(costs: list[tuple[int, int, Floats]], turn: Ints, fee_m: float) -> float:
    return float(sum(c[turn[a], turn[b]] for a, b, c in costs)) + fee_m * int(np.count_nonzero(turn))


def corrected_poses(poses: Poses, turns: dict[int, int]) -> Poses:
    """Poses with the rotations of turned images; an image turned clockwise shows its points turned
    counter-clockwise about the nadir."""
    rotations, turned = poses.rotations.copy(), poses.turns
    for i, quarters in turns.items():
        rotations[i] = poses[i].rotation.turned(quarters).matrix
        turned = None if turned is None else turned.turned([i], quarters)
    return replace(poses, rotations=rotations, turns=turned)


def reheaded(poses: Poses, headings_rad: dict[int, float]) -> Poses:
    """Poses of which some have another heading, known as well as a course determines it; they turn about the
    vertical, their tilts with them."""
    rotations, sd_rad = poses.rotations.copy(), poses.rotations_sd_rad.copy()
    for i, heading in headings_rad.items():
        yaw = poses[i].rotation.yaw_pitch_roll()[0]
        rotations[i] = about_z(yaw - heading) @ poses.rotations[i]
        sd_rad[i, 2] = max(float(sd_rad[i, 2]), np.radians(COURSE_YAW_SD_DEG))
    return replace(poses, rotations=rotations, rotations_sd_rad=sd_rad)
