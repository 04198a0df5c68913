"""Frames whose pixels were turned after the flight: found from where their neighbours lie."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import about_z
from geomosaic.placement.graph import connected_parts
from geomosaic.placement.prior import COURSE_YAW_SD_DEG

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
_TOGETHER = 0.7
_QUARTERS = [np.array([[c, -s], [s, c]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))]


def turn_costs_m(left_en: Floats, right_en: Floats, left_nadir: Floats, right_nadir: Floats) -> Floats:
    """Misalignment of a pair under each hypothesis of quarter turns, (4, 4): [left, right].

    A frame whose picture is turned puts its ground points on the wrong side of its nadir point.
    Turning its points back by k quarters about the nadir point rights them; that is exact for a
    camera that looks straight down, and good to the tilt's displacement otherwise. Two frames turned
    alike also show: their overlap then lies on the sides facing away from each other.

    Args: (k, 2) east and north of tie points as each frame places them; nadir points (2,).
    """
    a, b = left_en - left_nadir, right_en - right_nadir
    base = right_nadir - left_nadir
    costs = np.empty((4, 4))
    for i, turn_left in enumerate(_QUARTERS):
        for j, turn_right in enumerate(_QUARTERS):
            miss = b @ turn_right.T + base - a @ turn_left.T
            costs[i, j] = np.median(np.linalg.norm(miss, axis=1))
    return costs


def turned_frames(n: int, costs_m: list[tuple[int, int, Floats]], cap_m: float) -> dict[int, int]:
    """Quarter turns (1 to 3, counter-clockwise on the ground) of frames that need them.

    Minimises the sum over pairs of the misalignment, each capped, plus a quarter of it for every turned
    frame, by coordinate descent from the pairs' own votes; then groups of neighbours that gain less
    by their turns than those cost go back together. So where the evidence is level, a frame counts as
    it was tagged.

    Args: costs_m: (left, right, (4, 4) costs) per pair. cap_m: beyond this a pair says no more.
    """
    capped = [(a, b, np.minimum(c, cap_m)) for a, b, c in costs_m]
    turn = _descent(n, capped, _votes(n, capped), cap_m / 4.0)
    links = [(a, b) for a, b, _ in capped if turn[a] and turn[b]]
    for group in connected_parts(n, links):
        back = turn.copy()
        back[group] = 0
        if _total(capped, back, cap_m / 4.0) < _total(capped, turn, cap_m / 4.0):
            turn = back
    turn = _descent(n, capped, turn, cap_m / 4.0)
    return {int(i): int(turn[i]) for i in np.flatnonzero(turn)}


def headed_wrong(turns: dict[int, int], yaw_rad: Floats, course_rad: Floats) -> dict[int, float]:
    """Frames found turned whose heading is what is wrong, not their picture; and the heading (rad) that goes
    with their course.

    A picture turned after the flight keeps a heading that fits the course as the others' do; of a heading
    that was kept from another line the turned one fits better. Only told where heading and course go together
    in the frames that weren't turned; else a platform may fly backward, and the pictures count as turned.

    Args: yaw_rad, course_rad (n,) as tagged and as flown; NaN where unknown.
    """
    off = np.exp(1j * (yaw_rad - course_rad))
    known = np.isfinite(off)
    straight = [i for i in range(len(off)) if known[i] and i not in turns]
    usual = complex(np.mean(off[straight])) if straight else 0j
    if abs(usual) < _TOGETHER:
        return {}
    as_told = (off / usual).real
    wrong = [i for i, q in turns.items() if known[i] and (off[i] * (-1j) ** q / usual).real > as_told[i]]
    return {i: float((course_rad[i] + np.angle(usual)) % (2.0 * np.pi)) for i in wrong}


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
    """Each frame in turn takes what is best beside its neighbours' present turns, until none changes."""
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


def righted(poses: Poses, turns: dict[int, int]) -> Poses:
    """Poses with the rotations of turned pictures; a picture turned clockwise shows its points turned
    counter-clockwise about the nadir."""
    rotations = poses.rotations.copy()
    for i, quarters in turns.items():
        rotations[i] = poses[i].rotation.turned(quarters).matrix
    return replace(poses, rotations=rotations)


def reheaded(poses: Poses, headings_rad: dict[int, float]) -> Poses:
    """Poses of which some have another heading, known as well as a course tells it; they turn about the
    vertical, their tilts with them."""
    rotations, sd_rad = poses.rotations.copy(), poses.rotations_sd_rad.copy()
    for i, heading in headings_rad.items():
        yaw = poses[i].rotation.yaw_pitch_roll()[0]
        rotations[i] = about_z(yaw - heading) @ poses.rotations[i]
        sd_rad[i, 2] = max(float(sd_rad[i, 2]), np.radians(COURSE_YAW_SD_DEG))
    return replace(poses, rotations=rotations, rotations_sd_rad=sd_rad)
