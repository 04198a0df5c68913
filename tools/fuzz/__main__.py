"""Spoils files of every kind and gives them to geomosaic: nothing may fall, hang, grow or reach out.

Each case is made of the seed, its kind and its number alone: `--seed S --only KIND --case I` makes it again.
Failures stay in OUT/failures with their input and command; OUT/fuzz.json and OUT/fuzz.md hold the counts, of
what was done where Ctrl-C ended it.
"""

from __future__ import annotations

import argparse
import gc
import importlib.util
import os
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"
sys.dont_write_bytecode = True  # a case may write nothing but its results

from tools.bench.result_rows import add_options, write_rows
from tools.fuzz.fuzz_kinds import KINDS
from tools.fuzz.fuzz_rows import result_row
from tools.fuzz.fuzz_trials import Case, Trials
from tools.trials.trial_tables import write_tables

COLUMNS = (
    *(
        "accepted",
        "refused",
        "exit 1",
        "traceback",
        "fault",
        "crash",
        "hang",
        "memory",
        "changed outside",
    ),
    *("connection", "program", "exit code", "not one line", "half-written", "people's bytes shown"),
    *("differs, warned", "differs, small", "differs, gross", "stray lines"),
)
FAILURES = set(COLUMNS[3:15])
REPORT_EVERY = 500
"""Cases after which a line says how far it is."""


def plan(cases: int, only: str | None) -> list[tuple[str, int]]:
    """(kind, number) of all cases, the kinds mixed evenly."""
    kinds = [k for k in KINDS.values() if only in (None, k.name)]
    weights = sum(k.weight for k in kinds)
    counts = {k.name: max(1, round(cases * k.weight / weights)) for k in kinds}
    mixed = [((i + 0.5) / n, name, i) for name, n in counts.items() for i in range(n)]
    return [(name, i) for _, name, i in sorted(mixed)]


def columns_of(case: Case) -> Iterator[str]:
    """The columns of the table a case counts in."""
    if not case.problems:
        yield {0: "accepted", 1: "exit 1", 2: "refused"}.get(case.code, "exit code")
    yield from case.problems
    if case.grade in ("warned", "small", "gross"):
        yield f"differs, {case.grade}"
    if case.stray:
        yield "stray lines"


def warm() -> None:
    """Imports all that commands import late, so that each child finds it there."""
    names = [
        *("geomosaic.pipeline.runner", "geomosaic.pipeline.run_results", "geomosaic.pipeline.replayed_stage"),
        *(
            "geomosaic.recording.replay.recorded_solve",
            "geomosaic.recording.replay.moved_frames",
            "geomosaic.recording.file.repair",
        ),
        *("geomosaic.recording.inspect.inspection_tables", "geomosaic.recording.inspect.difference_tables"),
        *(
            "geomosaic.recording.inspect.compare",
            "geomosaic.recording.inspect.pictures",
            "geomosaic.recording.inspect.worst",
        ),
        *("geomosaic.cli.main", "geomosaic.cli.app", "geomosaic.cli.plan", "geomosaic.cli.progress"),
        *("typer._adapters", "typer._click._textwrap", "typer._click.decorators"),
        *("scipy.ndimage", "scipy.optimize", "scipy.sparse.linalg", "scipy.spatial"),
        *("exifread", "defusedxml.ElementTree", "pydantic.type_adapter"),
        *("shellingham", "rich._emoji_codes", "encodings.cp437"),
        *(
            ("rerun", "rerun.blueprint", "geomosaic.recording.rerun.view")
            if importlib.util.find_spec("rerun")
            else ()
        ),
        *("jinja2", "osgeo.ogr", "osgeo.osr", "cv2", "shapely", "rich.progress", "platform", "uuid"),
    ]
    for name in names:
        importlib.import_module(name)
    from geomosaic.pipeline.registry import installed

    installed().all()
    gc.freeze()


def main(argv: list[str] | None = None) -> int:
    """Runs the cases; 1 if any failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--only", choices=sorted(KINDS), help="cases of this kind only")
    parser.add_argument("--case", type=int, help="this one only; its files stay in OUT/failures")
    parser.add_argument("--first", type=int, default=0, help="leave out so many: a trial that goes on")
    parser.add_argument("--minutes", type=float, help="stop after so long, wherever it stands")
    parser.add_argument("--out", type=Path, default=Path("out/fuzz"))
    add_options(parser)
    asked = parser.parse_args(argv)
    if asked.case is not None and asked.only is None:
        parser.error("--case needs --only KIND")
    warnings.simplefilter("ignore")  # of rasterio, in this process alone: spoiled images have no map
    warm()
    out: Path = asked.out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    cases: list[Case] = []
    with tempfile.TemporaryDirectory(prefix="geomosaic-fuzz-") as folder:
        trials = Trials(asked.seed, Path(folder), out)
        started = time.monotonic()
        trials.prepare()
        todo = (
            plan(asked.cases, asked.only)[asked.first :] if asked.case is None else [(asked.only, asked.case)]
        )
        with suppress(KeyboardInterrupt):
            for name, number in todo:
                case = trials.case(KINDS[name], number)
                cases.append(case)
                failed = FAILURES & set(case.problems)
                if failed or case.grade == "gross" or asked.case is not None:
                    trials.keep(case)
                    what = ", ".join((*case.problems, case.grade))
                    print(f"{case.kind} {case.number}: {what}: {case.done[:90]}", flush=True)
                if len(cases) % REPORT_EVERY == 0:
                    print(
                        f"{len(cases)} of {len(todo)} cases, {time.monotonic() - started:.0f} s", flush=True
                    )
                if asked.minutes is not None and time.monotonic() - started > 60 * asked.minutes:
                    break
        tell(cases, asked.seed, out, time.monotonic() - started, trials.box.closed)
    failed = sum(bool(FAILURES & set(case.problems)) for case in cases)
    row = result_row(asked.only, failed, len(cases)) if asked.case is None else None
    write_rows(asked, [row] if row else [], argv)
    return int(failed > 0)


def tell(cases: list[Case], seed: int, out: Path, seconds: float, closed: bool) -> None:
    """Counts by kind, and the failures by where they were raised."""
    counts: dict[str, Counter[str]] = {}
    for case in cases:
        for name in (case.kind, "all"):
            counts.setdefault(name, Counter())["cases"] += 1
            counts[name].update(columns_of(case))
    rows = [
        {"kind": name, "cases": counts[name]["cases"], **{c: counts[name][c] for c in COLUMNS}}
        for name in (*(k for k in KINDS if k in counts), "all")
        if name in counts
    ]
    places: dict[str, list[str]] = {}
    for case in cases:
        if FAILURES & set(case.problems) or case.grade == "gross":
            what = ", ".join((*case.problems, *([f"differs, {case.grade}"] if case.grade == "gross" else [])))
            place = case.raised if case.problems else "; ".join(case.where)
            places.setdefault(f"{case.kind}: {what}: {place[:160]}", []).append(f"{case.kind} {case.number}")
    listed = [
        f"{len(who)} x {what} (as {who[0]})" for what, who in sorted(places.items(), key=lambda p: -len(p[1]))
    ]
    facts = {
        "seed": seed, "cases": len(cases), "seconds": round(seconds),
        "network": "own" if closed else "shared",
        "worst_seconds": max((c.seconds for c in cases), default=0),
        "worst_cpu_s": max((c.cpu_s for c in cases), default=0),
        "slowest": [f"{c.kind} {c.number}: {c.cpu_s}" for c in sorted(cases, key=lambda c: -c.cpu_s)[:3]],
        "worst_peak_mb": max((c.peak_mb for c in cases), default=0),
    }  # fmt: skip
    write_tables(
        out / "fuzz",
        "Spoiled files",
        facts,
        rows,
        listed,
        [asdict(c) for c in cases if c.problems or c.grade],
    )


if __name__ == "__main__":
    sys.exit(main())
