"""Pages that the site makes of declarations: one for each stage, and the list of them. A hook of mkdocs."""

from __future__ import annotations

from itertools import groupby
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

import geomosaic as gm

FOLDER = "stage"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages."""
    stages = gm.list_stages()
    for id, stage in stages.items():
        files.append(File.generated(config, f"{FOLDER}/{id}.md", content=page(stage, stages)))
    files.append(File.generated(config, f"{FOLDER}/index.md", content=index(stages)))
    return files


def index(stages: dict[str, dict[str, Any]]) -> str:
    """The stages by group."""
    lines = ["# Stages", "", "As they declare themselves: `geomosaic stages`, and `--json` for a front end."]
    in_groups = sorted(stages.values(), key=lambda s: (s["group"], s["id"]))
    for group, members in groupby(in_groups, key=lambda s: s["group"]):
        lines += ["", f"## {group}", "", "| stage | what |", "|---|---|"]
        lines += [
            f"| [`{s['id']}`]({s['id']}.md) | {_cell(s['help'] or s['display_name'])} |" for s in members
        ]
    return "\n".join(lines) + "\n"


def page(stage: dict[str, Any], stages: dict[str, dict[str, Any]]) -> str:
    """Inputs, outputs and parameters of a stage, and the stages that they come from or go to."""
    lines = [
        f"# {stage['display_name']}",
        "",
        f"`{stage['id']}`, version {stage['version']}",
        "",
        stage["help"],
    ]
    rows = []
    for word, key in (("takes", "inputs"), ("takes if there", "optional_inputs"), ("gives", "outputs")):
        for name, kind in stage[key].items():
            others = _givers(name, stages) if key != "outputs" else _takers(name, stages)
            links = ", ".join(f"[`{id}`]({id}.md)" for id in others if id != stage["id"])
            rows.append(f"| {word} | `{name}` | {kind} | {links} |")
    if rows:
        lines += ["", "| | artefact | type | from or to |", "|---|---|---|---|", *rows]
    if stage["params"]:
        lines += ["", "## Parameters", "", "| parameter | what | values | default |", "|---|---|---|---|"]
        lines += [_parameter(p) for p in stage["params"]]
        name = stage["params"][0]["name"]
        lines += ["", f"On the command line: `--set {stage['id']}.{name}=VALUE`."]
    return "\n".join(lines) + "\n"


def _parameter(p: dict[str, Any]) -> str:
    values = [", ".join(p["choices"]) or p["type"], p["unit"]]
    values += [f"{word} {p[key]:g}" for word, key in (("from", "min"), ("to", "max")) if p[key] is not None]
    default = "required" if p["required"] else "none" if p["default"] is None else f"`{p['default']}`"
    return f"| `{p['name']}` | {_cell(p['help'])} | {_cell(' '.join(filter(None, values)))} | {default} |"


def _givers(name: str, stages: dict[str, dict[str, Any]]) -> list[str]:
    return [id for id, s in stages.items() if name in s["outputs"]]


def _takers(name: str, stages: dict[str, dict[str, Any]]) -> list[str]:
    return [id for id, s in stages.items() if name in {**s["inputs"], **s["optional_inputs"]}]


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
