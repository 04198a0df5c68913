"""How a run works."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from geomosaic.recording.file.levels import RecordOptions


@dataclass(frozen=True)
class RunOptions:
    """How a run works.

    workers: processes on this machine. dask: the address of a cluster that computes instead. fixed_time:
    equal runs give equal bytes in run.mcap; clock times stand in run.json alone. overwrite: the folder may
    hold files of others, and results may replace them. record: how much is recorded, and for whom.
    incremental: it goes on from the finished run in its folder, and redoes what changed. cancelled: asked
    again and again; the run ends once it is true. preview: what other runs made stays, results
    and cache alike.
    """

    workers: int = 1
    dask: str | None = None
    fixed_time: bool = False
    overwrite: bool = False
    incremental: bool = False
    preview: bool = False
    record: RecordOptions = field(default_factory=RecordOptions)
    cancelled: Callable[[], bool] = lambda: False
