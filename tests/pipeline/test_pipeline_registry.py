"""Stages enter by entry points of real distributions; what is broken is said, never skipped."""

from __future__ import annotations

import importlib
import sys
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, ClassVar

import pytest
from pipeline_toy import STAGES, PowerNumbers, ReadNumbers, distribution

from geomosaic.errors import PluginError, UnknownNameError
from geomosaic.pipeline.entry_points import GROUP
from geomosaic.pipeline.registry import Registry, check_stage
from geomosaic.pipeline.stage import Stage, StageParams


def discovered(monkeypatch: pytest.MonkeyPatch, *folders: Path) -> Registry:
    for folder in folders:
        monkeypatch.syspath_prepend(str(folder))
    importlib.invalidate_caches()
    found = entry_points(group=GROUP)
    return Registry(e for e in found if e.dist is not None and not e.value.startswith("geomosaic"))


def test_a_distribution_brings_its_stages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    registry = discovered(monkeypatch, distribution(tmp_path))
    assert registry.ids() == ["toy.power", "toy.read", "toy.refuse", "toy.sum", "toy.tell", "toy.write"]
    assert registry.get("toy.power") is PowerNumbers
    assert registry.all()[1] == {}
    with pytest.raises(UnknownNameError, match=r"^unknown stage 'toy.powr'; did you mean 'toy.power'\?$"):
        registry.get("toy.powr")


def test_stages_are_imported_only_when_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tmp_path.joinpath("lazy_toy.py").write_text("from pipeline_toy import ReadNumbers\n")
    registry = discovered(monkeypatch, distribution(tmp_path, "lazy", {"toy.read": "lazy_toy:ReadNumbers"}))
    assert registry.ids() == ["toy.read"] and "lazy_toy" not in sys.modules
    assert registry.get("toy.read") is ReadNumbers and "lazy_toy" in sys.modules


@pytest.mark.parametrize(
    ("source", "target", "reason"),
    [
        ("import nothing_of_that_name", "X", "ModuleNotFoundError"),
        ("def (", "X", "SyntaxError"),
        ("raise RuntimeError('two\\nlines')", "X", "RuntimeError: two lines"),
        ("", "X", "AttributeError"),
        ("X = 3", "X", "3 is no subclass of Stage"),
        ("from pipeline_toy import SumNumbers as X", "X", "calls itself 'toy.sum'"),
    ],
)
def test_a_broken_plugin_is_listed_and_raises_when_asked_for(
    source: str, target: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tmp_path.joinpath("broken_toy.py").write_text(source + "\n")
    monkeypatch.delitem(sys.modules, "broken_toy", raising=False)
    entries = {"toy.broken": f"broken_toy:{target}", "toy.read": "pipeline_toy:ReadNumbers"}
    registry = discovered(monkeypatch, distribution(tmp_path, "broken", entries))
    working, broken = registry.all()
    assert working == [ReadNumbers]
    assert list(broken) == ["toy.broken"] and reason in broken["toy.broken"]
    with pytest.raises(PluginError) as error:
        registry.get("toy.broken")
    assert reason in str(error.value) and "\n" not in str(error.value)
    assert error.value.exit_code == 2


def test_an_id_claimed_twice_names_both(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one = distribution(tmp_path / "1", "one", {"toy.read": "pipeline_toy:ReadNumbers"})
    two = distribution(tmp_path / "2", "two", {"toy.read": "pipeline_toy:PowerNumbers"})
    registry = discovered(monkeypatch, one, two)
    with pytest.raises(PluginError, match=r"'toy.read' is claimed by .*\(two 1.2\) and by .*\(one 1.2\)"):
        registry.get("toy.read")
    with pytest.raises(PluginError, match=r"claimed by .*\((one|two) 1.2\) and by ReadNumbers$"):
        registry.register(ReadNumbers)


def test_registering_twice_in_one_process_is_refused() -> None:
    registry = Registry()
    registry.register(ReadNumbers)
    with pytest.raises(PluginError, match=r"'toy\.read' is claimed by ReadNumbers and by ReadNumbers"):
        registry.register(ReadNumbers)


def variant(**changes: Any) -> type[Stage]:
    return type("Variant", (PowerNumbers,), changes)


class _Bare(StageParams):
    x: int = 3


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"id": "Toy Power"}, "isn't of the form group.name"),
        ({"display_name": " "}, "has no display_name"),
        ({"group": 3}, "has no group"),
        ({"version": 0}, "version 0 is no whole number from 1"),
        ({"outputs": ["numbers"]}, "outputs is no dict"),
        ({"inputs": {1: int}}, "inputs is no dict"),
        ({"optional_inputs": {"numbers": int}}, "'numbers' is both an input and an optional one"),
        ({"Params": dict}, "Params is no subclass of StageParams"),
        ({"Params": _Bare}, "parameter x has no help"),
        ({"run": lambda self: {}}, "run must take"),
    ],
)
def test_a_declaration_is_checked_at_registration(changes: dict[str, Any], problem: str) -> None:
    with pytest.raises(PluginError) as error:
        Registry().register(variant(**changes))
    assert problem in str(error.value)


def test_a_stage_needs_a_run_method() -> None:
    class Idle(Stage):
        id = "toy.idle"
        display_name = "Idle"
        group = "Toy"
        outputs: ClassVar = {}

    with pytest.raises(PluginError, match="has no method run"):
        check_stage(Idle)


def test_toys_are_whole_stages() -> None:
    for stage in STAGES:
        assert check_stage(stage, id=stage.id) is stage
