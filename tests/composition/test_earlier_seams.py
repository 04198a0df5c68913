"""Seams of an earlier mosaic stay between frames that both mosaics have, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geomosaic.composition.earlier_seams import with_earlier_seams
from geomosaic.composition.model import OutputGrid
from geomosaic.composition.ownership import Ownership
from geomosaic.composition.seam_parts import SeamPart

CELL_PX, GSD_M = 8, 0.5
GRID = OutputGrid("EPSG:32632", 1000.0, 5000.0, GSD_M, 6 * CELL_PX, 4 * CELL_PX)
NUMBERS = np.array([1, 0, -1])
"""Frames 0 and 1 of the earlier survey are 1 and 0 now; its frame 2 is gone, and frame 2 is a new one."""


def owned(rows: list[str], grid: OutputGrid = GRID) -> Ownership:
    """Each cell's owner as a digit: the frame plus 1."""
    owner = np.array([[int(c) for c in row] for row in rows], dtype=np.int32)
    return Ownership(grid, np.ones(3, dtype=bool), CELL_PX, owner)


def part(frame: int, may: np.ndarray | None = None) -> SeamPart:
    may = np.ones((4, 6), dtype=bool) if may is None else may
    return SeamPart(frame, np.zeros(2), 0, 0, np.zeros((*may.shape, 3)), may)


WAS = owned(["112222", "112222", "112233", "111133"])
CUT = owned(["222111", "222111", "222111", "333331"])


def test_seams_stay_between_frames_of_both() -> None:
    """The earlier seam lies a cell further left; where the earlier owner is gone, or a new one gives, it moves."""
    found = with_earlier_seams(CUT, [part(0), part(1), part(2)], WAS, NUMBERS)
    assert found.owner.tolist() == owned(["221111", "221111", "221111", "333331"]).owner.tolist()


def test_an_owner_that_may_not_give_a_cell_any_more() -> None:
    may = np.ones((4, 6), dtype=bool)
    may[0, 2] = False
    found = with_earlier_seams(CUT, [part(0, may), part(1), part(2)], WAS, NUMBERS)
    assert found.owner.tolist() == owned(["222111", "221111", "221111", "333331"]).owner.tolist()


def test_a_grid_that_has_grown() -> None:
    """By whole cells to the left and above; beyond the earlier grid all is as it was cut."""
    grid = replace(GRID, west_m=1000.0 - CELL_PX * GSD_M, north_m=5000.0 + CELL_PX * GSD_M)
    grown = replace(CUT, grid=grid)
    found = with_earlier_seams(grown, [part(0), part(1), part(2)], WAS, NUMBERS)
    assert found.owner[0].tolist() == grown.owner[0].tolist()
    assert found.owner[:, 0].tolist() == grown.owner[:, 0].tolist()
    assert found.owner[1].tolist() == [2, 2, 2, 1, 1, 1]


@pytest.mark.parametrize("grid", [replace(GRID, west_m=1000.5), replace(GRID, gsd_m=0.4)])
def test_cells_that_are_others(grid: OutputGrid) -> None:
    found = with_earlier_seams(replace(CUT, grid=grid), [part(0), part(1), part(2)], WAS, NUMBERS)
    assert found.owner.tolist() == CUT.owner.tolist()


@pytest.mark.parametrize("cells", [(-9, 0), (9, 0), (0, -7), (0, 7)])
def test_an_earlier_mosaic_that_lies_beyond(cells: tuple[int, int]) -> None:
    """It may begin past the present one's end, on any side."""
    east_m, north_m = np.array(cells) * CELL_PX * GSD_M
    was = replace(WAS, grid=replace(GRID, west_m=1000.0 + east_m, north_m=5000.0 + north_m))
    found = with_earlier_seams(CUT, [part(0), part(1), part(2)], was, NUMBERS)
    assert found.owner.tolist() == CUT.owner.tolist()


def test_a_survey_of_other_frames() -> None:
    found = with_earlier_seams(CUT, [part(0), part(1), part(2)], WAS, np.array([-1, -1, -1]))
    assert found.owner.tolist() == CUT.owner.tolist()
