"""`geomosaic control`: control and check points marked in a browser."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from geomosaic.cli.options import Port, Quiet, output_option, with_options
from geomosaic.cli.requested import typer_option
from geomosaic.errors import InputError
from geomosaic.requests.mosaic_request import MosaicRequest

if TYPE_CHECKING:
    from geomosaic.marking.session import MarkingSession


_OF_SURVEY: Final = ("pos", "pos_crs", "height_datum", "camera", "dem", "ground_height")
"""Options that `geomosaic mosaic` takes as well."""


@dataclass(frozen=True)
class ControlOptions:
    """What `geomosaic control` is asked for."""

    frames: Annotated[Path, typer_option(MosaicRequest, "frames")]
    points: Annotated[
        Path, typer.Option(help="surveyed points, with or without marks (CSV, gcp_list.txt)", metavar="FILE")
    ]
    run: Annotated[
        Path | None,
        typer.Option(help="finished run whose adjusted poses predict where points are", metavar="RUN"),
    ] = None
    output: Annotated[
        Path | None,
        output_option("folder of gcp.csv and gcp_list.txt [next to the frames: FRAMES_DIR-control]"),
    ] = None
    pos: Annotated[Path | None, typer_option(MosaicRequest, "pos")] = None
    pos_crs: Annotated[str | None, typer_option(MosaicRequest, "pos_crs")] = None
    height_datum: Annotated[str | None, typer_option(MosaicRequest, "height_datum")] = None
    camera: Annotated[Path | None, typer_option(MosaicRequest, "camera")] = None
    dem: Annotated[Path | None, typer_option(MosaicRequest, "dem")] = None
    ground_height: Annotated[float | None, typer_option(MosaicRequest, "ground_height")] = None
    port: Port = 0
    quiet: Quiet = False


@with_options(ControlOptions)
def control(asked: ControlOptions) -> None:
    """Mark control and check points in a browser.

    Prints an address of this machine; open it in a browser. Each mark is saved at once to gcp.csv and
    gcp_list.txt, which --gcp of 'geomosaic mosaic' takes. The same command continues. Ctrl-C ends it.
    """
    from geomosaic.cli.progress import progress
    from geomosaic.geodesy.heights import height_datum as datum_of
    from geomosaic.marking.marked_points import read_points
    from geomosaic.marking.oriented_frames import frames_by_tags, frames_of_run
    from geomosaic.marking.session import MarkingSession
    from geomosaic.pipeline.files import make_folder
    from geomosaic.pipeline.folder_lock import locked_folder
    from geomosaic.requests.run_request import default_folder

    unused = [n for n in ("pos", "camera", "dem", "ground_height") if getattr(asked, n) is not None]
    if asked.run is not None and unused:
        flag = _flag(unused[0])
        raise InputError(
            f"{flag} has no effect with --run, whose poses count", fix=f"leave out {flag} or --run"
        )
    folder = asked.output or default_folder(asked.frames, "control")
    datum = None if asked.height_datum is None else datum_of(asked.height_datum)
    with progress(quiet=asked.quiet) as reporter:
        if asked.run is not None:
            oriented = frames_of_run(asked.frames, asked.run)
        else:
            request = MosaicRequest(
                frames=asked.frames,
                pos=asked.pos,
                pos_crs=asked.pos_crs,
                height_datum=asked.height_datum,
                camera=asked.camera,
                dem=asked.dem,
                ground_height=asked.ground_height,
                gcp_optional=True,
            )
            oriented = frames_by_tags(request, reporter)
    surveyed, notes = read_points(asked.points, folder, oriented, datum, asked.pos_crs)
    for note in notes:
        reporter.warning(note.text)
    with locked_folder(make_folder(folder), "geomosaic control"):
        _serve(MarkingSession(oriented, surveyed, folder), asked)


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _serve(session: MarkingSession, asked: ControlOptions) -> None:
    """Shows the page until Ctrl-C, and says what to do next."""
    from geomosaic.marking.marked_points import TABLE
    from geomosaic.marking.page_server import PageServer

    with PageServer(session, asked.port) as server:
        print(f"open       {server.url}", flush=True)
        print(f"marks      {session.folder / TABLE}; Ctrl-C ends", flush=True)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            command = ["geomosaic", "mosaic", str(asked.frames), "--gcp", str(session.folder / TABLE)]
            for name in _OF_SURVEY:
                if (value := getattr(asked, name)) is not None:
                    command += [_flag(name), str(value)]
            print(f"next       {shlex.join(command)}")
            raise
