"""The report in a real browser: map, table, swipe, dark, print, strangers' names, and a thousand frames."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from browser import Page, browser
from report_survey import HOSTILE, made_up_run

from geomosaic.report.frames import FramesReport, OtherImages, render_report
from geomosaic.report.glance import glance


@pytest.fixture(scope="module")
def window(tmp_path_factory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    run = made_up_run(folder)
    bad = "</script><script>document.title = 'taken'</script>"
    run["summary"]["warnings"].append({"code": "frame-damaged", "frame": bad, "text": bad})
    other = glance(folder / "ortho <true>.tif")
    file = folder / "report.html"
    file.write_text(
        render_report(FramesReport(**run, name="May", others=OtherImages(other, other))),
        encoding="utf-8",
    )
    return file


DRAWN = """(() => {
  const canvas = document.querySelector("#leaflet canvas"), of = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  let drawn = 0, chosen = 0;
  for (let k = 0; k < of.length; k += 4) {
    drawn += of[k + 3] > 0;
    chosen += of[k] === 0x1d && of[k + 1] === 0x9b && of[k + 2] === 0xf0 && of[k + 3] === 255;
  }
  return [drawn, chosen];
})()"""
AT_REST = "new Promise(done => setTimeout(done, 60))"
NAMES = (
    "[...document.querySelectorAll('#rows tbody tr:not([hidden]) td:first-child')].map(c => c.textContent)"
)
SELECTED = "[...document.querySelectorAll('#rows tr[aria-selected]')].map(r => Number(r.dataset.row))"


def asked(window: Page) -> list[str]:
    """Addresses besides the page's own."""
    return [url for url in window.requests if not url.startswith(("data:", "file:"))]


def complaints(window: Page) -> list[str]:
    """Without what Chromium says of a test that reads a canvas."""
    return [text for text in window.errors if "willReadFrequently" not in text]


def click(window: Page, selector: str) -> None:
    window.run(f"document.querySelector({selector!r}).scrollIntoView({{block: 'center'}})")
    window.click(selector)


def drawn(window: Page) -> tuple[int, int]:
    """Pixels of the map's canvas that hold anything, and that mark what is chosen."""
    window.run(AT_REST)
    of_all, chosen = window.run(DRAWN)
    return of_all, chosen


def test_it_opens_without_errors_or_requests_and_says_what_strangers_wrote(window, page):
    window.open(page.as_uri(), 1400, 900)
    assert complaints(window) == [] and asked(window) == []
    assert window.run("document.title") == "Mosaic of 12 frames, May"
    assert window.run("document.querySelectorAll('body img[src=x]').length") == 0
    assert HOSTILE in window.run(NAMES)
    image = window.run(
        "(b => [b.width, b.height, b.y])(document.getElementById('mosaic-image').getBoundingClientRect())"
    )
    verdict = window.run(
        "(b => [b.y, b.bottom, b.right])(document.querySelector('.verdict').getBoundingClientRect())"
    )
    assert image[0] > 300 and image[2] + image[1] <= 900 and verdict[1] < 900, "both on the first screen"


def test_layers_switch(window, page):
    window.open(page.as_uri(), 1400, 900)
    names = window.run(
        "[...document.querySelectorAll('#layers input[data-layer]')].map(b => b.dataset.layer)"
    )
    for wanted in (
        "mosaic",
        "overlap",
        "ssim",
        "footprints",
        "ties",
        "moves",
        "residuals",
        "displaced",
        "left",
        "frames",
    ):
        assert wanted in names, wanted
    all_of_it = drawn(window)[0]
    click(window, "#layers input[data-layer=footprints]")
    less = drawn(window)[0]
    assert less < 0.8 * all_of_it
    click(window, "#layers input[data-layer=moves]")
    assert drawn(window)[0] > less
    assert "times larger" in window.run("document.getElementById('notes').textContent")
    shown = "document.querySelectorAll('.leaflet-mosaic-pane img').length"
    assert window.run(shown) == 1
    click(window, "#layers input[data-layer=mosaic]")
    assert window.run(shown) == 0 and complaints(window) == []


def test_the_map_zooms_and_tells_where_the_mouse_is(window, page):
    window.open(page.as_uri(), 1400, 900)
    wide = "document.querySelector('.leaflet-mosaic-pane img').getBoundingClientRect().width"
    before = window.run(wide)
    click(window, ".leaflet-control-zoom-in")
    window.run("new Promise(done => setTimeout(done, 400))")
    assert window.run(wide) > 1.5 * before
    at = window.run(
        "(b => [b.x + b.width / 2, b.y + b.height / 2])(document.getElementById('leaflet').getBoundingClientRect())"
    )
    window.send("Input.dispatchMouseEvent", type="mouseMoved", x=at[0], y=at[1])
    east, north = map(
        float, re.findall(r"[\d.]{6,}", window.run("document.getElementById('place').textContent"))
    )
    assert abs(east - 686_100) < 500 and abs(north - 5_330_400) < 800


def test_the_table_sorts_and_filters(window, page):
    window.open(page.as_uri(), 1400, 900)
    given = window.run(NAMES)
    by = "[...document.querySelectorAll('#rows tbody tr')].map(r => Number(r.cells[3].dataset.by))"
    click(window, "#rows th:nth-child(4) button")
    moved = window.run(by)
    assert moved == sorted(moved) and window.run(NAMES) != given
    click(window, "#rows th:nth-child(4) button")
    assert window.run(by) == moved[::-1]
    window.run(
        "(f => { f.value = '0003'; f.dispatchEvent(new Event('input')); })(document.getElementById('filter'))"
    )
    assert window.run(NAMES) == ["DJI_0003.JPG"]
    assert window.run("document.getElementById('shown').textContent") == "1 of 12 frames"
    faint = drawn(window)[0]
    window.run(
        "(f => { f.value = ''; f.dispatchEvent(new Event('input')); })(document.getElementById('filter'))"
    )
    window.run(
        "(f => { f.value = 'placed'; f.dispatchEvent(new Event('change')); })(document.getElementById('kind'))"
    )
    assert window.run(NAMES) == ["DJI_0012.JPG"] and faint > 0


def test_a_row_and_its_place_on_the_map_select_each_other(window, page):
    window.open(page.as_uri(), 1400, 900)
    assert drawn(window)[1] == 0
    click(window, "#rows tbody tr:nth-child(5) td")
    assert window.run(SELECTED) == [4] and drawn(window)[1] > 100
    window.send("Input.dispatchKeyEvent", type="keyDown", key="Escape", code="Escape")
    assert window.run(SELECTED) == [] and drawn(window)[1] == 0
    window.run("document.getElementById('leaflet').scrollIntoView({block: 'center'})")
    middle = window.run(
        "(b => [b.x + b.width / 2, b.y + b.height / 2])(document.querySelector('.leaflet-mosaic-pane img').getBoundingClientRect())"
    )
    window.drag(tuple(middle))
    (row,) = window.run(SELECTED)
    assert 0 <= row < 12 and drawn(window)[1] > 100


def test_the_swipe_moves(window, page):
    window.open(page.as_uri(), 1400, 900)
    hidden = "getComputedStyle(document.getElementById('swipe')).display === 'none'"
    assert window.run(hidden)
    for side, name in (("left", "given"), ("right", "reference"), ("right", "mosaic")):
        window.run(
            f"(s => {{ s.value = '{name}'; s.dispatchEvent(new Event('change')); }})(document.getElementById('{side}'))"
        )
        assert not window.run(hidden)
    edges = "['given', 'mosaic'].map(n => document.querySelector(`.leaflet-${n}-pane`).style.clip.match(/[-\\d.]+/g).map(Number))"
    order = "['mosaic', 'given', 'reference', 'ssim'].map(n => Number(document.querySelector(`.leaflet-${n}-pane`).style.zIndex))"
    mosaic, given, reference, ssim = window.run(order)
    assert mosaic < given < reference < ssim, "what is switched on lies on both"
    window.run("document.getElementById('leaflet').scrollIntoView({block: 'center'})")
    before = window.run(edges)
    assert before[0][1] == before[1][3], "one ends where the other begins"
    x, y = window.run(
        "(b => [b.x + b.width / 2, b.y + b.height / 2])(document.getElementById('swipe').getBoundingClientRect())"
    )
    window.drag((x, y), (x - 60, y), (x - 120, y))
    after = window.run(edges)
    assert after[0][1] == pytest.approx(before[0][1] - 120.0, abs=1.5) and after[1][3] == after[0][1]
    assert complaints(window) == [] and asked(window) == []


def test_print_has_the_mosaic_and_the_glossary_but_no_form(window, page):
    window.open(page.as_uri(), 1400, 900)
    window.look(794, 1123, media="print")
    seen = "(s => document.querySelector(s).getBoundingClientRect().height > 0)"
    for selector, there in (
        ("#mosaic-image", True), ("#rows", True), (".verdict", True), ("#time", True),
        ("#leaflet", False), ("#score", False), ("#words", True), (".bar", False),
    ):  # fmt: skip
        assert window.run(f"{seen}('{selector}')") is there, selector
    stays = "[...document.querySelectorAll('#rows tr > :first-child')].every(c => getComputedStyle(c).position === 'static')"
    assert window.run(stays), "a head that sticks lies on the first row"
    content = base64.b64decode(window.send("Page.printToPDF")["data"])
    assert any(int(w) > 500 for w in re.findall(rb"/Width (\d+)", content)), "the mosaic's image"


@pytest.mark.parametrize("dark", [False, True])
def test_dark_light_and_narrow(window, page, dark):
    window.open(page.as_uri(), 400, 800, dark)
    assert window.run("document.documentElement.scrollWidth") <= 400
    paper, ink = window.run(
        "['backgroundColor', 'color'].map(k => getComputedStyle(document.body)[k].match(/\\d+/g).map(Number)[1])"
    )
    assert (paper < 50 and ink > 200) if dark else (paper > 200 and ink < 50)
    assert not window.run("document.getElementById('layers').open")


def test_a_thousand_frames_stay_fluent(window, tmp_path):
    run = made_up_run(tmp_path, 25, 40, with_comparison=False, ties_per_pair=3)
    file = tmp_path / "report.html"
    file.write_text(render_report(FramesReport(**run)), encoding="utf-8")
    assert file.stat().st_size < 4e6
    window.open(file.as_uri(), 1400, 900)
    loaded = window.run("(t => t.loadEventEnd - t.startTime)(performance.getEntriesByType('navigation')[0])")
    sort = "(() => { const t = performance.now(); document.querySelector('#rows th:nth-child(4) button').click(); document.body.offsetHeight; return performance.now() - t; })()"
    assert loaded < 8000 and window.run(sort) < 2000, "milliseconds, on a busy machine"
    assert window.run(NAMES + ".length") == 1000 and complaints(window) == []
