"""`geomosaic open`: a finished run in a browser, to look at and to measure."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from geomosaic.cli.options import Port


def open(
    run: Annotated[Path, typer.Argument(help="folder of a finished run", metavar="RUN")],
    other: Annotated[
        Path | None, typer.Argument(help="another run, to compare by a swipe", metavar="[RUN2]")
    ] = None,
    port: Port = 0,
) -> None:
    """Look at a finished run in a browser, and measure on its map.

    Prints an address of this machine; open it in a browser. The page shows the mosaic at full size, the
    surface, the accuracy, seamlines and control. It measures places, distances, profiles, areas and volumes
    with their standard deviations. Ctrl-C ends it.
    """
    from geomosaic.pages.loopback_server import LoopbackServer
    from geomosaic.viewer.run_view import run_views
    from geomosaic.viewer.viewer_pages import ViewerPages

    with LoopbackServer(ViewerPages(run_views(run, other)), port) as server:
        print(f"open       {server.url}", flush=True)
        print("ends       with Ctrl-C", flush=True)
        server.serve_forever()
