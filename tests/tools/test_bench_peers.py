"""What the bench of other programs makes of its figures, and its rows in the results."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from geomosaic.geodesy.local import LocalFrame
from tools.bench.bench_peers import apart_m, centres, compared_to, save, table, together
from tools.bench.bench_speed_measure import Taken
from tools.bench.bench_speed_table import Result
from tools.docs.results_page import all_rows

AT = LocalFrame(11.3, 48.1, 600.0)
ENU_M = np.random.default_rng(3).normal(0.0, 50.0, (12, 3))


def places(enu_m: np.ndarray) -> dict[str, list[float]]:
    found = AT.geodetic_from_enu(enu_m)
    return {f"F{i:02d}.jpg": [lat, lon, height] for i, (lon, lat, height) in enumerate(found.tolist())}


def test_centres_are_compared_as_they_are_and_after_a_similarity() -> None:
    moved = places(1.01 * ENU_M @ [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]] + [3.0, 4.0, 0.0])
    after, absolute = apart_m(moved, places(ENU_M))
    assert after < 1e-6 < 10.0 < absolute
    shifted = places(ENU_M + [3.0, 4.0, 0.0])
    assert apart_m(shifted, places(ENU_M)) == pytest.approx((0.0, 5.0), abs=1e-6)
    assert np.isnan(apart_m({}, moved)).all()


def test_without_a_truth_centres_are_compared_with_geomosaic_s() -> None:
    ours, theirs = places(ENU_M), places(ENU_M + 1e-3 * np.eye(12, 3))
    assert centres(ours, ours, None) == {}
    assert 0.0 < centres(theirs, ours, None)["centres_apart_mm"] < 1.0
    assert set(centres(theirs, ours, ours)) == {"centres_after_mm", "centres_absolute_m"}


def test_a_program_of_several_commands_takes_the_sum_of_times_and_the_most_memory() -> None:
    steps = [Taken(2.0, 3.0, 100.0, 0, "", ""), Taken(5.0, 4.0, 80.0, 0, "", "")]
    assert together(*steps) == {"wall_s": 7.0, "processor_s": 7.0, "peak_mb": 100.0}


def test_results_keep_the_flights_that_are_not_measured_and_give_rows(tmp_path: Path) -> None:
    ours = Result("geomosaic", {"processor_s": 10.0, "wall_s": 5.0, "centres_after_mm": 2.0})
    slow = Result("slow", {"processor_s": 40.0, "wall_s": 25.0, "centres_after_mm": 3.0})
    absent = Result("absent", failed="left out: no network | no index")
    programs = [vars(compared_to(result, ours, {})) for result in (ours, slow, absent)]
    assert programs[1]["figures"]["processor_ratio"] == 4.0
    entry = {"machine": "2 cores", "commit": "0", "command": "bench", "programs": programs}
    for name, date in (("first", "2026-01-01"), ("second", "2026-01-02"), ("first", "2026-01-03")):
        save(tmp_path / "peers", {name: {**entry, "date": date}})
    kept = json.loads((tmp_path / "peers.json").read_text())["flights"]
    assert {name: flight["date"] for name, flight in kept.items()} == {
        "first": "2026-01-03",
        "second": "2026-01-02",
    }
    assert table(programs)[-1].endswith("| left out: no network / no index |")
    rows = [row for row in all_rows(tmp_path) if "first" in row.what]
    assert [row.met for row in rows] == [True, None]
    assert rows[0].value == "40 s, 3 mm"
