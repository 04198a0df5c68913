"""An installed plug-in: its faults carry its name, its changed code gets no old results."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

STAGE = """
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from geomosaic.errors import InputError
from geomosaic.pipeline.stage import RunFile, Stage, StageParams, param
from hazeplugin.sums import total


@dataclass(frozen=True)
class Total:
    value: float


class HazeSum(Stage):
    id = "haze.sum"
    display_name = "Sum"
    group = "Haze"
    outputs: ClassVar = {"haze": Total}

    class Params(StageParams):
        file: Path = param(help="numbers")

    @classmethod
    def check(cls, params):
        if params.file.stat().st_size == 0:
            raise InputError("is empty", file=params.file)

    def run(self, inputs, params, context):
        keep = context.map("number", number, params.file.read_text().split())
        return {"haze": Total(total(keep))}


def number(text: str) -> float:
    return total([float(text)])


class HazeWrite(Stage):
    id = "haze.write"
    display_name = "Write"
    group = "Haze"
    inputs: ClassVar = {"haze": Total}
    outputs: ClassVar = {"haze_file": RunFile}
    results = ("haze.txt",)

    def run(self, inputs, params, context):
        with context.writing("haze.txt") as path:
            path.write_text(str(inputs["haze"].value))
        return {"haze_file": context.run_file("haze.txt")}
"""
ENTRIES = """[geomosaic.stages]
haze.sum = hazeplugin.stage:HazeSum
haze.write = hazeplugin.stage:HazeWrite
"""
SUMS = "def total(values):\n    return {factor} * sum(values)\n"


class Desk:
    """A folder where a plug-in is installed, and numbers to sum."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.site = folder, folder / "site"
        (folder / "numbers.txt").write_text("1 2 4")
        stages = "stages: [{stage: haze.sum, params: {file: numbers.txt}}, haze.write]\n"
        (folder / "haze.yaml").write_text(stages)

    def install(self, version: str, sums: str, entries: str = ENTRIES) -> None:
        """What pip leaves; pip itself installs the package of test_example_package.py."""
        shutil.rmtree(self.site, ignore_errors=True)
        info = f"haze_plugin-{version}.dist-info"
        files = {
            "hazeplugin/__init__.py": "",
            "hazeplugin/stage.py": STAGE,
            "hazeplugin/sums.py": sums,
            f"{info}/METADATA": f"Metadata-Version: 2.1\nName: haze-plugin\nVersion: {version}\n",
            f"{info}/entry_points.txt": entries,
        }
        files[f"{info}/RECORD"] = "".join(f"{name},,\n" for name in (*files, f"{info}/RECORD"))
        for name, text in files.items():
            (self.site / name).parent.mkdir(parents=True, exist_ok=True)
            (self.site / name).write_text(text)

    def run(self) -> tuple[int, str]:
        command = [sys.executable, "-m", "geomosaic.cli.main", "run", "haze.yaml", "-o", "RUN"]
        environment = {**os.environ, "PYTHONPATH": str(self.site), "PYTHONDONTWRITEBYTECODE": "1"}
        done = subprocess.run(
            [*command, "--workers", "1"],
            cwd=self.folder, env=environment, capture_output=True, text=True, timeout=120,
        )  # fmt: skip
        return done.returncode, done.stderr

    def sum(self) -> tuple[str, bool]:
        """What the run wrote, and whether it took the sum from the cache."""
        code, err = self.run()
        assert code == 0, err
        return (self.folder / "RUN" / "haze.txt").read_text(), "[1/2] Sum: unchanged, from the cache" in err


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    return Desk(tmp_path)


def test_changed_code_gets_no_old_results(desk: Desk) -> None:
    desk.install("1.0", SUMS.format(factor=1))
    assert desk.sum() == ("7.0", False)
    assert desk.sum() == ("7.0", True)
    # As in an editable install: another module than the stage's changes, the version stays. Items are redone too.
    (desk.site / "hazeplugin" / "sums.py").write_text(SUMS.format(factor=10))
    assert desk.sum() == ("700.0", False)
    assert desk.sum() == ("700.0", True)
    desk.install("1.1", SUMS.format(factor=10))
    assert desk.sum() == ("700.0", False), "another version may call other libraries"


CODE_OF_COMPOSE = """
from geomosaic.pipeline.plugin import code_of
from geomosaic.stages.mosaic_compose import mosaic_compose
for blend in ("haze", "feather"):
    print(code_of(mosaic_compose, mosaic_compose.plugged(mosaic_compose.Params(blend=blend))))
"""


@pytest.mark.proof
def test_a_changed_blend_of_others_gets_no_old_mosaic(desk: Desk) -> None:
    """Whose name stands in a parameter of geomosaic's own stage; other blends keep what they made."""
    desk.install("1.0", "HAZE = 1\n", f"{ENTRIES}[geomosaic.blends]\nhaze = hazeplugin.sums:HAZE\n")

    def codes() -> list[str]:
        environment = {**os.environ, "PYTHONPATH": str(desk.site), "PYTHONDONTWRITEBYTECODE": "1"}
        command = [sys.executable, "-c", CODE_OF_COMPOSE]
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=60, check=True
        )
        return done.stdout.split("\n")[:2]

    first = codes()
    assert first[0] and first == codes() and first[1] == ""
    (desk.site / "hazeplugin" / "sums.py").write_text("HAZE = 2\n")
    assert codes()[0] != first[0]


def test_faults_name_the_stage_and_its_distribution(desk: Desk) -> None:
    desk.install("1.0", "def total(values):\n    return values.nothing\n")
    code, err = desk.run()
    line = err.splitlines()[-1]
    assert code == 1
    assert line.startswith("geomosaic: stage haze.sum of haze-plugin 1.0 failed: AttributeError: 'list'")
    (desk.folder / "numbers.txt").write_text("")
    code, err = desk.run()
    where = desk.folder / "numbers.txt"
    assert code == 2
    assert err == f"geomosaic: stage haze.sum of haze-plugin 1.0: {where}: is empty\n"
