"""`geomosaic inspect` and `diff`: what a person asks of recordings."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from geomosaic.cli.options import AsJson, with_options
from geomosaic.errors import FileError, OutputError

if TYPE_CHECKING:
    from geomosaic.recording.file.model import Recording
    from geomosaic.recording.inspect.inspection import Inspection

RecordingFile = Annotated[
    Path, typer.Argument(metavar="RUN.mcap", help="the recording of a run, or its folder")
]
Png = Annotated[
    Path | None, typer.Option("--png", metavar="PNG", help="also draw a picture of it to this file")
]
_ALL = 1_000_000


@dataclass(frozen=True)
class InspectOptions:
    """What `geomosaic inspect` is asked for."""

    recording: RecordingFile
    stage: Annotated[
        str, typer.Option(metavar="STAGE", help="show a stage: inputs, results and messages")
    ] = ""
    frame: Annotated[
        str,
        typer.Option(
            metavar="FRAME", help="show a frame: reported and estimated pose, tie points and messages"
        ),
    ] = ""
    pair: Annotated[
        tuple[str, str] | None,
        typer.Option(metavar="FRAME FRAME", help="show a pair: tie points and residuals, or why it has none"),
    ] = None
    worst: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, max=_ALL, help="show the N worst faults, frames and pairs"),
    ] = None
    png: Png = None
    repair: Annotated[
        Path | None,
        typer.Option(metavar="OUT.mcap", help="write a complete recording from that of a killed run"),
    ] = None
    as_json: AsJson = False


@with_options(InspectOptions)
def inspect(asked: InspectOptions) -> None:
    """Show what is wrong with a recorded survey and how to fix it.

    Without an option, shows stages, rounds of adjustment, faults, warnings, topics, whether the recording is
    complete, and where a killed run ended. --png draws the plan; with --frame or --pair that frame or pair.
    """
    from geomosaic.pipeline import files
    from geomosaic.recording import read_recording
    from geomosaic.recording.inspect import inspection_tables as show
    from geomosaic.recording.inspect.inspection import SHOWN
    from geomosaic.recording.inspect.summary import summary
    from geomosaic.recording.inspect.tables import show_summary

    check_new(asked.png, "--png")
    check_new(asked.repair, "--repair")
    path = recording_file(asked.recording)
    recorded = read_recording(path)
    if asked.repair is not None:
        _repair(recorded, asked.repair)
        return
    answers = _answers(recorded)
    short: dict[str, Any] = {"path": str(path), "whole": recorded.whole, "problem": recorded.problem}
    short |= {"ended": answers.ended(), "unreadable": answers.unreadable}
    shown: list[Callable[[Console], None]] = [lambda console: show.show_head(short, console)]

    def ask(name: str, answer: dict[str, Any], view: Callable[[dict[str, Any], Console], None]) -> None:
        short[name] = answer
        shown.append(lambda console: view(answer, console))

    if asked.worst is not None:
        ask("worst", answers.worst(asked.worst), show.show_worst)
    if asked.stage:
        ask("stage", answers.stage(asked.stage), show.show_stage)
    if asked.frame:
        ask("frame", answers.frame(asked.frame), show.show_frame)
    if asked.pair is not None:
        ask("pair", answers.pair(*asked.pair), show.show_pair)
    if len(shown) == 1:
        ask("worst", answers.worst(SHOWN), show.show_faults)
        rest = summary(recorded)
        short |= rest
        shown.append(lambda console: show_summary(rest, console))
    if asked.png is not None:
        files.write_bytes(asked.png, _picture(answers, asked.frame, asked.pair))
    if asked.as_json:
        print(json.dumps(short, indent=2))
        return
    screen = new_console()
    for view in shown:
        view(screen)


def _answers(recorded: Recording) -> Inspection:
    """Of a damaged survey at least what else there is."""
    from geomosaic.recording.inspect.inspection import Inspection
    from geomosaic.recording.replay.recorded_solve import solved_of

    try:
        return Inspection(recorded, solved_of(recorded))
    except FileError as error:
        return Inspection(recorded, None, error.problem)


def _repair(recorded: Recording, out: Path) -> None:
    from geomosaic.pipeline import files
    from geomosaic.recording.file.repair import repaired

    with files.writing(out) as temporary:
        count = repaired(recorded, temporary)
    print(f"repaired   {out}, {count} messages")
    if recorded.problem:
        print(f"lost       what lay behind or in the damage: {recorded.problem}")


def _picture(answers: Inspection, frame: str, pair: tuple[str, str] | None) -> bytes:
    from geomosaic.recording.inspect import pictures

    recorded = answers.recording
    if not (pair or frame):
        return pictures.plan_png(recorded)
    solved = answers.readable()
    if pair is not None:
        found = answers.pair(*pair)
        return pictures.pair_png(recorded, solved, found["left"], found["right"])
    return pictures.frame_png(recorded, solved, answers.frame(frame)["frame"])


def diff(
    a: Annotated[Path, typer.Argument(metavar="A.mcap", help="a recording, or a run's folder")],
    b: Annotated[Path, typer.Argument(metavar="B.mcap", help="another one")],
    png: Png = None,
    as_json: AsJson = False,
) -> None:
    """Show what differs between two recordings.

    Results come first. Durations, the cache, the environment and the names of folders don't count. --png
    draws arrows from where A places the frames to where B does. Exit code 0 if they are equal, else 1.
    """
    from geomosaic.pipeline import files
    from geomosaic.recording import read_recording
    from geomosaic.recording.inspect import pictures
    from geomosaic.recording.inspect.compare import compare
    from geomosaic.recording.inspect.difference_tables import show_difference

    check_new(png, "--png")
    of_a, of_b = (_answers(read_recording(recording_file(path))) for path in (a, b))
    difference = compare(of_a.recording, of_b.recording, of_a.solved, of_b.solved)
    if png is not None:
        picture = pictures.difference_png(of_a.readable(), of_b.readable(), difference["frames"])
        files.write_bytes(png, picture)
    print(json.dumps(difference, indent=2)) if as_json else show_difference(difference, new_console())
    raise typer.Exit(0 if difference["equal"] else 1)


def check_new(out: Path | None, option: str) -> None:
    """Raises: `OutputError` where something has the name of a file to be written. option: the one that gives
    the name."""
    if out is not None and os.path.lexists(out):
        raise OutputError("is there already", file=out, fix=f"give another name with {option}")


def recording_file(path: Path) -> Path:
    """The recording of a run's folder, or the file itself."""
    return path / "run.mcap" if path.is_dir() else path


def new_console() -> Console:
    """A hundred columns wide where nobody looks."""
    console = Console(highlight=False)
    return console if console.is_terminal or "COLUMNS" in os.environ else Console(highlight=False, width=100)
