"""A short part of the standing trial `make fuzz`, and what its instruments see."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from random import Random

import pytest

from tools.fuzz.fuzz_formats import tiff_tags
from tools.fuzz.fuzz_mutations import Nasty, a_table, some_bytes, some_text
from tools.fuzz.fuzz_trees import a_json, a_yaml, an_xml
from tools.fuzz.fuzz_verdict import Result, difference
from tools.trials.trial_box import changes, snapshot, waited_s

ROOT = Path(__file__).parents[2]
CASES = 18


@pytest.mark.proof
def test_spoiled_files_are_refused_or_read_and_nothing_else_happens(tmp_path: Path) -> None:
    """A case of each kind or two, each in a process of its own, through the real commands."""
    words = ["--cases", str(CASES), "--seed", "8", "--out", str(tmp_path / "fuzz")]
    done = subprocess.run(
        [sys.executable, "-m", "tools.fuzz", *words],
        cwd=ROOT, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    reported = json.loads((tmp_path / "fuzz" / "fuzz.json").read_text())
    assert done.returncode == 0, done.stdout + done.stderr
    assert reported["cases"] >= CASES - 3
    whole = reported["table"][-1]
    assert whole["kind"] == "all"
    assert whole["accepted"] > 1
    assert whole["refused"] > 1


def test_a_seed_makes_the_same_case_again(tmp_path: Path) -> None:
    tables = {
        a_table: b"frame,lon,lat\na.jpg,11.5,48.25\nb.jpg,11.75,48.5\n",
        some_text: b"frame 1 2 3\n",
        some_bytes: bytes(range(256)),
        a_json: b'{"a": [1, 2.5, {"b": "c"}]}',
        a_yaml: b"a: [1, 2.5]\nb: {c: d}\n",
        an_xml: b"<a><b c='1'>2</b></a>",
        tiff_tags: b"II*\0\x08\0\0\0\x01\0\x00\x01\x03\0\x01\0\0\0\x07\0\0\0\0\0\0\0",
    }
    nasty = Nasty(tmp_path, 9)
    for mutate, data in tables.items():
        once = [mutate(data, Random(f"seed {i}"), nasty) for i in range(200)]
        assert once == [mutate(data, Random(f"seed {i}"), nasty) for i in range(200)]
        assert len({spoiled for spoiled, _ in once}) > 40


def test_what_changes_around_a_case_is_seen(tmp_path: Path) -> None:
    kept, gone, touched, linked = (tmp_path / name for name in ("kept", "gone", "touched", "linked"))
    for path in (kept, gone, touched):
        path.write_bytes(b"as it was")
    linked.symlink_to(kept)
    before = snapshot(tmp_path)
    gone.unlink()
    os.utime(touched, ns=(1, 1))
    linked.unlink()
    linked.write_bytes(b"as it was")
    (tmp_path / "new").mkdir()
    assert changes(before, snapshot(tmp_path)) == [
        "gone: gone", "linked: changed", "new: new", "touched: changed",
    ]  # fmt: skip


def test_differences_are_graded() -> None:
    frame = "survey.frames[0].position."
    base = Result(
        {f"{frame}lon_deg": 11.3, f"{frame}height_ellipsoidal_m": 565.6, "survey.frames.count": 4.0}
    )
    warning = frozenset({("height-doubtful", "a.jpg", "far off")})

    def graded(**numbers: float) -> str:
        names = {
            "lon": f"{frame}lon_deg",
            "height": f"{frame}height_ellipsoidal_m",
            "count": "survey.frames.count",
        }
        found = {**base.numbers, **{names[k]: v for k, v in numbers.items()}}
        return difference(base, Result(found), "survey").grade

    assert graded() == "same"
    assert graded(lon=11.301) == "small"
    assert graded(lon=12.3) == graded(height=56.56) == "gross"
    assert (
        difference(base, Result({**base.numbers, f"{frame}lon_deg": 12.3}, warning), "survey").grade
        == "warned"
    )
    assert difference(base, Result({**base.numbers, f"{frame}lon_deg": 11.301}), "same").grade == "gross"


def test_time_in_which_others_had_the_processor_does_not_count() -> None:
    """Two that compute for 0.4 s each on one core take 0.8 s; one of them waited for half of it."""
    core = min(os.sched_getaffinity(0))
    busy = f"import os, time; os.sched_setaffinity(0, [{core}])\nwhile time.process_time() < 0.4: pass"
    started = time.monotonic()
    both = [subprocess.Popen([sys.executable, "-S", "-c", busy]) for _ in range(2)]
    own_s = []
    for one in both:
        os.waitid(os.P_PID, one.pid, os.WEXITED | os.WNOWAIT)
        own_s.append(time.monotonic() - started - waited_s(one.pid))
        assert one.wait() == 0
    assert time.monotonic() - started > 0.75
    assert min(own_s) < 0.65, "others' time counts"
