"""`geomosaic push`: a run's results into an object store."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from geomosaic.cli.options import Quiet


def push(
    run: Annotated[Path, typer.Argument(help="folder of a finished run", metavar="RUN")],
    to: Annotated[
        str,
        typer.Argument(help="folder of an object store: s3://BUCKET/FOLDER/, gs:// or az://", metavar="URL"),
    ],
    quiet: Quiet = False,
) -> None:
    """Copy the results of a run into an object store.

    All that the run made goes there, without its cache; run.json goes last. Files of the same name are
    replaced. Credentials are those that GDAL finds in the environment.
    """
    from geomosaic.cli.progress import progress
    from geomosaic.doors.addresses import parsed
    from geomosaic.pipeline.pushing import push as push_files

    with progress(quiet=quiet) as reporter:
        pushed = push_files(run, parsed(to), reporter)
    if not quiet:
        print(f"pushed     {len(pushed.names)} files, {pushed.size_bytes / 1e6:,.1f} MB")
        print(f"folder     {to}")
