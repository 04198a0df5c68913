"""A stage declared as a function: what its annotations say, and what is said of wrong ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from pipeline_toy import recipe_of

from geomosaic.errors import PluginError
from geomosaic.pipeline.function_stage import InputGroup, stage
from geomosaic.pipeline.params import check_params
from geomosaic.pipeline.recipe import load_recipe
from geomosaic.pipeline.registry import Registry, check_stage
from geomosaic.pipeline.run_folder import RunFolder
from geomosaic.pipeline.run_options import RunOptions
from geomosaic.pipeline.runner import run
from geomosaic.pipeline.single_stage import StageInputs, run_stage
from geomosaic.pipeline.stage import Context, RunFile, Stage, StageParams, param


@dataclass(frozen=True)
class Counts:
    numbers: tuple[int, ...]


class RaiseParams(StageParams):
    """See each parameter's help."""

    by: int = param(1, help="what is added", ge=0)


@stage("toy.count", "Count", group="Toys", outputs="counts")
def count() -> Counts:
    """Counts to three."""
    return Counts((1, 2, 3))


@stage(
    "toy.raise",
    "Raise",
    group="Toys",
    version=3,
    outputs=("counts", "note"),
    results=("note.txt",),
    concurrent=True,
)
def raised(
    counts: Counts, params: RaiseParams, context: Context, more: Counts | None = None
) -> tuple[Counts, RunFile]:
    """Adds to each number.

    Writes what it added.
    """
    with context.writing("note.txt") as path:
        path.write_text(str(params.by + (0 if more is None else sum(more.numbers))))
    return Counts(tuple(n + params.by for n in counts.numbers)), context.run_file("note.txt")


@stage("toy.judge", "Judge", group="Toys", cached=False)
def judge(counts: Counts, context: Context) -> None:
    """Reports the sum."""
    context.metric("sum", sum(counts.numbers))


def test_a_function_is_declared_by_its_annotations() -> None:
    assert check_stage(raised, id="toy.raise") is raised
    assert (raised.display_name, raised.group, raised.version) == ("Raise", "Toys", 3)
    assert raised.inputs == {"counts": Counts} and raised.optional_inputs == {"more": Counts}
    assert raised.outputs == {"counts": Counts, "note": RunFile}
    assert raised.Params is RaiseParams and judge.Params is StageParams
    assert raised.__doc__ is not None and raised.__doc__.startswith("Adds to each number.")
    assert (raised.concurrent, raised.results, judge.cached, judge.outputs) == (
        True,
        ("note.txt",),
        False,
        {},
    )
    assert f"{raised.__module__}:{raised.__qualname__}" == f"{__name__}:raised"


def test_it_runs_by_itself_and_as_a_function(tmp_path: Path) -> None:
    params = check_params(raised.Params, {"by": 2}, stage=raised.id)
    for more, note in ({}, "2"), ({"more": Counts((4, 5))}, "11"):
        folder = RunFolder(tmp_path / "RUN", overwrite=True)
        made, _ = run_stage(
            recipe_of(raised, params),
            StageInputs(folder, {"counts": Counts((1,)), **more}),
            work_folder=tmp_path,
        )
        assert made["counts"] == Counts((3,)) and made["note"].name == "note.txt"
        assert (tmp_path / "RUN" / "note.txt").read_text() == note
    assert count.function() == Counts((1, 2, 3))


@dataclass(frozen=True)
class TwoCounts(InputGroup):
    counts: Counts
    more: Counts | None = None


@stage("toy.add", "Add", group="Toys", outputs="sum")
def add(both: TwoCounts) -> Counts:
    """Adds up two counts."""
    return Counts((*both.counts.numbers, *(both.more or Counts(())).numbers))


@stage("toy.add_some", "Add some", group="Toys", outputs="sum")
def add_some(more: Counts, both: TwoCounts | None = None) -> Counts:
    """Adds up what is there."""
    return more if both is None else Counts((*both.counts.numbers, *more.numbers))


def test_a_group_takes_its_fields_as_inputs(tmp_path: Path) -> None:
    assert add.inputs == {"counts": Counts} and add.optional_inputs == {"more": Counts}
    assert add_some.inputs == {"more": Counts} and add_some.optional_inputs == {"counts": Counts}
    one, two = Counts((1,)), Counts((2,))
    for step, inputs, numbers in (
        (add, {"counts": one}, (1,)),
        (add, {"counts": one, "more": two}, (1, 2)),
        (add_some, {"more": two}, (2,)),
        (add_some, {"counts": one, "more": two}, (1, 2)),
    ):
        folder = RunFolder(tmp_path / "RUN", overwrite=True)
        params = check_params(step.Params, {}, stage=step.id)
        made, _ = run_stage(recipe_of(step, params), StageInputs(folder, inputs), work_folder=tmp_path)
        assert made["sum"] == Counts(numbers)


def test_a_recipe_runs_declared_functions(tmp_path: Path) -> None:
    registry = Registry()
    for one in (count, raised, judge):
        registry.register(one)
    recipe = tmp_path / "toy.yaml"
    recipe.write_text(
        "name: toys\nstages:\n  - toy.count\n  - stage: toy.raise\n    params: {by: 5}\n  - toy.judge\n"
    )
    for cached in ([], ["toy.count", "toy.raise"]):
        summary = run(load_recipe(recipe, registry), tmp_path / "RUN", RunOptions(workers=1))
        assert summary["metrics"]["sum"] == 21
        assert summary["cached_stages"] == cached
    assert (tmp_path / "RUN" / "note.txt").read_text() == "5"


def bare(counts): ...  # type: ignore[no-untyped-def]
def many(*counts: Counts) -> None: ...
def number(count: int) -> None: ...
def unknown(counts: Conuts) -> None: ...  # type: ignore[name-defined]  # noqa: F821
def twice(one: RaiseParams, two: RaiseParams) -> None: ...
def half(counts: Counts | None) -> None: ...
def default(counts: Counts = Counts(())) -> None: ...
def gives() -> Counts: ...  # type: ignore[empty-body]
def nothing() -> None: ...


@pytest.mark.parametrize(
    ("function", "outputs", "problem"),
    [
        (bare, (), "parameter 'counts' has no annotation; annotate it with its type"),
        (many, (), "parameter 'counts' has no name of its own; an input is taken by its name"),
        (number, (), "parameter 'count' is annotated int; an artefact is a frozen dataclass or a RunFile"),
        (unknown, (), "an annotation of unknown can't be resolved (name 'Conuts' is not defined)"),
        (twice, (), "parameter 'two' is the second RaiseParams; a stage takes one"),
        (half, (), "parameter 'counts': an optional input is annotated X | None and has the default None"),
        (default, (), "parameter 'counts': an optional input is annotated X | None and has the default None"),
        (gives, (), "its function is annotated to return Counts, and must return None: it names no output"),
        (
            gives,
            ("a", "b"),
            "its function is annotated to return Counts, and must return a tuple of 2 types for a, b",
        ),
        (
            nothing,
            "counts",
            "output 'counts' is annotated nothing; an artefact is a frozen dataclass or a RunFile",
        ),
    ],
)
def test_wrong_annotations_are_one_clear_line(
    function: Callable[..., Any], outputs: str | tuple[str, ...], problem: str
) -> None:
    with pytest.raises(PluginError) as caught:
        stage("toy.wrong", "Wrong", group="Toys", outputs=outputs)(function)
    assert str(caught.value).replace(f"{__name__}.", "") == f"stage toy.wrong: {problem}"


def test_an_unknown_declaration_is_refused() -> None:
    with pytest.raises(PluginError, match=r"^stage toy.wrong: 'cache' is nothing that a stage declares$"):
        stage("toy.wrong", "Wrong", group="Toys", cache=False)(nothing)


def test_a_declaration_may_have_its_former_name() -> None:
    """Of a function and of a class."""
    former: Any = {"beside": True}
    declared = stage("toy.old", "Old", group="Toys", **former)
    assert declared(nothing).concurrent
    assert type("Old", (Stage,), former).concurrent
    assert not Stage.concurrent


def test_a_function_that_gives_too_little_is_named(tmp_path: Path) -> None:
    @stage("toy.little", "Little", group="Toys", outputs=("a", "b"))
    def little() -> tuple[Counts, Counts]:
        return (Counts(()),)  # type: ignore[return-value]

    with pytest.raises(PluginError, match=r"^stage toy.little gave \['a'\] instead of \['a', 'b'\]$"):
        run_stage(
            recipe_of(little, little.Params()),
            StageInputs(RunFolder(tmp_path / "RUN")),
            work_folder=tmp_path,
        )
