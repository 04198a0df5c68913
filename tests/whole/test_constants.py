"""Numbers in the maths say their unit, their reason and their source."""

import ast
import importlib
from collections.abc import Iterator, Mapping
from dataclasses import is_dataclass
from pathlib import Path

import pytest

import geomosaic
from geomosaic import constants
from geomosaic.adjustment.ground import trial_surface
from geomosaic.adjustment.solver import single_points
from geomosaic.composition import tone_solution
from geomosaic.constants import recorded, records, varied
from geomosaic.matching import affine_matching, least_squares_matching
from geomosaic.survey import plausible, strays

HOUSE = Path(geomosaic.__file__).parent
ROOMS = (
    "adjustment",
    "camera",
    "ccd",
    "composition",
    "geodesy",
    "matching",
    "placement",
    "projection",
    "quality",
    "survey",
)


def numbers(tree: ast.AST) -> Iterator[ast.AST]:
    """Numbers, other than those that choose from a sequence, say its shape, or are a table's keys."""
    if isinstance(tree, ast.Constant):
        if isinstance(tree.value, (int, float)) and not isinstance(tree.value, bool):
            yield tree
    elif isinstance(tree, ast.Dict):
        for value in tree.values:
            yield from numbers(value)
    elif not isinstance(tree, (ast.Subscript, ast.Lambda)):
        for child in ast.iter_child_nodes(tree):
            yield from numbers(child)


def of_structure(tree: ast.AST) -> bool:
    """No number by itself, but one of others, or a matrix: of zeros, ones, halves and twos alone."""
    others = any(
        isinstance(n, ast.List) or (isinstance(n, ast.Name) and n.id.isupper()) for n in ast.walk(tree)
    )
    return others and all(n.value in (0, 0.5, 1, 2) for n in numbers(tree))


def says_why(value: object) -> bool:
    inside = value.values() if isinstance(value, Mapping) else value if isinstance(value, tuple) else (value,)
    return bool(inside) and all(is_dataclass(v) and getattr(v, "reason", "") for v in inside)


def without_record(room: str) -> Iterator[str]:
    assert (HOUSE / room).is_dir(), f"there is no room {room}"
    for path in sorted((HOUSE / room).rglob("*.py")):
        name = ".".join(("geomosaic", *path.relative_to(HOUSE).with_suffix("").parts)).removesuffix(
            ".__init__"
        )
        tree = ast.parse(path.read_text())
        known = {name for name, _ in recorded(tree)}
        for line in tree.body:
            targets = (
                line.targets
                if isinstance(line, ast.Assign)
                else [line.target]
                if isinstance(line, ast.AnnAssign)
                else []
            )
            value = getattr(line, "value", None)
            if not targets or value is None or not any(numbers(value)):
                continue
            if isinstance(targets[0], ast.Name) and targets[0].id in known:
                continue
            if of_structure(value):
                continue
            if isinstance(targets[0], ast.Name) and says_why(
                vars(importlib.import_module(name))[targets[0].id]
            ):
                continue
            yield f"{path.relative_to(HOUSE)}:{line.lineno} {ast.unparse(line)[:80]}"


@pytest.mark.parametrize("room", ROOMS)
def test_each_number_has_a_record(room: str) -> None:
    missing = list(without_record(room))
    assert not missing, "\n" + "\n".join(missing)


def test_records_say_something() -> None:
    found = list(records())
    assert len(found) > 20
    for name, value, why in found:
        assert value is not None, name
        assert why.unit, name
        assert len(why.reason.split()) >= 3, f"{name}: {why.reason}"
        assert len(why.source) >= 4, f"{name}: {why.source}"


def test_a_number_without_a_record_is_found() -> None:
    assert [n.value for n in numbers(ast.parse("_FAR = 2.5"))] == [2.5]
    assert list(numbers(ast.parse("_FIRST = _ALL[0]"))) == []
    assert of_structure(ast.parse("np.array([[0, -1], [1, 0]])"))
    assert of_structure(ast.parse("_A * (1 - _B)"))
    assert not of_structure(ast.parse("np.radians(0.5)"))
    assert not of_structure(ast.parse("_A * (1 - 0.3)"))
    assert not of_structure(ast.parse("np.array([0.3, 1])"))


def test_what_nothing_real_is_beyond_has_a_reason_and_a_source() -> None:
    limits = {
        name: value
        for module in (plausible, strays)
        for name, value in vars(module).items()
        if isinstance(value, plausible.Limit)
    }
    assert len(limits) > 15
    assert not [name for name, limit in limits.items() if not (limit.unit and limit.reason and limit.source)]


def test_other_values_are_tried_by_name_wherever_the_constant_is_imported() -> None:
    usual, step_px = constants.TOGETHER, affine_matching._CONVERGED_PX
    with varied(TOGETHER=7, _PER_HEIGHT=5.0), varied("affine_matching", _CONVERGED_PX=3.0):
        assert (constants.TOGETHER, affine_matching.TOGETHER, least_squares_matching.TOGETHER) == (7, 7, 7)
        assert (trial_surface._PER_HEIGHT, affine_matching._CONVERGED_PX) == (5.0, 3.0)
    after = constants.TOGETHER, affine_matching.TOGETHER, affine_matching._CONVERGED_PX
    assert after == (usual, usual, step_px)


def test_a_constant_of_the_same_name_and_value_elsewhere_stays() -> None:
    assert single_points._ROUNDS is tone_solution._ROUNDS
    with varied("adjustment.solver.single_points", _ROUNDS=3):
        assert (single_points._ROUNDS, tone_solution._ROUNDS) == (3, 8)


def test_an_unknown_or_ambiguous_constant_is_not_varied() -> None:
    for name in ("NO_SUCH", "_CONVERGED_PX"):
        with pytest.raises(LookupError, match=name), varied(**{name: 1}):
            pass
