"""Stages that are begun before their turn: what they say waits for it, and nothing shows who was first."""

from __future__ import annotations

import functools
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from pipeline_toy import Numbers, ReadNumbers, log_line, powered, recipe_file

from geomosaic.errors import GeomosaicError, InputError
from geomosaic.pipeline.recipe import load_recipe
from geomosaic.pipeline.registry import Registry
from geomosaic.pipeline.reporter import Reporter, Silent
from geomosaic.pipeline.run_options import RunOptions
from geomosaic.pipeline.runner import run
from geomosaic.pipeline.stage import Context, Stage, StageParams, param
from geomosaic.pipeline.stage_task import concurrent_steps
from geomosaic.recording.file.reader import read_recording

PATIENCE_S = 20.0
RECIPE = """
name: two at once
seed: 5
stages:
  - {stage: toy.read, params: {file: numbers.txt}}
  - {stage: toy.wait, params: {sign: sign}}
  - {stage: toy.parallel, params: {sign: sign}}
"""


class Wait(Stage):
    """Waits for a sign of another stage, and says whether it came."""

    id = "toy.wait"
    display_name = "Wait"
    group = "Toy"
    inputs: ClassVar = {"numbers": Numbers}
    outputs: ClassVar = {"waited": Numbers}

    class Params(StageParams):
        """See each parameter's help."""

        sign: str = param(help="name of a file")
        patience_s: float = param(PATIENCE_S, help="how long", unit="s", ge=0.0, affects_output=False)
        fail: bool = param(False, help="then")

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        sign, until = context.run_folder / params.sign, time.monotonic() + params.patience_s
        while not sign.exists() and time.monotonic() < until:
            time.sleep(0.01)
        log_line("seen" if sign.exists() else "not seen")
        context.warn("waited", "", "the first")
        if params.fail:
            raise InputError("no pixels", file="x.jpg", fix="take it away")
        return {"waited": inputs["numbers"]}


class Parallel(Stage):
    """Gives a sign, and has its work done elsewhere."""

    id = "toy.parallel"
    display_name = "Parallel"
    group = "Toy"
    concurrent = True
    inputs: ClassVar = {"numbers": Numbers}
    outputs: ClassVar = {"powers": Numbers}

    class Params(StageParams):
        """See each parameter's help."""

        sign: str = param(help="name of a file")
        manner: str = param("plain", help="how it ends", choices=("plain", "fail", "endless"))

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        context.inform("begun")
        context.warn("parallel", "a.jpg", "the second")
        work = functools.partial(powered, power=2, delay_s=0.0)
        values = context.map("powers", work, [float(v) for v in inputs["numbers"].values])
        with context.writing(params.sign) as path:
            path.touch()
        if params.manner == "fail":
            raise InputError("no tie points", file="y.jpg", fix="fly again")
        while params.manner == "endless":
            context.check_cancelled()
            time.sleep(0.01)
        context.recorder.location("a", (7.5, 51.25, 120.0), (1.0, 2.0, 3.0), "tied")
        context.metric("toy.largest", max(values))
        return {"powers": Numbers(np.array(values), "parallel")}


class Listener(Silent):
    """Messages to a reporter, in order."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def stage_started(self, index: int, total: int, name: str) -> None:
        self.lines.append(name)

    def warning(self, text: str) -> None:
        self.lines.append(text)

    def note(self, text: str) -> None:
        self.lines.append(text)


def run_two(folder: Path, *overrides: str, workers: int, reporter: Reporter | None = None) -> dict[str, Any]:
    """A run of both stages, and of the reading before them."""
    stages = Registry()
    for stage in (ReadNumbers, Wait, Parallel):
        stages.register(stage)
    path = recipe_file(folder.parent, "1 2 3")
    path.write_text(RECIPE)
    recipe = load_recipe(path, stages, overrides)
    return run(recipe, folder, RunOptions(fixed_time=True, workers=workers), reporter=reporter)


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "log"
    monkeypatch.setenv("TOY_LOG", str(path))
    return path


def test_it_is_begun_before_its_turn_and_reported_when_that_comes(tmp_path: Path, log: Path) -> None:
    listener = Listener()
    summary = run_two(tmp_path / "run", workers=2, reporter=listener)
    assert "seen" in log.read_text().split("\n")
    assert listener.lines == ["Read numbers", "Wait", "the first", "Parallel", "begun", "a.jpg: the second"]
    assert [w["text"] for w in summary["warnings"]] == ["the first", "the second"]
    assert summary["metrics"] == {"toy": {"largest": 9.0}}


def test_alone_it_waits_for_its_turn(tmp_path: Path, log: Path) -> None:
    run_two(tmp_path / "run", "toy.wait.patience_s=0", workers=1)
    assert "not seen" in log.read_text().split("\n")


@pytest.mark.parametrize("manner", ["plain", "fail"])
def test_recordings_are_equal_whoever_was_first(tmp_path: Path, manner: str) -> None:
    recorded, folder = [], tmp_path / "run"
    for workers in (1, 2):
        try:
            run_two(folder, "toy.wait.patience_s=1", f"toy.parallel.manner={manner}", workers=workers)
        except InputError as error:
            assert "no tie points" in str(error)
        recorded.append((folder / "run.mcap").read_bytes())
        shutil.rmtree(folder)
    assert recorded[0] == recorded[1]


def test_it_ends_with_a_run_that_fails_before_its_turn(tmp_path: Path, log: Path) -> None:
    with pytest.raises(GeomosaicError, match="no pixels"):
        run_two(tmp_path / "run", "toy.wait.fail=true", "toy.parallel.manner=endless", workers=2)
    assert "seen" in log.read_text().split("\n")
    assert not list((tmp_path / "run" / "work" / "toy.parallel").glob("calls*"))


def test_what_it_recorded_is_there_once_where_an_input_has_changed_meanwhile(
    tmp_path: Path,
) -> None:
    class Edited(Listener):
        def stage_started(self, index: int, total: int, name: str) -> None:
            if name == "Parallel":
                tmp_path.joinpath("numbers.txt").write_text("1 2 3 4")

    with pytest.raises(GeomosaicError, match="changed"):
        run_two(tmp_path / "run", workers=2, reporter=Edited())
    logged = read_recording(tmp_path / "run" / "run.mcap").topics["/log"]
    assert logged.messages == 2 + 1  # what both warn of, and the end


def test_the_next_run_finds_it(tmp_path: Path) -> None:
    run_two(tmp_path / "run", workers=2)
    again = run_two(tmp_path / "run", workers=2)
    assert again["cached_stages"] == ["toy.read", "toy.wait", "toy.parallel"]


def test_ready_are_those_that_nobody_gives_anything_to(tmp_path: Path) -> None:
    class Anew(Parallel):
        id = "toy.anew"
        outputs: ClassVar = {"numbers": Numbers}

    class After(Parallel):
        id = "toy.after"
        outputs: ClassVar = {"more": Numbers}

    stages = Registry()
    for stage in (ReadNumbers, Wait, Parallel, Anew, After):
        stages.register(stage)
    path = recipe_file(tmp_path)
    more = [f"  - {{stage: toy.{name}, params: {{sign: {name}}}}}\n" for name in ("anew", "after")]
    path.write_text(RECIPE + "".join(more))
    steps = load_recipe(path, stages).steps
    assert concurrent_steps(steps, 0) == []  # reading gives the numbers
    assert concurrent_steps(steps, 1) == [2, 3]
    assert concurrent_steps(steps, 2) == [3]  # the last one waits for numbers given anew
    assert concurrent_steps(steps, 4) == []
