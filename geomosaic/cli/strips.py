"""`geomosaic strips`: from the strips of staggered CCDs to one scene."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from geomosaic.cli.mosaic import execute
from geomosaic.cli.options import FixedTime, Overwrite, RunFolder, Seed, Sets, Workers
from geomosaic.errors import GeomosaicError

STAGES = (
    "survey.strips",
    "mosaic.estimate_strips",
    "ccd.offsets",
    "ccd.radiometry",
    "mosaic.strips",
    "quality.strips",
    "export.cog",
    "export.offsets",
    "export.strip_layers",
    "export.strip_report",
)
"""What `geomosaic strips` does."""

Method = Annotated[
    str | None,
    typer.Option(metavar="METHOD", help="how offsets are found; 'geomosaic stages ccd.offsets' lists them"),
]


def name_strip_methods() -> None:
    """Puts the methods into the help, as the stage declares them."""
    from geomosaic.pipeline.params import describe_params
    from geomosaic.pipeline.registry import installed

    with suppress(GeomosaicError):
        (method,) = (p for p in describe_params(installed().get("ccd.offsets").Params) if p.name == "method")
        get_args(Method)[1].help = f"{method.help}: {', '.join(method.choices)} [{method.default}]"


def strips(
    geometry: Annotated[
        Path, typer.Argument(help="focal plane and strips, see docs/inputs.md", metavar="GEOMETRY.yaml")
    ],
    output: RunFolder,
    method: Method = None,
    set: Sets = None,
    workers: Workers = None,
    fixed_time: FixedTime = False,
    seed: Seed = None,
    overwrite: Overwrite = False,
) -> None:
    """Make one scene of the strips of a satellite's staggered CCDs."""
    from geomosaic.pipeline.recipe import recipe_from
    from geomosaic.pipeline.registry import installed

    given: dict[str, dict[str, Any]] = {
        "survey.strips": {"geometry": geometry},
        "ccd.offsets": {"method": method},
    }
    stages = [
        {"stage": id, "params": {k: v for k, v in given.get(id, {}).items() if v is not None}}
        for id in STAGES
    ]
    plain = {
        "name": "strips",
        "description": f"strips of {geometry.name}",
        "seed": seed or 0,
        "stages": stages,
    }
    execute(recipe_from(plain, installed(), set or ()), output, workers, None, fixed_time, overwrite)
