"""Square cells of the work frame whose heights are looked for, and the tiles they are worked on in."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Floats


@dataclass(frozen=True)
class Cells:
    """rows x cols cells of cell_m a side, from the corner (west_m, south_m) to the north and east."""

    west_m: float
    south_m: float
    cell_m: float
    rows: int
    cols: int

    @property
    def middle_m(self) -> Floats:
        """East and north of their middle, (2,)."""
        size = np.array([self.cols, self.rows]) * self.cell_m
        return np.asarray(np.array([self.west_m, self.south_m]) + size / 2.0)

    def part(self, row: int, col: int, rows: int, cols: int) -> Cells:
        """Some of them, or of those around."""
        west, south = self.west_m + col * self.cell_m, self.south_m + row * self.cell_m
        return Cells(west, south, self.cell_m, rows, cols)

    def axes_m(self) -> tuple[Floats, Floats]:
        """Easts (cols,) and norths (rows,) of the cells' middles."""
        east = self.west_m + (np.arange(self.cols) + 0.5) * self.cell_m
        north = self.south_m + (np.arange(self.rows) + 0.5) * self.cell_m
        return np.asarray(east), np.asarray(north)

    def coarser(self, by: int) -> Cells:
        """As many of by times the side as cover the same."""
        return Cells(self.west_m, self.south_m, self.cell_m * by, -(-self.rows // by), -(-self.cols // by))

    def tiles(self, side: int) -> Iterator[Tile]:
        """All of them by squares of so many cells, row by row."""
        for row in range(0, self.rows, side):
            for col in range(0, self.cols, side):
                yield Tile(row, col, min(side, self.rows - row), min(side, self.cols - col))


@dataclass(frozen=True)
class Tile:
    """Some of the cells of a grid: its first row and col, and how many."""

    row: int
    col: int
    rows: int
    cols: int

    @property
    def at(self) -> tuple[slice, slice]:
        """Its place among the cells."""
        return slice(self.row, self.row + self.rows), slice(self.col, self.col + self.cols)

    def touches(self, other: Tile, margin: int) -> bool:
        """Whether another one has any of its cells, or of so many on every side."""
        rows = self.row - margin < other.row + other.rows and other.row < self.row + self.rows + margin
        cols = self.col - margin < other.col + other.cols and other.col < self.col + self.cols + margin
        return rows and cols

    def around(self, cells: Cells, margin: int) -> Cells:
        """Its cells and so many on every side, past the grid's edge as well."""
        return cells.part(
            self.row - margin, self.col - margin, self.rows + 2 * margin, self.cols + 2 * margin
        )
