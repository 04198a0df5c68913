"""Constants are halved and doubled as their kind allows, and where modules use them is found."""

from __future__ import annotations

import math

import numpy as np
import pytest

from geomosaic.matching import affine_matching, turned
from geomosaic.pipeline.context import Notes
from tools.bench.bench_constants import other
from tools.bench.bench_constants_change import change
from tools.bench.bench_constants_names import homes, names_in, used_while_loading
from tools.bench.bench_constants_scenes import StageOutcome


def test_counts_stay_whole_shares_stay_below_1_and_tables_keep_their_shape() -> None:
    assert (other(1, 0.5, "frames"), other(5, 0.5, "frames"), other(5, 2.0, "frames")) == (1, 2, 10)
    assert (other(0.8, 2.0, "share"), other(0.8, 2.0, "m"), other(0.8, 0.5, "share")) == (0.9, 1.6, 0.4)
    assert other((2.0, 4), 2.0, "m") == (4.0, 8)
    assert other({"a": (1.0,)}, 0.5, "px") == {"a": (0.5,)}
    assert other(np.array([1.0, 2.0]), 2.0, "m").tolist() == [2.0, 4.0]
    for value in (True, "text", None, np.arange(3)):
        with pytest.raises(TypeError):
            other(value, 2.0, "m")


def test_where_a_constant_is_named_is_found() -> None:
    assert homes("matching.turned._MISPLACED") == [turned.__file__]
    assert "_HALF_PX" in used_while_loading(str(affine_matching.__file__))
    assert "_MISPLACED" not in used_while_loading(str(turned.__file__))
    using = {name for (name, _), names in names_in(str(turned.__file__)).items() if "_MISPLACED" in names}
    assert using == {"flown_courses_rad"}


def test_what_counts_is_a_hundredth_of_a_scatter_a_warning_or_a_failure() -> None:
    def outcome(off: float, code: str = "", failure: str = "") -> StageOutcome:
        warnings = [{"code": code, "frame": "", "text": ""}] if code else []
        return StageOutcome({"heights": np.array([-1.0, 1.0]) + off}, Notes(warnings), 0.0, failure)

    assert change(outcome(0.0), outcome(0.0), {})[0] == 0.0
    assert change(outcome(0.0), outcome(0.02), {}) == (pytest.approx(2.0), ".heights: by 0.02")
    assert change(outcome(0.0), outcome(0.0, "dark"), {}) == (math.inf, "warnings: dark")
    assert change(outcome(0.0), outcome(0.0, failure="no"), {}) == (math.inf, "no")
