"""A run shown in Rerun while it is on.

A process of its own reads the recording as it grows, a second behind the run, and gives what it says to the
viewer (`live_run`). So the viewer is shown the same messages as anybody later. Whether it is slow, closed or
was never there makes no difference to the run.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def watched(recording: Path | None, live: bool) -> Iterator[None]:
    """Has the recording shown while the block is on. The viewer stays open.

    Raises ModuleNotFoundError where Rerun isn't installed.
    """
    if live and importlib.util.find_spec("rerun") is None:
        raise ModuleNotFoundError("No module named 'rerun'", name="rerun")
    if live and recording is not None:
        quiet: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
        module = "geomosaic.recording.rerun.live_run"
        command = [sys.executable, "-P", "-m", module, str(recording.absolute()), str(os.getpid())]
        shows = subprocess.Popen(command, start_new_session=True, **quiet)  # noqa: S603
        threading.Thread(target=shows.wait, daemon=True).start()  # no run waits for it, nor the process's end
    yield
