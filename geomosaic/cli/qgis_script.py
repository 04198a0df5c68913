"""`geomosaic qgis-script`: the commands as algorithms of QGIS' Processing toolbox."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, get_args

import typer

from geomosaic.errors import OutputError
from geomosaic.requests import mosaic_stages, strips_request
from geomosaic.requests.mosaic_request import MosaicRequest
from geomosaic.requests.option import RARE, choices_of, flag_of, kinds_of, option_of
from geomosaic.requests.strips_request import StripsRequest

if TYPE_CHECKING:
    from geomosaic.pipeline.stage import Stage
    from geomosaic.requests.run_request import RunRequest

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
_KINDS: Final = {"true or false": "bool", "whole number": "int", "number": "float", "path": "file"}
_FLAG: Final = re.compile(r"(?<![\w-])--([a-z][a-z-]*)")
_TYPES: Final = {bool: "bool", int: "int", float: "float", Path: "file"}
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
    by_id = {stage.id: stage for stage in installed().all()[0]}
    of_stages = _of_stages(by_id[id] for id in ids if id in by_id)
    of_options = [_of_option(its, request, of_stages) for its in fields(request) if option_of(its).toolbox]
    taken = {option_of(its).sets for its in fields(request)}
    params = [*of_options, *(p for name, p in of_stages.items() if name not in taken)]
    return {
        "name": f"geomosaic_{command}",
        "display_name": title,
        "help": help,
        "command": [sys.executable, "-m", "geomosaic.cli.main", command],
        "params": sorted(params, key=lambda p: (p["advanced"], p["name"] != first)),
    }


def _of_option(
    its: Field[Any], request: type[RunRequest], of_stages: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """An option of the command; where it gives a stage's parameter its value, with that one's name and
    limits."""
    option = option_of(its)
    kind, choices = kinds_of(request)[its.name], choices_of(option)
    own = {
        "key": its.name.upper(),
        "name": its.name,
        "kind": "choice" if choices else next((k for t, k in _TYPES.items() if t in _types(kind)), "text"),
        "text": _sentence(option.help),
        "choices": list(choices) or None,
        "default": None if its.default is MISSING else its.default,
        "min": option.least,
        "max": option.most,
    }
    given = of_stages.get(option.sets) if option.value is None else None
    if given is not None:
        own |= given
        own["text"] = _sentence(option.help if kind is bool else given["help"])
    return own | {
        "option": flag_of(its) if option.heading else "",
        "required": not option.heading,
        "advanced": option.heading.startswith(RARE),
    }


def _types(kind: Any) -> set[Any]:
    return set(get_args(kind)) or {kind}


def _of_stages(stages: Iterable[type[Stage]]) -> dict[str, dict[str, Any]]:
    """The parameters of stages by name, each set with `--set`."""
    from geomosaic.cli.stages import describe

    found = {}
    for of in map(describe, stages):
        for p in of["params"]:
            name, unit = f"{of['id']}.{p['name']}", f" ({p['unit']})" if p["unit"] else ""
            kind = "choice" if p["choices"] else _KINDS.get(p["type"], "text")
            found[name] = {
                "key": name.replace(".", "_").upper(),
                "name": name,
                "option": "--set",
                "kind": "folder" if name == "survey.read.frames" else kind,
                "help": f"{p['help']}{unit}",
                "text": f"{of['display_name']}: {p['help']}{unit}",
                "required": False,
                "advanced": True,
                **{key: p[key] for key in ("choices", "default", "min", "max")},
            }
    return found


def _sentence(text: str) -> str:
    """A help text as a label, where options are names of other fields."""
    plain = _FLAG.sub(lambda found: found[1].replace("-", " "), text)
    return f"{plain[:1].upper()}{plain[1:]}"


def _scripts() -> Path:
    """Where QGIS looks for scripts of its default profile."""
    home = Path.home()
    if sys.platform == "darwin":
        return home / "Library/Application Support" / _PROFILE
    if sys.platform == "win32":
        return Path(os.environ.get("APPDATA", home)) / _PROFILE
    return Path(os.environ.get("XDG_DATA_HOME", home / ".local/share")) / _PROFILE
