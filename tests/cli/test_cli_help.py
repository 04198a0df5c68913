"""The help: whole lines in the order of work, options under headings, a command proposed for what is none."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
import typer
from small_surveys import geomosaic

from geomosaic.cli import help as headings
from geomosaic.cli.app import build_app
from geomosaic.cli.running import _conclude
from geomosaic.cli.simulation_help import _FREQUENT, STARTS
from geomosaic.pipeline.params import describe_params
from geomosaic.pipeline.recipe import recipe_from
from geomosaic.pipeline.registry import installed

HEADINGS = {headings.INPUTS, headings.SURFACE, headings.ACCURACY, headings.OUTPUT, headings.RUNNING}
HEADED = [["mosaic"], ["watch"], ["strips"], ["run"], ["simulate", "frames"], ["simulate", "strips"]]


def page(capsys: pytest.CaptureFixture[str], *command: str) -> str:
    """A page of help at 80 columns."""
    assert geomosaic(*command) == 0
    return capsys.readouterr().out


def options_of(text: str) -> dict[str, list[str]]:
    """The long names of options on a page by their heading."""
    found: dict[str, list[str]] = {}
    heading = ""
    for line in text.splitlines():
        if line.endswith(":") and not line.startswith(" "):
            heading = line[:-1]
        elif option := re.match(r"  (?:-\w, )?(--[a-z0-9-]+)", line):
            found.setdefault(heading, []).append(option[1])
    return found


def made(*command: str) -> typer.core.TyperCommand:
    """A command as the program makes it."""
    found = typer.main.get_command(build_app([*command]))
    for name in command:
        found = found.commands[name]
    return found


@pytest.fixture(autouse=True)
def eighty_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")


def test_each_command_has_one_whole_line_in_the_order_of_work(capsys: pytest.CaptureFixture[str]) -> None:
    lines = page(capsys, "--help").splitlines()
    listed = [line.split()[0] for line in lines if re.match(r"  [a-z]", line)]
    group = typer.main.get_command(build_app())
    assert sorted(listed) == sorted(group.commands) and listed[0] == "mosaic"
    order = ("mosaic", "fetch", "inspect", "export", "doctor", "simulate")
    assert [listed.index(name) for name in order] == sorted(listed.index(name) for name in order)
    for name, command in group.commands.items():
        (line,) = (line for line in lines if line.startswith(f"  {name} "))
        text = line.removeprefix(f"  {name}").strip()
        first = " ".join(command.help.partition("\n\n")[0].split())
        assert len(line) <= 80 and text == first and text.endswith("."), name


@pytest.mark.parametrize("group", ["simulate", "export"])
def test_each_form_of_a_group_has_one_whole_line(group: str, capsys: pytest.CaptureFixture[str]) -> None:
    lines = page(capsys, group, "--help").splitlines()
    below = lines[lines.index("Commands:") + 1 : lines.index("Options:") - 1]
    commands = typer.main.get_command(build_app([group])).commands[group].commands
    assert [line.split()[0] for line in below] == [*commands]
    assert all(len(line) <= 80 and not line.endswith("...") for line in below)


@pytest.mark.parametrize("command", [*HEADED, ["evaluate"], ["replay"], ["fetch"], ["export", "stac"]])
def test_help_names_defaults_and_no_bounds_or_types_of_the_parser(
    command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    asked = "--help-all" if command in HEADED else "--help"
    text = page(capsys, *command, asked)
    assert not re.search(r"default: |[<>]=?x|x[<>]|<[a-z]", text)
    if command not in HEADED:
        assert "--help-all" not in text and [*options_of(text)] == ["Options"]
    if command == ["mosaic"]:
        assert " ".join(text.split()).count("auto is the UTM zone [auto]") == 1


@pytest.mark.parametrize("command", HEADED)
def test_each_option_stands_once_and_help_all_shows_all(
    command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    short, whole = (options_of(page(capsys, *command, asked)) for asked in ("--help", "--help-all"))
    names = [
        max(p.opts, key=len) for p in made(*command).params if p.param_type_name == "option" and not p.hidden
    ]
    assert sorted(o for below in whole.values() for o in below) == sorted([*names, "--help"])
    rare = {heading: below for heading, below in whole.items() if heading.startswith(headings.RARE)}
    assert rare and short == {heading: below for heading, below in whole.items() if heading not in rare}
    assert whole["Help"] == ["--help-all", "--help"]
    if command[0] != "simulate":
        assert whole.keys() <= HEADINGS | {headings.RARE, "Help"}


def test_help_ends_with_how_to_see_the_rare_options(capsys: pytest.CaptureFixture[str]) -> None:
    whole = options_of(page(capsys, "mosaic", "--help-all"))
    assert {"--fixed-time", "--private-places", "--align-to", "--dem-offset"} <= {*whole[headings.RARE]}
    last = page(capsys, "mosaic", "--help").splitlines()[-1]
    assert last == f"For {len(whole[headings.RARE])} rarely needed options: geomosaic mosaic --help-all"
    assert set(HEADINGS) < set(whole)


def test_commands_of_more_than_twenty_options_have_headings() -> None:
    for group in ("simulate", "export"):
        for name, command in typer.main.get_command(build_app([group])).commands[group].commands.items():
            assert [group, name] in HEADED or len(command.params) <= 20, name
    for name, command in typer.main.get_command(build_app()).commands.items():
        assert [name] in HEADED or len(command.params) <= 20, name


def test_simulations_headings_name_parameters() -> None:
    names = {id: [p.name for p in describe_params(installed().get(id).Params)] for id in STARTS}
    assert {*names} == {"simulate.frames", "simulate.strips"}
    for id, starts in STARTS.items():
        assert next(iter(starts)) == names[id][0]
        assert [*starts] == sorted(starts, key=names[id].index)
    assert {name for known in names.values() for name in known} >= _FREQUENT


def test_a_path_proposes_the_command_to_type(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a flight").mkdir()
    (tmp_path / "a flight" / "1.JPG").touch()
    (tmp_path / "recipe.yaml").touch()
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").touch()
    flight = f"mosaic '{tmp_path}/a flight'"
    for given, kind, proposed in [
        (["a flight"], "folder", flight),
        (["a flight", "--dem", "d.tif"], "folder", f"{flight} --dem d.tif"),
        (["a flight/1.JPG", "a flight/2.JPG"], "file", flight),
        (["recipe.yaml"], "file", f"run {tmp_path}/recipe.yaml"),
        (["run"], "folder", f"inspect {tmp_path}/run"),
    ]:
        path = tmp_path / given[0]
        assert geomosaic(path, *given[1:]) == 2
        said = capsys.readouterr()
        expected = f"geomosaic: {path}: is a {kind}, not a command; type: geomosaic {proposed}\n"
        assert (said.out, said.err) == ("", expected)
    assert geomosaic(tmp_path / "nowhere") == 2
    assert "nowhere: no such file or folder; check the path" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("typed", "meant"), [("mosiac", "mosaic"), ("docter", "doctor"), ("inspct", "inspect")]
)
def test_a_misspelt_command_proposes_the_nearest(
    typed: str, meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert geomosaic(typed, "frames") == 2
    said = capsys.readouterr()
    assert (said.out, said.err) == ("", f"geomosaic: unknown command '{typed}'; did you mean '{meant}'?\n")


def test_a_run_ends_with_verdict_accuracy_and_what_to_open(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from geomosaic.requests.mosaic_stages import OPTIONAL, STAGES

    steps = [{"stage": id} for id in STAGES if id not in OPTIONAL]
    steps[0]["params"] = {"frames": str(tmp_path)}
    recipe = recipe_from({"name": "mosaic", "stages": steps}, installed())
    for name in ("mosaic.tif", "report.html", "project.qgz"):
        (tmp_path / name).touch()
    verdict = {"grade": "good", "cause": "", "fix": "", "text": "6 of 6 frames tied"}
    verdict["answers"] = [["absolute accuracy", "horizontal RMSE 0.03 m"]]
    summary = {"warnings": ["w"], "metrics": {}, "frames": {"tied": 6}, "verdict": verdict}
    _conclude(recipe, tmp_path, summary)
    lines = capsys.readouterr().out.splitlines()
    assert f"mosaic     {tmp_path}/mosaic.tif" in lines[:-3]
    assert lines[-3:] == [
        "verdict    good: 6 of 6 frames tied",
        "absolute   horizontal RMSE 0.03 m",
        f"open       {tmp_path}/report.html, {tmp_path}/project.qgz",
    ]


def test_without_the_simulator_its_command_says_how_to_install_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "geomosaic_simulate", None)
    assert geomosaic("simulate", "frames", "out") == 2
    said = capsys.readouterr().err
    assert "geomosaic_simulate isn't installed" in said and "make setup" in said
    assert geomosaic("mosaic", "--help") == 0
