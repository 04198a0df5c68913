"""The strips' report: whole, escaped, without a network, and right in what it says."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from strip_scenes import ComposedScene, composed

from geomosaic.ccd.model import PairOffsets
from geomosaic.errors import GeomosaicError
from geomosaic.quality.jitter import Spectrum
from geomosaic.quality.strip_figures import strip_figures
from geomosaic.quality.strips import PairQuality, StripQuality
from geomosaic.report.numbers import whole
from geomosaic.report.strip_images import Place, seam_col, seam_crops, seam_places
from geomosaic.report.strip_plots import misplacement_plot, offsets_plot, spectrum_plot
from geomosaic.report.strips import StripsReport, render_strips_report, strips_verdict
from geomosaic_simulate.strip_plan import StripPlan

SUMMARY = {
    "warnings": [{"code": "scene-gap", "frame": "<img src=x>", "text": "<script>alert(1)</script>"}],
    "timings_s": {"ccd.offsets": 12.5, "mosaic.strips": 130.0},
    "peak_memory_mb": 812.4,
    "recipe": {"name": "strips_joint"},
    "versions": {"geomosaic": "9.9"},
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> ComposedScene:
    plan = StripPlan(ccds=4, width_px=320, lines=4600, seed=3, dead="4", short="2:4400", cloud_cover=0.15)
    return composed(tmp_path_factory.mktemp("strips"), plan, bump_px=2.5)


def page_of(scene: ComposedScene, **changes: object) -> str:
    given = {
        "geometry": scene.geometry,
        "offsets": scene.offsets,
        "quality": scene.quality,
        "radiometry": scene.radiometry,
        "mosaic": scene.mosaic,
        "mosaic_file": scene.mosaic_file,
        "summary": SUMMARY,
    }
    return render_strips_report(StripsReport(**(given | changes)))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def page(scene: ComposedScene) -> str:
    return page_of(scene)


class Tags(HTMLParser):
    """Open elements, ids and references."""

    VOID = ("meta", "input", "br", "img")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.refs: list[str] = []

    def handle_starttag(self, name: str, attributes: list[tuple[str, str | None]]) -> None:
        if name not in self.VOID:
            self.open.append(name)
        for key, value in attributes:
            if key == "id":
                self.ids.append(value or "")
            if key in ("href", "src"):
                self.refs.append(value or "")

    def handle_startendtag(self, name: str, attributes: list[tuple[str, str | None]]) -> None:
        self.refs += [value or "" for key, value in attributes if key in ("href", "src")]

    def handle_endtag(self, name: str) -> None:
        assert self.open.pop() == name


def test_the_page_is_sound_and_needs_no_network(page: str) -> None:
    tags = Tags()
    tags.feed(page)
    assert tags.open == []
    assert len(set(tags.ids)) == len(tags.ids)
    for ref in tags.refs:
        assert ref.startswith("data:image/webp;base64,") or (ref[0] == "#" and ref[1:] in tags.ids)
    assert "default-src 'none'; img-src data:;" in page
    assert "<script>alert" not in page and "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert "&lt;img src=x&gt;" in page
    assert len(page) < 1_500_000


def test_the_page_is_the_run_s(scene: ComposedScene) -> None:
    page = page_of(scene, name="scene <7>")
    assert (
        "<title>Scene of 3 CCD strips, scene &lt;7&gt;</title>" in page and "<b>scene &lt;7&gt;</b>" in page
    )


def test_offsets_sort_by_their_least_value(page: str) -> None:
    head = page[page.index('id="rows"') :].partition("</thead>")[0]
    columns = re.findall(r'<th( class="n")? scope="col"><button type="button">([^<]*)', head)
    row = re.findall(r"<td[^>]*>", page[page.index('<tr data-row="0"') :].partition("</tr>")[0])
    for (numbers, title), cell in zip(columns, row, strict=True):
        assert bool(numbers) == ("data-by" in cell), title


def test_what_it_says(page: str, scene: ComposedScene) -> None:
    worst = scene.quality.pairs[1].segments_px
    assert int(np.nanargmax(worst)) == 6 and worst[6] > 2.0
    many = sum(int(np.isfinite(p.segments_px).sum()) for p in scene.quality.pairs)
    assert many >= 8
    for words in (
        "Scene of 3 CCD strips",
        f"Misplaced: 1 of {many} segments is off by more than 1 px",
        "between CCDs 2 and 3 at lines 3072 to 3583",
        "3 of 4",
        f"{whole(scene.mosaic.width_px)} × {whole(scene.mosaic.height_px)}",
        "CCD 4 has no strip.",
        "The strip of CCD 2 ends 200 lines before the longest.",
        f"Columns {scene.mosaic.gaps_px[0][0]} to {scene.mosaic.gaps_px[0][1] - 1} of the scene are empty",
        "ccd1.tif – ccd2.tif",
        "0.9700",
        "2\u00a0min 22\u00a0s",
        "peak memory 812\u00a0MB",
        "strips_joint",
        "limit, 1 px",
    ):
        assert words in page, words
    for section in re.findall(r'<section id="(\w+)">', page):
        assert section in (
            "warnings",
            "map",
            "missing",
            "misplacement",
            "seams",
            "offsets",
            "jitter",
            "ccds",
            "time",
            "next",
            "words",
        )
    assert page.count('class="seam"') >= 5
    layers = {
        one["name"]: one for one in json.loads(re.search(r'id="map-data">(.*?)</script>', page)[1])["layers"]
    }
    assert layers["misplaced"]["rows"] == [1] and layers["misplaced"]["labels"][0].startswith(
        "lines 3072 to 3583"
    )
    assert layers["ccds"]["odd"] == [3] and layers["ccds"]["labels"] == ["1", "2", "3", "4"]
    assert '<tr data-row="1" data-kind="misplaced"' in page


def test_a_scene_in_place_says_so(scene: ComposedScene) -> None:
    first = scene.quality.pairs[0]
    figures = strip_figures([np.full((600, 2), 0.03)])
    quality = StripQuality((first,), figures, 600, 0, 0)
    page = page_of(scene, quality=quality, summary={}, radiometry=None)
    assert "In place: neighbouring strips agree to 0.042\u00a0px RMS" in page and "No warnings." in page
    assert "could not be checked" not in page and 'id="time"' in page


def test_a_scene_that_could_not_be_checked_says_so(scene: ComposedScene) -> None:
    hidden = tuple(
        replace(
            p,
            residual_px=np.full_like(p.residual_px, np.nan),
            segments_px=np.full_like(p.segments_px, np.nan),
        )
        for p in scene.quality.pairs
    )
    page = page_of(scene, quality=StripQuality(hidden, strip_figures([]), 5000, 4000, 1000))
    assert "Nothing could be checked" in page and "Nothing could be measured." in page
    assert "nan" not in re.sub(r"base64,[^\"]*", "", page)


def test_seams_that_could_not_be_checked_lead_the_verdict(scene: ComposedScene) -> None:
    """One black strip hides two seams: the third one's figures do not speak for them."""
    first, second = scene.quality.pairs
    gone = {
        "residual_px": np.full_like(first.residual_px, np.nan),
        "segments_px": np.full_like(first.segments_px, np.nan),
        "share_of_labels": (np.nan,) * 3,
    }
    figures = strip_figures([np.full((600, 2), 0.03)])
    page = page_of(scene, quality=StripQuality((replace(first, **gone), second), figures, 600, 0, 0))
    assert (
        '<p class="why">Nothing could be checked between CCDs 1–2; elsewhere neighbouring strips agree to '
        "0.042\u00a0px RMS"
    ) in page
    assert "In place" not in page and "nan" not in re.sub(r"base64,[^\"]*", "", page)
    worse = strip_figures([np.full((600, 2), 3.0)])
    page = page_of(scene, quality=StripQuality((replace(first, **gone), second), worse, 600, 0, 0))
    lead = re.search(r'<p class="why">(.*?)\.[ <]', page)
    assert lead and lead[1].startswith("Misplaced: 1 of")
    assert lead[1].endswith("; between CCDs 1–2 nothing could be checked")
    few = strip_figures([np.full((20, 2), 0.03)])
    page = page_of(scene, quality=StripQuality((replace(first, **gone),), few, 600, 580, 0))
    assert '<p class="why">Too little could be checked' in page


@pytest.mark.parametrize(
    ("hidden", "words"), [((0, 1), "CCDs 1–2 and 2–3;"), ((0, 1, 4), "CCDs 1–2, 2–3 and 5–6;")]
)
def test_all_hidden_seams_are_named(hidden: tuple[int, ...], words: str) -> None:
    pairs = [
        PairQuality(
            k,
            600,
            np.zeros((10, 2)),
            np.full(10, 0.01),
            np.full(10, 64.0),
            np.zeros((10, 2)),
            np.full(2, np.nan if k in hidden else 0.04),
            (1.0, 0.0, 0.0),
        )
        for k in range(5)
    ]
    figures = strip_figures([np.full((600, 2), 0.03)])
    reported = strips_verdict(StripQuality(tuple(pairs), figures, 600, 0, 0))
    assert reported.startswith(f"Nothing could be checked between {words} elsewhere")


def test_crops_are_of_the_seam_at_full_size(scene: ComposedScene) -> None:
    """The crop is the scene's own pixels about the seam, at the row where the line lies."""
    import rasterio

    from geomosaic.doors.raster import OWN, open_raster

    place = Place("worst", 1500, 0.5)
    ((reported, svg),) = seam_crops(scene.mosaic_file, scene.geometry, 0, [place], scene.mosaic.first_line)
    assert reported == place
    data = base64.b64decode(re.search(r"base64,([^\"]+)", svg).group(1))  # type: ignore[union-attr]
    crop = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert crop.shape[:2] == (220, 300)
    # Pair 0 is of side +1: line 1500 of the left strip lies 1057 lines further on in the scene.
    row = round(1500 + 1057 - scene.mosaic.first_line) - 110
    col = round(seam_col(scene.geometry, 0)) - 150
    assert seam_col(scene.geometry, 0) == 320 - 96 + 48
    with open_raster(scene.mosaic_file, OWN) as raster:
        truth = raster.read(1, window=rasterio.windows.Window(col, row, 300, 220)).astype(np.float64)
    assert np.corrcoef(truth.ravel(), crop[..., 0].ravel())[0, 1] > 0.98
    assert f'width="300" height="{220 + 18}"' in svg
    with pytest.raises(GeomosaicError, match="none\\.tif"):
        seam_crops(scene.mosaic_file.with_name("none.tif"), scene.geometry, 0, [place], 0.0)


def test_places_worth_a_look(scene: ComposedScene) -> None:
    checked, offsets = scene.quality.pairs[1], scene.offsets.pairs[1]
    worst, typical, hidden = seam_places(scene.geometry, checked, offsets)
    assert worst.why == "worst" and 3072 <= worst.line < 3584 and worst.left_px == pytest.approx(2.5, abs=0.2)
    assert typical.why == "typical" and typical.left_px < 0.1
    assert hidden.why == "not measured" and offsets.label[hidden.line] != 0 and np.isnan(hidden.left_px)


def pair(n: int) -> PairOffsets:
    t = np.linspace(0.0, 6.0, n)
    label = np.zeros(n, np.uint8)
    label[n // 2 : n // 2 + 3] = 1
    label[-n // 10 :] = 2
    return PairOffsets(0, np.sin(t), 3 * np.cos(t), np.full(n, 0.1), np.full(n, 0.2), label)


@pytest.mark.parametrize("n", [1, 40, 35_000])
def test_plots_of_offsets_stay_small_and_keep_short_stretches(n: int) -> None:
    svg = offsets_plot(pair(n), label="<offsets>")
    assert svg.count("<polyline") == 2 and svg.count("<polygon") == 2 and "&lt;offsets&gt;" in svg
    assert len(svg) < 200_000 and "nan" not in svg
    if n > 1:
        # Three bridged lines of 35,000 are still a bar of their own.
        bars = re.findall(r'<rect x="[\d.]+" y="[\d.]+" width="[\d.]+" height="10" fill="(#\w+)"/>', svg)
        assert sorted(bars) == ["#b8860b", "#d55e00"]


def test_plots_of_nothing() -> None:
    assert misplacement_plot(StripQuality((), strip_figures([]), 0, 0, 0), [], label="x") is None
    none = Spectrum(np.empty(0), np.empty(0), np.empty(0))
    assert spectrum_plot(none, none, label="x") is None
    hz = np.linspace(0.0, 90.0, 4000)
    some = Spectrum(hz, np.full(4000, 0.01), np.exp(-((hz - 22.0) ** 2)))
    svg = spectrum_plot(some, none, label="x")
    assert svg is not None and svg.count("<polyline") == 2 and ">22" not in svg and ">100<" in svg


def test_an_unreadable_mosaic_is_one_clear_line(scene: ComposedScene, tmp_path: Path) -> None:
    (tmp_path / "m.tif").write_text("no image")
    with pytest.raises(GeomosaicError, match=r"m\.tif"):
        page_of(scene, mosaic_file=tmp_path / "m.tif")
