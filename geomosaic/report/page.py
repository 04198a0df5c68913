"""What all reports share: the templates, the map's data and script, warnings, times and memory."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import yaml
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from geomosaic.export.tile_page import inline_json, leaflet
from geomosaic.report import numbers
from geomosaic.report.accuracy_table import AccuracyTable
from geomosaic.report.glance import Glance
from geomosaic.report.layers import MapView
from geomosaic.report.table import ReportTable
from geomosaic.report.warnings import warnings_of

_TEMPLATES: Final = Path(__file__).parent / "templates"

Fact = tuple[str, str, str]
"""Of the page's head: name, value, a note."""


@dataclass(frozen=True)
class PageVerdict:
    """The first words. grade: `good`, `doubtful`, `bad`, or empty where nothing was judged; why: sentences;
    fix: the fix; accuracy: the answers to what people ask of a map; points: of check and of control points
    their kind, number, RMSE in plan and in height, and blunders; standard: the sentence that the ASPRS
    standard asks for."""

    grade: str
    why: str
    fix: str = ""
    accuracy: AccuracyTable | None = None
    points: Sequence[tuple[str, str, str, str, str]] = ()
    standard: str = ""

    @property
    def word(self) -> str:
        """The grade in one word of the headline."""
        return self.grade.capitalize() or "Not judged"


@dataclass(frozen=True)
class PageHead:
    """What every page begins with. run: its name; image: the mosaic, and its caption; plate: the map as
    paper shows it, SVG."""

    title: str
    run: str
    judged: PageVerdict
    image: Glance
    caption: str
    facts: list[Fact]
    map_view: MapView
    table: ReportTable
    plate: str = ""


def render(name: str, summary: Mapping[str, Any], begin: PageHead, **shown: Any) -> str:
    """A page by its template, which escapes all that isn't markup.

    Args: summary: what run.json holds so far, of which every page shows warnings, times, recipe and versions;
    begin: the first screen, the map and the table; shown: the rest, by the template's names.
    """
    return (
        _environment()
        .get_template(name)
        .render(
            css=part("style.css"),
            leaflet_css=leaflet("leaflet.css"),
            leaflet_js=leaflet("leaflet.js"),
            script=part("report.js"),
            begin=begin,
            facts=[*begin.facts, *_time_taken(summary)],
            map_data=inline_json(begin.map_view.plain()),
            warnings=warnings_of(summary),
            stages=_stages(summary),
            memory_mb=summary.get("peak_memory_mb"),
            recipe=yaml.safe_dump(summary.get("recipe", {}), sort_keys=False),
            versions=yaml.safe_dump(summary.get("versions", {}), sort_keys=False),
            **shown,
        )
    )


@cache
def _environment() -> Environment:
    """Of the templates, which it keeps compiled."""
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    names = ("short", "signed", "whole", "percent", "plural", "duration", "map_metres", "cm", "signed_cm")
    environment.filters |= {word: getattr(numbers, word) for word in names} | {
        "svg": markup,
        "options": options,
    }
    return environment


def part(name: str) -> Markup:
    """A style sheet or script of the project's own, for a page that holds all it needs."""
    return Markup((_TEMPLATES / name).read_text("utf-8"))  # noqa: S704


def markup(svg: str | None) -> Markup:
    """Text made by `report.svg`, which escapes what it is given."""
    return Markup(svg or "")  # noqa: S704


def options(words: str) -> Markup:
    """Words whose options (`--dem`) no line end parts."""
    return Markup(re.sub(r"--[a-z][a-z-]*", r'<span class="option">\g<0></span>', str(escape(words))))  # noqa: S704


def _time_taken(summary: Mapping[str, Any]) -> list[Fact]:
    timings, memory = summary.get("timings_s", {}), summary.get("peak_memory_mb")
    if not timings:
        return []
    note = f", peak memory {numbers.short(memory, 'MB')}" if memory else ""
    return [("time taken", numbers.duration(sum(map(float, timings.values()))), f"without this page{note}")]


@dataclass(frozen=True)
class StageCost:
    """Seconds of a stage, its share of the longest in per cent, the run's peak memory up to its end in MB
    where it is known; kept: its results came from the cache."""

    name: str
    seconds: float
    share: float
    memory_mb: float | None
    kept: bool


def _stages(summary: Mapping[str, Any]) -> list[StageCost]:
    timings = {k: float(v) for k, v in summary.get("timings_s", {}).items()}
    memory = summary.get("memory_mb", {})
    longest = max(timings.values(), default=0.0) or 1.0
    kept = {*summary.get("cached_stages", []), *summary.get("recorded_stages", [])}
    return [
        StageCost(name, s, 100.0 * s / longest, memory.get(name), name in kept) for name, s in timings.items()
    ]
