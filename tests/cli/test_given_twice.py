"""An option that takes one value and is given twice is an error: the last one is not taken silently."""

from __future__ import annotations

import pytest

from geomosaic.cli.main import main
from geomosaic.errors import InputError
from geomosaic.requests.mosaic_request import MosaicRequest
from geomosaic.requests.recipe_request import RecipeRequest


@pytest.mark.parametrize(
    ("arguments", "flag"),
    [
        (("mosaic", "frames", "--gcp", "a.txt", "--gcp", "b.txt"), "--gcp"),
        (("mosaic", "frames", "-o", "a", "--output=b"), "--output"),
        (("run", "recipe.yaml", "--seed", "1", "--seed", "1"), "--seed"),
        (("replay", "run.mcap", "-o", "a", "--from", "x", "--from", "y"), "--from"),
        (("evaluate", "run", "--reference", "a.tif", "--reference", "b.tif"), "--reference"),
        (("export", "surface", "run", "--heights", "EPSG:5773", "--heights", "x"), "--heights"),
    ],
)
def test_an_option_with_one_value_is_given_once(
    arguments: tuple[str, ...], flag: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"geomosaic: {flag} is given twice and takes one value; give {flag} once")


def test_options_that_may_be_given_twice(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ("mosaic", "nowhere", "--set", "survey.read.crs=auto", "--set", "mosaic.seams.edges=keep")
    assert main((*arguments, "-q", "-q")) == 2
    assert "no such file or folder; give an existing one as FRAMES_DIR" in capsys.readouterr().err


def test_a_variable_of_the_shell_that_is_unset(capsys: pytest.CaptureFixture[str]) -> None:
    """An empty path is the current folder to Python: whatever images lie there became a mosaic."""
    assert main(["mosaic", "", "-o", "run"]) == 2
    assert "an argument is empty" in capsys.readouterr().err
    with pytest.raises(InputError, match="frames is empty"):
        MosaicRequest(frames="")


@pytest.mark.parametrize(("first", "flag"), [("A", "frames"), ("a.yaml", "strips")])
def test_input_and_its_option(first: str, flag: str) -> None:
    """The results went into a folder named by INPUT."""
    with pytest.raises(InputError, match=f"leave out INPUT or --{flag}"):
        RecipeRequest(name="none", input=first, **{flag: "B"}).recipe()


def test_an_offset_of_no_dem() -> None:
    with pytest.raises(InputError, match="--dem-offset has an effect only on a DEM; add --dem FILE"):
        MosaicRequest(frames="frames", dem_offset=5.0).stages()
