"""The page of finished runs: what is shown of them, its tiles, and what is measured on it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from geomosaic.pages.loopback_server import COMMON_FILES, Answer, numbers
from geomosaic.quality import run_heights, run_measures
from geomosaic.viewer.grid_raster import TILE_PX
from geomosaic.viewer.measuring import measured
from geomosaic.viewer.run_view import RunView

_PAGE: Final = Path(__file__).with_name("page")
_FILES: Final = ("index.html", "viewer.css", "viewer.js", "map_canvas.js", "measures.js")
_MOST_REDUCTION: Final = 1 << 16


class ViewerPages:
    """One run, or two that are compared."""

    command = "geomosaic open"
    files: Final = {**COMMON_FILES, **{name: _PAGE / name for name in _FILES}}

    def __init__(self, views: list[RunView]) -> None:
        self._views = views

    def get(self, path: list[str]) -> Answer | None:
        """What is shown of the runs, or a tile: run, layer, reduction, across, down."""
        match path:
            case ["runs"]:
                return Answer.json(self._described())
            case ["tile", *parts] if len(parts) == 5 and (at := numbers(parts[2:], 3)) is not None:
                return self._tile(parts[0], parts[1], at)
            case _:
                return None

    def post(self, path: list[str], asked: Any) -> Answer:
        """A measure of the first run, or of the one that is asked for."""
        if path != ["measure"]:
            raise ValueError(path)
        points = np.array([[float(col), float(row)] for col, row in asked["points"]])
        return Answer.json(measured(self._views[int(asked["run"])], str(asked["kind"]), points))

    def _tile(self, run: str, layer: str, at: list[int]) -> Answer | None:
        if not run.isdigit() or int(run) >= len(self._views) or not 0 < at[0] <= _MOST_REDUCTION:
            return None
        shown = self._views[int(run)].layers.get(layer)
        tile = None if shown is None else shown.tile(*at)
        return None if tile is None else Answer("image/webp", tile, kept=True)

    def _described(self) -> dict[str, Any]:
        grid = self._views[0].grid
        return {
            "width": grid.width,
            "height": grid.height,
            "origin": [grid.transform.c, grid.transform.f],
            "pixel": [grid.transform.a, grid.transform.e],
            "on_map": grid.on_earth,
            "tile": TILE_PX,
            "rules": [run_measures.ASSUMED, run_heights.ASSUMED, run_measures.VOLUMES_ASSUMED],
            "runs": [
                {
                    "name": view.folder.resolve().name,
                    "layers": [
                        {"name": name, "title": layer.title, "legend": layer.legend}
                        for name, layer in view.layers.items()
                    ],
                    "features": view.features,
                    "unmeasured": view.unmeasured,
                }
                for view in self._views
            ],
        }
