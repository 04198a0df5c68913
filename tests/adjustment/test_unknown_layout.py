"""Shared unknowns that one solve hands to the next."""

from __future__ import annotations

import numpy as np

from geomosaic.adjustment.problem.estimate import UnknownLayout, Unknowns


def layout(headings: int) -> UnknownLayout:
    """No camera, the ground's level, a delay, and common errors of so many groups of headings."""

    def part(name: str, count: int, given: float) -> Unknowns:
        names = tuple(f"{name}_{k}" for k in range(count))
        return Unknowns(name, "platform", names, np.full(count, given), np.ones(count))

    return UnknownLayout((), part("level", 1, 0.5), (part("delay", 1, 0.0), part("headings", headings, 0.0)))


def test_parts_of_the_same_size_go_on_and_others_begin_anew() -> None:
    """A block that falls apart has more groups of headings; it ended 502 frames with a ValueError."""
    known = {
        "level": (np.array([7.0]), np.array([True])),
        "headings": (np.array([0.1, 0.2]), np.array([False, True])),
        "gone": (np.array([3.0]), np.array([True])),
    }
    values, fixed = layout(2).begun_from(known)
    assert (values.tolist(), fixed.tolist()) == ([7.0, 0.0, 0.1, 0.2], [True, False, False, True])
    for headings in (1, 3):
        values, fixed = layout(headings).begun_from(known)
        assert values.tolist() == [7.0, 0.0, *[0.0] * headings]
        assert fixed.tolist() == [True, False, *[False] * headings]
