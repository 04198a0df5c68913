"""The overlaps alone of a simulated scene, in memory: for benches of many scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomosaic.ccd.overlaps import Edge, Strips
from geomosaic.survey.strips import StripGeometry
from geomosaic_simulate.spread import in_threads
from geomosaic_simulate.strip_ground import window_of
from geomosaic_simulate.strip_plan import StripPlan
from geomosaic_simulate.strip_scene import PairTruth, StripWorld
from geomosaic_simulate.strip_sensor import CcdSensor

_CHUNK_LINES = 1024


@dataclass(frozen=True, eq=False)
class SimulatedPair:
    """A pair's overlap. left (n, read_px): the left strip's last columns at all lines of its file. right (n',
    read_px): the right strip's first ones. truth: for each of the left strip's lines."""

    left: NDArray[Any]
    right: NDArray[Any]
    truth: PairTruth


def simulate_overlaps(plan: StripPlan) -> tuple[StripGeometry, tuple[SimulatedPair, ...]]:
    """The geometry (whose strips' files there are none of) and each pair's two edges with its truth.

    The same scene as the one `simulate_strips` writes, but for the noise. Pairs of a dead CCD have no lines.
    """
    scene = StripWorld(plan)
    pairs = tuple(in_threads(lambda pair: _pair(scene, pair), range(plan.ccds - 1)))
    return plan.geometry(), pairs


def _pair(scene: StripWorld, pair: int) -> SimulatedPair:
    plan = scene.plan
    sides = (pair, (plan.width_px - plan.read_px, plan.width_px)), (pair + 1, (0, plan.read_px))
    apart = round(scene.plan.geometry().side(pair) * plan.row_separation_lines)
    kind = np.uint8 if plan.bit_depth <= 8 else np.uint16
    edges = [np.zeros((plan.lines, plan.read_px), dtype=kind) for _ in sides]
    spare = abs(apart)
    for first in range(-spare, plan.lines + spare, _CHUNK_LINES):
        looks = []
        for (ccd, cols), shift in zip(sides, (0, apart), strict=True):
            start, stop = np.clip([first + shift, first + shift + _CHUNK_LINES], 0, plan.lines)
            lines = np.arange(start, stop)
            looks.append((lines, scene.look(ccd, cols, lines)) if lines.size else None)
        found = [look for look in looks if look is not None]
        if not found:
            continue
        window = scene.ground.window(*window_of(*(look.ground for _, look in found)))
        for (ccd, cols), edge, look in zip(sides, edges, looks, strict=True):
            if look is not None:
                light = scene.light(look[1], window).brightness
                edge[look[0]] = CcdSensor.of(plan, ccd).counts(light, cols[0], int(look[0][0]))
    left, right = (edge[plan.acquired(ccd)] for (ccd, _), edge in zip(sides, edges, strict=True))
    truth = scene.truth(pair)
    return SimulatedPair(left, right, truth)


def strips_in_memory(geometry: StripGeometry, edges: Sequence[tuple[NDArray[Any], NDArray[Any]]]) -> Strips:
    """Strips of arrays: of each pair the left strip's last, the right strip's first columns (n, read_px)."""

    def columns(ccd: int, edge: Edge, start: int, stop: int) -> NDArray[Any]:
        pair, which = (ccd, 0) if edge == "right" else (ccd - 1, 1)
        return edges[pair][which][start:stop]

    return Strips(geometry, columns)
