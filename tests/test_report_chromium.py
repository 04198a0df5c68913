"""The report in a real browser: map, table, swipe, dark, print, strangers' names, and a thousand frames."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from chromium import Chromium
from report_survey import HOSTILE, made_up_run

from geomosaic.report.frames import Beside, render_report
from geomosaic.report.glance import glance


@pytest.fixture(scope="module")
def browser(tmp_path_factory) -> Iterator[Chromium]:
    chromium = Chromium(tmp_path_factory.mktemp("profile"))
    yield chromium
    chromium.close()


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    run = made_up_run(folder)
    bad = "</script><script>document.title = 'taken'</script>"
    run["summary"]["warnings"].append({"code": "frame-damaged", "frame": bad, "text": bad})
    other = glance(folder / "ortho <true>.tif")
    file = folder / "report.html"
    file.write_text(render_report(**run, beside=Beside(other, other)), encoding="utf-8")
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
SETTLED = "new Promise(done => setTimeout(done, 60))"
NAMES = (
    "[...document.querySelectorAll('#rows tbody tr:not([hidden]) td:first-child')].map(c => c.textContent)"
)
SELECTED = "[...document.querySelectorAll('#rows tr[aria-selected]')].map(r => Number(r.dataset.row))"


def drawn(browser: Chromium) -> tuple[int, int]:
    """Pixels of the map's canvas that hold anything, and that mark what is chosen."""
    browser.run(SETTLED)
    of_all, chosen = browser.run(DRAWN)
    return of_all, chosen


def test_it_opens_without_errors_or_requests_and_says_what_strangers_wrote(browser, page):
    browser.open(page)
    assert browser.complaints == [] and browser.requests == []
    assert browser.run("document.title") == f"Mosaic of 12 frames, {page.parent.name}"
    assert browser.run("document.querySelectorAll('body img[src=x]').length") == 0
    assert HOSTILE in browser.run(NAMES)
    image = browser.run(
        "(b => [b.width, b.height, b.y])(document.getElementById('mosaic-image').getBoundingClientRect())"
    )
    verdict = browser.run(
        "(b => [b.y, b.bottom, b.right])(document.querySelector('.verdict').getBoundingClientRect())"
    )
    assert image[0] > 300 and image[2] + image[1] <= 900 and verdict[1] < 900, "both on the first screen"


def test_layers_switch(browser, page):
    browser.open(page)
    names = browser.run(
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
    all_of_it = drawn(browser)[0]
    browser.click("#layers input[data-layer=footprints]")
    less = drawn(browser)[0]
    assert less < 0.8 * all_of_it
    browser.click("#layers input[data-layer=moves]")
    assert drawn(browser)[0] > less
    assert "times larger" in browser.run("document.getElementById('notes').textContent")
    shown = "document.querySelectorAll('.leaflet-mosaic-pane img').length"
    assert browser.run(shown) == 1
    browser.click("#layers input[data-layer=mosaic]")
    assert browser.run(shown) == 0 and browser.complaints == []


def test_the_map_zooms_and_tells_where_the_mouse_is(browser, page):
    browser.open(page)
    wide = "document.querySelector('.leaflet-mosaic-pane img').getBoundingClientRect().width"
    before = browser.run(wide)
    browser.click(".leaflet-control-zoom-in")
    browser.run("new Promise(done => setTimeout(done, 400))")
    assert browser.run(wide) > 1.5 * before
    at = browser.run(
        "(b => [b.x + b.width / 2, b.y + b.height / 2])(document.getElementById('leaflet').getBoundingClientRect())"
    )
    browser.send("Input.dispatchMouseEvent", type="mouseMoved", x=at[0], y=at[1])
    east, north = map(
        float, re.findall(r"[\d.]{6,}", browser.run("document.getElementById('place').textContent"))
    )
    assert abs(east - 686_100) < 500 and abs(north - 5_330_400) < 800


def test_the_table_sorts_and_filters(browser, page):
    browser.open(page)
    given = browser.run(NAMES)
    by = "[...document.querySelectorAll('#rows tbody tr')].map(r => Number(r.cells[3].dataset.by))"
    browser.click("#rows th:nth-child(4) button")
    moved = browser.run(by)
    assert moved == sorted(moved) and browser.run(NAMES) != given
    browser.click("#rows th:nth-child(4) button")
    assert browser.run(by) == moved[::-1]
    browser.run(
        "(f => { f.value = '0003'; f.dispatchEvent(new Event('input')); })(document.getElementById('filter'))"
    )
    assert browser.run(NAMES) == ["DJI_0003.JPG"]
    assert browser.run("document.getElementById('shown').textContent") == "1 of 12 frames"
    faint = drawn(browser)[0]
    browser.run(
        "(f => { f.value = ''; f.dispatchEvent(new Event('input')); })(document.getElementById('filter'))"
    )
    browser.run(
        "(f => { f.value = 'placed'; f.dispatchEvent(new Event('change')); })(document.getElementById('kind'))"
    )
    assert browser.run(NAMES) == ["DJI_0012.JPG"] and faint > 0


def test_a_row_and_its_place_on_the_map_select_each_other(browser, page):
    browser.open(page)
    assert drawn(browser)[1] == 0
    browser.click("#rows tbody tr:nth-child(5) td")
    assert browser.run(SELECTED) == [4] and drawn(browser)[1] > 100
    browser.send("Input.dispatchKeyEvent", type="keyDown", key="Escape", code="Escape")
    assert browser.run(SELECTED) == [] and drawn(browser)[1] == 0
    browser.run("document.getElementById('leaflet').scrollIntoView({block: 'center'})")
    middle = browser.run(
        "(b => [b.x + b.width / 2, b.y + b.height / 2])(document.querySelector('.leaflet-mosaic-pane img').getBoundingClientRect())"
    )
    browser.mouse([tuple(middle)])
    (row,) = browser.run(SELECTED)
    assert 0 <= row < 12 and drawn(browser)[1] > 100


def test_the_swipe_moves(browser, page):
    browser.open(page)
    hidden = "getComputedStyle(document.getElementById('swipe')).display === 'none'"
    assert browser.run(hidden)
    for side, name in (("left", "given"), ("right", "reference"), ("right", "mosaic")):
        browser.run(
            f"(s => {{ s.value = '{name}'; s.dispatchEvent(new Event('change')); }})(document.getElementById('{side}'))"
        )
        assert not browser.run(hidden)
    edges = "['given', 'mosaic'].map(n => document.querySelector(`.leaflet-${n}-pane`).style.clip.match(/[-\\d.]+/g).map(Number))"
    browser.run("document.getElementById('leaflet').scrollIntoView({block: 'center'})")
    before = browser.run(edges)
    assert before[0][1] == before[1][3], "one ends where the other begins"
    x, y = browser.run(
        "(b => [b.x + b.width / 2, b.y + b.height / 2])(document.getElementById('swipe').getBoundingClientRect())"
    )
    browser.mouse([(x, y), (x - 60, y), (x - 120, y)])
    after = browser.run(edges)
    assert after[0][1] == pytest.approx(before[0][1] - 120.0, abs=1.5) and after[1][3] == after[0][1]
    assert browser.complaints == [] and browser.requests == []


def test_print_has_the_mosaic_and_neither_form_nor_glossary(browser, page, tmp_path):
    browser.open(page)
    browser.look(794, 1123, media="print")
    seen = "(s => document.querySelector(s).getBoundingClientRect().height > 0)"
    for selector, there in (
        ("#mosaic-image", True), ("#rows", True), (".verdict", True), ("#time", True),
        ("#leaflet", False), ("#score", False), ("#words", False), (".bar", False),
    ):  # fmt: skip
        assert browser.run(f"{seen}('{selector}')") is there, selector
    browser.pdf(tmp_path / "report.pdf")
    content = (tmp_path / "report.pdf").read_bytes()
    assert any(int(w) > 500 for w in re.findall(rb"/Width (\d+)", content)), "the mosaic's image"
    browser.look(1400, 900)


@pytest.mark.parametrize("dark", [False, True])
def test_dark_light_and_narrow(browser, page, dark):
    browser.open(page, 400, 800, dark)
    assert browser.run("document.documentElement.scrollWidth") <= 400
    paper, ink = browser.run(
        "['backgroundColor', 'color'].map(k => getComputedStyle(document.body)[k].match(/\\d+/g).map(Number)[1])"
    )
    assert (paper < 50 and ink > 200) if dark else (paper > 200 and ink < 50)
    assert not browser.run("document.getElementById('layers').open")


def test_a_thousand_frames_stay_fluent(browser, tmp_path):
    run = made_up_run(tmp_path, 25, 40, with_comparison=False, ties_per_pair=3)
    file = tmp_path / "report.html"
    file.write_text(render_report(**run), encoding="utf-8")
    assert file.stat().st_size < 4e6
    browser.open(file)
    loaded = browser.run("(t => t.loadEventEnd - t.startTime)(performance.getEntriesByType('navigation')[0])")
    sort = "(() => { const t = performance.now(); document.querySelector('#rows th:nth-child(4) button').click(); document.body.offsetHeight; return performance.now() - t; })()"
    assert loaded < 8000 and browser.run(sort) < 2000, "milliseconds, on a busy machine"
    assert browser.run(NAMES + ".length") == 1000 and browser.complaints == []
