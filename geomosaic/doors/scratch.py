"""Folders for what is made on the way: what a killed run leaves of them is removed by the next one."""

from __future__ import annotations

import os
from pathlib import Path
from tempfile import TemporaryDirectory


def scratch_folder(parent: Path | None) -> TemporaryDirectory[str]:
    """A folder in parent, for a with block. Its name is that of a half-written file, see `files.sweep`."""
    return TemporaryDirectory(dir=parent, prefix=".scratch-", suffix=f".{os.getpid()}.geomosaic.part")
