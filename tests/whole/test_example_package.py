"""The example package of a stage, installed as people do it and run by the command line."""

from __future__ import annotations

import csv
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from small_surveys import small_survey

from geomosaic import api
from geomosaic.pipeline.context import Context

EXAMPLE = Path(__file__).parents[2] / "examples" / "geomosaic-haze"
DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where it is installed."""
    folder = tmp_path_factory.mktemp("site")
    project = folder / "project"  # setuptools builds next to what it builds
    subprocess.run(["cp", "-r", EXAMPLE, project], check=True)
    quiet = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    command = [sys.executable, "-m", "pip", "install", *quiet, "--target", folder / "site", project]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    return folder / "site"


def geomosaic(site: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """The command line, with the package installed."""
    return subprocess.run(
        [sys.executable, "-m", "geomosaic.cli.main", *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": str(site)}, capture_output=True, text=True, timeout=120,
    )  # fmt: skip


@pytest.mark.proof
def test_the_example_is_a_stage_like_any_other(site: Path, tmp_path: Path) -> None:
    survey = small_survey(tmp_path, lines=1, frames_per_line=3, width_px=240, height_px=180, pos_in="exif")
    described = geomosaic(site, "stages", "haze.estimate")
    assert described.stdout.startswith("haze.estimate: Estimate haze (Haze, version 1)\n"), described.stderr
    arguments = ["run", EXAMPLE / "haze.yaml", survey.frames, "-o", tmp_path / "run", "--workers"]
    done = geomosaic(site, *arguments, 2)
    assert done.returncode == 0, done.stderr
    assert re.search(r"^haze {7}0\.\d\d in the worst frame$", done.stdout, re.MULTILINE)
    with (tmp_path / "run" / "haze.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [r["frame"] for r in rows] == [f"F000{i}.jpg" for i in (1, 2, 3)]
    assert all(0.0 <= float(r["dark_level"]) < 0.5 for r in rows)
    again = geomosaic(site, *arguments, 1, "--set", "haze.estimate.hazy=0")
    assert "warning: F0001.jpg: hazy" in again.stderr


def test_the_page_tells_all_that_authors_can_use() -> None:
    """Every public name of Context and of geomosaic.api."""
    page = (DOCS / "stages.md").read_text(encoding="utf-8")
    of_context = {n for n in vars(Context) if not n.startswith("_")} | {
        n for n in vars(Context(Path(), work_folder=Path())) if not n.startswith("_")
    }
    lacking = sorted(n for n in (*of_context, *api.__all__) if not re.search(rf"\b{n}\b", page))
    assert not lacking
