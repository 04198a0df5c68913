"""`geomosaic fetch`: the files of a survey from web servers and object stores into a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from geomosaic.cli.options import Quiet
from geomosaic.cli.requested import typer_parser
from geomosaic.requests.option import folder_given


def fetch(
    sources: Annotated[
        list[str],
        typer.Argument(
            help="lists of addresses (one a line; of a .csv file one a row), addresses of files (https://, "
            "s3://, gs://, az://), or folders of an object store (s3://BUCKET/FOLDER/)",
            metavar="LIST_OR_URL",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", help="folder to write to", metavar="FOLDER", parser=typer_parser(folder_given)
        ),
    ],
    insecure: Annotated[
        bool, typer.Option("--insecure", help="allow http:// to other machines than this one")
    ] = False,
    overwrite: Annotated[
        bool,
        typer.Option(
            "--overwrite", help="replace files of the same name and files that were changed in the folder"
        ),
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Download frames and their files from web or object stores.

    Files that are already complete are kept, so the same command continues a download that was stopped.
    Credentials are those that GDAL finds in the environment.
    """
    from geomosaic.cli.progress import progress
    from geomosaic.doors.addresses import is_address, parsed, read_addresses
    from geomosaic.pipeline.fetching import fetch as fetch_files

    texts = [text for s in sources for text in ([s] if is_address(s) else read_addresses(Path(s)))]
    wanted = [parsed(text, insecure) for text in texts]
    with progress(quiet=quiet) as reporter:
        fetched = fetch_files(wanted, output, reporter, overwrite=overwrite)
    if quiet:
        return
    size = f"{fetched.size_bytes / 1e6:,.1f} MB"
    print(f"fetched    {len(fetched.fetched)} files, {size}; {len(fetched.there)} were there")
    if fetched.skipped:
        named = ", ".join(fetched.skipped[:3]) + (", ..." if len(fetched.skipped) > 3 else "")
        print(f"skipped    {len(fetched.skipped)}, which no survey holds: {named}")
    print(f"folder     {output}")
