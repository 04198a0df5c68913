"""A finished run folder, read back."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from geomosaic.errors import FileError
from geomosaic.pipeline.runner import RUN_JSON


def read_summary(run_folder: Path) -> dict[str, Any]:
    """run.json of a finished run. Raises `FileError` if there is none."""
    path = run_folder / RUN_JSON
    try:
        summary = json.loads(path.read_text())
    except OSError as error:
        raise FileError(
            "is no finished run (run.json is missing)", file=run_folder, mend="run it to its end"
        ) from error
    except ValueError as error:
        raise FileError("is no JSON", file=path, mend="run the recipe again") from error
    if not isinstance(summary, dict):
        raise FileError("doesn't describe a run", file=path, mend="run the recipe again")
    return summary
