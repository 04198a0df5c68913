"""Solutions of candidate models of lens and shutter, begun from another model's."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geomosaic.adjustment.kernels.interior import INTERIOR, READOUT, interior_of, with_interior
from geomosaic.adjustment.model import Block, Settings
from geomosaic.adjustment.problem.tracks import Tracks
from geomosaic.adjustment.procedure.block_problem import block_problem
from geomosaic.adjustment.solver.solution import Start
from geomosaic.adjustment.solver.solve import SolveOptions, few_steps, solve
from geomosaic.adjustment.terms.interior_orientation import part_of_camera
from geomosaic.arrays import Floats
from geomosaic.camera.interior import Camera
from geomosaic.constants import tuned
from geomosaic.estimation.linear import least_squares

_OF_ALL_LENSES = INTERIOR.index("k1")
_ANGLES = tuned(100, "angles", "at which one lens is fitted to another: smooth functions need no more")


@dataclass(frozen=True)
class Model:
    """A model of lens and shutter, and the solution that its own begins from."""

    block: Block
    settings: Settings
    before: Start


def solved(tracks: Tracks, model: Model) -> Start:
    """The model's solution. Raises: NotSolvableError where there is none."""
    start = _start(model)
    problem = block_problem(model.block, model.settings, tracks, start.points_m)
    options = SolveOptions(rough=True, self_calibration=model.settings.self_calibration)
    found = solve(problem, start.poses, start, options)
    return found.of_points(found.points_m)


def tested(tracks: Tracks, model: Model) -> Start:
    """The model a few steps from the solution before, see `few_steps`."""
    start = _start(model)
    return few_steps(block_problem(model.block, model.settings, tracks, start.points_m), start)


def _start(model: Model) -> Start:
    """What the model's solve begins from: lenses of its kind, whose terms are determined anew."""
    before = model.before
    by_name, held = {c.name: c for c in model.block.lenses}, before.held.copy()
    lenses = tuple(_begun_lens(by_name.get(c.name, c), c) for c in before.cameras)
    for lens, found in zip(lenses, before.cameras, strict=True):
        if lens.kind != found.kind and model.settings.self_calibration:
            its = held[before.estimate.layout.slices[part_of_camera(lens.name)]]
            its[_OF_ALL_LENSES:READOUT] = False
    return replace(before.of_points(before.points_m, lenses), held=held)


def _begun_lens(given: Camera, found: Camera) -> Camera:
    """A lens as found with another model; one of another kind gets terms that bend rays alike."""
    numbers, before = interior_of(given), interior_of(found)
    same = READOUT if given.kind == found.kind else _OF_ALL_LENSES
    numbers[:same] = before[:same]
    if given.kind != found.kind:
        numbers[_OF_ALL_LENSES : _OF_ALL_LENSES + 3] = _odd_terms(found)
    numbers[READOUT] = before[READOUT] or numbers[READOUT]
    return with_interior(given, numbers)


def _odd_terms(lens: Camera) -> Floats:
    """k1 to k3 of the fisheye of the same focal length that bends rays as a lens does."""
    widest = np.linalg.norm(lens.ray_from_image(lens.corners_px)[:, :2], axis=1).max()
    angle = np.linspace(0.0, float(np.arctan(widest)), _ANGLES)
    design = angle[:, None] ** [3, 5, 7]
    return least_squares(design, lens.lens.radial(lens.terms, np.tan(angle)) - angle)
