"""Whether each fix that a verdict names changes the outcome: simulated surveys before and after it.

    python -m tools.bench.bench_fixes [--only NAME...] [--seeds N] [--seed FIRST] [--out out/bench-fixes]
                                          [--results docs/results/fixes]

Each case is a survey with one fault, mosaicked as it is and then with the fix applied. It is right if the
figure is against the map before, the verdict says what the case's fix is, and the figure is good after it.
Another lens, standing houses and short hills need no fix: their mosaics are good as they are.
Exit code 1 if a case is not right for some seed.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tools.bench.bench_flights import commit

PROGRAM = Path(sys.executable).with_name("geomosaic")
SMALL = ("--width-px", "640", "--height-px", "480", "--ground-pixel-m", "0.15")
Words = tuple[str, ...]


def _none(_: Path) -> Words:
    return ()


@dataclass(frozen=True)
class FixCase:
    """A fault and its fix.

    evidence: the figure; says: words of its fix; survey: options of the simulation; before, after: files that
    are made in the survey's folder, and the options of the mosaic that use them.
    """

    name: str
    evidence: str
    says: str
    survey: Words
    before: Callable[[Path], Words] = _none
    after: Callable[[Path], Words] = _none


def _points(folder: Path, name: str, kinds: Callable[[str], str], wrong: str = "") -> Path:
    """The survey's control points with other kinds, and one of them 5 m off to the east."""
    with (folder / "gcp.csv").open() as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        row["kind"] = kinds(row["kind"])
        if row["name"] == wrong:
            row["lon_deg"] = f"{float(row['lon_deg']) + 5.0 / 74_300.0:.10f}"
    path = folder / name
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return path


def _as_checks(*more: str) -> Callable[[Path], Words]:
    return lambda folder: ("--gcp", str(_points(folder, "checks.csv", lambda _: "check")), *more)


def _as_given(*more: str) -> Callable[[Path], Words]:
    return lambda folder: ("--gcp", str(_points(folder, "points.csv", lambda kind: kind)), *more)


def _one_wrong(folder: Path) -> Words:
    return "--gcp", str(_points(folder, "wrong.csv", lambda kind: kind, wrong="GCP-02"))


def _without_frames(*names: str) -> Callable[[Path], Words]:
    def left_out(folder: Path) -> Words:
        for name in names:
            (folder / "frames" / name).unlink(missing_ok=True)
        return ()

    return left_out


CASES = (
    FixCase(
        "GNSS off in common, 10 cm asked for",
        "absolute accuracy",
        "as control points",
        (*SMALL, "--lines", "3", "--frames-per-line", "5", "--control-points", "28", "--position-bias-m", "2",
         "--position-sd-m", "0.3"),
        _as_checks("--accuracy", "10cm"),
        _as_given("--accuracy", "10cm"),
    ),
    FixCase(
        "no control, 20 cm asked for",
        "absolute accuracy",
        "control points (--gcp)",
        (*SMALL, "--lines", "3", "--frames-per-line", "5", "--control-points", "12"),
        lambda _: ("--accuracy", "20cm"),
        _as_given("--accuracy", "20cm"),
    ),
    FixCase(
        "distances to 1 per mille asked for",
        "relative accuracy",
        "control points (--gcp)",
        (*SMALL, "--lines", "2", "--frames-per-line", "5", "--control-points", "12"),
        lambda _: ("--accuracy-relative", "1"),
        _as_given("--accuracy-relative", "1"),
    ),
    FixCase(
        "positions 40 m off in common, RTK check points",
        "check points",
        "as control points",
        (*SMALL, "--lines", "3", "--frames-per-line", "5", "--control-points", "12",
         "--position-bias-m", "40"),
        _as_checks(),
        _as_given(),
    ),
    FixCase(
        "one control point 5 m off",
        "blunders",
        "check the coordinates",
        (*SMALL, "--lines", "3", "--frames-per-line", "5", "--control-points", "12"),
        _one_wrong,
        _as_given(),
    ),
    FixCase(
        "steep hills beyond the last tie points",
        "rim",
        "elevation model (--dem)",
        (*SMALL, "--lines", "1", "--frames-per-line", "3", "--relief-m", "60",
         "--relief-wavelength-m", "80"),
        lambda _: ("--edges", "keep", "--accuracy-relative", "1"),
        lambda folder: ("--edges", "keep", "--accuracy-relative", "1", "--dem",
                        str(folder / "truth" / "dem.tif")),
    ),
    FixCase(
        "a frame that overlaps no other",
        "frames not tied",
        "leave them out",
        (*SMALL, "--lines", "1", "--frames-per-line", "9", "--lost", "6-8"),
        _none,
        _without_frames("F0009.jpg"),
    ),
)  # fmt: skip


def run_case(case: FixCase, seed: int, out: Path) -> dict[str, Any]:
    """Both runs of a case, and what their verdicts say of its figure."""
    folder = out / f"{case.name.replace(' ', '_').replace(',', '')}-{seed}"
    shutil.rmtree(folder, ignore_errors=True)
    _call("simulate", "frames", str(folder), *case.survey, "--seed", str(seed), "--pos-in", "exif", "-q")
    row: dict[str, Any] = {"case": case.name, "seed": seed, "evidence": case.evidence}
    for when, options in (("before", case.before), ("after", case.after)):
        run = folder / when
        _call("mosaic", str(folder / "frames"), *options(folder), "-o", str(run), "-q")
        verdict = json.loads((run / "run.json").read_text())["verdict"]
        found = next((e for e in verdict["evidence"] if e["name"] == case.evidence), None)
        row[when] = None if found is None else found["value"]
        row[f"{when}_grade"] = "good" if found is None else found["grade"]
        row[f"{when}_verdict"] = verdict["grade"]
        if when == "before":
            row["fix"] = "" if found is None else found["fix"]
    row["right"] = (
        row["before_grade"] in ("doubtful", "bad")
        and case.says in row["fix"]
        and row["after_grade"] in ("good", "noted")
    )
    return row


def _call(*words: str) -> None:
    done = subprocess.run([str(PROGRAM), *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(words)}: {done.stderr.strip()[-300:]}")


def table(rows: list[dict[str, Any]]) -> str:
    """One line a case."""
    lines = [
        "| survey | seed | figure | before | after the fix | verdict | right |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        before, after = (
            "-" if r[k] is None else f"{r[k]:.3g} ({r[f'{k}_grade']})" for k in ("before", "after")
        )
        said = f"{r['before_verdict']}, then {r['after_verdict']}"
        cells = (r["case"], r["seed"], f"{r['evidence']}: {r['fix']}", before, after, said)
        lines.append(f"| {' | '.join(map(str, cells))} | {'yes' if r['right'] else 'no'} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="cases whose name holds it")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--seed", type=int, default=1, help="the first seed")
    parser.add_argument("--out", type=Path, default=Path("out/bench-fixes"))
    parser.add_argument("--results", type=Path, help="without suffix, such as docs/results/fixes")
    asked = parser.parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    rows = []
    for case in CASES:
        if asked.only and not any(name in case.name for name in asked.only):
            continue
        for seed in range(asked.seed, asked.seed + asked.seeds):
            rows.append(run_case(case, seed, asked.out))
            print(table(rows[-1:]).splitlines()[-1], flush=True)
    if asked.results:
        whole = {
            "title": "Fixes",
            "command": f"make bench-fixes SEED={asked.seed}",
            "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
            "machine": f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}",
            "commit": commit(),
            "rows": rows,
        }
        asked.results.with_suffix(".json").write_text(json.dumps(whole, indent=1) + "\n")
        asked.results.with_suffix(".md").write_text(f"# Fixes\n\n`{whole['command']}`\n\n{table(rows)}")
    return 0 if all(r["right"] for r in rows) else 1


if __name__ == "__main__":
    raise SystemExit(main())
