"""Errors name what the user typed: an option, `--set`, or an argument in Python."""

from __future__ import annotations

import inspect
import re
from typing import Any

import pytest

import geomosaic
from geomosaic.errors import InputError
from geomosaic.requests.mosaic_request import MosaicRequest
from geomosaic.requests.naming import in_python, named_as_options, named_as_typed
from geomosaic.requests.recipe_request import RecipeRequest
from geomosaic.requests.replay_request import ReplayRequest

FAULT = "stage mosaic.seams: gsd_m = 'fine': must be a number or 'auto' in m"


def typed(request: type[Any], problem: str, fix: str = "", **given: Any) -> str:
    with pytest.raises(InputError) as caught, named_as_typed(request, given):
        raise InputError(problem, file="r.yaml", fix=fix or None)
    assert str(caught.value).endswith(caught.value.fix or "")
    return str(caught.value).removeprefix("r.yaml: ")


def test_a_value_is_named_by_the_option_that_gave_it() -> None:
    assert typed(MosaicRequest, FAULT, gsd="fine") == "--gsd 'fine': must be a number or 'auto' in m"
    by_set = typed(RecipeRequest, FAULT, set=["mosaic.seams.gsd_m=fine"])
    assert by_set == "--set mosaic.seams.gsd_m='fine': must be a number or 'auto' in m"
    assert typed(RecipeRequest, FAULT) == FAULT  # it stands in the recipe's file


@pytest.mark.parametrize(
    ("fix", "mosaic", "run"),
    [
        (
            "give --pos with heights",
            "give --pos with heights",
            "give --set survey.read.pos=FILE with heights",
        ),
        (
            "add --radiometry reflectance",
            "add --radiometry reflectance",
            "add --set survey.read.radiometry=reflectance",
        ),
        ("or add --gcp-optional", "or add --gcp-optional", "or add --set survey.read.gcp_optional=true"),
        (
            "give --dem-offset METRES",
            "give --dem-offset METRES",
            "give --set survey.read.dem_offset_m=METRES",
        ),
        ("use --set survey.read.dem=PATH", "use --dem PATH", "use --set survey.read.dem=PATH"),
        ("use --set matching.sift.keypoints=9", "use --set matching.sift.keypoints=9", ""),
        ("--keep-strays uses them", "--keep-strays uses them", "--set survey.read.leave_out=none uses them"),
        ("choose another folder with -o", "choose another folder with -o", ""),
        ("make it with gdalwarp --config A B", "make it with gdalwarp --config A B", ""),
    ],
)
def test_a_fix_is_named_as_the_command_takes_it(fix: str, mosaic: str, run: str) -> None:
    assert typed(MosaicRequest, "x", fix) == f"x; {mosaic}"
    assert typed(RecipeRequest, "x", fix) == typed(ReplayRequest, "x", fix) == f"x; {run or mosaic}"


def test_a_command_of_one_stage_names_its_own_options() -> None:
    with (
        pytest.raises(InputError, match=r"^--heights 'x': must be a text$"),
        named_as_options("export.surface"),
    ):
        raise InputError("stage export.surface: heights = 'x': must be a text")
    with (
        pytest.raises(InputError, match="; write --heights ellipsoidal, or"),
        named_as_options("export.surface"),
    ):
        raise InputError("no geoid", fix="write --set export.surface.heights=ellipsoidal, or install it")
    reference = {"reference": "--surface-reference"}
    with (
        pytest.raises(InputError, match="--surface-reference PATH"),
        named_as_options("quality.surface", reference),
    ):
        raise InputError("no such file", fix="give an existing one with --set quality.surface.reference=PATH")


@pytest.mark.parametrize(
    ("text", "typed"),
    [
        ("width_px is -3; give 0 or more", "--width-px is -3; give 0 or more"),
        ("lost: '0' names no frames of 1 to 12", "--lost: '0' names no frames of 1 to 12"),
        (
            "more duplicates than frames; give fewer duplicates",
            "more duplicates than frames; give fewer duplicates",
        ),
    ],
)
def test_bare_parameters_are_options_of_a_command_of_one_stage(text: str, typed: str) -> None:
    with pytest.raises(InputError) as caught, named_as_options("simulate.frames"):
        raise InputError(text)
    assert str(caught.value) == typed


@pytest.mark.parametrize(
    ("text", "python"),
    [
        ("give --pos-crs, such as EPSG:32737", "give pos_crs, such as EPSG:32737"),
        ("add --surface dense", "add surface='dense'"),
        ("with --pos heights", "with pos heights"),
        ("give --dem-offset METRES, or install it", "give dem_offset=METRES, or install it"),
        ("use --set survey.read.dem=PATH", "use dem=PATH"),
        ("use --set survey.read.leave_out=none", "use set={'survey.read.leave_out': 'none'}"),
        ("--keep-strays uses them", "keep_strays uses them"),
        ("choose another folder with -o", "choose another folder with output"),
        ("pyproj sync --file us_nga_egm96_15.tif", "pyproj sync --file us_nga_egm96_15.tif"),
        (FAULT, "gsd = 'fine': must be a number or 'auto' in m"),
    ],
)
def test_python_names_arguments(text: str, python: str) -> None:
    assert in_python(text, MosaicRequest) == python


def test_help_in_python_names_arguments() -> None:
    """Not options of the command line, whose help has the same text."""
    for function in (geomosaic.mosaic, geomosaic.strips, geomosaic.run, geomosaic.replay):
        said = inspect.getdoc(function) or ""
        assert not re.findall(r"(?<![\w-])--[a-z][a-z-]*", said), function
    assert "in the pos file, and in a gcp file" in (inspect.getdoc(geomosaic.mosaic) or "")
