"""geomosaic from Python: runs as objects, as the documentation shows them, and a cheap import."""

from __future__ import annotations

import doctest
import inspect
import pydoc
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import geomosaic as gm
from geomosaic import runs
from geomosaic.errors import FileError, InputError, PoorResultError
from geomosaic.requests.mosaic_request import MosaicRequest
from geomosaic.survey.model import Survey
from geomosaic_simulate.survey import SimulatedSurvey


@pytest.fixture(scope="module")
def run(few_run: Path) -> gm.Run:
    """Four small frames."""
    return gm.open_run(few_run)


@pytest.mark.proof
def test_what_the_documentation_shows_is_so(few_survey: SimulatedSurvey, tmp_path: Path) -> None:
    shutil.copytree(few_survey.frames, tmp_path / "frames")
    sets = {"matching.sift.keypoints": 3000}
    run = gm.mosaic(tmp_path / "frames", tmp_path / "run", set=sets, workers=1, overwrite=True)
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    for test in doctest.DocTestFinder().find(runs, globs={"gm": gm, "run": run, "folder": run.folder.parent}):
        reports: list[str] = []
        doctest.DocTestRunner(optionflags=flags).run(test, out=reports.append)
        assert not reports, "".join(reports)


def test_a_run_holds_its_products(run: gm.Run) -> None:
    assert run.mosaic.crs.is_projected and run.mosaic.read(1, window=((0, 8), (0, 8))).shape == (8, 8)
    assert set(run.frames["status"]) == {"tied"} and run.frames["lon_deg"].dtype == np.float64
    assert {"mosaic", "layers", "positions", "report", "recording", "summary"} <= set(run.files)
    survey = run.artefact("survey")
    assert isinstance(survey, Survey) and len(survey.frames) == 4
    assert run.recording.recipe_yaml.startswith("name: mosaic")
    picture = run._repr_html_()
    assert picture.startswith('<figure><img src="data:image/webp;base64,') and "<b>good</b>: " in picture
    with pytest.raises(FileError, match=r"this run made no 'tie'; it made survey, "):
        run.artefact("tie")
    with pytest.raises(FileError, match=r"is no finished run \(run\.json is missing\)"):
        gm.open_run(run.folder.parent)


def test_numbers_out_of_arrays_are_numbers() -> None:
    keypoints, every, workers = np.array([3000, 2, 1])
    request = MosaicRequest(frames=Path("f"), every=every, workers=workers, strict=np.bool_(True))
    assert (request.every, request.workers, request.strict) == (2, 1, True)
    sets = {
        "matching.sift.keypoints": keypoints,
        "matching.sift.ratio": np.float32(0.5),
        "a.b.c": np.arange(2),
    }
    assert runs._sets(sets) == ["matching.sift.keypoints=3000", "matching.sift.ratio=0.5", "a.b.c=[0, 1]"]


def test_a_run_without_a_mosaic_is_shown_too(run: gm.Run, tmp_path: Path) -> None:
    shutil.copytree(run.folder, tmp_path / "a&b")
    (tmp_path / "a&b" / "mosaic.tif").unlink()
    shown = gm.open_run(tmp_path / "a&b")._repr_html_()
    assert shown.startswith(f"<p>{tmp_path}/a&amp;b <b>good</b>: ")


def test_errors_are_those_of_the_command(few_survey: SimulatedSurvey, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no JPEG, TIFF or PNG frames"):
        gm.mosaic(tmp_path)
    with pytest.raises(InputError, match="unknown recipe 'quck-look'; did you mean 'quick-look'"):
        gm.run("quck-look", few_survey.frames)
    assert PoorResultError.exit_code == 3 and not list(tmp_path.iterdir())


def test_help_shows_every_option_with_its_default() -> None:
    shown = inspect.signature(runs.mosaic).parameters
    assert shown["crs"].default == "auto" and shown["pos"].annotation == Path | None
    assert not {"dry_run", "as_json", "quiet", "help_all"} & shown.keys()
    assert "pos_crs: CRS of x and y in the pos file" in (runs.mosaic.__doc__ or "")


@pytest.mark.parametrize("name", ["help_all", "help", "no_such_option", "dry_run"])
def test_options_of_the_terminal_and_unknown_ones_raise(name: str, tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    with pytest.raises(InputError, match=f"unknown argument '{name}'"):
        gm.mosaic(tmp_path / "frames", **{name: True})
    assert [path.name for path in tmp_path.iterdir()] == ["frames"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"workers": 0}, "workers is 0; give at least 1"),
        ({"workers": 1.5}, "workers is 1.5; give a whole number"),
        ({"pos": 3}, "pos is 3; give a path"),
        ({"pdf": "yes"}, "pdf is 'yes'; give True or False"),
        ({"accuracy": "5 feet"}, "accuracy: '5 feet' is no length"),
        ({"set": 5}, "set is 5; give a list of texts"),
    ],
)
def test_a_value_of_another_kind_raises(options: dict[str, object], said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=said):
        gm.mosaic(tmp_path, **options)


def test_a_request_takes_values_as_the_command_line_does() -> None:
    asked = MosaicRequest(frames="frames", accuracy="5cm", gsd=0.05, set=["mosaic.seams.edges=keep"])
    assert (asked.frames, asked.accuracy, asked.gsd) == (Path("frames"), 0.05, "0.05")
    assert asked.parameters()["quality.verdict"] == {"accuracy_m": 0.05}


def test_mosaic_is_a_function_and_nothing_else() -> None:
    import geomosaic.composition.grid
    import geomosaic.stages.mosaic_compose  # noqa: F401

    assert inspect.isfunction(gm.mosaic) and gm.mosaic is runs.mosaic
    shown = pydoc.render_doc(gm.mosaic, renderer=pydoc.plaintext)
    assert "mosaic(frames" in shown and "one map-true mosaic of a folder of frames" in shown


CHEAP = """
import sys, geomosaic as gm
heavy = [n for n in ("numpy", "cv2", "osgeo", "rasterio", "typer", "rich", "pydantic") if n in sys.modules]
assert not heavy, heavy
from geomosaic.stages import mosaic_estimate
assert "mosaic" in dir(gm) and gm.list_stages()["mosaic.estimate"]["group"] == "Mosaic"
try:
    gm.mosaik
except AttributeError as error:
    print(error)
"""


def test_the_import_is_cheap_and_unknown_names_raise() -> None:
    done = subprocess.run([sys.executable, "-c", CHEAP], capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("module 'geomosaic' has no attribute 'mosaik'\n", "")


SCRIPT = """
import sys
import geomosaic as gm
run = gm.run(*sys.argv[1:], workers=2)
print(run.figures["survey"]["frames"])
"""


def test_a_script_needs_no_guard(few_survey: SimulatedSurvey, tmp_path: Path) -> None:
    """Workers don't run the script anew, as those of multiprocessing's own pools do."""
    (tmp_path / "script.py").write_text(SCRIPT)
    stages = "survey.read, projection.ground, placement.pos, matching.sift"
    (tmp_path / "matched.yaml").write_text(f"name: matched\nstages: [{stages}]\n")
    given = tmp_path / "matched.yaml", few_survey.frames, tmp_path / "run"
    command = [sys.executable, tmp_path / "script.py", *given]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "4\n"), done.stderr
