"""Control and check points in the report: figures, arrows, the first screen, the glossary, paper and phone."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from browser import Page as Window
from browser import browser
from report_survey import HOSTILE, made_up_run, with_points
from test_report_page import Page
from test_report_surface import METRICS as SURFACE_METRICS
from test_report_surface import run as surface_run  # noqa: F401
from test_report_surface import section as surface_section

from geomosaic.composition.model import Trimmed, TrimmedPart
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.pipeline.stage import Context
from geomosaic.report.accuracy_table import accuracy_table
from geomosaic.report.control import mapped_points, point_figures
from geomosaic.report.control_layers import arrow_scale, control_layers
from geomosaic.report.frames import FramesReport, render_report
from geomosaic.stages.export_report import export_report


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return with_points(made_up_run(tmp_path_factory.mktemp("run")))


@pytest.fixture(scope="module")
def page(run, tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("page") / "report.html"
    file.write_text(render_report(FramesReport(**run, name="May")), encoding="utf-8")
    return file


def test_blunders_are_named_and_left_out_of_the_figures(run):
    checks, controls = point_figures(run["adjusted"])
    assert (checks.blunders, controls.blunders) == (("CHK-15",), ("GCP-03",))
    assert (checks.count, controls.count, checks.plan_only) == ("7 of 8", "9 of 10", 1)
    off_m = np.array([c.residual_m for c in run["adjusted"].control if not c.check and c.name != "GCP-03"])
    assert controls.rmse_h_m == pytest.approx(np.sqrt((off_m[:, :2] ** 2).sum(axis=1).mean()))
    assert controls.rmse_v_m == pytest.approx(np.sqrt((off_m[:, 2] ** 2).mean()))
    assert checks.row[0] == "Check points" and checks.row[4] == "CHK-15" and checks.row[2].endswith(" cm")
    assert checks.points[0].name == "CHK-15", "the largest residual first"


def test_arrows_lead_from_the_map_to_where_points_were_surveyed(run):
    kinds = mapped_points(run["survey"], point_figures(run["adjusted"]))
    surveyed = {p.name: (p.lon_deg, p.lat_deg) for p in run["survey"].control}
    found = {c.name: c.residual_m for c in run["adjusted"].control}
    for kind in kinds:
        lon, lat = np.array([surveyed[name] for name in kind.names]).T
        there = MapProjection(run["survey"].map_crs).map_from_geodetic(lon, lat)
        np.testing.assert_allclose(kind.at_m + kind.residual_m, there, atol=1e-6)
        length = [np.hypot(*found[name][:2]) for name in kind.names]
        np.testing.assert_allclose(np.linalg.norm(kind.residual_m, axis=1), length, rtol=2e-3)
    assert "170\xa0cm in plan" in kinds[0].labels[0] and kinds[0].labels[0].endswith(
        "left out of the figures"
    )
    assert "no surveyed height" in kinds[0].labels[kinds[0].names.index("CHK-11")]


def test_one_scale_for_all_arrows_and_blunders_are_cut(run):
    kinds = mapped_points(run["survey"], point_figures(run["adjusted"]))
    scale = arrow_scale(kinds, 200.0)
    lengths = np.concatenate([np.linalg.norm(k.residual_m, axis=1)[~k.blunders] for k in kinds])
    assert scale.factor in (200.0, 500.0) and 0.04 < scale.factor * np.quantile(lengths, 0.9) / 200.0 <= 0.1
    control, check = control_layers(kinds, scale, np.zeros(2))
    assert (control.mark, check.mark, control.factor) == ("triangle", "square", scale.factor)
    assert control.odd == [0] and len(control.lines) == len(control.points) == 10
    shaft = np.array(control.lines[0][:4]).reshape(2, 2)
    assert np.linalg.norm(shaft[1] - shaft[0]) == pytest.approx(scale.longest_m * scale.factor, abs=0.05)
    assert f"drawn {scale.factor:.0f} times larger, cut at" in check.note
    alone = arrow_scale([], 200.0)
    assert control_layers([], alone, np.zeros(2)) == []


def test_the_first_screen_begins_with_the_accuracy_table(run):
    words = " ".join(Page(render_report(FramesReport(**run))).words.split())
    order = (
        "Doubtful", "Seams at 2 of 3 places", "distances over 100 m RMSE 2.0 cm, 0.12 px 30.0 cm, met",
        "horizontal, measured RMSE 4.1 cm CE90 6.2 cm 3.0 cm, missed",
        "vertical, measured RMSE 5.2 cm LE90 8.6 cm 10.0 cm, met", "7 of 8", "CHK-15", "9 of 10", "GCP-03",
        "mean shift of the map +1.0 cm east, -2.0 cm north, 0.0 cm up", "frames tied", "Fix",
    )  # fmt: skip
    spaced = re.sub(r"\s+", " ", re.sub("<[^>]+>", " ", render_report(FramesReport(**run)))).replace(
        "\u202f", " "
    )
    at = [spaced.index(wanted) for wanted in order]
    assert at == sorted(at), "in this order"
    assert "&lt;span" not in render_report(
        FramesReport(**run)
    ) and 'class="option">--gcp</span>' in render_report(FramesReport(**run))
    assert HOSTILE in words and "nan" not in words.split()


def test_what_is_not_known_is_not_stated(run):
    verdict = run["verdict"]
    none = replace(verdict.accuracy.absolute, rmse_h_m=np.nan, rmse_v_m=np.nan, check_points=0)
    silent = replace(verdict.accuracy.relative, scale_permille=np.nan)
    seams = replace(verdict.seams, displacement_px=np.full((3, 2), np.nan))
    accuracy = replace(verdict.accuracy, absolute=none, relative=silent)
    table = accuracy_table(accuracy, replace(verdict.required, why="no frame has a position"), seams, 0.1)
    assert [row.usual for row in table.rows] == ["–"] * 3
    assert table.notes == ["Required: no frame has a position."]


def test_nothing_required_takes_no_column_and_an_unknown_scale_is_named(run):
    """An empty last column pushed the table over the picture."""
    heading = "<th>required</th>"
    assert heading in render_report(FramesReport(**run))
    verdict = run["verdict"]
    nothing = dict.fromkeys(("rmse_h_m", "rmse_v_m", "permille"), np.nan)
    unscaled = replace(verdict.required, **nothing, scaled=False)
    html = render_report(FramesReport(**{**run, "verdict": replace(verdict, required=unscaled)}))
    assert heading not in html and "scale of the map: not known" in html


def test_programs_find_the_points_and_their_figures_next_to_the_page(run, tmp_path):
    folder = run["mosaic_file"].parent
    summary = {**run["summary"], "accuracy": {"class": "a"}, "verdict": {"grade": "doubtful"}}
    context = Context(folder, stage_id="export.report", work_folder=tmp_path / "work", summary=summary)
    given = {k: run[k] for k in ("survey", "placement", "ties", "adjusted", "mosaic", "verdict")}
    given["mosaic_file"] = context.run_file("mosaic.tif")
    export_report().run(given, export_report.Params(), context)
    reported = json.loads((folder / "accuracy_report.json").read_text(encoding="utf-8"))
    assert (reported["accuracy"], reported["verdict"]) == (summary["accuracy"], summary["verdict"])
    assert [p["name"] for p in reported["points"] if p["blunder"]] == ["GCP-03", "CHK-15"]
    figures = reported["figures"]["check"]
    assert (figures["points"], figures["used"], figures["blunders"]) == (8, 7, ["CHK-15"])
    assert figures["rmse_h_m"] == pytest.approx(point_figures(run["adjusted"])[0].rmse_h_m)


class Labels(HTMLParser):
    """What names a figure: heads of tables and of facts, first cells of rows that hold a figure, layers."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.found: set[str] = set()
        self.terms: set[str] = set()
        self._open: list[tuple[str, str]] = []
        self._cells, self._text = 0, ""
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        if tag in ("table", "dl", "tr", "th", "td", "dt", "form"):
            self._open.append((tag, given.get("class") or given.get("id") or ""))
        if tag == "tr":
            self._cells = 0
        if tag in ("td", "th", "dt"):
            self._cells, self._text = self._cells + 1, ""

    def handle_data(self, data):
        self._text += data

    def handle_endtag(self, tag):
        if not self._open or self._open[-1][0] != tag:
            return
        self._open.pop()
        within = {name for _, name in self._open}
        if "scores" in within:
            return
        text = " ".join(self._text.split())
        if tag == "dt" and "words" in within:
            self.terms |= {term.strip().lower() for term in text.split(",")} | {text.lower()}
        elif tag in ("dt", "th") or (tag == "td" and self._is_name(within)):
            self.found.add(text.lower())

    def _is_name(self, within):
        tables = {"evidence", "figures", "unknowns", "points"}
        return ("accuracy" in within and self._cells <= 2) or (bool(tables & within) and self._cells == 1)


NO_FIGURES = {
    "",
    "what",
    "likely cause, effect",
    "fix",
    "between",
    "and",
    "value",
    "what it says",
    "reference",
}


def test_the_glossary_defines_every_figure(run, request):
    """Of a page on which every section stands; a figure that is new has to be defined."""
    summary = {**run["summary"], "metrics": {**run["summary"]["metrics"], **SURFACE_METRICS, **COMPOSITION}}
    section = surface_section(request.getfixturevalue("surface_run"), compared=True)
    part = TrimmedPart("seen too coarsely", 40.0, ())
    shown = {**run, "summary": summary, "mosaic": replace(run["mosaic"], trimmed=Trimmed(400.0, (part,)))}
    html = render_report(FramesReport(**shown, surface=section))
    page = Labels(html)
    data = json.loads(re.search(r'id="map-data">(.*?)</script>', html)[1])
    page.found |= {layer["title"].lower() for layer in [*data["layers"], *data["images"]]}
    missing = {label for label in page.found - NO_FIGURES if not defined(label, page.terms)}
    assert len(page.found) > 90 and missing == set()
    assert not defined("sharpness", page.terms) and not defined("residuals of time", page.terms)


COMPOSITION = {
    "tones": {
        "difference_grey": dict.fromkeys(("before_median", "before_90", "after_median", "after_90"), 9.0)
    },
    "seams": {
        name: {"length_m": 3.0, "difference_mean": 4.0, "difference_90": 5.0, "on_objects": 0.1}
        for name in ("nearest_nadir", "least_difference")
    },
}


def defined(label: str, terms: set[str]) -> bool:
    """Whether it is a term, or one with its unit, its axis, its length or how it was found."""
    bare = re.sub(r"(, (col|row|measured|estimated))?( \[.*?\])?$| \d+ m$", "", label)
    bare = re.sub(r"^at \d+ of \d+ places$", "mismatch", bare)
    bare = re.sub(r"^(boresight|lever arm|offset) \w+$", r"\1", bare)
    return bare in terms


@pytest.fixture(scope="module")
def window(tmp_path_factory) -> Iterator[Window]:
    with browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


SMALLEST = """(() => {
  const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT), small = [];
  while (walk.nextNode()) {
    const of = walk.currentNode.parentElement, box = of.getBoundingClientRect();
    if (!walk.currentNode.data.trim() || !box.width || of.closest('script, style, svg')) continue;
    if (parseFloat(getComputedStyle(of).fontSize) < 12) small.push(of.outerHTML.slice(0, 80));
  }
  return small;
})()"""


def test_at_400_px_nothing_is_cut_and_text_is_readable(window, page):
    window.open(page.as_uri(), 400, 800)
    assert window.run("document.documentElement.scrollWidth") <= 400
    assert window.run(SMALLEST) == []
    wide = "[...document.querySelectorAll('.evidence, .accuracy')].map(t => [t.scrollWidth, t.parentElement.clientWidth])"
    assert all(table <= room <= 368 for table, room in window.run(wide))
    cells = "[...document.querySelectorAll('.evidence td, .accuracy td')].every(c => c.getBoundingClientRect().right <= 385)"
    assert window.run(cells)


def test_heights_above_the_take_off_have_no_figure_in_the_table(run):
    """Land may lie 800 m above the sea, which is no accuracy of a map."""
    verdict = run["verdict"]
    nowhere = replace(verdict.accuracy.absolute, rmse_v_m=800.0, check_points=0)
    accuracy = replace(verdict.accuracy, absolute=nowhere)
    table = accuracy_table(accuracy, replace(verdict.required, rmse_v_m=0.1), verdict.seams, 0.1)
    row = table.rows[-1]
    assert row.figure.startswith("vertical: not known") and row.missed and row.unstated
    assert "take-off" in row.figure and not row.most


@pytest.mark.parametrize("width", [400, 700, 900, 1280])
def test_the_accuracy_table_keeps_off_the_picture(window, page, width):
    window.open(page.as_uri(), width, 800)
    table, room = window.run(
        "['.accuracy', '.verdict'].map(s => document.querySelector(s).getBoundingClientRect().right)"
    )
    assert table <= room + 1 and window.run("document.documentElement.scrollWidth") <= width


def test_points_are_symbols_with_names_and_residuals(window, page):
    window.open(page.as_uri(), 1400, 900, dark=True)
    marks = "[...document.querySelectorAll('.surveyed')].map(m => m.querySelectorAll('path').length)"
    assert sorted(window.run(marks)) == [1] * 16 + [3] * 2, "blunders are crossed out"
    shapes = "new Set([...document.querySelectorAll('.surveyed path:first-child')].map(p => p.getAttribute('d'))).size"
    assert window.run(shapes) == 2
    legend = window.run("document.querySelector('.legend').innerText")
    assert re.search(r"Control points\s+Check points\s+Blunder\s+\d+ cm, drawn \d+ times larger", legend)
    window.run("document.getElementById('leaflet').scrollIntoView({block: 'center'})")
    wrong = "[...document.querySelectorAll('.surveyed')].find(m => m.querySelectorAll('path').length > 1)"
    x, y = window.run(f"(b => [b.x + b.width / 2, b.y + b.height / 2])({wrong}.getBoundingClientRect())")
    window.send("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
    window.until("document.querySelector('.leaflet-tooltip')")
    reported = window.run("document.querySelector('.leaflet-tooltip').textContent")
    assert re.match(r"(Control point GCP-03|Check point CHK-15)\n17\d\scm in plan", reported), reported
    window.click("#layers input[data-layer=check]")
    window.click("#layers input[data-layer=control]")
    assert window.run("document.querySelectorAll('.surveyed, .legend').length") == 0
    assert window.errors == [] and all(u.startswith(("file:", "data:")) for u in window.requests)


def test_paper_has_the_map_with_points_all_tables_and_the_glossary(window, page):
    window.open(page.as_uri(), 1400, 900)
    window.run("window.dispatchEvent(new Event('beforeprint'))")
    window.look(690, 1000, media="print")
    plate = "document.querySelector('.plate svg')"
    assert window.run(f"{plate}.getBoundingClientRect().width") > 500
    assert window.run("document.getElementById('plate-image').getAttribute('href')").startswith("data:image/")
    words = window.run(f"{plate}.textContent")
    assert "times larger" in words and "GCP-03" in words and "blunder" in words and "north is up" in words
    shut = "[...document.querySelectorAll('main details:not(#time details):not(.layers)')].filter(d => !d.open).length"
    assert window.run(shut) == 0
    whole = "[...document.querySelectorAll('#control tr, .evidence tr, .words div')].every(r => getComputedStyle(r).breakInside === 'avoid')"
    assert (
        window.run(whole)
        and window.run("document.querySelector('#words').getBoundingClientRect().height") > 0
    )
    content = base64.b64decode(window.send("Page.printToPDF", preferCSSPageSize=True)["data"])
    assert b"/MediaBox [0 0 594" in content or b"/MediaBox [0 0 595" in content, "A4"
    window.run("window.dispatchEvent(new Event('afterprint'))")
