"""To which constants results are sensitive: each halved and doubled on small scenes, and what moves.

    python -m tools.bench.bench_constants [--rooms ROOM ...] [--only NAME ...] [--out DIR] [--again]
                                          [--longest SECONDS] [--results docs/results/constants]
                                          [--scenes NAME ...] [--flights FRAMES ...]

Each scene (tools/bench/bench_constants_scenes.py) runs once, stage by stage, and its functions are noted. A
constant is then halved and doubled (`geomosaic.constants.varied`) for each stage that called a function which
names it, the fastest first. This ends when an outcome moves: by 1 % of a stated deviation or a figure, 0.01
px, 0.1 grey levels, a warning or a verdict. Numbers without fractions are rounded and stay at least 1; shares
below 1 stay below it. A constant that is used while a module loads, or as a default, is named and not varied.

--only: constants whose name ends so. --flights: folders of real frames, tried after the scenes. --longest:
processor seconds for one constant; what then has not moved is `still` on the trials it had. --again
measures what has a row already. Rows are kept in RESULTS.json by name, those of other rooms too, each with
the scenes that it was tried on (`of`); RESULTS.md is the table.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import json
import os
import platform
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from geomosaic.constants import Record, records
from tools.bench.bench_constants_names import homes, used_while_loading
from tools.bench.bench_constants_scenes import SCENES, Done, Scene, stages
from tools.bench.bench_constants_trials import Trials
from tools.bench.bench_flights import commit

Row = dict[str, Any]
FACTORS = (0.5, 2.0)
BELOW_1 = re.compile(r"share|probab|correlation|\bof 1\b")
MOVES, STILL, UNREACHED, LOADED, FIXED = "moves", "still", "not reached", "used while loading", "not a number"


def other(value: Any, factor: float, unit: str) -> Any:
    """A value, or each number in it, times a factor. Raises: `TypeError` where it holds no number."""
    if isinstance(value, (bool, np.bool_)) or value is None:
        raise TypeError
    if isinstance(value, (int, np.integer)):
        return type(value)(max(1, round(value * factor))) if value > 0 else type(value)(value * factor)
    if isinstance(value, (float, np.floating)):
        new = value * factor
        return type(value)((1.0 + value) / 2.0 if value < 1.0 <= new and BELOW_1.search(unit) else new)
    if isinstance(value, np.ndarray):
        if value.dtype.kind == "f":
            return value * factor
        raise TypeError
    if isinstance(value, Mapping):
        return type(value)({key: other(one, factor, unit) for key, one in value.items()})  # type: ignore[call-arg]
    if isinstance(value, (tuple, list)):
        return type(value)(other(one, factor, unit) for one in value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        numbers = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        return dataclasses.replace(value, **{k: other(v, factor, unit) for k, v in numbers.items()})
    raise TypeError


def measured(name: str, value: Any, why: Record, trials: Trials, longest_s: float) -> Row:
    """What a constant's row says."""
    row: Row = {"name": name, "value": repr(value)[:80], "unit": why.unit}
    constant = name.rpartition(".")[2]
    loading = [file for file in homes(name) if constant in used_while_loading(file)]
    if loading:
        return row | {"result": LOADED, "at": ", ".join(Path(file).name for file in loading)}
    try:
        values = [other(value, factor, why.unit) for factor in FACTORS]
    except (TypeError, ValueError):
        return row | {"result": FIXED}
    reach = trials.reach(name)
    if not reach:
        return row | {"result": UNREACHED}
    spent, most, tried, slower = 0.0, (0.0, ""), 0, (1.0, 1.0)
    for k in reach:
        if tried and spent > longest_s:
            break
        for factor, new in zip(FACTORS, values, strict=True):
            amount, what, slow = trials.trial(k, name, new)
            tried, spent = tried + 1, spent + slow * trials.seconds(k)
            slower = min(slower[0], slow), max(slower[1], slow)
            if amount > 1.0:
                size = {"times": round(min(amount, 1e6), 1), "what": what}
                return row | {
                    "result": MOVES,
                    "at": trials.where(k),
                    "factor": factor,
                    **size,
                    "trials": tried,
                }
            most = max(most, (amount, what))
    least = {"times": round(most[0], 3), "what": most[1], "trials": tried, "scenes": len(reach)}
    return row | {"result": STILL, **least, "time": [round(t, 2) for t in slower]}


def table(rows: list[Row]) -> Iterator[str]:
    """The counts by room, and the constants that nothing moves."""
    kinds = (MOVES, STILL, UNREACHED, LOADED, FIXED)
    rooms: dict[str, Counter[str]] = {}
    for row in rows:
        rooms.setdefault(row["name"].split(".")[0], Counter())[row["result"]] += 1
    yield f"| room | constants | {' | '.join(kinds)} |"
    yield "|---|" + "---:|" * (1 + len(kinds))
    for room, counts in sorted(rooms.items()):
        yield f"| {room} | {sum(counts.values())} | {' | '.join(str(counts[k]) for k in kinds)} |"
    for kind in kinds[1:]:
        yield from (
            "",
            f"## {kind.capitalize()}",
            "",
            "| constant | value | unit | most, of what counts | time |",
        )
        yield "|---|---|---|---:|---|"
        for row in rows:
            if row["result"] == kind:
                value = row["value"].replace("|", "/").replace("\n", " ")
                time_ = " to ".join(map(str, row.get("time", ())))
                most = row.get("times", row.get("at", ""))
                yield f"| {row['name']} | `{value}` | {row['unit']} | {most} | {time_} |"


def keep(rows: Mapping[str, Row], results: Path) -> None:
    """Writes RESULTS.json, one constant a line, and RESULTS.md; rows of constants that are gone go."""
    there = {name for name, _, _ in records()}
    kept = [rows[name] for name in sorted(rows) if name in there]
    head: Row = {
        "title": "Constants, halved and doubled",
        "command": "make bench-constants",
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}",
        "commit": commit(),
    }
    lines = ",\n".join(" " + json.dumps(row) for row in kept)
    results.with_suffix(".json").write_text(json.dumps(head)[:-1] + f', "rows": [\n{lines}\n]}}\n')
    measured_at = ", ".join(str(head[key]) for key in ("date", "machine", "commit"))
    of_all = f"{len(kept)} of {len(there)} constants"
    text = f"# {head['title']}\n\n`{head['command']}`, {measured_at}. {of_all}.\n\n"
    results.with_suffix(".md").write_text(text + "\n".join(table(kept)) + "\n")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rooms", nargs="*", default=[])
    parser.add_argument("--only", nargs="*", default=[], help="ends of names")
    parser.add_argument("--scenes", nargs="*", default=[], help="names of scenes")
    parser.add_argument("--flights", nargs="*", type=Path, default=[], help="folders of real frames")
    parser.add_argument("--out", type=Path, default=Path("out/bench-constants"))
    parser.add_argument("--results", type=Path, default=Path("docs/results/constants"))
    parser.add_argument("--longest", type=float, default=60.0, help="processor seconds for a constant")
    parser.add_argument("--again", action="store_true")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    out = args.out.absolute()
    done: list[Done] = []
    chosen = [scene for scene in SCENES if not args.scenes or scene.name in args.scenes]
    for scene in (*chosen, *(Scene(p.name, "", "mosaic", {}, str(p.absolute())) for p in args.flights)):
        mine = stages(scene, out)
        times = ", ".join(f"{d.step.stage.id} {d.outcome.seconds:.1f}" for d in mine if d.outcome.seconds > 1)
        print(f"{scene.name}: {sum(d.outcome.seconds for d in mine):.1f} s ({times})", flush=True)
        done += mine
    kept = args.results.with_suffix(".json")
    rows = {row["name"]: row for row in json.loads(kept.read_text())["rows"]} if kept.exists() else {}
    names = list(dict.fromkeys(d.scene for d in done))
    trials = Trials(done)
    try:
        for name, value, why in list(records(*args.rooms)):
            if args.only and not name.endswith(tuple(args.only)):
                continue
            if args.again or rows.get(name, {}).get("value") != repr(value)[:80]:
                rows[name] = measured(name, value, why, trials, args.longest) | {"of": names}
                print(json.dumps(rows[name]), flush=True)
                keep(rows, args.results)
    finally:
        trials.close()
    keep(rows, args.results)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
