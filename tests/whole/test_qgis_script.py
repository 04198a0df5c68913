"""`geomosaic qgis-script`: what it writes; a real QGIS runs and cancels it in `make check-qgis`."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest

from geomosaic.cli.qgis_script import declared
from geomosaic.pipeline.recipe import recipe_from
from geomosaic.pipeline.registry import installed
from geomosaic.requests import mosaic_stages as mosaic
from geomosaic.requests import strips_request as strips
from geomosaic.requests.mosaic_request import MosaicRequest
from geomosaic.requests.option import RARE, flag_of, option_of


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


@pytest.mark.parametrize(
    ("command", "request_"), [("mosaic", MosaicRequest), ("strips", strips.StripsRequest)]
)
def test_each_option_of_the_command_is_offered(command, request_):
    """Without those that QGIS gives itself, or that show another window."""
    offered = {p["option"]: p for p in declared(command)["params"] if p["option"] not in ("", "--set")}
    options = {flag_of(its): option_of(its) for its in fields(request_) if option_of(its).heading}
    assert options.keys() - offered.keys() == {"--output", "--set", "--live"}
    rare = {flag for flag, option in options.items() if option.heading.startswith(RARE)}
    assert {flag for flag, p in offered.items() if p["advanced"]} == rare & offered.keys()
    assert not [p["text"] for p in offered.values() if "--" in p["text"]]


def test_switches_and_choices_are_what_they_are_on_the_command_line():
    """`--incremental` has no value there."""
    offered = {p["name"]: p for p in declared("mosaic")["params"]}
    for name in ("incremental", "coregister", "overwrite", "private", "keep_strays", "survey.read.strict"):
        assert (offered[name]["kind"], offered[name]["default"]) == ("bool", False), name
    assert offered["survey.read.strict"]["option"] == "--strict", "it fails by the verdict too"
    assert offered["surface"]["choices"] == ["ties", "auto", "dense"]
    assert offered["record"]["choices"] == ["off", "summary", "normal", "full"]
    assert (offered["workers"]["kind"], offered["workers"]["min"], offered["workers"]["max"]) == (
        "int",
        1,
        1024,
    )
    assert "survey.read.leave_out" not in offered, "keep_strays sets it"
    template = (Path(declared.__code__.co_filename).parent / "qgis_algorithm.py.in").read_text()
    assert 'if declared["kind"] == "bool" and option != "--set":\n            return [option]' in template


@pytest.mark.parametrize(("command", "stages"), [("mosaic", mosaic.STAGES), ("strips", strips.STAGES)])
def test_each_parameter_can_be_set_as_the_script_does(command, stages, tmp_path):
    (tmp_path / "file").touch()
    of = [p for p in declared(command)["params"] if "." in p["name"]]
    needed = {p["name"]: tmp_path for p in of if p["name"].endswith(".reference") or not p["option"]}
    plain = {"stages": [{"stage": stage} for stage in stages]}
    for p in of:
        value = (
            p["default"] if p["default"] is not None else {"int": 1, "float": 50.0}.get(p["kind"], tmp_path)
        )
        text = str(value).lower() if isinstance(value, bool) else value
        recipe_from(
            plain, installed(), [f"{name}={path}" for name, path in {**needed, p["name"]: text}.items()]
        )
