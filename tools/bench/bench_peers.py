"""geomosaic against other open programs on the same frames, one after the other in one go.

    python -m tools.bench.bench_peers [--frames 24 100 500] [--width-px 1336] [--shared ../shared] [--seed 1]
                                      [--out out/bench-peers] [--results docs/results/peers]

Flights: simulated ones of so many frames with positions in their tags, and 18 real frames of 9 MP
(SHARED/data/brighton_beach, left out where it is not there). Programs: geomosaic's whole run; pycolmap with
matching by position and then its incremental or its global mapper (the time of matching counts in each). The
others are pyOrthomosaic in two and three dimensions, OpenCV's Stitcher for scans and the package `stitching`.
Each has an environment of its own, made from the package index; one that cannot be had is left out with the
reason.

Time and memory are those of all processes of a program. Processor time is what two programs compare by on a
machine that others use. Errors of projection centres are against the simulated truth: root mean square of
the distance, after the best similarity in space and as they are. Real frames have no truth: there centres
are compared with geomosaic's. Mosaics are judged as `bench_speed` judges them.

Flights of a results file that are not measured now stay in it, each with its own date and command.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import json
import os
import platform
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio

from geomosaic.geodesy.local import ecef_from_geodetic
from tools.bench.bench_flights import commit
from tools.bench.bench_oracle import after_similarity_m
from tools.bench.bench_speed import (
    AS_IT_WAS,
    JUDGE_CACHE_BYTES,
    Judge,
    Made,
    SpeedFlight,
    run_ours,
    run_peer,
    simulated,
)
from tools.bench.bench_speed_measure import Taken, measured
from tools.bench.bench_speed_table import Column, Result
from tools.bench.peers.environments import UnavailableError, environment
from tools.bench.peers.peer import PEERS

Places = Mapping[str, Sequence[float]]
"""Latitude, longitude and height of the projection centre by frame."""
PYCOLMAP = "pycolmap==4.2.1"
MAPPERS = {
    "incremental": "pycolmap 4.2.1, incremental",
    "tagged_lens": "pycolmap 4.2.1, incremental, lens of the tags",
    "global": "pycolmap 4.2.1, global",
}
MAPPING = Path(__file__).parent / "peers" / "pycolmap_mapping.py"
MOST_JUDGED_WHOLE, PARTS = 100, 12
"""Mosaics of so many frames are judged whole, those of more on so many squares."""
COLUMNS = (
    Column("processor_s", "processor time, s", 1),
    Column("processor_ratio", "over geomosaic's", 2),
    Column("wall_s", "time, s", 1),
    Column("wall_ratio", "over geomosaic's", 2),
    Column("peak_mb", "memory, MB", 0),
    Column("frames_used", "frames used", 0, more=True),
    Column("centres_after_mm", "centres after similarity, mm", 1),
    Column("centres_absolute_m", "centres absolute, m", 3),
    Column("centres_apart_mm", "centres from geomosaic's after similarity, mm", 1),
    Column("after_px", "mosaic after similarity, px", 3),
    Column("jumps_px", "mosaic, jumps 99 %, px", 2),
    Column("absolute_m", "mosaic absolute, m", 2),
    Column("ssim", "mosaic, SSIM", 4, more=True),
    Column("steps_grey", "mosaic, colour steps 99 %, grey", 2),
)


def places_of(table: Path) -> Places:
    """Of a positions.csv; frames that are not in use are left out."""
    with table.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["status"] in ("tied", "placed")]
    keys = ("lat_deg", "lon_deg", "height_ellipsoidal_m")
    return {row["frame"]: [float(row[key]) for key in keys] for row in rows}


def apart_m(found: Places, reference: Places) -> tuple[float, float]:
    """Root mean square distances of the centres that both have: after the best similarity, and absolute.

    NaN of fewer than four.
    """
    names = sorted(found.keys() & reference.keys())
    if len(names) < 4:
        return np.nan, np.nan
    here, there = (_ecef_m(places, names) for places in (found, reference))
    return _rms(after_similarity_m(here, there)), _rms(here - there)


def _ecef_m(places: Places, names: Sequence[str]) -> np.ndarray[Any, np.dtype[np.float64]]:
    lat, lon, height = np.array([places[name] for name in names]).T
    return ecef_from_geodetic(lon, lat, height)


def _rms(errors: np.ndarray[Any, np.dtype[np.float64]]) -> float:
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def together(*steps: Taken) -> dict[str, float]:
    """The figures of a program that ran as several commands."""
    return {
        "wall_s": sum(step.wall_s for step in steps),
        "processor_s": sum(step.processor_s for step in steps),
        "peak_mb": max(step.peak_mb for step in steps),
    }


def run_pycolmap(
    flight: SpeedFlight, home: Path, most_s: float, most_mb: float
) -> dict[str, tuple[Result, Places]]:
    """Each mapper's figures, and the centres that it found; matched once for all."""
    out = flight.out / "pycolmap"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)

    def step(name: str) -> Taken:
        command = [python, MAPPING, name, flight.frames, out]
        return measured(
            command, flight.out / f"pycolmap-{name}.log", most_s=most_s, most_mb=most_mb, env=AS_IT_WAS
        )

    try:
        python = environment(home / "pycolmap", PYCOLMAP) / "python"
    except UnavailableError as error:
        return {title: (Result(title, failed=f"left out: {error}"), {}) for title in MAPPERS.values()}
    matched, found = step("match"), {}
    for name, title in MAPPERS.items():
        mapped = matched if matched.failed else step(name)
        steps = (matched,) if matched.failed else (matched, mapped)
        if mapped.failed:
            found[title] = Result(title, together(*steps), failed=f"no map: {mapped.failed}"), {}
            continue
        places = json.loads((out / f"{name}.json").read_text())
        found[title] = Result(title, {**together(*steps), "frames_used": len(places)}), places
    shutil.rmtree(out)
    return found


def bench(flight: SpeedFlight, home: Path, asked: argparse.Namespace) -> list[Result]:
    """Figures of all programs, geomosaic's first."""
    flight.out.mkdir(parents=True, exist_ok=True)
    for path in flight.paths:
        path.read_bytes()
    run, taken, outcome = run_ours(flight)
    used = outcome["frames"]["tied"] + outcome["frames"]["placed"]
    ours = Result("geomosaic", {**together(taken), "frames_used": used})
    ours_places = places_of(run / "positions.csv")
    most_mb = 1e3 * asked.peer_gb
    mapped = run_pycolmap(flight, home, asked.peer_s, most_mb)
    made = [Made(ours, run / "mosaic.tif")]
    made += [run_peer(flight, peer, home, asked.peer_s, most_mb) for peer in PEERS]
    parts = PARTS if len(flight.paths) > MOST_JUDGED_WHOLE else 0
    judge = Judge(flight, run, made, argparse.Namespace(parts=parts, part_px=1536, seed=asked.seed))
    results = [judge.judged(one) for one in made]
    truth = places_of(flight.ortho.with_name("positions.csv")) if flight.ortho else None
    by_name = {"geomosaic": ours_places, **{title: places for title, (_, places) in mapped.items()}}
    results[1:1] = [result for result, _ in mapped.values()]
    return [compared_to(r, results[0], centres(by_name.get(r.name, {}), ours_places, truth)) for r in results]


def centres(found: Places, ours: Places, truth: Places | None) -> dict[str, float]:
    """Errors of projection centres: against the truth, else their distance from geomosaic's."""
    if truth is not None:
        after, absolute = apart_m(found, truth)
        figures = {"centres_after_mm": 1e3 * after, "centres_absolute_m": absolute}
    else:
        figures = {} if found is ours else {"centres_apart_mm": 1e3 * apart_m(found, ours)[0]}
    return {key: value for key, value in figures.items() if np.isfinite(value)}


def compared_to(result: Result, ours: Result, more: Mapping[str, float]) -> Result:
    """With more figures, and its times over geomosaic's."""
    figures = {**result.figures, **more}
    if result is not ours and "processor_s" in figures:
        figures["processor_ratio"] = figures["processor_s"] / ours.figures["processor_s"]
        figures["wall_ratio"] = figures["wall_s"] / ours.figures["wall_s"]
    return replace(result, figures=figures)


def table(results: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line a program; columns that none has are left out."""
    columns = [c for c in COLUMNS if any(c.key in r["figures"] for r in results)]
    lines = [f"| program | {' | '.join(c.title for c in columns)} | |", "|---" * (len(columns) + 2) + "|"]
    for r in results:
        cells = [f"{r['figures'][c.key]:.{c.digits}f}" if c.key in r["figures"] else "" for c in columns]
        lines.append(f"| {r['name']} | {' | '.join(cells)} | {r['failed'].replace('|', '/')} |")
    return lines


def save(results: Path, flights: Mapping[str, Any]) -> None:
    """Writes RESULTS.json and RESULTS.md: new flights replace those of the same name."""
    path = results.with_suffix(".json")
    whole = json.loads(path.read_text()) if path.exists() else {}
    whole = {
        "title": "Other programs",
        "command": "make bench-peers",
        "flights": {**whole.get("flights", {}), **flights},
    }
    whole["date"] = max(flight["date"] for flight in whole["flights"].values())
    path.write_text(json.dumps(whole, indent=1) + "\n")
    lines = ["# Other programs on the same frames", "", "`make bench-peers`"]
    for name, flight in whole["flights"].items():
        facts = (flight["date"], flight["machine"], f"commit {flight['commit']}", f"`{flight['command']}`")
        lines += ["", f"## {name}", "", ", ".join(facts) + ".", "", *table(flight["programs"])]
    results.with_suffix(".md").write_text("\n".join(lines) + "\n")


def main() -> int:
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--frames", type=int, nargs="*", default=[24, 100], help="of simulated flights")
    ask.add_argument("--width-px", type=int, default=1336, help="of their frames, which are 4 : 3")
    ask.add_argument("--shared", type=Path, help="folder with data/brighton_beach; without it no real flight")
    ask.add_argument("--seed", type=int, default=1)
    ask.add_argument("--out", type=Path, default=Path("out/bench-peers"))
    ask.add_argument("--results", type=Path, help="without suffix, such as docs/results/peers")
    ask.add_argument("--peer-s", type=float, default=7200.0, help="a peer is stopped after so many seconds")
    ask.add_argument("--peer-gb", type=float, default=16.0, help="or if it holds so much")
    asked = ask.parse_args()
    out = asked.out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    size = f"{asked.width_px} x {asked.width_px * 3 // 4} px"
    flights = [
        replace(simulated(out, n, asked.width_px, asked.seed), name=f"{n} simulated frames of {size}")
        for n in asked.frames
    ]
    if asked.shared:
        real = asked.shared.absolute() / "data" / "brighton_beach" / "images"
        if real.is_dir():
            flights.append(SpeedFlight("18 frames of brighton_beach", real, out / "brighton_beach"))
        else:
            print(f"the real flight is left out: there is no {real}", file=sys.stderr)
    for flight in flights:
        with rasterio.Env(GDAL_CACHEMAX=JUDGE_CACHE_BYTES):
            found = [vars(result) for result in bench(flight, out / "peers", asked)]
        print(f"\n**{flight.name}**\n", *table(found), sep="\n", flush=True)
        machine = f"{os.cpu_count()} cores of a shared machine, {platform.machine()}"
        given = f"--frames {len(flight.paths)} --width-px {asked.width_px} --seed {asked.seed}"
        given = given if flight.ortho else "--frames --shared ../shared"
        entry = {
            "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
            "machine": machine,
            "load": round(os.getloadavg()[2], 1),
            "commit": commit(),
            "command": f"python -m tools.bench.bench_peers {given}",
            "programs": found,
        }
        if asked.results:
            save(asked.results, {flight.name: entry})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
