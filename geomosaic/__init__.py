"""geomosaic: overlapping images of the ground in, one map-true image out.

import geomosaic as gm
run = gm.mosaic("frames/", "out/")
"""

from importlib import import_module
from typing import Any

from geomosaic.doors.offline import go_offline

__version__ = "0.1.0"
_FUNCTIONS = ("Judgement", "Run", "list_stages", "mosaic", "open_run", "replay", "run", "strips")
"""Names of `geomosaic.runs` that this module offers; imported on first use."""

go_offline()


def __getattr__(name: str) -> Any:
    if name in _FUNCTIONS:
        return getattr(import_module("geomosaic.runs"), name)
    raise AttributeError(f"module 'geomosaic' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted({*globals(), *_FUNCTIONS})
