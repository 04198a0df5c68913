"""From pixels to mosaic on surveys as people deliver them, drawn at random, and judged against their truth.

    python -m tools.bench.bench_dirty [--out DIR] [--seed FIRST] [--seeds N] [--plain N] [--workers N]
                                          [--again] [--results docs/results/dirty] [-- OPTION ...]

Each survey comes from `geomosaic simulate frames --dirty SEED` and goes through `geomosaic mosaic` with
nothing but its frames. Right: after the best similarity 1 px, jumps (99 %) 1.5 px, positions within three
stated deviations, and nine tenths of the land shown. Of a survey that nothing places (no GPS at all), shape
alone is judged. What the run says of itself (`verdict` in run.json) is listed with it. --plain: surveys
without faults, by EXIF's default accuracy: 0.2 px. Options after `--` go to the simulation, instead of draws,
such as `-- --without vibration`. --again mosaics surveys whose row is there already. Tables go to standard
output, OUT/dirty.md and OUT/dirty.json. Exit code 1 if one survey has no mosaic, one is wrong without its
verdict saying so, or fewer than 95 % are right.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from geomosaic.quality.figures import circle_of, interval_of
from tools.bench.bench_dirty_judge import of_map, of_positions
from tools.bench.bench_flights import commit

GEOMOSAIC = Path(sys.executable).with_name("geomosaic")
PLAIN = ["--lines", "3", "--frames-per-line", "8", "--k1", "0", "--k2", "0", "--width-px", "640",
         "--height-px", "480", "--height-above-ground-m", "72", "--pos-in", "exif"]  # fmt: skip
AFTER_PX, JUMP_PX, SDS, COVERED = 1.0, 1.5, 3.0, 0.9
WRONG_PX = 3.0
PLAIN_AFTER_PX = 0.2
RIGHT_SHARE = 0.95
LONGEST_S = 1800.0
Row = dict[str, Any]


def survey(kind: str, seed: int, out: Path, again: bool, instead: list[str]) -> Row:
    """One survey from simulation to judgement; its row is kept in its folder."""
    folder = out / re.sub(r"[^\w.-]+", "_", "-".join([kind, str(seed), *instead]))
    kept = folder / "row.json"
    if kept.exists() and not again:
        row: Row = json.loads(kept.read_text())
        return row
    if not (folder / "truth" / "truth.json").exists() or not (folder / "simulated").exists():
        shutil.rmtree(folder, ignore_errors=True)
        drawn = ["--dirty", str(seed)] if kind == "dirty" else [*PLAIN, "--seed", str(seed)]
        code, _, words = _call("simulate", "frames", folder, *drawn, *instead)
        if code:
            raise SystemExit(f"{kind} {seed}: {words}")
        (folder / "simulated").touch()
    run = folder / "run"
    shutil.rmtree(run, ignore_errors=True)
    code, seconds, words = _call("mosaic", folder / "frames", "-o", run, "--workers", "1")
    row = {"kind": kind, "seed": seed, **described(folder), "exit": code, "s": round(seconds, 1)}
    row["said"] = words if code else ""
    if (run / "mosaic.tif").exists() and code == 0:
        summary = json.loads((run / "run.json").read_text())
        verdict = summary.get("verdict") or {}
        row |= {
            "grade": verdict.get("grade", "none"),
            "cause": verdict.get("cause", ""),
            "against": [e["name"] for e in verdict.get("evidence", []) if e["grade"] in ("doubtful", "bad")],
            "evidence": {e["name"]: e["value"] for e in verdict.get("evidence", [])},
            "warnings": sorted({w["code"] for w in summary["warnings"]}),
            "accuracy": summary.get("accuracy"),
            **of_map(folder, run / "mosaic.tif"),
            **of_positions(folder, run),
        }
    row["outcome"], row["missed"] = outcome(row)
    kept.write_text(json.dumps(row, indent=1))
    return row


def described(folder: Path) -> Row:
    """How a survey was flown, and its faults."""
    plan = json.loads((folder / "truth" / "truth.json").read_text())["plan"]
    dirty = folder / "truth" / "dirty.json"
    drawn = json.loads(dirty.read_text()) if dirty.exists() else {"ground": "flat", "faults": []}
    stands = [n for n, on in (("trees", plan["trees_stand"]), ("houses", plan["buildings_stand"])) if on]
    return {
        "flown": plan["kind"],
        "ground": " + ".join([drawn["ground"], *stands]),
        "placed": "no_gps_at_all" not in [f["name"] for f in drawn["faults"]],
        "faults": [f["name"] for f in drawn["faults"]],
    }


def outcome(row: Row) -> tuple[str, list[str]]:
    """What a row amounts to, and which bounds it misses."""
    if "grade" not in row:
        return "no mosaic", [f"exit {row['exit']}"]
    after = AFTER_PX if row["kind"] == "dirty" else PLAIN_AFTER_PX
    missed = []
    if row.get("after_px") is None:
        missed.append("nothing to measure")
    else:
        missed += [f"after {row['after_px']:.2f} px"] if not row["after_px"] <= after else []
        missed += [f"jumps {row['jump_px']:.2f} px"] if not row["jump_px"] <= JUMP_PX else []
    if row["covered"] is not None and row["covered"] < COVERED:
        missed.append(f"covered {100 * row['covered']:.0f} %")
    if row["placed"]:
        reported = row.get("absolute_m"), row.get("stated_m")
        if None in reported or not reported[0] <= SDS * reported[1]:
            missed.append(
                "absolute {} m, stated {} m".format(*("-" if t is None else f"{t:.2f}" for t in reported))
            )
    if not missed:
        return ("right" if row["grade"] != "bad" else "right called bad"), []
    return ("wrong, flagged" if row["grade"] in ("doubtful", "bad") else "wrong, not flagged"), missed


def _call(*words: object) -> tuple[int, float, str]:
    """Exit code, seconds and the last lines of what it said."""
    begun = time.monotonic()
    limits = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    try:
        done = subprocess.run([str(GEOMOSAIC), *map(str, words)], capture_output=True, text=True, check=False,
                              timeout=LONGEST_S, env={**os.environ, **limits})  # fmt: skip
    except subprocess.TimeoutExpired:
        return -1, LONGEST_S, f"stopped after {LONGEST_S:g} s"
    return done.returncode, time.monotonic() - begun, " / ".join(done.stderr.strip().splitlines()[-2:])[:400]


OUTCOMES = ("right", "right called bad", "wrong, flagged", "wrong, not flagged", "no mosaic")
HEAD = ("seed", "flown", "ground", "faults", "after, px", "jumps, px", "covered, %", "absolute, m",
        "stated, m", "tied", "verdict", "s", "outcome")  # fmt: skip


def line(r: Row) -> str:
    def number(name: str, digits: int, times: float = 1.0) -> str:
        return "" if r.get(name) is None else f"{times * r[name]:.{digits}f}"

    cells = (
        r["seed"], r["flown"], r["ground"], ", ".join(r["faults"]),
        *(number(name, 2) for name in ("after_px", "jump_px")), number("covered", 0, 100.0),
        *(number(name, 2) for name in ("absolute_m", "stated_m")),
        f"{r['tied']} of {r['wanted']}" if "tied" in r else "",
        " ".join([r.get("grade", ""), *(f"({name})" for name in r.get("against", []))]).strip(),
        f"{r['s']:.0f}",
        r["outcome"] + (f": {'; '.join(r['missed'])}" if r["missed"] else ""),
    )  # fmt: skip
    return f"| {' | '.join(map(str, cells))} |"


def table(head: Iterable[str], lines: Iterable[str]) -> list[str]:
    names = list(head)
    return [f"| {' | '.join(names)} |", f"|{'---|' * len(names)}", *lines, ""]


def counted(rows: list[Row], by: Callable[[Row], list[str]]) -> list[str]:
    """One line for each name that `by` gives to rows, the ones that go wrong most often first."""
    names = {name for r in rows for name in by(r)}

    def right(mine: list[Row]) -> float:
        return sum(r["outcome"].startswith("right") for r in mine) / max(len(mine), 1)

    groups = [
        (name, [r for r in rows if name in by(r)], [r for r in rows if name not in by(r)]) for name in names
    ]
    groups.sort(key=lambda g: (right(g[1]) - right(g[2]), -len(g[1]), g[0]))
    return [
        f"| {name} | {len(mine)} | "
        + " | ".join(str(sum(r["outcome"] == o for r in mine)) for o in OUTCOMES)
        + f" | {100 * right(mine):.0f} | {100 * right(others):.0f} |"
        for name, mine, others in groups
    ]


def calibration(rows: list[Row]) -> list[str]:
    """How often what a run states of its accuracy holds, and what its verdicts are worth."""
    accurate: dict[str, list[bool]] = {}
    for r in rows:
        stated = r.get("accuracy") or {}
        absolute, relative = stated.get("absolute") or {}, stated.get("relative") or {}
        within_90 = interval_of(0.9)
        for name, off, sd, times in (
            ("absolute within CE90", r.get("map_absolute_m"), absolute.get("rmse_h_m"), circle_of(0.9)),
            ("100 m within 90 %", r.get("over_100_m"), relative.get("rmse_m_per_100m"), within_90),
            ("whole map within 90 %", r.get("over_whole_m"), relative.get("rmse_m_whole"), within_90),
            (
                "scale within 90 %",
                r.get("scale_off_permille"),
                relative.get("scale_permille"),
                interval_of(0.9),
            ),
        ):
            if off is not None and sd is not None:
                accurate.setdefault(name, []).append(abs(off) <= times * sd)
    known = [r for r in rows if r.get("after_px") is not None]
    right = [r for r in known if r["outcome"].startswith("right")]
    wrong = [r for r in known if r["after_px"] > WRONG_PX or any("absolute" in m for m in r["missed"])]
    out = ["# Calibration", ""]
    out += [
        f"- {name}: {sum(of)} of {len(of)} ({100 * sum(of) / len(of):.0f} %)" for name, of in accurate.items()
    ]
    for name, mine in (("right", right), (f"wrong by more than {WRONG_PX:g} px or three deviations", wrong)):
        good = sum(r.get("grade") == "good" for r in mine)
        out.append(f"- {name}: {good} of {len(mine)} called good")
    return [*out, ""]


def report(rows: list[Row], out: Path) -> bool:
    """Writes the tables, and says whether all bounds are kept."""
    text, good = calibration(rows), True
    for kind, title in (("dirty", "Surveys as people deliver them"), ("plain", "Plain surveys")):
        mine = sorted((r for r in rows if r["kind"] == kind), key=lambda r: int(r["seed"]))
        if not mine:
            continue
        counts = {o: sum(r["outcome"] == o for r in mine) for o in OUTCOMES}
        rights = counts["right"] + counts["right called bad"]
        good &= not counts["no mosaic"] and not counts["wrong, not flagged"]
        good &= rights >= (RIGHT_SHARE if kind == "dirty" else 1.0) * len(mine)
        text += [
            f"# {title}",
            "",
            f"{len(mine)} surveys: " + ", ".join(f"{n} {o}" for o, n in counts.items()),
            "",
        ]
        text += table(HEAD, map(line, mine))
        if kind == "dirty":
            head = ("", "surveys", *OUTCOMES, "right with it, %", "right without, %")
            for what, by in (
                ("By fault", lambda r: r["faults"] or ["none"]),
                ("By flight and ground", lambda r: [r["flown"], *r["ground"].split(" + ")]),
                ("By verdict", lambda r: [r.get("grade", "no mosaic")]),
            ):
                text += [f"## {what}", "", *table(head, counted(mine, by))]
    (out / "dirty.md").write_text("\n".join(text))
    (out / "dirty.json").write_text(json.dumps(rows, indent=1))
    return good


def keep(rows: list[Row], args: argparse.Namespace) -> None:
    """Writes RESULTS.json and RESULTS.md with command, date, machine and commit."""
    whole = {
        "title": "Unseen surveys with faults",
        "command": f"make bench-dirty SEED={args.seed} SEEDS={args.seeds}",
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}",
        "commit": commit(),
        "rows": rows,
    }
    args.results.with_suffix(".json").write_text(json.dumps(whole, indent=1) + "\n")
    measured = ", ".join(str(whole[key]) for key in ("date", "machine", "commit"))
    head = f"# {whole['title']}\n\n`{whole['command']}`, {measured}.\n\n"
    args.results.with_suffix(".md").write_text(head + (args.out / "dirty.md").read_text())


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("out/bench-dirty"))
    parser.add_argument("--seed", type=int, default=1, help="the first seed")
    parser.add_argument("--seeds", type=int, default=100, help="how many dirty surveys")
    parser.add_argument("--plain", type=int, default=30, help="how many plain ones")
    parser.add_argument("--workers", type=int, default=1, help="surveys side by side")
    parser.add_argument("--again", action="store_true", help="mosaic again what was mosaicked before")
    parser.add_argument("--results", type=Path, help="without suffix, such as docs/results/dirty")
    parser.add_argument("instead", nargs="*", help="options of the simulation, after --")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    wanted = [
        (kind, args.seed + k)
        for kind, count in (("dirty", args.seeds), ("plain", args.plain))
        for k in range(count)
    ]
    print("\n".join(table(HEAD, [])[:2]), flush=True)
    rows: list[Row] = []
    with ThreadPoolExecutor(args.workers) as pool:
        for row in pool.map(lambda one: survey(*one, args.out, args.again, args.instead), wanted):
            rows.append(row)
            print(line(row), flush=True)
            good = report(rows, args.out)
            if args.results:
                keep(rows, args)
    print((args.out / "dirty.md").read_text())
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
