"""project.qgz: a QGIS project of the run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from geomosaic.export.project import write_project
from geomosaic.export.project_layers import project_of
from geomosaic.pipeline.stage import Context, RunFile, Stage

PROJECT = "project.qgz"
TITLE = "Mosaic"
"""Not the folder's name: equal runs give equal bytes wherever they lie."""


class ExportProject(Stage):
    """Writes project.qgz: the mosaic, the surface where there is one, and all layers, in groups and styled.

    Paths in it are relative: the run's folder can be moved.
    """

    id = "export.project"
    display_name = "Write a QGIS project"
    group = "Export"
    version = 2
    inputs: ClassVar[dict[str, type]] = {"layers_file": RunFile, "mosaic_file": RunFile}
    outputs: ClassVar[dict[str, type]] = {"project_file": RunFile}
    results: ClassVar[tuple[str, ...]] = (PROJECT,)
    cached = False

    def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
        """Names the files that are there by now."""
        layers, mosaic = (context.path_of(inputs[name]) for name in ("layers_file", "mosaic_file"))
        crs, extent, groups = project_of(layers, mosaic)
        with context.writing(PROJECT) as path:
            write_project(path, TITLE, crs, extent, groups)
        return {"project_file": context.run_file(PROJECT)}
