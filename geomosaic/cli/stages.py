"""`geomosaic stages`: what there is, as declared."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geomosaic.cli.options import AsJson

if TYPE_CHECKING:
    from geomosaic.pipeline.stage import Stage


def stages(
    id: Annotated[str | None, typer.Argument(help="a stage's id", metavar="ID")] = None,
    as_json: AsJson = False,
) -> None:
    """List the stages of processing, or describe one.

    The description holds parameters with units and bounds, inputs and outputs.
    """
    from geomosaic.pipeline.registry import installed

    if id is not None:
        found = describe(installed().get(id))
        print(json.dumps(found, indent=2) if as_json else _text(found))
        return
    working, broken = installed().all()
    if as_json:
        print(json.dumps({"stages": [describe(s) for s in working], "broken": broken}, indent=2))
        return
    width = max((len(s.id) for s in working), default=0)
    for stage in working:
        print(f"{stage.id:<{width}}  {stage.display_name} ({stage.group}, version {stage.version})")
    for name, problem in broken.items():
        print(f"{name:<{width}}  BROKEN: {problem}")


def describe(stage: type[Stage]) -> dict[str, Any]:
    """A stage's declaration as plain values, from which a front end can be generated."""
    from geomosaic.pipeline.params import describe_params

    def names(artefacts: dict[str, type]) -> dict[str, str]:
        return {name: getattr(kind, "__name__", str(kind)) for name, kind in artefacts.items()}

    return {
        "id": stage.id,
        "display_name": stage.display_name,
        "group": stage.group,
        "version": stage.version,
        "help": " ".join((stage.__doc__ or "").split()),
        "inputs": names(stage.inputs),
        "optional_inputs": names(stage.optional_inputs),
        "outputs": names(stage.outputs),
        "params": [
            {
                "name": p.name,
                "type": p.type,
                "unit": p.unit,
                "min": p.ge,
                "max": p.le,
                "choices": list(p.choices),
                "default": str(p.default) if isinstance(p.default, Path) else p.default,
                "required": p.required,
                "help": p.help,
                "affects_output": p.affects_output,
            }
            for p in describe_params(stage.Params)
        ],
    }


def _text(found: dict[str, Any]) -> str:
    lines = [
        f"{found['id']}: {found['display_name']} ({found['group']}, version {found['version']})",
        *([found["help"]] if found["help"] else []),
    ]
    for title, key in (("takes", "inputs"), ("takes if there", "optional_inputs"), ("gives", "outputs")):
        if found[key]:
            lines.append(f"{title}: " + ", ".join(f"{name} ({kind})" for name, kind in found[key].items()))
    for p in found["params"]:
        kind = [", ".join(p["choices"]) or p["type"], p["unit"]]
        kind += [f"{word} {p[key]:g}" for word, key in (("from", "min"), ("to", "max")) if p[key] is not None]
        default = "required" if p["required"] else f"default {p['default']}"
        lines.append(f"  {p['name']}: {p['help']} ({' '.join(filter(None, kind))}; {default})")
    return "\n".join(lines)
