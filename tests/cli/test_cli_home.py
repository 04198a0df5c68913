"""What makes the command line at home anywhere: defaults, plans, quiet, strict, recipes by name, completion."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_surveys import geomosaic, summary

from geomosaic.cli.running import print_named
from geomosaic.pipeline.recipe_names import recipe_names
from geomosaic.requests.run_request import default_folder
from geomosaic_simulate.survey import SimulatedSurvey

QUICK = ("-q", "--workers", 1, "--set", "adjustment.solve.method=least_squares")


@pytest.fixture(scope="module")
def frames(few_survey: SimulatedSurvey, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four small frames with tags."""
    return shutil.copytree(few_survey.frames, tmp_path_factory.mktemp("home") / "frames")


def all_below(folder: Path) -> set[Path]:
    """Every file and folder."""
    return {*folder.rglob("*")}


def test_a_dry_run_says_what_the_run_would_take_and_leaves_nothing(
    frames: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = all_below(frames.parent)
    assert geomosaic("mosaic", frames, "--dry-run", "--gsd", 0.25, "--workers", 1) == 0
    said = capsys.readouterr()
    reported = dict(line.split(maxsplit=1) for line in said.out.splitlines())
    assert ": Read the survey, " in reported["stages"] and "mosaic.tif" in reported["results"]
    assert reported["frames"] == "4, 0 left out" and reported["pairs"] == "6 to compare, in 2 flight lines"
    for part in ("px at 0.25 m and take ", " on the disk, ", " of memory and "):
        assert part in reported["expected"]
    assert said.out.splitlines()[-1].endswith(f"the run goes to {frames}-mosaic")
    assert "Match frames" not in said.err and all_below(frames.parent) == before


def test_a_dry_run_in_json_has_its_figures_as_numbers(
    frames: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["mosaic", frames, "--gsd", 0.25, "--workers", 1]
    assert geomosaic(*command, "--dry-run", "--json", "-q") == 0
    said = capsys.readouterr()
    plan = json.loads(said.out)
    assert said.err == ""
    assert plan["stages"][0] == "survey.read" and "mosaic.tif" in plan["results"]
    assert plan["output"] == f"{frames}-mosaic"
    assert plan["metrics"]["survey"]["frames"] == 4
    assert plan["metrics"]["placement"]["candidate_pairs"] == 6
    found = plan["metrics"]["estimate"]
    assert found["gsd_m"] == 0.25 and 100 < found["width_px"] < 1000
    for name in ("disk_gb", "memory_gb", "minutes"):
        least, most = found[name]
        assert 0.0 < least < most, name
    assert geomosaic(*command, "--json") == 2
    assert "--json says what --dry-run finds" in capsys.readouterr().err


def test_the_longest_word_widens_the_column(capsys: pytest.CaptureFixture[str]) -> None:
    print_named([("mosaic", "a"), ("surface_confidence", "b")])
    assert capsys.readouterr().out == "mosaic             a\nsurface_confidence b\n"


def test_a_run_that_has_nothing_to_name(capsys: pytest.CaptureFixture[str]) -> None:
    print_named([])
    assert not capsys.readouterr().out


def test_a_dry_run_refuses_what_the_run_refuses(frames: Path, capsys: pytest.CaptureFixture[str]) -> None:
    few = ["--set", "mosaic.seams.max_gigapixels=0.001", "--gsd", 0.001, "--workers", 1]
    assert geomosaic("mosaic", frames, "--dry-run", *few) == 2
    assert "gigapixels at 0.001 m" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("output", "more", "problem"),
    [
        ("theirs", (), "is not empty and not geomosaic's"),
        ("new", ("--incremental",), "there is no finished run to go on from"),
        ("/dev/null", (), "a file stands where a folder is needed"),
        ("/dev/null", ("--overwrite",), "a file stands where a folder is needed"),
        ("/proc/x", (), "/proc/x: "),
    ],
)
def test_a_dry_run_refuses_the_folder_that_the_run_refuses(
    frames: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    output: str,
    more: tuple[str],
    problem: str,
) -> None:
    """In one line, and nothing is written."""
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "notes.txt").write_text("mine")
    before = all_below(tmp_path)
    said = []
    for dry in ((), ("--dry-run",)):
        assert geomosaic("mosaic", frames, "-o", tmp_path / output, "-q", *more, *dry) == 2
        said.append(capsys.readouterr().err)
    assert said[0] == said[1] and problem in said[0] and said[0].count("\n") == 1
    assert all_below(tmp_path) == before


def test_a_recipe_by_name_quietly_into_a_folder_next_to_the_frames(
    frames: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert geomosaic("run", "quick-look", frames, *QUICK) == 0
    said = capsys.readouterr()
    assert said.out == said.err == ""
    run = frames.with_name("frames-quick-look")
    assert summary(run)["recipe"]["name"] == "quick look" and (run / "mosaic.tif").is_file()
    again = ("-o", run.with_name("again"), "--from", "mosaic.compose")
    for more in (("replay", run / "run.mcap", *again, *QUICK[:3]), ("export", "vrt", run, "-q")):
        assert geomosaic(*more) == 0
        said = capsys.readouterr()
        assert said.out == said.err == "", more[0]
    assert (run / "mosaic.vrt").is_file() and (run.with_name("again") / "mosaic.tif").is_file()
    assert geomosaic("export", "vrt", run.with_name("nowhere"), "-q") == 2
    assert "nowhere" in capsys.readouterr().err, "but errors"
    assert geomosaic("run", "quick_lok", frames) == 2
    assert "unknown recipe 'quick_lok'; did you mean 'quick-look'?" in capsys.readouterr().err


def test_a_strict_run_fails_after_it_where_the_verdict_is_bad(
    frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    noise = np.random.default_rng(2)
    (tmp_path / "frames").mkdir()
    for frame in sorted(frames.glob("*.jpg")):
        tags = frame.read_bytes()
        pixels = cv2.imencode(".jpg", noise.integers(0, 255, (240, 320, 3), np.uint8))[1].tobytes()
        head = tags[: tags.index(b"\xff\xdb")]  # EXIF and XMP lie before the tables
        (tmp_path / "frames" / frame.name).write_bytes(head + pixels[pixels.index(b"\xff\xdb") :])
    arguments = ["run", "none", tmp_path / "frames", "--workers", 1]
    assert geomosaic(*arguments) == 0
    run = tmp_path / "frames-none"
    assert summary(run)["verdict"]["grade"] == "bad"
    capsys.readouterr()
    assert geomosaic(*arguments, "--strict", "-q") == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("geomosaic: the verdict is bad: ")
    assert (run / "report.html").is_file() and summary(run)["recipe"]["stages"][0]["params"]["strict"]


def test_recipes_are_listed_and_printed_to_be_changed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert geomosaic("recipes") == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == recipe_names()
    assert geomosaic("recipes", "quick-look") == 0
    assert capsys.readouterr().out.startswith("# geomosaic run quick-look FOLDER\nname: quick look\n")
    assert geomosaic("recipes", "--makefile") == 0
    assert Path(capsys.readouterr().out.strip()).is_file()
    assert geomosaic("recipes", tmp_path / "x.yaml") == 2


def test_the_run_folder_lies_next_to_what_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("geometry.yaml").touch()
    assert default_folder(Path("geometry.yaml"), "scene") == Path("geometry-scene")
    assert default_folder(Path("flight.1/"), "mosaic") == Path("flight.1-mosaic")
    assert default_folder(Path(), "mosaic") == tmp_path.with_name(f"{tmp_path.name}-mosaic")
    assert geomosaic("mosaic", "/") == 2
    assert "/: no run folder can lie next to it; give the run folder with -o" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("geomosaic mos", "mosaic"),
        ("geomosaic mosaic frames --dry", "--dry-run"),
        ("geomosaic export sta", "stac"),
        ("geomosaic simulate frames out --lin", "--lines"),
        ("geomosaic run quick", "quick-look"),
    ],
)
def test_a_shell_completes(
    line: str, found: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    reported = {
        "_GEOMOSAIC_COMPLETE": "complete_bash",
        "COMP_WORDS": line,
        "COMP_CWORD": str(line.count(" ")),
    }
    for name, value in reported.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(SystemExit):
        geomosaic()
    said = capsys.readouterr()
    assert (said.out.split(), said.err) == ([found], "")


LIGHT = """
import sys
from geomosaic.cli.main import main
code = main(sys.argv[1:])
heavy = [n for n in ("numpy", "scipy", "cv2", "osgeo", "rasterio", "mcap") if n in sys.modules]
sys.exit(f"{code}, loads {heavy}" if code or heavy else 0)
"""


@pytest.mark.parametrize("command", [["--version"], ["recipes", "--makefile"]])
def test_the_start_is_light(command: list[str]) -> None:
    """A tenth of the time that libraries would take: shells and Makefiles ask often."""
    done = subprocess.run([sys.executable, "-c", LIGHT, *command], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


def test_python_m_is_the_command() -> None:
    asked = [sys.executable, "-m", "geomosaic", "fly"]
    done = subprocess.run(asked, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (2, "") and done.stderr.startswith(
        "geomosaic: unknown command 'fly'"
    )


@pytest.mark.parametrize("command", [[], ["mosaic"], ["export", "tiles"]])
def test_h_is_help(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert geomosaic(*command, "-h") == 0
    short = capsys.readouterr().out
    assert geomosaic(*command, "--help") == 0
    assert short == capsys.readouterr().out and "-h, --help" in short
