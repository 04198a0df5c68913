"""`geomosaic qgis-script`: the commands as algorithms of QGIS' Processing toolbox."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import Field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from geomosaic.errors import OutputError
from geomosaic.requests import mosaic_stages, strips_request
from geomosaic.requests.mosaic_request import MosaicRequest
from geomosaic.requests.option import flag_of, kinds_of, option_of
from geomosaic.requests.strips_request import StripsRequest

if TYPE_CHECKING:
    from geomosaic.pipeline.stage import Stage

_COMMANDS: Final = {
    "mosaic": (
        "Mosaic of aerial frames",
        "One map-true mosaic of a folder of overlapping frames, its layers, a report and a QGIS project.",
        "survey.read.frames",
    ),
    "strips": (
        "Scene of CCD strips",
        "One scene of the strips of a satellite's staggered CCDs, its layers and a report.",
        "survey.strips.geometry",
    ),
}
"""By command: its name in the toolbox, its help, the parameter that it takes without an option."""
_REQUESTS: Final[dict[str, tuple[type[MosaicRequest | StripsRequest], Sequence[str]]]] = {
    "mosaic": (MosaicRequest, mosaic_stages.STAGES),
    "strips": (StripsRequest, strips_request.STAGES),
}
_PLAIN: Final = (
    "survey.read.pos", "survey.read.camera", "survey.read.dem", "survey.read.gcp", "survey.read.crs",
    "mosaic.seams.gsd_m", "mosaic.seams.aoi", "mosaic.seams.align_to", "ccd.offsets.method",
)  # fmt: skip
"""What is seen at first; all else is under `Advanced`."""
_BY_FLAG: Final = "matching.reference"
"""A stage that only `--coregister` adds, which the toolbox does not offer."""
_KINDS: Final = {"true or false": "bool", "whole number": "int", "number": "float", "path": "file"}
_PROFILE: Final = Path("QGIS/QGIS3/profiles/default/processing/scripts")


def qgis_script(
    folder: Annotated[
        Path | None,
        typer.Argument(
            help="folder to write to [the script folder of QGIS]", metavar="FOLDER", show_default=False
        ),
    ] = None,
) -> None:
    """Add geomosaic to the Processing toolbox of QGIS.

    The scripts that are written run this installation of geomosaic.
    """
    folder = folder or _scripts()
    template = Path(__file__).with_name("qgis_algorithm.py.in").read_text(encoding="utf-8")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for command in _COMMANDS:
            path = folder / f"geomosaic_{command}.py"
            declaration = json.dumps(declared(command), indent=1, ensure_ascii=True).replace(
                '"""', '\\"\\"\\"'
            )
            path.write_text(template.replace("DECLARATION", declaration, 1), encoding="utf-8")
            print(path)
    except OSError as error:
        raise OutputError(
            f"can't be written ({error.strerror})", file=folder, fix="give another folder"
        ) from error


def declared(command: str) -> dict[str, Any]:
    """A command as the script has it: name, texts, words, and what `geomosaic stages --json` says of its
    stages."""
    from geomosaic.pipeline.registry import installed

    title, help, first = _COMMANDS[command]
    request, ids = _REQUESTS[command]
    flags = {
        option_of(its).sets: flag_of(its)
        for its in fields(request)
        if kinds_of(request)[its.name] is not bool
    }
    by_id = {stage.id: stage for stage in installed().all()[0]}
    return {
        "name": f"geomosaic_{command}",
        "display_name": title,
        "help": help,
        "command": [sys.executable, "-m", "geomosaic.cli.main", command],
        "params": [
            *_params((by_id[id] for id in ids if id in by_id and id != _BY_FLAG), first, flags),
            *(_switch(its) for its in fields(request) if option_of(its).toolbox),
        ],
    }


def _switch(its: Field[Any]) -> dict[str, Any]:
    """An option without a value."""
    text = option_of(its).help
    return {
        "key": its.name.upper(),
        "name": its.name,
        "option": flag_of(its),
        "kind": "bool",
        "text": f"{text[:1].upper()}{text[1:]}",
        "required": False,
        "advanced": True,
        "default": its.default,
        **dict.fromkeys(("choices", "min", "max")),
    }


def _params(stages: Iterable[type[Stage]], first: str, flags: Mapping[str, str]) -> Sequence[dict[str, Any]]:
    from geomosaic.cli.stages import describe

    found, plain = [], (first, *_PLAIN)
    for stage in stages:
        of = describe(stage)
        for p in of["params"]:
            name = f"{of['id']}.{p['name']}"
            kind = "choice" if p["choices"] else _KINDS.get(p["type"], "text")
            found.append(
                {
                    "key": name.replace(".", "_").upper(),
                    "name": name,
                    "option": "" if name == first else flags.get(name, "--set"),
                    "kind": "folder" if name == "survey.read.frames" else kind,
                    "text": _text(of["display_name"] if name not in plain else "", p),
                    "required": name == first,
                    "advanced": name not in plain,
                    **{key: p[key] for key in ("choices", "default", "min", "max")},
                }
            )
    return sorted(found, key=lambda p: (p["advanced"], p["name"] != first))


def _text(stage: str, p: Mapping[str, Any]) -> str:
    """`Place the seamlines: share of ... (m)`."""
    unit = f" ({p['unit']})" if p["unit"] else ""
    return f"{stage}: {p['help']}{unit}" if stage else f"{p['help'][:1].upper()}{p['help'][1:]}{unit}"


def _scripts() -> Path:
    """Where QGIS looks for scripts of its default profile."""
    home = Path.home()
    if sys.platform == "darwin":
        return home / "Library/Application Support" / _PROFILE
    if sys.platform == "win32":
        return Path(os.environ.get("APPDATA", home)) / _PROFILE
    return Path(os.environ.get("XDG_DATA_HOME", home / ".local/share")) / _PROFILE
