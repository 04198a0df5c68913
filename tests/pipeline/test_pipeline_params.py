"""Declared parameters: what is refused, and how it is said."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Literal

import pydantic
import pytest

from geomosaic.errors import InputError, UnknownNameError
from geomosaic.pipeline.params import (
    StageParams,
    check_params,
    describe_params,
    file_values,
    output_values,
    param,
)


def methods() -> list[str]:
    return ["chain", "layered"]


class P(StageParams):
    gsd_m: float | Literal["auto"] = param("auto", help="ground pixel", unit="m", ge=0.001, le=100)
    count: int = param(3, help="how many", ge=1)
    method: str = param("chain", help="manner", choices=methods)
    window: tuple[float, ...] = param((1.0,), help="sizes", unit="px", le=9)
    frames: Path = param(help="folder of frames")
    dem: Path | None = param(None, help="elevation")
    more: tuple[Path, ...] = param((), help="more files")
    loud: bool = param(False, help="say more", affects_output=False)


def check(**values: Any) -> Any:
    return check_params(P, {"frames": "/f", **values}, stage="a.b", file="r.yaml")


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({"gsd_m": 0.0}, "gsd_m = 0.0: must be a number or 'auto' in m, 0.001 to 100"),
        ({"gsd_m": "fine"}, "gsd_m = 'fine': must be a number or 'auto' in m, 0.001 to 100"),
        ({"gsd_m": float("nan")}, "gsd_m = nan: must be a number or 'auto' in m, 0.001 to 100"),
        ({"gsd_m": float("inf")}, "gsd_m = inf: must be a number or 'auto' in m, 0.001 to 100"),
        ({"count": 0}, "count = 0: must be a whole number, at least 1"),
        ({"count": 2.5}, "count = 2.5: must be a whole number, at least 1"),
        ({"method": "layerd"}, "method = 'layerd': must be one of chain, layered (did you mean 'layered'?)"),
        ({"window": [1, 10]}, "window = (1.0, 10.0): must be a list of number in px, at most 9"),
        ({"loud": "perhaps"}, "loud = 'perhaps': must be true or false"),
        ({"dem": [1]}, "dem = [1]: must be a path"),
    ],
)
def test_a_value_that_does_not_fit_is_one_line(values: dict[str, Any], line: str) -> None:
    with pytest.raises(InputError) as error:
        check(**values)
    if "window" in values:
        line = line.replace("window = (1.0, 10.0)", "window = 10.0")
    assert str(error.value) == f"r.yaml: stage a.b: {line}"


def test_missing_and_unknown_parameters_are_named() -> None:
    with pytest.raises(InputError, match=r"^r.yaml: stage a.b: frames is missing; give a path \(folder of"):
        check_params(P, {}, stage="a.b", file="r.yaml")
    with pytest.raises(
        UnknownNameError, match=r"^r.yaml: unknown parameter of stage a.b 'gsdm'; did you mean 'gsd_m'\?$"
    ):
        check(gsdm=1)


def test_values_become_what_is_declared() -> None:
    p = check(gsd_m="0.05", count="4", method="layered", window=[2, 3.5], dem="/d.tif", more=["/a", "/b"])
    assert (p.gsd_m, p.count, p.method, p.window) == (0.05, 4, "layered", (2.0, 3.5))
    assert file_values(p) == {
        "frames": Path("/f"),
        "dem": Path("/d.tif"),
        "more[0]": Path("/a"),
        "more[1]": Path("/b"),
    }
    with pytest.raises(pydantic.ValidationError):
        p.count = 5


def test_only_what_affects_the_output_enters_the_fingerprint() -> None:
    assert output_values(check(loud=True)) == output_values(check())
    assert "loud" not in output_values(check())
    assert output_values(check(count=4)) != output_values(check())


def test_description_has_all_that_a_front_end_needs() -> None:
    found = {p.name: p for p in describe_params(P)}
    gsd, frames = found["gsd_m"], found["frames"]
    assert (gsd.type, gsd.unit, gsd.default, gsd.ge, gsd.le) == ("number or 'auto'", "m", "auto", 0.001, 100)
    assert (gsd.required, gsd.is_file, gsd.help) == (False, False, "ground pixel")
    assert (frames.required, frames.is_file, frames.type) == (True, True, "path")
    assert found["method"].choices == ("chain", "layered")
    assert not found["loud"].affects_output


def test_a_former_name_of_a_parameter_is_accepted() -> None:
    class Renamed(StageParams):
        FORMERLY: ClassVar[dict[str, str]] = {"number": "count"}
        count: int = param(3, help="how many", ge=1)

    assert check_params(Renamed, {"number": 5}, stage="a.b") == Renamed(count=5)
    assert [p.name for p in describe_params(Renamed)] == ["count"]
