"""Names and folders that the system refuses are one line with a fix."""

from __future__ import annotations

from pathlib import Path

import pytest

from geomosaic.cli.main import main
from geomosaic.errors import OutputError
from geomosaic.pipeline.files import write_bytes
from geomosaic.requests.recipe_request import RecipeRequest

LONG = "a" * 300
TOO_LONG = "the name is too long for the file system; give a shorter one"


@pytest.mark.parametrize(
    "words",
    [
        ["run", LONG],
        ["mosaic", LONG],
        ["mosaic", ".", "-o", LONG],
        ["inspect", LONG],
        ["diff", LONG, LONG],
        ["measure", LONG, "--line", "x"],
        ["evaluate", LONG, "--reference", "x"],
        ["geoid", "fetch", "us_nga_egm96_15.tif", "--from", LONG],
    ],
)
def test_a_name_that_is_too_long(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "F1.jpg").write_bytes(b"")
    assert main([*words, "--workers", "1"] if words[0] in ("run", "mosaic") else words) == 2
    err = capsys.readouterr().err
    assert err.endswith(f"a...: {TOO_LONG}\n") and err.count("\n") == 1 and len(err) < 250


def test_a_user_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "F1.jpg").write_bytes(b"")
    pos = "~nobody-of-this-name/pos.csv"
    assert main(["mosaic", str(tmp_path), "--pos", pos, "-o", str(tmp_path / "run"), "--workers", "1"]) == 2
    err = capsys.readouterr().err
    assert err.endswith(f"{pos}: no such file or folder; give an existing one with --pos PATH\n")


def test_a_current_folder_that_was_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert main(["mosaic", "frames", "--workers", "1"]) == 2
    line = "geomosaic: the current folder was removed; change to another one (cd) and run again\n"
    assert capsys.readouterr().err == line


@pytest.mark.parametrize("name", ["2024-05-01", "a: b", "#5", "null", "~"])
def test_a_recipe_s_input_may_have_any_name(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    recipe = RecipeRequest(name="quick-look", input=Path(name), workers=1).recipe()
    wanted = Path.home() if name == "~" else tmp_path / name
    assert recipe.steps[0].params.model_dump()["frames"] == wanted


@pytest.mark.parametrize("name", [".", "..", "/"])
def test_a_folder_that_has_no_name_is_no_file_to_write(name: str) -> None:
    with pytest.raises(OutputError, match="a folder stands where the file is to go"):
        write_bytes(Path(name), b"x")


def test_frames_of_a_video_do_not_take_the_place_of_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "flight.mp4").write_bytes(b"x")
    monkeypatch.chdir(tmp_path / "empty")
    assert main(["frames", "../flight.mp4", "-o", "."]) == 2
    line = "geomosaic: .: is the current folder; choose a new or empty folder with -o\n"
    assert capsys.readouterr().err == line
