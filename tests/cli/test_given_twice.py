"""An option that takes one value and is given twice is an error: the last one is not taken silently."""

from __future__ import annotations

import pytest

from geomosaic.cli.main import main


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
