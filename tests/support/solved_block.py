"""A block without images, adjusted by the bundle, as the survey that the exports take."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from adjustment_blocks import fly

from geomosaic.adjustment.model import Adjusted, Block, Settings
from geomosaic.adjustment.procedure.bundle_method import pose_block
from geomosaic.adjustment.procedure.control_points import ground_control
from geomosaic.composition.model import Mosaic, OutputGrid
from geomosaic.geodesy.local import LocalFrame
from geomosaic.matching.model import TiePoints
from geomosaic.placement.model import Placement
from geomosaic.survey.model import Attitude, ControlPoint, Frame, Position, Survey

WORK = LocalFrame(11.5, 48.1, 520.0)
ALONE = 7
"""The frame without ties, placed by its POS."""


@dataclass(frozen=True)
class Solved:
    """What `write_layers` and `render_report` take, but for the images."""

    survey: Survey
    placement: Placement
    ties: TiePoints
    adjusted: Adjusted
    mosaic: Mosaic
    block: Block


def solved_block() -> Solved:
    """Two lines of four frames, the last one untied; two check points and a control point, 5 cm off."""
    flown = fly(3, 2, 4)
    block = flown.block
    pairs = tuple(t for t in block.ties.pairs if ALONE not in (t.left, t.right))
    names = tuple(f"{i:03d}.jpg" for i in range(8))
    camera = block.cameras[0]
    frames = tuple(
        Frame(
            name, f"/survey/{name}", camera.width_px, camera.height_px, 3, "uint8", camera.name,
            Position(11.5, 48.1, 620.0, 100.0, 1.5, 1.5, 2.0, "t"), Attitude(0.0, 0.0, 0.0, 1.0, 0.3, "t"),
        )
        for name in names
    )  # fmt: skip
    control = []
    for name, check, at in (("A", False, [12.0, 30.0, 0.0]), ("B", True, [20.0, 8.0, 0.0]), ("C", True, [5.0, 41.0, 0.0])):  # fmt: skip
        seen = tuple((names[i], c, r) for i, c, r in flown.seen(np.array(at), 0.3) if i != ALONE)
        lon, lat, height = WORK.geodetic_from_enu(np.array(at) + [0.05, 0.0, 0.0])
        control.append(ControlPoint(name, lon, lat, height, 0.02, 0.03, check, seen))
    control.append(ControlPoint("unseen", 11.5, 48.1, 520.0, 0.02, 0.03, True, ()))
    survey = Survey(frames, (camera,), WORK, "EPSG:32632", control=tuple(control))
    block = replace(block, ties=TiePoints(pairs), control=ground_control(survey, block.ground))
    adjusted = pose_block(block, Settings())
    placement = Placement(block.poses, tuple(range(8)), block.lines, (), 0.1, "rigorous")
    grid = OutputGrid("EPSG:32632", 686_000.0, 5_331_000.0, 0.1, 100, 100)
    mosaic = Mosaic(grid, "work/raster.tif", 3, "uint8", None, (), tuple(range(8)), 8)
    return Solved(survey, placement, block.ties, adjusted, mosaic, block)
