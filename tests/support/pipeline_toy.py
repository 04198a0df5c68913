"""Small real stages that the tests of the pipeline run, also in other processes."""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from geomosaic.errors import InputError, UnknownNameError
from geomosaic.pipeline.recipe import Recipe, RecipeStep
from geomosaic.pipeline.registry import Registry
from geomosaic.pipeline.stage import Context, RunFile, Stage, StageParams, param


@dataclass(frozen=True)
class Numbers:
    """Some numbers and where they are from."""

    values: NDArray[np.float64]
    source: str


@dataclass(frozen=True)
class Total:
    """A sum."""

    value: float
    raster: str


def log_line(line: str) -> None:
    """Notes that real work was done, from whatever process."""
    log = os.environ.get("TOY_LOG")
    if log:
        with Path(log).open("a") as file:
            file.write(line + "\n")


def powered(value: float, power: int, delay_s: float) -> float:
    """The work of one item."""
    log_line(f"item {value:g}")
    time.sleep(delay_s)
    if value == 13.0:
        raise UnknownNameError("number", "13", ["12", "14"])
    if value == 99.0:
        os._exit(9)
    return value**power


class ReadNumbers(Stage):
    """Reads numbers from a text file."""

    id = "toy.read"
    display_name = "Read numbers"
    group = "Toy"
    version = 1
    outputs: ClassVar = {"numbers": Numbers}

    class Params(StageParams):
        """See each parameter's help."""

        file: Path = param(help="numbers, one a line")
        offset_m: float = param(0.0, help="added to each", unit="m", ge=-100, le=100)
        loud: bool = param(False, help="say more", affects_output=False)

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        log_line("read")
        values = np.array([float(line) for line in params.file.read_text().split()]) + params.offset_m
        if len(values) > 3:
            context.warn("many-numbers", "four.jpg", f"{len(values)} numbers are many")
        return {"numbers": Numbers(values, params.file.name)}


class PowerNumbers(Stage):
    """Raises each number to a power."""

    id = "toy.power"
    display_name = "Raise to a power"
    group = "Toy"
    version = 3
    inputs: ClassVar = {"numbers": Numbers}
    outputs: ClassVar = {"numbers": Numbers}

    class Params(StageParams):
        """See each parameter's help."""

        power: int = param(2, help="exponent", ge=1, le=9)
        name: str = param("plain", help="manner", choices={"plain": 1, "fancy": 2})
        step_m: float | Literal["auto"] = param("auto", help="step", unit="m", ge=0.01)
        delay_s: float = param(0.0, help="time per number", unit="s", ge=0, affects_output=False)

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        log_line("power")
        work = functools.partial(powered, power=params.power, delay_s=params.delay_s)
        values = context.map("powers", work, [float(v) for v in inputs["numbers"].values])
        context.recorder.offsets("toy.power", 0, [("a", "b", 1.5, -2.5)], [("a", 0.25, 0.5)])
        context.recorder.location("a", (7.5, 51.25, 120.0), (1.0, 2.0, 3.0), "tied")
        context.metric("toy.largest", max(values))
        return {"numbers": Numbers(np.array(values), params.name)}


class SumNumbers(Stage):
    """Sums up, and leaves a raw file in the work folder."""

    id = "toy.sum"
    display_name = "Sum up"
    group = "Toy"
    version = 1
    inputs: ClassVar = {"numbers": Numbers}
    outputs: ClassVar = {"total": Total}

    class Params(StageParams):
        """See each parameter's help."""

        fill: int = param(0, help="what the raw file holds", ge=0, le=255)

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        log_line("sum")
        name = "work/toy.sum/raw.bin"
        with context.writing(name) as path:
            path.write_bytes(bytes([params.fill]) * 1000)
        return {"total": Total(float(inputs["numbers"].values.sum()), name)}


class WriteTotal(Stage):
    """Writes the sum as a file of the run."""

    id = "toy.write"
    display_name = "Write the sum"
    group = "Toy"
    version = 1
    inputs: ClassVar = {"total": Total}
    optional_inputs: ClassVar = {"numbers": Numbers, "nowhere": Numbers}
    outputs: ClassVar = {"total_file": RunFile}
    results = ("total.txt", "old.txt")

    @classmethod
    def conclusions(cls, summary: Mapping[str, Any]) -> list[tuple[str, str]]:
        """How many frames are tied."""
        return [("frames", f"{summary['frames']['tied']} tied")]

    class Params(StageParams):
        """See each parameter's help."""

        megabytes: int = param(0, help="padding", unit="MB", ge=0, le=1000)

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        log_line("write")
        raw = (context.run_folder / inputs["total"].raster).read_bytes()
        with context.writing("total.txt") as path:
            path.write_text(f"{inputs['total'].value!r} {raw[0]} {context.rng('x').integers(1000)}\n")
            with path.open("ab") as file:
                for _ in range(params.megabytes):
                    file.write(bytes(1_000_000))
        context.report("frames", {"total": 4, "tied": np.int64(3), "placed": 1, "rejected": 0})
        return {"total_file": context.run_file("total.txt")}


class Tell(Stage):
    """Reads the run's summary, so it is never cached."""

    id = "toy.tell"
    display_name = "Tell"
    group = "Toy"
    version = 1
    outputs: ClassVar = {}
    cached = False
    results = ("notes.txt",)

    def run(self, inputs: Mapping[str, Any], params: StageParams, context: Context) -> dict[str, Any]:
        log_line("tell")
        summary = context.summary()
        with context.writing("notes.txt") as path:
            path.write_text(f"{len(summary['warnings'])} {summary['metrics'].get('toy')}\n")
        return {}


class Refuse(Stage):
    """Fails."""

    id = "toy.refuse"
    display_name = "Refuse"
    group = "Toy"
    version = 1

    def run(self, inputs: Mapping[str, Any], params: StageParams, context: Context) -> dict[str, Any]:
        with context.writing("half.txt") as path:
            path.write_text("half")
            raise InputError("no pixels", file="x.jpg", fix="take it away")


STAGES = (ReadNumbers, PowerNumbers, SumNumbers, WriteTotal, Tell, Refuse)


def registry() -> Registry:
    """All toy stages, registered in this process."""
    found = Registry()
    for stage in STAGES:
        found.register(stage)
    return found


def distribution(folder: Path, name: str = "toys", entries: dict[str, str] | None = None) -> Path:
    """A real distribution with entry points: put the folder on sys.path and it is installed."""
    info = folder / f"{name}-1.2.dist-info"
    info.mkdir(parents=True)
    info.joinpath("METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.2\n")
    if entries is None:
        entries = {s.id: f"pipeline_toy:{s.__name__}" for s in STAGES}
    lines = [f"{id} = {target}" for id, target in entries.items()]
    info.joinpath("entry_points.txt").write_text("[geomosaic.stages]\n" + "\n".join(lines) + "\n")
    return folder


RECIPE = """
name: toy
description: sums of powers
seed: 5
stages:
  - stage: toy.read
    params: {file: numbers.txt}
  - toy.power
  - toy.sum
  - stage: toy.write
  - toy.tell
"""


def recipe_file(folder: Path, numbers: str = "1 2 3 4") -> Path:
    """The recipe and its numbers in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    folder.joinpath("numbers.txt").write_text(numbers)
    folder.joinpath("toy.yaml").write_text(RECIPE)
    return folder / "toy.yaml"


def recipe_of(stage: type[Stage], params: StageParams) -> Recipe:
    """One stage by itself."""
    return Recipe("", "", 0, (RecipeStep(stage, params),))
