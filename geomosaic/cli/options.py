"""Options that several commands share."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from geomosaic.cli.help import OUTPUT, RARE, RUNNING
from geomosaic.errors import GeomosaicError, InputError, UnknownNameError

if TYPE_CHECKING:
    from geomosaic.recording.levels import RecordOptions


def cores() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def folder_given(text: str) -> Path:
    if not text.strip():
        raise typer.BadParameter("give the folder to write to; '.' is the current one")
    if "\0" in text or any("\ud800" <= c <= "\udfff" for c in text):
        raise typer.BadParameter(f"{text!r} is no name in UTF-8")
    return Path(text)


_LENGTHS_M = {"mm": 0.001, "cm": 0.01, "m": 1.0}


def length_given(text: str) -> float:
    """Metres of a length such as 5cm, 0.05m or 0.05."""
    number, unit = text.strip().lower(), "m"
    for name in _LENGTHS_M:
        if number.endswith(name):
            number, unit = number.removesuffix(name), name
            break
    with suppress(ValueError):
        metres = float(number) * _LENGTHS_M[unit]
        if 0.0 < metres < float("inf"):
            return metres
    raise typer.BadParameter(f"{text!r} is no length; give metres, or a unit: 5cm, 50mm, 0.05m")


RunFolder = Annotated[
    Path,
    typer.Option("-o", "--output", help="folder to write the run to", metavar="RUN", parser=folder_given),
]
RunFolderBeside = Annotated[
    Path | None,
    typer.Option(
        "-o",
        "--output",
        help="folder to write the run to [next to the input, such as INPUT-mosaic]",
        metavar="RUN",
        parser=folder_given,
        show_default=False,
        rich_help_panel=OUTPUT,
    ),
]
Strict = Annotated[
    bool,
    typer.Option(
        "--strict",
        help="end the run if a frame cannot be used or a position has no frame; exit with 3 if the verdict "
        "is bad",
        rich_help_panel=RUNNING,
    ),
]
DryRun = Annotated[
    bool,
    typer.Option(
        "--dry-run",
        help="report what the run would do and its size, memory, disk and time; write nothing",
        rich_help_panel=RUNNING,
    ),
]
Quiet = Annotated[
    bool, typer.Option("-q", "--quiet", help="print nothing but errors", rich_help_panel=RUNNING)
]
Overwrite = Annotated[
    bool,
    typer.Option(
        "--overwrite",
        help="write into a folder that holds other files; results may replace them",
        rich_help_panel=OUTPUT,
    ),
]
Aoi = Annotated[
    Path | None,
    typer.Option(
        help="cut the mosaic to the polygons in this file (GeoPackage, GeoJSON, ...)",
        metavar="FILE",
        rich_help_panel=OUTPUT,
    ),
]
AlignTo = Annotated[
    Path | None,
    typer.Option(
        help="use CRS, pixel size and grid of this raster, so that pixels coincide",
        metavar="TIF",
        rich_help_panel=RARE,
    ),
]
Sets = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="STAGE.PARAM=VALUE",
        help="set a parameter of a stage ('geomosaic stages' lists them); may be repeated",
        rich_help_panel=RARE,
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(
        help="number of worker processes [one per core]",
        metavar="N",
        min=1,
        max=1024,
        show_default=False,
        rich_help_panel=RUNNING,
    ),
]
Dask = Annotated[
    str | None,
    typer.Option(
        metavar="tcp://HOST:PORT",
        help="compute on this Dask cluster instead of this machine",
        rich_help_panel=RARE,
    ),
]
FixedTime = Annotated[
    bool,
    typer.Option(
        "--fixed-time",
        help="leave clock times out of the recording, so that equal runs give equal bytes",
        rich_help_panel=RARE,
    ),
]
Record = Annotated[
    str,
    typer.Option(
        metavar="off|summary|normal|full",
        help="content of run.mcap: off writes none; summary holds figures; normal also images and what a "
        "replay needs; full also the tie points of each pair",
        rich_help_panel=RARE,
    ),
]
Private = Annotated[
    bool,
    typer.Option(
        "--private",
        help="leave folders, user and host out of the recording, so that it can be shared",
        rich_help_panel=RARE,
    ),
]
PrivatePlaces = Annotated[
    bool,
    typer.Option(
        "--private-places",
        help="as --private, and move all places by a secret offset; the recording cannot be replayed, and "
        "its images still show the ground",
        rich_help_panel=RARE,
    ),
]
Live = Annotated[
    bool, typer.Option("--live", help="show the run in Rerun while it works", rich_help_panel=RARE)
]
Seed = Annotated[
    int | None, typer.Option(help="seed of all random numbers", metavar="N", min=0, rich_help_panel=RARE)
]
PlanJson = Annotated[
    bool, typer.Option("--json", help="with --dry-run: print its figures as JSON", rich_help_panel=RARE)
]
AsJson = Annotated[bool, typer.Option("--json", help="print JSON")]


def record_options(record: str, private: bool, private_places: bool, live: bool) -> RecordOptions:
    """How a run is recorded. Raises `UnknownNameError` for another level, `InputError` if nothing is to be
    recorded and shown."""
    from geomosaic.recording.levels import LEVELS, RecordOptions

    if record not in LEVELS:
        raise UnknownNameError("level of --record", record, LEVELS)
    if live and record == "off":
        raise InputError("--live shows what is recorded", mend="leave --record off away")
    return RecordOptions(record, private, private_places, live)


def beside(given: Path, what: str) -> Path:
    """The run folder where none is given: `FRAMES-mosaic` beside `FRAMES`."""
    place = given if given.name not in ("", "..") else given.resolve()
    if not place.name:
        raise InputError("there is no place beside it", file=given, mend="give the run folder with -o")
    return place.with_name(f"{place.stem if place.is_file() else place.name}-{what}")


def crs_of(align_to: Path, asked: str) -> str:
    """The CRS of a raster, or the one that was asked for if it is the same; else `InputError`."""
    from geomosaic.mosaic.alignment import read_alignment

    alignment = read_alignment(align_to)
    if asked == "auto":
        return alignment.crs
    alignment.check_crs(asked)
    return asked


def name_choices(option: Any, id: str, parameter: str) -> None:
    """Puts into an option's help what a stage declares of a parameter; a broken stage says so when run."""
    from geomosaic.pipeline.params import describe_params
    from geomosaic.pipeline.registry import installed

    with suppress(GeomosaicError):
        (declared,) = (p for p in describe_params(installed().get(id).Params) if p.name == parameter)
        get_args(option)[1].help = f"{declared.help}: {', '.join(declared.choices)} [{declared.default}]"
