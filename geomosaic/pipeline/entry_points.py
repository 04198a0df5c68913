"""Which stages distributions announce, by their entry points alone: nothing of them is imported."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.metadata import entry_points
from typing import Final

GROUP: Final = "geomosaic.stages"


def modules_of(ids: Iterable[str]) -> list[str]:
    """The modules of stages, where any are announced under these ids."""
    announced = entry_points(group=GROUP)
    return sorted({entry.module for id in ids for entry in announced.select(name=id)})
