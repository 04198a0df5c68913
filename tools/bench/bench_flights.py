"""Every flight of a folder through `geomosaic mosaic` with its defaults, one after another.

    python -m tools.bench.bench_flights DATA [--only NAME...] [--limit-s 3600] [--workers N]
                                            [--results docs/results/flights] [--out out/bench-flights]

DATA holds a sheet NAME.yaml for each flight (`bench_flights_sheet.py` lists its keys). Each run is a process
of its own. RESULTS.json and RESULTS.md hold the newest result of each flight, with its commit: flights that
are not run keep theirs. OUT/crops.html shows twenty crops of each mosaic. Exit code 1 if a flight fails or
misses what its sheet expects; 0 where there is no DATA. The geomosaic that is run is the one that Python
imports: PYTHONPATH=TREE measures another tree.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import shlex
import shutil
import statistics
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from geomosaic.errors import GeomosaicError
from tools.bench.bench_flights_figures import figures_of, figures_of_failed
from tools.bench.bench_flights_sheet import SheetFlight, read_flights
from tools.bench.bench_flights_table import tables
from tools.bench.bench_speed_measure import measured
from tools.bench.contact_sheet import write_page
from tools.bench.result_rows import ResultRow, RowKind, add_options, commit, write_rows
from tools.docs.results_page import FAST, FLIGHTS

PROGRAM = Path(sys.executable).with_name("geomosaic")


SCALE_WITHIN = 0.01
DISK_MOST = 1.5
ROWS = {
    "scale": RowKind(
        FLIGHTS,
        "{flight}: scale of the map over that of its GNSS positions",
        "1",
        "{scale:.3f}",
    ),
    "disk": RowKind(
        FAST,
        "real flights: run folder over the raw mosaic",
        "{most:g}",
        "{median:.2f} (median); {within} of {flights} flights within",
    ),
}


def run_flight(flight: SheetFlight, data: Path, asked: argparse.Namespace) -> dict[str, Any]:
    """Runs a flight and returns its row of the results."""
    run = asked.out / flight.name
    shutil.rmtree(run, ignore_errors=True)
    workers = [] if asked.workers is None else ["--workers", str(asked.workers)]
    words = ["mosaic", str(flight.frames), *flight.words, "--seed", str(asked.seed), *workers]
    taken = measured([PROGRAM, *words, "-o", run], asked.out / f"{flight.name}.log", most_s=asked.limit_s)
    figures = figures_of_failed(PROGRAM, run) if taken.failed else figures_of(run, flight.check_points)
    failed = _relative(taken.failed, data)
    return {
        "exit_code": None if taken.stopped else taken.code,
        "failed": failed,
        "missed": [failed] if failed else missed(flight, figures),
        "expect": dict(flight.expect),
        **figures,
        "wall_s": round(taken.wall_s, 1),
        "processor_s": round(taken.processor_s, 1),
        "peak_mb": round(taken.peak_mb),
        "command": _relative(shlex.join(["geomosaic", *words]), data),
        "known": flight.known,
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}",
        "commit": commit(),
        "seed": asked.seed,
    }


def _relative(text: str, data: Path) -> str:
    """A text whose paths count from the folder of flights."""
    return text.replace(f"{data}/", "").replace(f"{data.parent}/", "../")


def missed(flight: SheetFlight, figures: Mapping[str, Any]) -> list[str]:
    """What the sheet expects and the run does not reach; a figure that the run does not have is missed."""
    lines = []
    for key, wanted in flight.expect.items():
        found = figures.get(key)
        least = key == "tied_share"
        if found is None or (found < wanted if least else found > wanted):
            shown = "unknown" if found is None else f"{found:.3g}"
            lines.append(f"{key} {shown}, expected at {'least' if least else 'most'} {wanted:g}")
    return lines


def merge(results: Path, rows: Mapping[str, Any]) -> dict[str, Any]:
    """Writes RESULTS.json and RESULTS.md: new rows replace those of the same flights. Returns all."""
    path = results.with_suffix(".json")
    before = json.loads(path.read_text())["flights"] if path.exists() else {}
    flights = dict(sorted({**before, **rows}.items()))
    path.parent.mkdir(parents=True, exist_ok=True)
    whole = {"title": "Flights", "command": "make bench-flights DATA=folder", "flights": flights}
    path.write_text(json.dumps(whole, indent=1) + "\n")
    head = (
        "# Flights\n\n`make bench-flights DATA=folder`; machine, date, command and seed are in the JSON.\n\n"
    )
    results.with_suffix(".md").write_text(head + tables(flights))
    return flights


def disk_rows(flights: Mapping[str, Any]) -> list[ResultRow]:
    """What the run folders of all flights take; nothing where none is known."""
    found = [row["folder_over_raw"] for row in flights.values() if row.get("folder_over_raw")]
    if not found:
        return []
    within = sum(share <= DISK_MOST for share in found)
    counts = {"median": statistics.median(found), "within": within, "flights": len(found)}
    return [ROWS["disk"].row(within == len(found), most=DISK_MOST, **counts)]


def main(argv: list[str] | None = None) -> int:
    """Runs what is asked for, prints the table and merges the results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path, help="folder of sheets NAME.yaml")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="run these flights alone")
    parser.add_argument("--limit-s", type=float, default=3600.0, help="a flight that takes longer is stopped")
    parser.add_argument("--workers", type=int, help="workers of each run [its default]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--results", type=Path, default=Path("docs/results/flights"), help="without suffix")
    parser.add_argument("--out", type=Path, default=Path("out/bench-flights"), help="for the run folders")
    parser.add_argument("--before", type=Path, help="--out of an earlier bench: crops stand side by side")
    add_options(parser)
    asked = parser.parse_args(argv)
    data = asked.data.resolve()
    if not data.is_dir():
        print(f"skipped: there is no folder {asked.data}; name the folder of flights with DATA=folder")
        return 0
    try:
        flights = read_flights(data, asked.only)
    except GeomosaicError as error:
        print(error, file=sys.stderr)
        return 2
    asked.out.mkdir(parents=True, exist_ok=True)
    rows: dict[str, Any] = {}
    for flight in flights:
        if not flight.frames.is_dir():
            print(f"skipped: {flight.name}: there is no folder {flight.frames}", flush=True)
            continue
        rows[flight.name] = run_flight(flight, data, asked)
        flights_so_far = merge(asked.results, rows)
        wrong = "; ".join(rows[flight.name]["missed"])
        print(f"{flight.name}: {rows[flight.name]['wall_s']:.0f} s, {wrong or 'ok'}", flush=True)
    if not rows:
        print(f"skipped: {asked.data} has no flights to run")
        return 0
    scales = {name: row["scale_over_gnss"] for name, row in rows.items() if row.get("scale_over_gnss")}
    within = {name: abs(scale - 1.0) <= SCALE_WITHIN for name, scale in scales.items()}
    found = [ROWS["scale"].row(within[n], flight=n, scale=s) for n, s in scales.items()]
    write_rows(asked, [*found, *disk_rows(flights_so_far)], argv)
    runs = [asked.out / name for name in rows]
    write_page(asked.out / "crops.html", [r for r in runs if (r / "run.json").is_file()], asked.before)
    print("\n" + tables(rows))
    return 1 if any(row["missed"] for row in rows.values()) else 0


if __name__ == "__main__":
    raise SystemExit(main())
