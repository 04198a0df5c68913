"""What is not geomosaic's stays: a marker says whose a folder is, and no link inside it is followed."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest
from small_surveys import geomosaic
from test_pipeline_runner import Toys, toys  # noqa: F401

from geomosaic.errors import FileError, LinkError, OutputError
from geomosaic.pipeline.run_folder import MARKER, RunFolder
from geomosaic.pipeline.run_options import RunOptions
from geomosaic.pipeline.runner import run


def contents(folder: Path) -> dict[str, bytes | str]:
    """All that lies below a folder."""
    return {
        p.relative_to(folder).as_posix(): str(p.readlink()) if p.is_symlink() else p.read_bytes()
        for p in folder.rglob("*")
        if p.is_symlink() or p.is_file()
    }


def test_a_folder_of_others_is_refused_and_left_as_it_is(toys: Toys) -> None:  # noqa: F811
    (toys.run_folder / "work").mkdir(parents=True)
    (toys.run_folder / "work" / "notes.txt").write_text("mine")
    before = contents(toys.run_folder)
    with pytest.raises(OutputError, match=r"is not empty and not geomosaic's; choose a new .* --overwrite$"):
        toys.run()
    assert contents(toys.run_folder) == before and toys.done() == []


def test_a_line_break_in_a_folders_name_is_refused_before_any_work(tmp_path: Path) -> None:
    """GDAL leaves it out and writes elsewhere."""
    with pytest.raises(OutputError, match="line break or another control character"):
        RunFolder.opened(tmp_path / "a\nb" / "run")
    assert not list(tmp_path.iterdir())


def test_overwriting_replaces_results_and_nothing_else(toys: Toys) -> None:  # noqa: F811
    (toys.run_folder / "work" / "toy.gone").mkdir(parents=True)
    mine = {"work/notes.txt": b"a", "work/toy.gone/entry.json": b"b", "readme": b"c", "work/toy.read/x": b"d"}
    for name, content in {**mine, "total.txt": b"theirs"}.items():
        (toys.run_folder / name).parent.mkdir(exist_ok=True)
        (toys.run_folder / name).write_bytes(content)
    toys.run(overwrite=True)
    toys.run("toy.power.power=3")
    toys.run("toy.power.power=4")
    there = contents(toys.run_folder)
    assert {name: there[name] for name in mine} == mine
    assert str(there["total.txt"], "ascii").startswith("354.0 ")


def test_a_file_of_others_under_a_result_s_name_is_refused_before_any_work(toys: Toys) -> None:  # noqa: F811
    toys.run()
    toys.done()
    listed = json.loads((toys.run_folder / MARKER).read_text())
    listed["files"].remove("total.txt")
    (toys.run_folder / MARKER).write_text(json.dumps(listed))
    (toys.run_folder / "total.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"total\.txt: is in the way, and geomosaic did not make it"):
        toys.run("toy.power.power=3")
    assert (toys.run_folder / "total.txt").read_text() == "mine"


def test_a_result_that_is_not_made_again_goes(toys: Toys) -> None:  # noqa: F811
    """Among new results an old one would be of another run."""
    toys.run()
    folder = RunFolder(toys.run_folder)
    folder.claim("extra.txt").write_text("no result")
    folder.claim("old.txt").write_text("old")
    (toys.run_folder / "mine.txt").write_text("mine")
    recipe = toys.recipe("toy.power.power=3")
    writes = next(step.stage for step in recipe.steps if step.stage.id == "toy.write")
    assert writes.results == ("total.txt", "old.txt")
    run(recipe, toys.run_folder)
    left = {p.name for p in toys.run_folder.iterdir()}
    assert {"extra.txt", "mine.txt", "total.txt"} <= left and "old.txt" not in left


@pytest.mark.parametrize(
    "name",
    ["work", "work/lock", "work/toy.read", "work/toy.read/calls.part", "run.mcap", "total.txt", MARKER],
)
@pytest.mark.parametrize("finished", [False, True])
def test_links_are_not_followed(name: str, finished: bool, toys: Toys) -> None:  # noqa: F811
    theirs = toys.folder / "theirs"
    if finished:
        toys.run()
    place = toys.run_folder / name
    place.parent.mkdir(parents=True, exist_ok=True)
    if place.is_dir():
        place.rename(theirs)
    elif name in ("work", "work/toy.read"):
        theirs.mkdir()
        (theirs / "pearl").write_text("x")
    else:
        place.unlink(missing_ok=True)
        theirs.write_text("x")
    place.symlink_to(theirs)
    before = contents(toys.folder / "theirs") if theirs.is_dir() else theirs.read_bytes()
    toys.done()
    for offset in (2, 3):
        with pytest.raises(LinkError, match=r"is a link, and links are not followed there; remove it"):
            toys.run(f"toy.read.offset_m={offset}", overwrite=True)
    assert (contents(theirs) if theirs.is_dir() else theirs.read_bytes()) == before


def test_another_name_of_the_recording_keeps_its_content(toys: Toys) -> None:  # noqa: F811
    toys.run()
    other = toys.folder / "kept.mcap"
    os.link(toys.run_folder / "run.mcap", other)
    before = other.read_bytes()
    toys.run("toy.power.power=3")
    assert other.read_bytes() == before != (toys.run_folder / "run.mcap").read_bytes()


def test_an_empty_name_is_no_folder(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for command in ("mosaic", "run", "strips", "replay"):
        assert geomosaic(command, tmp_path, "-o", "") == 2
        assert "an argument is empty" in capsys.readouterr().err


def test_a_marker_that_is_damaged_lists_nothing(toys: Toys) -> None:  # noqa: F811
    toys.run()
    (toys.run_folder / MARKER).write_text('{"files": ["../../x", 3')
    with pytest.raises(OutputError, match="is in the way, and geomosaic did not make it"):
        toys.run()
    toys.run(overwrite=True)
    toys.run()


def test_a_marker_cannot_reach_out_of_its_folder(toys: Toys) -> None:  # noqa: F811
    toys.run()
    (toys.folder / "pearl").write_text("x")
    (toys.run_folder / MARKER).write_text(json.dumps({"files": ["work/../../pearl", "../pearl", "/etc"]}))
    toys.run("toy.power.power=3", overwrite=True)
    assert (toys.folder / "pearl").read_text() == "x"


def test_an_export_does_not_read_through_a_link(toys: Toys, capsys: pytest.CaptureFixture[str]) -> None:  # noqa: F811
    toys.run()
    theirs = toys.folder / "theirs.json"
    (toys.run_folder / "run.json").rename(theirs)
    (toys.run_folder / "run.json").symlink_to(theirs)
    assert geomosaic("export", "vrt", toys.run_folder) == 2
    assert "run.json: is a link, and links are not followed there" in capsys.readouterr().err


def test_two_commands_that_write_at_once_both_list_what_they_made(tmp_path: Path) -> None:
    """As two exports of a finished run do."""
    RunFolder.opened(tmp_path)
    one, other = RunFolder(tmp_path), RunFolder(tmp_path)
    for folder, name in ((one, "tiles"), (other, "mosaic.kmz"), (one, "mosaic.vrt")):
        with folder.writing(name) as path:
            path.write_text("x")
    other.remove("tiles")
    one.note(["work/more"])
    assert RunFolder(tmp_path).made() == {"mosaic.kmz", "mosaic.vrt", "work/more"}
    with RunFolder(tmp_path).writing("mosaic.kmz") as path:
        path.write_text("again")


def test_results_of_another_recipe_do_not_outlive_its_run(toys: Toys) -> None:  # noqa: F811
    """A dense surface would be measured under a mosaic of other poses. What commands made of it goes too."""
    toys.run()
    RunFolder(toys.run_folder).note(["tiles.txt"], results=True)
    for name in ("tiles.txt", "mine.txt"):
        (toys.run_folder / name).write_text("x")
    whole = toys.recipe()
    short = replace(whole, steps=whole.steps[:1])
    run(short, toys.run_folder, RunOptions(preview=True))
    assert (toys.run_folder / "total.txt").exists() and (toys.run_folder / "tiles.txt").exists()
    run(short, toys.run_folder)
    there = {p.name for p in toys.run_folder.iterdir()}
    assert there == {MARKER, "mine.txt", "run.json", "run.mcap", "work"}


def test_a_result_of_another_recipe_that_is_read_stays(toys: Toys) -> None:  # noqa: F811
    toys.run()
    given = toys.run_folder / "total.txt"
    given.write_text("5")
    whole = toys.recipe(f"toy.read.file={given}")
    run(replace(whole, steps=whole.steps[:1]), toys.run_folder)
    assert given.read_text() == "5"


def test_names_that_no_file_here_can_have_do_not_count(toys: Toys) -> None:  # noqa: F811
    toys.run()
    listed = json.loads((toys.run_folder / MARKER).read_text())
    listed["files"] += ["work/a\\b", "work/\0", ""]
    (toys.run_folder / MARKER).write_text(json.dumps(listed))
    toys.run()
    assert RunFolder(toys.run_folder).made().isdisjoint({"work/a\\b", "work/\0", ""})


def test_a_folder_whose_name_is_not_utf_8_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / os.fsdecode(b"b\xff")
    folder.mkdir()
    monkeypatch.chdir(folder)
    with pytest.raises(FileError, match="its name is not in UTF-8; rename it"):
        RunFolder.opened(Path("run"))
    assert not list(folder.iterdir())
