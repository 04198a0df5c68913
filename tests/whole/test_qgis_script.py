"""`geomosaic qgis-script`: what it writes; a real QGIS runs and cancels it in `make check-qgis`."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

from geomosaic.cli.qgis_script import declared
from geomosaic.pipeline.recipe import recipe_from
from geomosaic.pipeline.registry import installed
from geomosaic.requests import mosaic_stages as mosaic
from geomosaic.requests import strips_request as strips


def written(folder: Path) -> dict[str, str]:
    done = subprocess.run(
        [sys.executable, "-m", "geomosaic.cli.main", "qgis-script", str(folder)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return {Path(path).stem: Path(path).read_text() for path in done.stdout.split()}


def test_the_scripts_hold_all_that_stages_declare(tmp_path):
    texts = written(tmp_path / "scripts")
    assert texts.keys() == {"geomosaic_mosaic", "geomosaic_strips"}
    for name, text in texts.items():
        tree = ast.parse(text)
        (value,) = (
            node.value
            for node in tree.body
            if isinstance(node, ast.Assign) and node.targets[0].id == "DECLARED"
        )
        of = json.loads(value.args[0].value)
        assert of["name"] == name
        assert of["command"][0] == sys.executable, "QGIS has another Python"
        keys = [p["key"] for p in of["params"]]
        assert len(set(keys)) == len(keys) > 20
        assert [p["name"] for p in of["params"] if p["required"]] == [
            {"geomosaic_mosaic": "survey.read.frames", "geomosaic_strips": "survey.strips.geometry"}[name]
        ]
        imported = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
        assert imported == {"pathlib", "qgis.core"}, "QGIS' Python has none of our packages"


def test_an_option_that_sets_no_parameter_is_a_switch():
    """`--incremental` has no value on the command line."""
    (switch,) = (p for p in declared("mosaic")["params"] if "." not in p["name"])
    assert (switch["name"], switch["option"], switch["kind"]) == ("incremental", "--incremental", "bool")
    assert not switch["default"]
    template = (Path(declared.__code__.co_filename).parent / "qgis_algorithm.py.in").read_text()
    assert 'if declared["kind"] == "bool" and option != "--set":\n            return [option]' in template


@pytest.mark.parametrize(("command", "stages"), [("mosaic", mosaic.STAGES), ("strips", strips.STAGES)])
def test_each_parameter_can_be_set_as_the_script_does(command, stages, tmp_path):
    (tmp_path / "file").touch()
    of = [p for p in declared(command)["params"] if "." in p["name"]]
    needed = {p["name"]: tmp_path for p in of if "reference" in p["option"] or not p["option"]}
    plain = {"stages": [{"stage": stage} for stage in stages if stage != "matching.reference"]}
    for p in of:
        value = (
            p["default"] if p["default"] is not None else {"int": 1, "float": 50.0}.get(p["kind"], tmp_path)
        )
        text = str(value).lower() if isinstance(value, bool) else value
        recipe_from(
            plain, installed(), [f"{name}={path}" for name, path in {**needed, p["name"]: text}.items()]
        )
