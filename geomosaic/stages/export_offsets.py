"""offsets.csv."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from geomosaic.ccd.model import StripOffsets
from geomosaic.export.offsets_csv import write_offsets_csv
from geomosaic.pipeline.stage import Context, RunFile, Stage

OFFSETS = "offsets.csv"


class ExportOffsets(Stage):
    """Writes the offsets of every line of every pair."""

    id = "export.offsets"
    display_name = "Write the strips' offsets"
    group = "Export"
    version = 1
    inputs: ClassVar[dict[str, type]] = {"offsets": StripOffsets}
    outputs: ClassVar[dict[str, type]] = {"offsets_file": RunFile}
    results: ClassVar[tuple[str, ...]] = (OFFSETS,)

    def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
        """As `StripOffsets` has them."""
        with context.writing(OFFSETS) as path:
            write_offsets_csv(path, inputs["offsets"].pairs)
        return {"offsets_file": context.run_file(OFFSETS)}
