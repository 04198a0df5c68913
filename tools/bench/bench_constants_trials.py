"""Stages of the scenes, once more with a constant varied."""

from __future__ import annotations

import dataclasses
import math
import shutil
import signal
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from geomosaic.constants import varied
from tools.bench.bench_constants_change import change, rasters_of
from tools.bench.bench_constants_names import homes, loaded, names_in
from tools.bench.bench_constants_scenes import Done


class Trials:
    """Stages of all scenes, each once more with a constant varied."""

    def __init__(self, done: list[Done]) -> None:
        self._done = sorted(done, key=lambda one: one.outcome.seconds)
        self._scratch = Path(tempfile.mkdtemp(prefix="constants-"))
        self._ready: dict[int, tuple[Done, Mapping[str, Any], float]] = {}
        self._names: dict[int, dict[str, set[str]]] = {}

    def close(self) -> None:
        """Removes its files."""
        shutil.rmtree(self._scratch)

    def reach(self, name: str) -> list[int]:
        """The stages that called a function which names a constant, the fastest first."""
        files, constant = set(homes(name)), name.rpartition(".")[2]
        return [
            k for k in range(len(self._done)) if any(constant in self._called(k).get(f, ()) for f in files)
        ]

    def _called(self, k: int) -> dict[str, set[str]]:
        """By file, the names in the functions that a stage called."""
        if k not in self._names:
            found: dict[str, set[str]] = {}
            for file, function, line in self._done[k].codes:
                found.setdefault(file, set()).update(names_in(file).get((function, line), ()))
            self._names[k] = found
        return self._names[k]

    def trial(self, k: int, name: str, value: Any) -> tuple[float, str, float]:
        """The largest change, what changed, and processor seconds as a multiple of the usual."""
        done, rasters, noise = self._prepared(k)
        module, _, constant = name.rpartition(".")
        _forget()
        usual = done.outcome.seconds  # without the noting of functions
        with _at_most(20.0 * usual + 20.0), varied(module, **{constant: value}):
            try:
                after = done.again(self._scratch / "work")
            except Exception as error:  # whatever a senseless value leads to
                return math.inf, f"{type(error).__name__}: {error}"[:80], 1.0
        amount, what = change(done.outcome, after, rasters)
        return (amount if amount > 3.0 * noise else 0.0), what, after.seconds / max(usual, 0.01)

    def seconds(self, k: int) -> float:
        """Processor seconds of a stage as it is."""
        return self._done[k].outcome.seconds

    def where(self, k: int) -> str:
        """A stage and its scene."""
        return f"{self._done[k].step.stage.id}, {self._done[k].scene}"

    def _prepared(self, k: int) -> tuple[Done, Mapping[str, Any], float]:
        """A stage with a folder of its own, what it writes there, and how far it is from itself."""
        if k not in self._ready:
            one = self._done[k]
            folder = self._scratch / str(k)
            shutil.copytree(one.folder, folder)
            mine = dataclasses.replace(one, folder=folder)
            _forget()
            begun = time.time()
            mine.outcome = mine.again(self._scratch / "work")
            rasters = rasters_of(folder, begun - 0.01)
            self._ready[k] = mine, rasters, change(one.outcome, mine.outcome, {})[0]
        return self._ready[k]


def _forget() -> None:
    """Empties what functions remember from call to call."""
    for module in loaded().values():
        for value in list(vars(module).values()):
            if hasattr(value, "cache_clear"):
                value.cache_clear()


class _at_most:  # noqa: N801  reads as a word
    """Raises `TimeoutError` after so many seconds."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds

    def __enter__(self) -> None:
        def late(*_: object) -> None:
            raise TimeoutError("slow")

        signal.signal(signal.SIGALRM, late)
        signal.setitimer(signal.ITIMER_REAL, self._seconds)

    def __exit__(self, *_: object) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
