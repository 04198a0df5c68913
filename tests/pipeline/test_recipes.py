"""The recipes that come with the project: one for each adjustment method, and the paper's."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from geomosaic.adjustment.methods import METHODS
from geomosaic.ccd.methods import METHODS as STRIP_METHODS
from geomosaic.errors import InputError
from geomosaic.pipeline.recipe import Recipe, load_recipe
from geomosaic.pipeline.registry import installed
from geomosaic.requests.mosaic_request import MosaicRequest
from geomosaic.requests.strips_request import STAGES as STRIP_STAGES

RECIPES = Path(__file__).parents[2] / "recipes"


def load(name: str, frames: Path, *more: str) -> Recipe:
    return load_recipe(RECIPES / f"{name}.yaml", installed(), [f"survey.read.frames={frames}", *more])


def params(recipe: Recipe, stage: str) -> dict[str, object]:
    return next(s.params.model_dump() for s in recipe.steps if s.stage.id == stage)


def test_there_is_one_recipe_for_each_method_and_the_paper() -> None:
    strips = {f"strips_{method}" for method in STRIP_METHODS}
    assert {p.stem for p in RECIPES.glob("*.yaml")} == {*METHODS, "paper", "quick_look", "roofs", *strips}


@pytest.mark.parametrize("method", STRIP_METHODS)
def test_a_strips_recipe_holds_the_method_of_its_name(method: str, tmp_path: Path) -> None:
    geometry = tmp_path / "geometry.yaml"
    recipe = load_recipe(
        RECIPES / f"strips_{method}.yaml", installed(), [f"survey.strips.geometry={geometry}"]
    )
    assert params(recipe, "ccd.offsets")["method"] == method
    assert [s.stage.id for s in recipe.steps] == [stage for stage in STRIP_STAGES if stage != "export.map"]
    assert recipe.name == "strips, " + method.replace("_", " ")


@pytest.mark.parametrize("name", [*METHODS, "paper", "quick_look", "roofs"])
def test_a_recipe_is_whole(name: str, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.jpg"), np.zeros((8, 8), np.uint8))
    recipe = load(name, tmp_path)
    recipe.check_files()
    assert recipe.description and "\n" not in recipe.description
    assert recipe.name == name.replace("_", " ")
    assert recipe.steps[0].stage.id == "survey.read"
    assert recipe.steps[-1].stage.id == "export.report"
    assert params(recipe, "survey.read")["frames"] == tmp_path


@pytest.mark.parametrize("method", METHODS)
def test_a_recipe_holds_the_method_of_its_name(method: str, tmp_path: Path) -> None:
    assert params(load(method, tmp_path), "adjustment.solve")["method"] == method


def test_the_papers_numbers(tmp_path: Path) -> None:
    recipe = load("paper", tmp_path)
    solve, placement = params(recipe, "adjustment.solve"), params(recipe, "placement.pos")
    assert (solve["method"], solve["epsilon_px"], solve["max_rounds"]) == ("error_sharing", 10.0, 12)
    assert (placement["formula"], placement["attitude"]) == ("mid_latitude", "phi_omega_kappa")
    assert (
        params(load("paper", tmp_path, "adjustment.solve.max_rounds=7"), "adjustment.solve")["max_rounds"]
        == 7
    )


def test_roofs_are_put_in_place_as_by_the_command(tmp_path: Path) -> None:
    """After the seams on the tie points' ground, before the mosaic is composed."""
    asked = MosaicRequest(frames=tmp_path, surface="auto").stages()
    stages = [step.stage.id for step in load("roofs", tmp_path).steps]
    assert set(stages) == set(asked)
    at = stages.index("mosaic.seams")
    assert stages[at + 1 : at + 5] == ["surface.dense", "surface.terrain", "mosaic.roofs", "mosaic.compose"]


def test_without_frames_a_recipe_says_what_is_missing() -> None:
    with pytest.raises(InputError, match=r"survey\.read.*frames"):
        load_recipe(RECIPES / "chain.yaml", installed())
