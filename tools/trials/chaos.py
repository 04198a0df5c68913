"""Hits runs at random moments, runs the same command again, and asks for the result of a run left in peace.

Blows: kill -9 at random and amid matching, adjustment and composition, Ctrl-C, TERM, a full disk, a dead
worker. Others are a frame that vanishes and comes back, and inputs changed, removed or added. There are one
to four in a row. Inputs are two frames, a flight of 13 or strips; the run has one worker, two, or Dask. After
the blows the command runs undisturbed over the inputs as they then are. Its result must be that of a fresh
run over these, or a refusal in one line. Nothing that was finished of single frames, pairs and tiles may have
been made again. `inspect` has to say where a killed run was, and `inspect --repair` to make its recording
whole:

    python -m tools.trials.chaos --what flight --no-dask --trials 12 \\
        --blow kill --blow "kill in matching" --blow "kill in adjustment" --blow "kill in composition"
"""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from random import Random

from mcap.records import Attachment, Message

from geomosaic.recording import read_recording
from geomosaic.recording.file.mcapfile import items, opened
from geomosaic.recording.inspect.inspection import Inspection
from tools.bench.result_rows import ResultRow, RowKind, add_options, write_rows
from tools.docs.results_page import SAFE
from tools.trials.chaos_changes import CHANGES, change, put_back
from tools.trials.chaos_world import PROGRAM, EndedRun, Running, Trial, World, items_of, result_of
from tools.trials.trial_box import changes, snapshot
from tools.trials.trial_tables import write_tables

BLOWS = {
    "kill": 4, "ctrl-c": 4, "term": 3, "full disk": 3, "dead worker": 3, "vanish": 2, "change": 4,
    "change later": 2, "none": 1,
}  # fmt: skip
"""By weight; `change` strikes while the run reads, `change later` between two runs; what vanishes comes back
after the run."""
AMID = {
    "kill in matching": ("Place frames by POS", "Match frames with SIFT"),
    "kill in adjustment": ("Match frames with SIFT", "Adjust the frames"),
    "kill in composition": ("Place the seamlines", "Compose the mosaic"),
    "vanish in matching": ("Place frames by POS", "Match frames with SIFT"),
}
"""One of them begins each trial of a flight: a stage, behind the one after which it is looked for."""
KINDS = ("frames", "frames", "flight", "strips", "strips")
ROWS = {
    "result": RowKind(
        SAFE,
        "runs killed, stopped, starved, inputs changed: a result that differs",
        "none",
        "{differing:d} of {runs:d}",
    ),
    "traceback": RowKind(
        SAFE,
        "runs that printed a traceback on the way",
        "none",
        "{printed:d} of {runs:d}",
    ),
    "flight": RowKind(
        SAFE,
        "interrupted flights whose result is equal; finished items made again",
        "all; none",
        "{equal:d} of {runs:d}; {again}",
    ),
    "ctrl-c": RowKind(
        SAFE,
        "Ctrl-C until the program has ended, slowest",
        "{most_s:g} s",
        "{slowest_s:.2f} s",
    ),
}
Items = dict[Path, tuple[int, int]]
STOP_S = 3.0
"""Within so long a run that was asked to stop has ended."""
STOPPED = {
    "ctrl-c": (130, -signal.SIGINT, 0),
    "term": (143, 130, -signal.SIGTERM, 0),
    "kill": (-signal.SIGKILL, 0),
}


def strike(world: World, trial: Trial, blow: str, rng: Random, done: list[str]) -> None:
    """One run of the command, hit once; its inputs' changes go into `done`."""
    length_s = world.length_s[f"{trial.what} {trial.method}"]
    before = items_of(world.run)
    if blow == "full disk":
        world.disk.resize(world.disk.used_kb() + 40 + rng.randrange(world.used_kb[trial.what]))
    running = Running(world.command(trial, world.run), world.folder / "run.log")
    wait_s = rng.uniform(0.02, 1.05) * length_s
    detail = ""
    struck = time.monotonic()
    if blow in AMID:
        after, stage = AMID[blow]
        running.wait_for(after, rng.uniform(0.1, 0.8) * world.stages[f"{trial.what} {trial.method}"][stage])
        struck = time.monotonic()
    elif blow not in ("full disk", "change later", "none"):
        running.wait(wait_s)
        struck = time.monotonic()
        detail = f" at {wait_s:.2f} s"
    if blow.startswith("kill"):
        running.process.kill()
        killed_ns = time.time_ns()
    elif blow == "ctrl-c" and running.process.poll() is None:
        os.killpg(running.process.pid, signal.SIGINT)
    elif blow == "term":
        running.process.terminate()
    elif blow == "dead worker":
        workers = world.dask_workers() if trial.team == "dask" else running.children()
        if workers:
            try:
                os.kill(rng.choice(workers), signal.SIGKILL)
            except ProcessLookupError:
                detail += " (gone)"
    elif blow.startswith("vanish"):
        detail += f": {change(world.inputs, 'vanished', rng)}"
    elif blow == "change":
        done.append(change(world.inputs, rng.choice(CHANGES[trial.what]), rng))
        detail += f": {done[-1]}"
    ended = running.end(struck)
    world.disk.large()
    put_back(world.inputs)
    if blow.startswith("kill") and ended.code == -signal.SIGKILL:
        detail += f" ({where_it_was(trial, world.run, len(running.stages()), killed_ns)})"
    if blow.startswith("kill in") and AMID[blow][1] in running.stages():
        detail += " (too late)"
    judge_items(trial, before, items_of(world.run))
    if blow == "change later":
        done.append(change(world.inputs, rng.choice(CHANGES[trial.what]), rng))
        detail = f": {done[-1]}"
    left = len(items_of(world.run))
    trial.blows.append(f"{blow}{detail} -> {ended.code} in {ended.seconds:.1f} s, {left} items")
    judge_blow(trial, blow, ended)


def where_it_was(trial: Trial, run: Path, done: int, killed_ns: int) -> str:
    """What `inspect` says of where a killed run was, and how old the last message in its recording is. What
    `--repair` makes of it must be whole and say the same. done: how many stages its progress names."""
    reported = geomosaic("inspect", run, "--json")
    if reported.returncode:
        return reported.stderr.strip()
    said = json.loads(reported.stdout)
    finished = sum(stage["finished"] for stage in said["stages"])
    if done and not done <= finished <= done + 1:
        trial.problems.append("wrong place")
    whole = run.with_name("whole.mcap")
    repair = geomosaic("inspect", run, "--repair", whole)
    if repair.returncode:
        trial.problems.append("not repaired")
        trial.words += f"[repair] {repair.stderr}\n"
        return str(said["ended"].get("text", "finished"))
    recording = read_recording(whole)
    same = Inspection(recording, None).ended() == said["ended"] or finished == recording.planned
    if not recording.whole or not same:
        trial.problems.append("repaired otherwise")
    last_ns = last_word_ns(whole)
    whole.unlink()
    trial.silent_s.append(round((killed_ns - last_ns) / 1e9, 2))
    return f"{said['ended'].get('text', 'finished')}; last word {trial.silent_s[-1]} s before"


def last_word_ns(recording: Path) -> int:
    """When the last message, or attachment, of a recording was written."""
    with opened(recording) as file:
        found = (item.record for item in items(recording, file))
        return max(record.log_time for record in found if isinstance(record, Message | Attachment))


def geomosaic(*words: object) -> subprocess.CompletedProcess[str]:
    """A command that nobody hits."""
    argv = [str(PROGRAM), *map(str, words)]
    return subprocess.run(argv, capture_output=True, text=True, check=False)


def judge_items(trial: Trial, before: Items, after: Items) -> None:
    """What single frames, pairs and tiles gave is not made again by the next run."""
    again = [path for path, mark in before.items() if after.get(path, mark) != mark]
    trial.kept += len(before)
    trial.again += len(again)
    if again:
        trial.problems.append("done twice")
        trial.words += f"[done twice] {len(again)} of {len(before)}, {again[0]}\n"


def judge_blow(trial: Trial, blow: str, ended: EndedRun) -> None:
    """What a run that was hit must not do."""
    before = len(trial.problems)
    killed = blow.startswith("kill")
    if "Traceback (most recent call last)" in ended.err and not killed:
        trial.problems.append(f"traceback after {blow}")
    if "a fault of geomosaic" in ended.err:
        trial.problems.append(f"fault after {blow}")
    if ended.hung:
        trial.problems.append(f"hang after {blow}")
    if ended.orphans:
        trial.problems.append(f"orphans after {blow}")
    if killed or blow in STOPPED:
        if ended.code not in STOPPED["kill" if killed else blow] and not ended.hung:
            # a run that ended by itself at that moment, with a refusal of changed inputs, is none of ours
            refused = ended.code == 2 and any("removed" in b or "camera" in b for b in trial.blows)
            if not refused:
                trial.problems.append(f"exit {ended.code} after {blow}")
        if not killed:
            trial.seconds[blow] = max(trial.seconds.get(blow, 0.0), ended.seconds)
            if ended.seconds > STOP_S:
                trial.problems.append(f"slow after {blow}")
    elif blow.startswith("vanish") and ended.code and ".jpg" not in ended.last:
        trial.problems.append("unnamed after vanish")
    elif ended.code not in (0, 1, 2):
        trial.problems.append(f"exit {ended.code} after {blow}")
    if len(trial.problems) > before:
        trial.words += f"[{blow}] {ended.err[-1500:]}\n"


def one_trial(
    world: World,
    number: int,
    methods: tuple[str, ...],
    kinds: tuple[str, ...],
    dask: bool,
    only: tuple[str, ...] = (),
) -> Trial:
    """Blows, then a run in peace, then the comparison. only: blows of which each trial has one, by turns."""
    rng = Random(f"{world.seed} chaos {number}")
    what = rng.choice(kinds)
    team = rng.choice(("1", "2", "2", "dask") if dask and what != "strips" else ("1", "2"))
    trial = Trial(number, what, team, rng.choice(methods) if what != "strips" else "")
    allowed = {
        b: w
        for b, w in BLOWS.items()
        if (b != "dead worker" or team != "1")
        and (b != "full disk" or world.disk.own)
        and (b != "vanish" or what != "strips")
    }
    blows = rng.choices(list(allowed), list(allowed.values()), k=rng.choice((1, 1, 2, 3)))
    if only:
        blows = [only[number % len(only)]]
    elif what == "flight":
        blows.insert(0, [*AMID][number % len(AMID)])
    world.restore(what)
    world.reference(trial, "")
    done: list[str] = []
    mine: dict[Path, bytes] = {}
    for blow in blows:
        strike(world, trial, blow, rng, done)
        _put_own_files(world.run, mine)
    state = "; ".join(done) + "".join(f" {n}" for n in snapshot_marks(world.inputs, done))
    code, wanted, refusal = world.reference(trial, state)
    given, kept = snapshot(world.inputs), items_of(world.run)
    running = Running(world.command(trial, world.run), world.folder / "run.log")
    ended = running.end(time.monotonic())
    trial.ended = f"exit {ended.code}, wanted {code}"
    judge_blow(trial, "none", ended)
    if ended.code == 0 and code == 0:
        found = result_of(world.run)
        other = sorted(n for n in wanted.keys() | found.keys() if wanted.get(n) != found.get(n))
        if other:
            trial.problems.append("another result")
            each = [f"{n}: {wanted.get(n)} -> {found.get(n)}" for n in other]
            trial.words += f"[result] {'; '.join(each)}"[:2000] + "\n"
    elif ended.code != code or ended.code != 2:
        trial.problems.append("another end")
        trial.words += f"[end] {ended.last} / fresh: {refusal}\n"
    else:
        trial.ended = "refused"
    judge_items(trial, kept, items_of(world.run))
    if lost := [p.name for p, data in mine.items() if not p.is_file() or p.read_bytes() != data]:
        trial.problems.append("people's files lost")
        trial.words += f"[people's] {', '.join(lost)}\n"
    if spoiled := changes(given, snapshot(world.inputs)):
        trial.problems.append("inputs touched")
        trial.words += f"[inputs] {', '.join(spoiled)}\n"
    return trial


def snapshot_marks(inputs: Path, done: list[str]) -> list[str]:
    """The contents of changed inputs: equal words of two changes may stand for other digits."""
    return [f"{n}={mark[-1]}" for n, mark in snapshot(inputs).items() if mark[0] == "file"] if done else []


def _put_own_files(run: Path, mine: dict[Path, bytes]) -> None:
    """People's files, into a run folder that is one already, into its work folder, and next to it."""
    places = [run.with_name("outside.txt")]
    if run.is_dir() and any(run.iterdir()):
        places += [
            run / "my notes.txt",
            *([run / "work" / "my notes.txt"] if (run / "work").is_dir() else []),
        ]
    for path in places:
        if path not in mine:
            mine[path] = f"people's own {path.name}\n".encode()
            path.write_bytes(mine[path])


def tell(trials: list[Trial], seed: int, seconds: float, out: Path, own_disk: bool) -> None:
    """Counts by what was run and by blow, the worst times, the failures."""
    rows = []
    for name in ("frames", "flight", "strips", "all"):
        those = [t for t in trials if name in (t.what, "all")]
        blows = Counter(re.split(r" at |:| ->| \(", b)[0] for t in those for b in t.blows)
        bad = Counter(p for t in those for p in set(t.problems))
        row = {
            "runs of": name, "trials": len(those), "blows": sum(blows.values()),
            **{b: blows[b] for b in (*AMID, *BLOWS)},
            "dask": sum(t.team == "dask" for t in those),
            "equal": sum(not t.problems and t.ended != "refused" for t in those),
            "refused": sum(not t.problems and t.ended == "refused" for t in those),
            "failed": sum(bool(t.problems) for t in those),
            "items found again": sum(t.kept for t in those), "made again": sum(t.again for t in those),
            "ctrl-c worst s": round(max((t.seconds.get("ctrl-c", 0.0) for t in those), default=0.0), 2),
            "term worst s": round(max((t.seconds.get("term", 0.0) for t in those), default=0.0), 2),
            "recording silent worst s": max((s for t in those for s in t.silent_s), default=0.0),
        }  # fmt: skip
        rows.append(row | dict.fromkeys(sorted({p for t in trials for p in t.problems}), 0) | dict(bad))
    facts = {"seed": seed, "trials": len(trials), "seconds": round(seconds), "own disk": own_disk}
    listed = [
        f"trial {t.number} ({t.what}, {t.team}): {', '.join(t.problems)}: {'; '.join(t.blows)}; {t.ended}"
        for t in trials if t.problems
    ]  # fmt: skip
    write_tables(out / "chaos", "Runs that were hit", facts, rows, listed, [asdict(t) for t in trials])


def result_rows(trials: list[Trial]) -> list[ResultRow]:
    """The rows of results: of flights where all trials are flights, else of all runs."""
    runs = len(trials)
    differing = sum(bool({"another result", "another end"} & set(t.problems)) for t in trials)
    if all(t.what == "flight" for t in trials):
        again = sum(t.again for t in trials)
        figures = {"equal": runs - differing, "runs": runs, "again": again or "none"}
        return [ROWS["flight"].row(not differing and not again, **figures)]
    printed = sum(any(p.startswith("traceback") for p in t.problems) for t in trials)
    rows = [
        ROWS["result"].row(not differing, differing=differing, runs=runs),
        ROWS["traceback"].row(not printed, printed=printed, runs=runs),
    ]
    stopped_s = [t.seconds["ctrl-c"] for t in trials if "ctrl-c" in t.seconds]
    if stopped_s:
        slowest_s = max(stopped_s)
        rows.append(ROWS["ctrl-c"].row(slowest_s <= STOP_S, slowest_s=slowest_s, most_s=STOP_S))
    return rows


def main(argv: list[str] | None = None) -> int:
    """Runs the trials; 1 if any failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--trial", type=int, help="this one only")
    parser.add_argument("--minutes", type=float, help="stop after so long, wherever it stands")
    parser.add_argument("--method", action="append", help="of adjusting frames [bundle, least_squares]")
    parser.add_argument("--what", action="append", choices=KINDS, help="what is run [all, frames most]")
    parser.add_argument("--blow", action="append", choices=(*BLOWS, *AMID), help="one a trial, by turns")
    parser.add_argument("--no-dask", action="store_true", help="local workers only")
    parser.add_argument("--out", type=Path, default=Path("out/chaos"))
    add_options(parser)
    asked = parser.parse_args(argv)
    out: Path = asked.out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    methods = tuple(asked.method or ("bundle", "least_squares", "least_squares"))
    kinds, only = tuple(asked.what or KINDS), tuple(asked.blow or ())
    signal.signal(signal.SIGINT, signal.default_int_handler)  # also in the background: runs inherit it
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # the disk is unmounted at every end
    trials: list[Trial] = []
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="geomosaic-chaos-") as folder:
        world = World(Path(folder), asked.seed)
        try:
            for number in range(asked.trials) if asked.trial is None else [asked.trial]:
                trials.append(trial := one_trial(world, number, methods, kinds, not asked.no_dask, only))
                if trial.problems or asked.trial is not None or only:
                    came = ", ".join(trial.problems) or trial.ended
                    print(f"trial {number}: {came}: {trial.blows}\n{trial.words}", flush=True)
                if asked.minutes is not None and time.monotonic() - started > 60 * asked.minutes:
                    break
        finally:
            world.close()
    tell(trials, asked.seed, time.monotonic() - started, out, world.disk.own)
    write_rows(asked, result_rows(trials), argv)
    return int(any(t.problems for t in trials))


if __name__ == "__main__":
    sys.exit(main())
