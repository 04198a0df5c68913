"""Options that commands share which are no requests."""

from __future__ import annotations

from typing import Annotated

import typer

from geomosaic.cli.requested import Terminal, typer_option
from geomosaic.requests.run_request import RunRequest

Sets = Annotated[list[str] | None, typer_option(RunRequest, "set")]
Workers = Annotated[int | None, typer_option(RunRequest, "workers")]
Overwrite = Annotated[bool, typer_option(RunRequest, "overwrite")]
Quiet = Annotated[bool, typer_option(Terminal, "quiet")]
AsJson = Annotated[bool, typer.Option("--json", help="print JSON")]
Port = Annotated[
    int, typer.Option(help="port on this machine; 0 is any free one", metavar="N", min=0, max=65535)
]
