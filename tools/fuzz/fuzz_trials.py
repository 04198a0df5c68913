"""One spoiled file through the real command, and what came of it."""

from __future__ import annotations

import gc
import io
import os
import shutil
import sys
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from geomosaic.cli.main import main
from geomosaic.errors import GeomosaicError
from tools.fuzz.fuzz_base import make_base, people
from tools.fuzz.fuzz_kinds import HANG_S, KINDS, Kind, fill, spoil
from tools.fuzz.fuzz_mutations import Nasty
from tools.fuzz.fuzz_verdict import Difference, Result, difference, problems, result_of, stray_lines
from tools.trials.trial_box import Box, EndedCommand, changes, snapshot

_MOST = ("seconds", "cpu_s", "peak_mb")


@dataclass(frozen=True)
class Case:
    """One case's outcome. argv, code, reported: of its last command, or of the one that something is wrong
    with;
    seconds, cpu_s, peak_mb: the most that a command took."""

    kind: str
    number: int
    file: str
    done: str
    argv: tuple[str, ...]
    code: int
    problems: tuple[str, ...]
    grade: str
    where: tuple[str, ...]
    seconds: float
    cpu_s: float
    peak_mb: float
    stray: tuple[str, ...]
    reported: str
    raised: str = ""


@dataclass
class Trials:
    """A box, the base inputs, and the results of what is not spoiled."""

    seed: int
    folder: Path
    out: Path
    box: Box = field(init=False)
    bases: dict[str, Result] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.box = Box(self.folder / "box")
        self.templates = self.folder / "templates"

    def prepare(self) -> None:
        """Makes the base inputs and the finished runs in a child. This process stays as it was started, but
        for caches that reading the unspoiled recording fills. So not every child has to fill them again."""
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                make_base(self.folder / "base", self.seed)
                code = 0
            finally:
                os._exit(code)
        if os.waitpid(pid, 0)[1] != 0:
            sys.exit("the base inputs could not be made")
        for name in ("survey", "tiffs", "strips"):
            shutil.copytree(self.folder / "base" / name, self.templates / name / "in")
        self._finished_run()
        self._new_box(KINDS["recording"])
        files = [str(self.box.path("in") / name) for name in ("rec/run.mcap", "other.mcap")]
        for argv in (["inspect", files[0], "--json"], ["inspect", files[0]], ["diff", *files, "--json"]):
            with redirect_stdout(io.StringIO()):
                main(argv)
        gc.freeze()

    def _finished_run(self) -> None:
        self._new_box(KINDS["pos"])
        for argv in KINDS["cache"].commands(self.box.folder, "", Random(0)):
            ended = self.box.run(argv, 5 * HANG_S)
            if ended.code:
                sys.exit(f"the unspoiled run fails: {ended.err}")
        run = self.templates / "run"
        for part in ("in", "out"):
            shutil.copytree(self.box.path(part), run / part, symlinks=True)
        (run / "out" / "my own notes.txt").write_text("not to be touched\n")
        (run / "out" / "work" / "my own notes.txt").write_text("not to be touched either\n")
        recorded = self.templates / "recorded"
        shutil.copytree(self.box.path("in"), recorded / "in")
        shutil.copytree(self.box.path("out"), recorded / "in" / "rec", symlinks=True)
        shutil.copy(self.box.path("out") / "run.mcap", recorded / "in" / "other.mcap")

    def _new_box(self, kind: Kind) -> None:
        self.box.empty()
        people(self.box.path("outside"))
        fill(self.box.folder, self.templates / kind.template)

    def base(self, kind: Kind, rng: Random, file: str) -> Result:
        """The result of the same commands with nothing spoiled."""
        state = rng.getstate()
        self._new_box(kind)
        commands = kind.commands(self.box.folder, file, rng)
        rng.setstate(state)
        key = f"{kind.name} {commands}"
        if key not in self.bases:
            ended = [self.box.run(argv, 5 * HANG_S) for argv in commands]
            whole = ended[-1].code == 0 and self.box.path("out").is_dir()
            self.bases[key] = (
                result_of(self.box.path("out"), kind.judge) if whole and kind.judge else Result()
            )
        return self.bases[key]

    def case(self, kind: Kind, number: int) -> Case:
        """Spoils, runs, judges."""
        rng = Random(f"{self.seed} {kind.name} {number}")
        nasty = Nasty(self.box.folder, self.box.port)
        self._new_box(kind)
        file, done = spoil(kind, self.box.folder, rng, nasty)
        state = rng.getstate()
        commands = kind.commands(self.box.folder, file, rng)
        own = ("out", "tmp")
        before = snapshot(self.box.folder, own)
        mine_before = self._own_notes()
        found: list[str] = []
        all_ended: list[EndedCommand] = []
        shown = False
        for argv in commands:
            self._mark_unread()
            ended = self.box.run(argv, kind.most_s)
            all_ended.append(ended)
            shown = shown or self._was_read()
            changed = changes(before, snapshot(self.box.folder, own))
            if mine_before != self._own_notes():
                changed.append("people's notes in the run folder")
            left = [] if ended.hung or ended.code < 0 else [p.name for p in self.box.path("tmp").iterdir()]
            changed += [f"tmp/{name}: left" for name in left]
            found += problems(ended, changed, self.box.path("out"), kind.most_bytes)
            if found or (ended.code and not kind.each):
                break
        failed = (e for e in all_ended if e.code == 1 and e.argv[0] != "diff" and not found)
        ended = next(failed, ended)
        if shown and kind.template in ("run", "recorded") and file != "in/rec/run.mcap":
            found.append("people's bytes shown")
        detail = self._detail(ended, found, changed, kind, number)
        if ended.code == 1 and not found and "NotSolvableError" not in detail and ended.argv[0] != "diff":
            found.append("exit code")
        graded = Difference("")
        if ended.code == 0 and kind.judge and not found:
            graded = self._graded(kind, rng, state, file)
        return Case(
            kind.name, number, file, done, ended.argv, ended.code, tuple(dict.fromkeys(found)), graded.grade,
            graded.where, *(round(max(getattr(e, of) for e in all_ended), 2) for of in _MOST),
            tuple(stray_lines(ended)[:3]), ended.err[-600:], detail,
        )  # fmt: skip

    def _own_notes(self) -> list[tuple[str, bool]]:
        own = [self.box.path("out") / "my own notes.txt", self.box.path("out") / "work" / "my own notes.txt"]
        return [(str(p), p.is_file()) for p in own]

    def _mark_unread(self) -> None:
        """Sets the time of people's files' last reading far back: the next reading shows."""
        for path in self.box.path("outside").iterdir():
            os.utime(path, ns=(0, path.stat().st_mtime_ns))

    def _was_read(self) -> bool:
        """Whether people's files were read since."""
        return any(path.stat().st_atime_ns for path in self.box.path("outside").iterdir())

    def _detail(
        self, ended: EndedCommand, found: list[str], changed: list[str], kind: Kind, number: int
    ) -> str:
        """Where a failure was raised, from a second run that tells it; and what changed or was done."""
        lines = [*changed[:5], *ended.doings[:5]]
        if ended.code == 1 or "fault" in found or "traceback" in found:
            self._again(kind, number)
            reported = self.box.run(ended.argv, kind.most_s, details=True).err.splitlines()
            places = [i for i, line in enumerate(reported) if line.lstrip().startswith("File ")]
            if places:
                own = [i for i in places if "geomosaic/" in reported[i]] or places
                lines += [
                    reported[own[-1]].strip(),
                    *[x for x in reported[places[-1] :] if x and not x.startswith(" ")][:2],
                ]
        return " | ".join(lines)[:1500]

    def _again(self, kind: Kind, number: int) -> None:
        """The case's box as it was before the command."""
        rng = Random(f"{self.seed} {kind.name} {number}")
        self._new_box(kind)
        file, _ = spoil(kind, self.box.folder, rng, Nasty(self.box.folder, self.box.port))
        kind.commands(self.box.folder, file, rng)

    def _graded(self, kind: Kind, rng: Random, state: tuple[object, ...], file: str) -> Difference:
        try:
            result = result_of(self.box.path("out"), kind.judge)
        except (GeomosaicError, OSError) as error:
            return Difference("gross", (f"the result can't be read: {error}",))
        rng.setstate(state)  # type: ignore[arg-type]
        return difference(self.base(kind, rng, file), result, kind.judge)

    def keep(self, case: Case) -> None:
        """The spoiled file, the command and the words of a case that failed."""
        self._again(KINDS[case.kind], case.number)
        folder = self.out / "failures" / f"{case.kind}-{case.number}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        spoiled = self.box.folder / case.file
        if spoiled.is_file() and not spoiled.is_symlink() and spoiled.stat().st_size < 64 << 20:
            shutil.copy(spoiled, folder / spoiled.name)
        words = [
            f"python -m tools.fuzz --seed {self.seed} --only {case.kind} --case {case.number}",
            "geomosaic " + " ".join(case.argv), f"{case.file}: {case.done}", f"exit {case.code}",
            ", ".join((*case.problems, case.grade)), *case.where, case.raised, case.reported,
        ]  # fmt: skip
        (folder / "case.txt").write_text("\n".join(words) + "\n", errors="replace")
