"""What all reports share: the templates, warnings in groups, times, and words for numbers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from geomosaic.report.plots import Axis, bar_plot
from geomosaic.report.svg import short

_TEMPLATES = Path(__file__).parent / "templates"
_MOST_WARNINGS = 500

Fact = tuple[str, str, str]
"""Of the page's head: name, value, a note."""


def render(name: str, summary: Mapping[str, Any], facts: list[Fact], **shown: Any) -> str:
    """A page by its template, which escapes all that isn't markup.

    Args: summary: what run.json holds so far, of which every page shows warnings, times, recipe and versions;
    facts: the head's, to which the time taken is added; shown: the rest, by the template's names.
    """
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    environment.filters["short"] = short
    environment.filters["svg"] = markup
    return environment.get_template(name).render(
        css=part("style.css"),
        facts=[*facts, *_time_taken(summary)],
        warnings=_grouped_warnings(summary),
        timings=markup(_timings_plot(summary)),
        recipe=yaml.safe_dump(summary.get("recipe", {}), sort_keys=False),
        versions=yaml.safe_dump(summary.get("versions", {}), sort_keys=False),
        **shown,
    )


def part(name: str) -> Markup:
    """A style sheet or script of the project's own, for a page that holds all it needs."""
    return Markup((_TEMPLATES / name).read_text("utf-8"))  # noqa: S704


def markup(svg: str | None) -> Markup:
    """Text made by `report.svg`, which escapes what it is given."""
    return Markup(svg or "")  # noqa: S704


def plural(number: int, noun: str) -> str:
    """`3 frames`, `1 frame`."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def length(metres: float) -> str:
    """In metres, or centimetres below one."""
    return short(metres * 100.0, "cm") if metres < 1.0 else short(metres, "m")


def _time_taken(summary: Mapping[str, Any]) -> list[Fact]:
    timings, memory = summary.get("timings_s", {}), summary.get("peak_memory_mb")
    if not timings:
        return []
    note = f"peak memory {memory:.0f} MB" if memory else ""
    return [("time taken", _duration(sum(map(float, timings.values()))), note)]


def _duration(seconds: float) -> str:
    """Seconds, or minutes from two on."""
    if seconds < 120.0:
        return f"{seconds:.1f}\u00a0s"
    return f"{int(seconds // 60)}\u00a0min {int(seconds % 60)}\u00a0s"


def _grouped_warnings(summary: Mapping[str, Any]) -> list[tuple[str, int, list[Mapping[str, Any]]]]:
    """Code, number and first warnings of each code; the most frequent last, so that none hides another."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for warning in summary.get("warnings", []):
        groups.setdefault(str(warning.get("code", "")), []).append(warning)
    counted = ((code, len(group), group[:_MOST_WARNINGS]) for code, group in groups.items())
    return sorted(counted, key=lambda g: g[1])


def _timings_plot(summary: Mapping[str, Any]) -> str | None:
    """Bars of the stages' times; None where none are known."""
    timings = summary.get("timings_s", {})
    if not timings:
        return None
    return bar_plot(list(timings), list(timings.values()), Axis("time", "s"), label="time of each stage")
