"""A recipe is checked as a whole, and each fault is one line that names file and fix."""

from __future__ import annotations

from pathlib import Path

import pytest
from pipeline_toy import RECIPE, recipe_file, registry

from geomosaic.errors import FileError, InputError
from geomosaic.pipeline.recipe import _FIX, load_recipe, parse_recipe

READ = "stages: [{stage: toy.read, params: {file: numbers.txt}}"


def fault(text: str, *overrides: str) -> str:
    with pytest.raises(InputError) as error:
        parse_recipe(text, registry(), overrides, file="r.yaml").check_files()
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("stages: [toy.reed]", "r.yaml: unknown stage 'toy.reed'; did you mean 'toy.read'?"),
        ("seeds: 1\nstages: [toy.read]", "r.yaml: unknown key 'seeds'; did you mean 'seed'?"),
        ("seed: -1\nstages: [toy.read]", "r.yaml: seed = -1: must be a whole number from 0"),
        ("seed: true\nstages: [toy.read]", "r.yaml: seed = True: must be a whole number from 0"),
        (
            "name: x",
            f"r.yaml: has no list 'stages'; {_FIX}",
        ),
        (
            "stages: []",
            f"r.yaml: has no list 'stages'; {_FIX}",
        ),
        (
            "just text",
            f"r.yaml: has no list 'stages'; {_FIX}",
        ),
        ("stages: [3]", "r.yaml: stage number 1 has no name; write '- stage: ID'"),
        (
            "stages: [{stage: toy.read, parms: {}}]",
            "r.yaml: unknown key of stage toy.read 'parms'; did you mean 'params'?",
        ),
        (
            "stages: [{stage: toy.read, params: 3}]",
            "r.yaml: stage toy.read: params is no mapping; write 'key: value'",
        ),
        ("stages: [toy.read]", "r.yaml: stage toy.read: file is missing; give a path (numbers, one a line)"),
        (
            f"{READ}, {{stage: toy.power, params: {{power: 10}}}}]",
            "r.yaml: stage toy.power: power = 10: must be a whole number, 1 to 9",
        ),
        (
            f"{READ}, {{stage: toy.power, params: {{powr: 2}}}}]",
            "r.yaml: unknown parameter of stage toy.power 'powr'; did you mean 'power'?",
        ),
        (
            f"{READ}, {{stage: toy.power, params: {{step_m: 0}}}}]",
            "r.yaml: stage toy.power: step_m = 0.0: must be a number or 'auto' in m, at least 0.01",
        ),
        (
            "stages: [toy.power]",
            "r.yaml: stage toy.power needs 'numbers', which no earlier stage gives; "
            "add a stage that gives 'numbers' before it",
        ),
        (
            f"{READ}, toy.write, toy.sum]",
            "r.yaml: stage toy.write needs 'total', which no earlier stage gives; move toy.sum before it",
        ),
        (
            "stages: [a\nb: {",
            "r.yaml: is no valid YAML in line 2: expected ',' or ']', but got ':'; correct it",
        ),
        (
            "seed: 1\nseed: 2",
            "r.yaml: is no valid YAML in line 2: 'seed' is given twice; correct it",
        ),
        ("stages: !!python/object/apply:os.getcwd []", None),
    ],
)
def test_a_fault_is_one_line(text: str, line: str | None) -> None:
    found = fault(text)
    assert found == line if line else "tags (!) aren't read" in found


def test_a_type_that_does_not_fit_is_found_before_anything_runs(tmp_path: Path) -> None:
    class Other:
        pass

    wrong = registry()
    power = wrong.get("toy.power")
    wrong._stages["toy.power"] = type("Odd", (power,), {"outputs": {"numbers": Other}})
    with pytest.raises(InputError, match=r"toy\.sum wants 'numbers' as Numbers, but toy.power gives Other"):
        load_recipe(recipe_file(tmp_path), wrong)


def test_a_name_is_given_once_unless_its_stage_takes_it() -> None:
    """toy.power takes the numbers and gives others of the name; a second reader would hide the first one's."""
    read = "{stage: toy.read, params: {file: numbers.txt}}"
    parse_recipe(f"stages: [{read}, toy.power]", registry())
    words = r"toy\.read gives 'numbers', which toy\.read has given and it doesn't take; leave one of them out"
    with pytest.raises(InputError, match=words):
        parse_recipe(f"stages: [{read}, {read}]", registry())


def test_overrides_win_and_are_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = recipe_file(tmp_path / "recipes")
    monkeypatch.chdir(tmp_path)
    tmp_path.joinpath("2024").write_text("5")
    sets = ["toy.power.power=3", "toy.power.step_m=1e-1", "toy.read.file=2024", "toy.read.loud=yes"]
    recipe = load_recipe(path, registry(), sets)
    read, power = recipe.steps[0].params, recipe.steps[1].params
    assert read.model_dump() == {"file": tmp_path / "2024", "offset_m": 0.0, "loud": True}
    assert power.model_dump() == {"power": 3, "name": "plain", "step_m": 0.1, "delay_s": 0.0}
    assert load_recipe(path, registry()).steps[0].params.file == tmp_path / "recipes" / "numbers.txt"


@pytest.mark.parametrize(
    "name", ["2024-05-01", "a: b", "#5", "yes", "[x]", "@x", "null", "~nobody-here/x", "x #y"]
)
def test_a_file_may_have_any_name(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever YAML would make of it."""
    path = recipe_file(tmp_path / "recipes")
    monkeypatch.chdir(tmp_path)
    recipe = load_recipe(path, registry(), [f"toy.read.file={name}"])
    assert recipe.steps[0].params.model_dump()["file"] == tmp_path / name


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("toy.power", "--set toy.power: not understood; write --set stage.id.parameter=value"),
        ("power=3", "--set power=3: not understood; write --set stage.id.parameter=value"),
        (
            "toy.pwer.power=3",
            "--set toy.pwer.power=3: unknown stage of this recipe 'toy.pwer'; did you mean 'toy.power'?",
        ),
        (
            "toy.power.pow=3",
            "--set toy.power.pow=3: unknown parameter of stage toy.power 'pow'; did you mean 'power'?",
        ),
        ("toy.power.power=0", "r.yaml: stage toy.power: power = 0: must be a whole number, 1 to 9"),
        ("toy.power.power=[1", None),
    ],
)
def test_a_wrong_override_is_one_line(override: str, line: str | None) -> None:
    found = fault(RECIPE, override)
    assert (
        found == line if line else found.startswith("--set toy.power.power=[1: is no valid YAML in line 1: ")
    )


def test_files_must_exist(tmp_path: Path) -> None:
    recipe = load_recipe(recipe_file(tmp_path), registry(), ["toy.read.file=/no/such"])
    with pytest.raises(FileError) as error:
        recipe.check_files()
    assert (
        str(error.value)
        == "/no/such: no such file or folder; give an existing one with --set toy.read.file=PATH"
    )
    recipe.check_files(skip=[0])


def test_a_recipe_says_itself_again(tmp_path: Path) -> None:
    recipe = load_recipe(recipe_file(tmp_path), registry(), ["toy.power.power=4"])
    again = parse_recipe(recipe.yaml(), registry())
    assert again.plain() == recipe.plain() and again.seed == 5
    assert recipe.plain()["stages"][1] == {
        "stage": "toy.power",
        "params": {"power": 4, "name": "plain", "step_m": "auto", "delay_s": 0.0},
    }


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b"a: " + b"x" * (1 << 20)])
def test_what_is_no_recipe_file_is_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "r.yaml"
    path.write_bytes(content)
    with pytest.raises(FileError):
        load_recipe(path, registry())
    with pytest.raises(FileError):
        load_recipe(tmp_path, registry())
