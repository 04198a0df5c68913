"""How fast frames become a mosaic: against the floor of the same libraries, and against other programs.

    python -m tools.bench.bench_speed [--shared ../shared] [--out DIR] [--frames 100] [--no-peers]

Two flights: 18 real frames of 9 MP (SHARED/data/brighton_beach, left out where it isn't there), and 100
simulated ones of 12 MP, made once and kept in OUT. Nothing is given but their tags. On each flight the whole
command runs, then the floor (`bench_speed_floor`: every frame decoded and warped once, one COG written). Then
the peers run (tools/peers), each in an environment of its own, made from PyPI. What can't be had is left out
and reported. Time is of the whole process; memory of all its processes together, sampled; frames are read
once before, so that all find them in memory. Simulated mosaics are judged against the true ortho, on squares
of ground that most programs show, drawn by the seed (`bench_speed_parts`). Where there are no more squares
than asked for, the whole is judged. Of the real ones the colour steps are measured (`bench_speed_judge`).
Tables go to standard output, figures to OUT/speed.json. Exit code 1 if an aim is missed. The aims: the whole
at most 2.5 times the floor, the mosaic with its COG (seams, composition, writing) 1.3 times, 1.5 GB, and no
figure of any peer better.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

AS_IT_WAS = dict(os.environ)
"""For programs; the judge does its algebra on one core, since two wait for each other during other work."""
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import rasterio

from geomosaic.errors import GeomosaicError
from tools.bench.bench_speed_judge import FAR_M, Frames, against_truth, area_m2, placed, steps_figure
from tools.bench.bench_speed_measure import Taken, measured
from tools.bench.bench_speed_parts import parts_of
from tools.bench.bench_speed_rows import Measured, result_rows
from tools.bench.bench_speed_table import Result, against_floor, missed, side_by_side
from tools.bench.peers.environments import UnavailableError
from tools.bench.peers.peer import PEERS, Peer
from tools.bench.result_rows import ResultRow, add_options, write_rows

GEOMOSAIC = Path(sys.executable).with_name("geomosaic")
TOOLS = Path(__file__).parent
HEIGHT_M, ACROSS_M = 100.0, 100.0
"""Of simulated flights above the ground, and what a frame shows from side to side."""


JUDGE_CACHE_BYTES = 256 << 20
"""Of rasters that are judged: GDAL takes a twentieth of the memory by itself."""


@dataclass(frozen=True)
class SpeedFlight:
    """Frames that every program gets, a folder for what comes out, and the true ortho where there is one."""

    name: str
    frames: Path
    out: Path
    ortho: Path | None = None
    row_names: tuple[str, str] = ("18 real frames", "18 real frames of 9 MP")
    """Short, and with the size of a frame, as the rows of results have it."""

    @property
    def paths(self) -> list[Path]:
        """The frames."""
        return sorted(p for p in self.frames.iterdir() if p.suffix.lower() == ".jpg")


def simulated(out: Path, frames: int, width_px: int, seed: int) -> SpeedFlight:
    """A block flown at 100 m, as near to a square of lines and frames as it goes."""
    lines = max(k for k in range(1, int(frames**0.5) + 1) if frames % k == 0)
    height_px = width_px * 3 // 4
    folder = out / f"flight-{frames}-{width_px}x{height_px}-{seed}"
    if not (folder / "done").exists():
        shutil.rmtree(folder, ignore_errors=True)
        print(f"simulating {frames} frames of {width_px} x {height_px} px", file=sys.stderr)
        reported = {"lines": lines, "frames-per-line": frames // lines,
                "width-px": width_px, "height-px": height_px, "ground-pixel-m": ACROSS_M / width_px,
                "height-above-ground-m": HEIGHT_M, "k1": 0, "k2": 0,
                "pos-in": "exif", "seed": seed}  # fmt: skip
        options = [word for name, value in reported.items() for word in (f"--{name}", str(value))]
        command = [str(GEOMOSAIC), "simulate", "frames", str(folder), *options]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        (folder / "done").touch()
    short = f"{frames} simulated frames"
    name = f"{short} of {width_px * height_px / 1e6:.0f} MP"
    truth = folder / "truth" / "ortho.tif"
    return SpeedFlight(name, folder / "frames", folder / "results", truth, (short, name))


@dataclass(frozen=True)
class Made:
    """What a program took, and its mosaic, if it made one."""

    result: Result
    mosaic: Path | None = None
    georeferenced: bool = True


def run_ours(flight: SpeedFlight) -> tuple[Path, Taken, dict[str, Any]]:
    """The whole command into a new run folder."""
    run = flight.out / "run"
    shutil.rmtree(run, ignore_errors=True)
    taken = measured([GEOMOSAIC, "mosaic", flight.frames, "-o", run], flight.out / "run.log", env=AS_IT_WAS)
    if taken.failed:
        raise SystemExit(f"{flight.name}: {taken.failed}; see {flight.out / 'run.log'}")
    return run, taken, json.loads((run / "run.json").read_text())


def run_floor(flight: SpeedFlight, run: Path) -> dict[str, float]:
    """Seconds of the floor's parts."""
    out, log = flight.out / "floor.tif", flight.out / "floor.log"
    taken = measured([sys.executable, TOOLS / "bench_speed_floor.py", run, out], log, env=AS_IT_WAS)
    if taken.failed:
        raise SystemExit(f"{flight.name}, floor: {taken.failed}; see {log}")
    out.unlink()
    return dict(json.loads(taken.said.splitlines()[-1]))


def run_peer(flight: SpeedFlight, peer: Peer, home: Path, most_s: float, most_mb: float) -> Made:
    """A peer's mosaic, which stays in the flight's results; whatever else it has written goes."""
    name = "".join(c if c.isalnum() else "-" for c in peer.name)
    out, log = flight.out / name, flight.out / f"{name}.log"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    try:
        command = peer.command(flight.frames, out, home)
    except UnavailableError as error:
        return Made(Result(peer.name, failed=f"left out: {error}"))
    taken = measured(command, log, most_s=most_s, most_mb=most_mb, env=AS_IT_WAS)
    figures: dict[str, float] = {
        "wall_s": taken.wall_s,
        "processor_s": taken.processor_s,
        "peak_mb": taken.peak_mb,
    }
    if taken.failed:
        return Made(Result(peer.name, figures, failed=f"no mosaic: {taken.failed}"))
    figures["frames_used"] = peer.frames_used(out)
    for path in out.iterdir():
        if path.name != peer.mosaic:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    return Made(Result(peer.name, figures), out / peer.mosaic, peer.georeferenced)


class Judge:
    """Looks at the mosaics of one flight, of which a run is solved.

    One without a place is registered to the truth or the run's mosaic; one that doesn't register has no
    figures fit, which is as good as none.
    """

    def __init__(
        self, flight: SpeedFlight, run: Path, made: Sequence[Made], asked: argparse.Namespace
    ) -> None:
        self._flight = flight
        onto = flight.ortho or run / "mosaic.tif"
        self._registered = {
            m.result.name: m.mosaic
            if m.georeferenced
            else placed(m.mosaic, onto, m.mosaic.with_name("placed.vrt"))
            for m in made
            if m.mosaic
        }
        self._frames = None if flight.ortho else Frames(run)
        self._squares = None
        if flight.ortho and asked.parts:
            shown = [registered for registered in self._registered.values() if registered]
            self._squares = parts_of(flight.ortho, shown, asked.parts, asked.part_px, FAR_M, asked.seed)

    def words(self) -> str:
        """What is judged."""
        if self._squares is None:
            return "Judged on the whole of each mosaic."
        squares, side_m = len(self._squares.middles_m), self._squares.side_m
        return f"Judged on {squares} squares of {side_m:.1f} m that most programs show; ground shown: of all."

    def judged(self, made: Made) -> Result:
        """With the figures of its mosaic, by the keys of `bench_speed_table.COLUMNS`; unknown figures are
        left out."""
        registered = self._registered.get(made.result.name)
        if registered is None:
            return made.result
        start = time.process_time()
        try:
            found = self._figures(registered, made.georeferenced)
        except GeomosaicError as error:
            print(f"{made.result.name}: {error}", file=sys.stderr)
            return made.result
        print(f"{made.result.name}: judged in {time.process_time() - start:.0f} s", file=sys.stderr)
        return replace(made.result, figures={**made.result.figures, **found})

    def _figures(self, registered: Path, georeferenced: bool) -> dict[str, float]:
        if self._flight.ortho:
            return against_truth(
                registered, self._flight.ortho, self._flight.out, georeferenced, self._squares
            )
        assert self._frames
        return {"area_m2": area_m2(registered), "steps_grey": steps_figure(self._frames.steps(registered))}


def bench(
    flight: SpeedFlight, home: Path, asked: argparse.Namespace, results: list[ResultRow]
) -> tuple[dict[str, Any], bool]:
    """All of one flight: prints its tables, and adds its rows to results. Returns the figures, and whether
    all aims are reached."""
    flight.out.mkdir(parents=True, exist_ok=True)
    for path in flight.paths:
        path.read_bytes()
    rounds = []
    for _ in range(asked.rounds):
        run, taken, reported = run_ours(flight)
        rounds.append((taken, reported, run_floor(flight, run)))
    taken, reported, _ = min(rounds, key=lambda r: r[0].wall_s)
    floor = min((r[2] for r in rounds), key=lambda f: f["whole_s"])
    peak_mb = max(r[0].peak_mb for r in rounds)
    lines = against_floor(floor, reported["timings_s"], taken.wall_s, taken.processor_s, peak_mb)
    print(f"\n**{flight.name}**\n", *lines, sep="\n", flush=True)
    used = reported["frames"]["tied"] + reported["frames"]["placed"]
    took = {"wall_s": taken.wall_s, "processor_s": taken.processor_s, "peak_mb": peak_mb, "frames_used": used}
    made = [Made(Result("geomosaic", took), run / "mosaic.tif")]
    made += [
        run_peer(flight, peer, home, asked.peer_s, 1e3 * asked.peer_gb)
        for peer in (() if asked.no_peers else PEERS)
    ]
    judge = Judge(flight, run, made, asked)
    ours, *others = map(judge.judged, made)
    compared = side_by_side(ours, others)
    print("", *compared, "", judge.words(), sep="\n", flush=True)
    measured_here = Measured(
        *flight.row_names, len(flight.paths), floor["whole_s"], reported["timings_s"], taken.wall_s, peak_mb
    )
    results += result_rows(measured_here, ours, others)
    figures = {
        "floor": floor,
        "stages_s": reported["timings_s"],
        "sum_of_own_peaks_mb": reported["peak_memory_mb"],
        "programs": [asdict(r) for r in (ours, *others)],
    }
    return figures, not missed([*lines, *compared])


def main() -> int:
    """Benches the flights asked for."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--shared", type=Path, default=Path("../shared"), help="where data/brighton_beach lies")
    ask.add_argument("--out", type=Path, default=Path("out/bench-speed"))
    ask.add_argument("--only", choices=("real", "simulated"))
    ask.add_argument("--frames", type=int, default=100, help="of the simulated flight")
    ask.add_argument("--width-px", type=int, default=4000, help="of its frames, which are 4 : 3")
    ask.add_argument("--seed", type=int, default=1)
    ask.add_argument("--rounds", type=int, default=1, help="of the whole and the floor; the least counts")
    ask.add_argument("--parts", type=int, default=12, help="squares that are judged; 0: the whole")
    ask.add_argument("--part-px", type=int, default=1536, help="their side, of the true ortho's pixels")
    ask.add_argument("--no-peers", action="store_true")
    ask.add_argument("--peer-s", type=float, default=7200.0, help="a peer is stopped after so many seconds")
    ask.add_argument("--peer-gb", type=float, default=16.0, help="or if it holds so much")
    add_options(ask)
    asked = ask.parse_args()
    out = asked.out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    flights = []
    real = asked.shared.absolute() / "data" / "brighton_beach" / "images"
    if asked.only != "simulated":
        if real.is_dir():
            flights.append(SpeedFlight("18 frames of brighton_beach", real, out / "brighton_beach"))
        else:
            print(f"the real flight is left out: there is no {real}")
    if asked.only != "real":
        flights.append(simulated(out, asked.frames, asked.width_px, asked.seed))
    results, rows, good = {}, list[ResultRow](), True
    with rasterio.Env(GDAL_CACHEMAX=JUDGE_CACHE_BYTES):
        for flight in flights:
            results[flight.name], reached = bench(flight, out / "peers", asked, rows)
            good &= reached
            (out / "speed.json").write_text(json.dumps(results, indent=1))
    write_rows(asked, rows)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
