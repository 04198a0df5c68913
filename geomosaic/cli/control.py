"""`geomosaic control`: control and check points marked in a browser."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from geomosaic.cli.options import Port, Quiet
from geomosaic.cli.requested import typer_option, typer_parser
from geomosaic.requests.mosaic_request import MosaicRequest
from geomosaic.requests.option import folder_given


def control(
    frames: Annotated[Path, typer_option(MosaicRequest, "frames")],
    points: Annotated[
        Path, typer.Option(help="surveyed points, with or without marks (CSV, gcp_list.txt)", metavar="FILE")
    ],
    run: Annotated[
        Path | None,
        typer.Option(help="finished run whose adjusted poses predict where points are", metavar="RUN"),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            help="folder of gcp.csv and gcp_list.txt [next to the frames: FRAMES_DIR-control]",
            metavar="FOLDER",
            parser=typer_parser(folder_given),
        ),
    ] = None,
    pos: Annotated[Path | None, typer_option(MosaicRequest, "pos")] = None,
    pos_crs: Annotated[str | None, typer_option(MosaicRequest, "pos_crs")] = None,
    height_datum: Annotated[str | None, typer_option(MosaicRequest, "height_datum")] = None,
    camera: Annotated[Path | None, typer_option(MosaicRequest, "camera")] = None,
    dem: Annotated[Path | None, typer_option(MosaicRequest, "dem")] = None,
    ground_height: Annotated[float | None, typer_option(MosaicRequest, "ground_height")] = None,
    port: Port = 0,
    quiet: Quiet = False,
) -> None:
    """Mark control and check points in a browser.

    Prints an address of this machine; open it in a browser. Each mark is saved at once to gcp.csv and
    gcp_list.txt, which --gcp of 'geomosaic mosaic' takes. The same command continues. Ctrl-C ends it.
    """
    from geomosaic.cli.progress import progress
    from geomosaic.geodesy.heights import height_datum as datum_of
    from geomosaic.marking.marked_points import TABLE, read_points
    from geomosaic.marking.oriented_frames import frames_by_tags, frames_of_run
    from geomosaic.marking.page_server import PageServer
    from geomosaic.marking.session import MarkingSession
    from geomosaic.requests.run_request import default_folder

    folder = output or default_folder(frames, "control")
    datum = None if height_datum is None else datum_of(height_datum)
    with progress(quiet=quiet) as reporter:
        if run is not None:
            oriented = frames_of_run(frames, run)
        else:
            request = MosaicRequest(
                frames=frames,
                pos=pos,
                pos_crs=pos_crs,
                height_datum=height_datum,
                camera=camera,
                dem=dem,
                ground_height=ground_height,
                gcp_optional=True,
            )
            oriented = frames_by_tags(request, reporter)
    surveyed, notes = read_points(points, folder, oriented, datum)
    for note in notes:
        reporter.warning(note.text)
    session = MarkingSession(oriented, surveyed, folder)
    with PageServer(session, port) as server:
        print(f"open       {server.url}", flush=True)
        print(f"marks      {folder / TABLE}; Ctrl-C ends", flush=True)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            gcp = shlex.join(["--gcp", str(folder / TABLE)])
            print(f"next       geomosaic mosaic {shlex.quote(str(frames))} {gcp}")
            raise
