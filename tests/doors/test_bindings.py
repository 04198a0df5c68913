"""GDAL's bindings are missing or don't fit: one line, with the command that fixes it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from geomosaic_simulate.survey import SimulatedSurvey

OSGEO = {
    "are not installed": 'raise ModuleNotFoundError("No module named \'osgeo\'", name="osgeo")',
    "don't work (libgdal.so.99: cannot open)": 'raise ImportError("libgdal.so.99: cannot open")',
}


@pytest.mark.parametrize("problem", OSGEO)
def test_bindings_that_do_not_work_are_one_line_with_the_fix(
    problem: str, few_survey: SimulatedSurvey, tmp_path: Path
) -> None:
    (tmp_path / "site" / "osgeo").mkdir(parents=True)
    (tmp_path / "site" / "osgeo" / "__init__.py").write_text(OSGEO[problem])
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "gdal-config").write_text("#!/bin/sh\necho 3.6.2\n")
    (tmp_path / "bin" / "gdal-config").chmod(0o755)
    path = os.pathsep.join([str(tmp_path / "bin"), os.environ["PATH"]])
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "site"), "PATH": path}
    for command in (["mosaic", str(few_survey.frames), "--workers", "1"], ["stages", "survey.read"]):
        done = subprocess.run(
            [sys.executable, "-m", "geomosaic.cli.main", *command],
            env=environment, capture_output=True, text=True, timeout=60,
        )  # fmt: skip
        assert done.returncode == 2
        (line,) = done.stderr.splitlines()
        assert line.startswith(f"geomosaic: GDAL's Python bindings {problem}; pip install setuptools ")
        assert line.endswith("--no-build-isolation 'gdal[numpy]==3.6.2'")


def test_what_an_extra_brings_is_named_where_it_is_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from geomosaic.cli import main
    from geomosaic.cli.stopping import Stop

    error = ModuleNotFoundError("No module named 'rerun'", name="rerun")
    assert main._failed(error, Stop()) == 2
    assert (
        capsys.readouterr().err == "geomosaic: rerun isn't installed; pip install 'geomosaic-ortho[view]'\n"
    )
