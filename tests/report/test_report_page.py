"""The report: self-contained, escaped, complete, small enough, and written by its stage."""

from __future__ import annotations

import ast
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from quality_images import eight_bits, texture, write_tif
from report_survey import HOSTILE, made_up_run

import geomosaic
from geomosaic.adjustment.model import Adjusted
from geomosaic.errors import FileError
from geomosaic.export.orientation import orientations
from geomosaic.geodesy.mapcrs import LOCAL_CRS
from geomosaic.matching.model import TiePoints
from geomosaic.pipeline.stage import Context
from geomosaic.report import warnings
from geomosaic.report.frame_layers import FrameLayers, map_footprints_m
from geomosaic.report.frames import FramesReport, render_report
from geomosaic.report.glance import glance
from geomosaic.report.parts import frame_table
from geomosaic.report.warnings import warnings_of
from geomosaic.stages.export_cog import export_cog
from geomosaic.stages.export_report import export_report
from geomosaic.stages.quality_compare import quality_compare


class Page(HTMLParser):
    """Tags with their attributes, ids, and the text that is shown."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words = ""
        self.open: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "input", "img", "br", "link"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "script"):
            self.words += data


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return made_up_run(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def html(run):
    return render_report(FramesReport(**run, name="run of May"))


def test_the_page_is_whole_and_says_what_a_surveyor_asks(html):
    page = Page(html)
    assert page.open == []
    words = " ".join(page.words.split())
    for wanted in (
        "Mosaic of 12 frames", "11 of 12", "2024-06-10", "EPSG:32632", "error sharing", "8 rounds",
        "no tie points", "no tie points with other frames", "absolute RMSE", "jump, 99 %", "SSIM", "DJI_0012.JPG",
        "focal length", "1000.00", "CCIR", "geomosaic replay run.mcap", "nadir point", "time taken", "11.0 s",
        "without this page",
    ):  # fmt: skip
        assert wanted in words, wanted
    assert words.index("Not judged") < words.index("Map and frames") < words.index("no tie points")
    targets = {a.get("id") for _, a in page.tags}
    links = [a["href"] for t, a in page.tags if t == "a"]
    assert links and all(link.startswith("#") and link[1:] in targets for link in links)


def test_light_and_seams_are_reported_before_and_after(run):
    grey = {"before_median": 11.53, "before_90": 33.32, "after_median": 9.32, "after_90": 29.33}
    seams = {
        "nearest_nadir": {"length_m": 3972.5, "difference_mean": 14.47, "difference_90": 32.48},
        "least_difference": {"length_m": 2974.3, "difference_mean": 7.29, "difference_90": 15.52},
        "median_px": 0.4,
    }
    metrics = {**run["summary"]["metrics"], "tones": {"difference_grey": grey}, "seams": seams}
    words = Page(
        render_report(FramesReport(**{**run, "summary": {**run["summary"], "metrics": metrics}}))
    ).words
    words = " ".join(words.split())
    for wanted in ("light11.5 (33.3)9.32 (29.3)", "seams14.5 (32.5)7.29 (15.5)", "3 972 m2 974 m"):
        assert wanted in words, wanted
    assert "halfway between frames" not in Page(render_report(FramesReport(**run))).words


def test_nothing_is_fetched_and_nothing_foreign_is_run(html):
    page = Page(html)
    assert "default-src 'none'" in html
    sources = [a[k] for _, a in page.tags for k in ("src", "href") if a.get(k)]
    assert all(s.startswith(("data:image/", "#")) for s in sources)
    assert "@import" not in html and "url(" not in html[: html.index("</style>")]
    assert not any(t in ("link", "iframe", "object", "base") for t, _ in page.tags)
    assert not any(k.startswith("on") for _, a in page.tags for k in a)


def test_strangers_names_are_shown_as_they_are(html):
    assert HOSTILE not in html
    assert HOSTILE in Page(html).words
    assert "ortho <true>.tif" in Page(html).words
    assert "turned by 180 degrees <b>" in Page(html).words


def test_the_score_form_asks_each_criterion_at_five_levels(html):
    page = Page(html)
    radios = [a for t, a in page.tags if t == "input" and a.get("type") == "radio"]
    (form,) = [a for t, a in page.tags if t == "form" and a["id"] == "scores"]
    assert form["data-run"] == "run of May"
    names = form["data-criteria"].split()
    assert {a["name"] for a in radios} == {f"score-{n}" for n in names}
    for name in names:
        assert [a["value"] for a in radios if a["name"] == f"score-{name}"] == list("54321")


def test_the_table_measures_from_the_prior(run):
    table = frame_table(
        run["placement"],
        run["ties"],
        run["adjusted"],
        orientations(run["survey"], run["placement"].poses, run["adjusted"]),
        {"DJI_0006.JPG": 3},
    )
    name, status, residual, moved, turned, _, ties, warned, line = table.rows[5].cells
    prior, after = run["placement"].poses.positions_m[5], run["adjusted"].poses.positions_m[5]
    assert float(moved.by) == pytest.approx(float(np.linalg.norm(after - prior)), rel=1e-5)
    assert 0.0 < float(turned.by) < 4.0 and (name.text, status.text) == ("DJI_0006.JPG", "tied")
    assert float(residual.by) == pytest.approx(0.04 * np.sqrt(2.0) / 0.1, rel=0.15)
    assert (warned.by, line.by) == ("3", "1") and float(ties.by) > 0.0
    last = table.rows[-1]
    assert last.kind == "placed" and last.cells[6].by == "0" and last.cells[2].text == "–"
    assert sum(int(r.cells[6].by) for r in table.rows) == 2 * sum(len(p) for p in run["ties"].pairs)


def test_rejected_frames_without_a_position_are_not_on_the_map(run):
    """The last two, which are tied to each other alone."""
    sd_m = run["placement"].poses.positions_sd_m.copy()
    sd_m[10:] = 1e5
    placement = replace(run["placement"], poses=replace(run["placement"].poses, positions_sd_m=sd_m))
    adjusted = replace(run["adjusted"], status=("tied",) * 10 + ("rejected",) * 2)
    pair = replace(run["ties"].pairs[0], left=10, right=11)
    adjusted = replace(adjusted, residuals_m=adjusted.residuals_m[:1])
    o = orientations(run["survey"], placement.poses, adjusted)
    outlines_m = map_footprints_m(run["survey"], adjusted, o.placed)
    drawn = FrameLayers(
        *(
            run["survey"],
            placement,
            TiePoints((pair,)),
            adjusted,
            o,
            outlines_m,
            np.array([690_000.0, 5.33e6]),
        ),
        pixel_m=0.1,
    )
    layers = {layer.name: layer for layer in drawn.all(run["mosaic"], None, None)}
    for shapes in (layers["frames"].points, layers["footprints"].areas):
        assert [bool(shape) for shape in shapes] == [True] * 10 + [False] * 2
    assert len(layers["moves"].lines) == 10
    assert layers["ties"].lines == layers["residuals"].lines == []


def test_equal_warnings_are_counted_and_routine_ones_folded(run):
    one = {"code": "frame-turned", "text": "upright here"}
    given = [{**one, "frame": f"{i}.jpg"} for i in range(6)]
    given.append({"code": "frame-damaged", "frame": "7.jpg", "text": "no end"})
    given.append({"code": "shutter-doubtful", "frame": "", "text": "frames turn"})
    warning_found = warnings_of({"warnings": given})
    assert [w.code for w in warning_found.severe] == ["frame damaged"] and [
        w.code for w in warning_found.look
    ] == ["shutter doubtful"]
    assert [(w.count, len(w.frames)) for w in warning_found.routine] == [(6, 6)] and warning_found.frames == {
        "7.jpg": 1
    }
    html = render_report(FramesReport(**{**run, "summary": {**run["summary"], "warnings": given}}))
    words = " ".join(Page(html).words.split())
    assert (
        words.index("The map suffers from this") < words.index("Worth a look") < words.index("1 routine note")
    )
    assert "× 6" in words and words.count("upright here") == 1


def test_severities_are_of_codes_that_there_are():
    """A code that is renamed would fall among those worth a look."""
    package = Path(geomosaic.__file__).parent
    said = {
        node.value
        for file in package.rglob("*.py")
        if file != Path(warnings.__file__)
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    assert not (warnings._SEVERE | warnings._ROUTINE) - said
    assert not warnings._SEVERE & warnings._ROUTINE


def test_a_map_without_a_scale_has_no_metres(run):
    """Frames without positions: lengths are in ground pixels, as nothing says how long a metre is."""
    seams = {"nearest_nadir": {"length_m": 972.5, "difference_mean": 1.0, "difference_90": 2.0}}
    seams["least_difference"] = seams["nearest_nadir"]
    poses = run["placement"].poses
    unknown = replace(poses, positions_sd_m=np.full((12, 3), 1e5))
    grid = replace(run["mosaic"].grid, crs=LOCAL_CRS)
    local = {
        "survey": replace(run["survey"], map_crs=LOCAL_CRS, control=()),
        "placement": replace(run["placement"], poses=unknown),
        "adjusted": replace(run["adjusted"], control=()),
        "mosaic": replace(run["mosaic"], grid=grid),
        "summary": {"metrics": {"seams": seams}},
        "comparison": None,
        "verdict": None,
    }
    html = render_report(FramesReport(**{**run, **local}))
    assert not re.findall(r".{40}\d\u00a0(?:m|cm|m²|ha)\b", html)
    words = " ".join(Page(html).words.split())
    assert (
        "9 725 px" in words.replace("\u202f", " ").replace("\u00a0", " ")
        and "As POS placed them" not in words
    )


def test_the_plain_run_without_reference_rounds_or_ties(run):
    adjusted = run["adjusted"]
    bare = Adjusted(adjusted.poses, adjusted.cameras, ("placed",) * 12, (), (), adjusted.ground)
    ties = replace(run["ties"], pairs=(), untied=())
    page = Page(
        render_report(
            FramesReport(**{**run, "adjusted": bare, "ties": ties, "comparison": None, "summary": {}})
        )
    )
    words = " ".join(page.words.split())
    assert "No warnings." in words and "Not judged" in words
    assert "Accuracy against the reference" not in words
    assert "without this page" not in words and "Peak memory of all processes:" not in words
    assert not re.search(r"\bnan\b", words)


@pytest.mark.proof
def test_a_thousand_frames_stay_below_five_megabytes(tmp_path):
    run = made_up_run(tmp_path, 20, 50, with_comparison=False, ties_per_pair=5)
    one = {"code": "no-tie-points", "text": "no tie points with other frames"}
    run["summary"]["warnings"] = [{**one, "frame": f"DJI_{i}.JPG"} for i in range(1000)]
    html = render_report(FramesReport(**run))
    assert len(html.encode()) < 5e6
    assert "× 1000" in html and "The rest is in run.json." in html


def test_the_glance_knows_its_place_and_area(tmp_path):
    valid = np.ones((300, 400), dtype=bool)
    valid[:150, :200] = False
    image = eight_bits(texture(300, 400, seed=1)).astype(np.uint16) * 37
    path = write_tif(tmp_path / "m.tif", image, 500000.0, 5200000.0, 0.5, valid=valid)
    g = glance(path)
    assert g.covered_m2 == pytest.approx(0.75 * 200.0 * 150.0)
    np.testing.assert_allclose(g.at(np.array([[500050.0, 5199970.0]])), [[100.0, 60.0]], atol=1e-6)
    assert g.uri.startswith("data:image/webp;base64,")
    with pytest.raises(FileError, match="there is no such file"):
        glance(tmp_path / "none.tif")


def test_both_stages_in_a_run_folder(run, tmp_path):
    folder = run["mosaic_file"].parent
    context = Context(folder, stage_id="quality.compare", work_folder=tmp_path / "work")
    mosaic_file = context.run_file("mosaic.tif")
    params = quality_compare.Params(reference=folder / "ortho <true>.tif", search_px=16)
    given = {"mosaic_file": mosaic_file, "mosaic": run["mosaic"]}
    compared = quality_compare().run(given, params, context)
    comparison, seen = compared["comparison"], compared["reference_seen"]
    metrics = context.notes.metrics["quality"]
    assert metrics["absolute_rmse_m"] == pytest.approx(comparison.figures.absolute_rmse_m)
    assert 0.5 < metrics["ssim"]["ssim"] < 1.0
    json.dumps(context.notes.metrics, allow_nan=False)

    context = Context(
        folder, stage_id="export.report", work_folder=tmp_path / "work2", summary=run["summary"]
    )
    inputs = {k: run[k] for k in ("survey", "placement", "ties", "adjusted", "mosaic")}
    given = {**inputs, "mosaic_file": mosaic_file, **compared}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("geomosaic.report.map_images.open_map", None)  # the reference isn't opened again
        out = export_report().run(given, export_report.Params(), context)
    assert out["report_file"].name == "report.html"
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "absolute RMSE" in page and seen.image.uri in page


def test_frame_errors_against_the_truth_enter_the_metrics(run, tmp_path):
    survey, adjusted = run["survey"], run["adjusted"]
    geodetic = survey.work_frame.geodetic_from_enu(adjusted.poses.positions_m)
    lines = ["frame,lon_deg,lat_deg,height_ellipsoidal_m,yaw_deg,pitch_deg,roll_deg"]
    for i, (lon, lat, height) in enumerate(geodetic):
        yaw = 90 if run["placement"].lines[i] % 2 == 0 else 270
        lines.append(f'"{survey.frames[i].name}",{lon:.10f},{lat:.10f},{height:.4f},{yaw},-90,0')
    truth = tmp_path / "positions.csv"
    truth.write_text("\n".join(lines))
    folder = run["mosaic_file"].parent
    context = Context(folder, stage_id="quality.compare", work_folder=tmp_path / "work")
    params = quality_compare.Params(reference=folder / "ortho <true>.tif", truth=truth, search_px=16)
    given = {k: run[k] for k in ("survey", "placement", "adjusted")}
    quality_compare().run({**given, "mosaic_file": context.run_file("mosaic.tif")}, params, context)
    frames = context.notes.metrics["quality"]["frames"]
    assert len(frames["error_m"]) == 12 and frames["rmse_m"] < 0.02


def test_the_mosaic_is_reduced_for_the_report_while_it_is_exported(run, tmp_path, monkeypatch):
    (tmp_path / "raster.tif").write_bytes(run["mosaic_file"].read_bytes())
    context = Context(tmp_path, stage_id="export.cog", key="k")
    raster = {"raster_file": context.run_file("raster.tif")}
    made = export_cog().run(raster, export_cog.Params(), context)
    small = glance(tmp_path / "mosaic.tif")
    monkeypatch.setattr("geomosaic.report.frames.glance", None)  # it isn't reduced again
    context = Context(tmp_path, stage_id="export.report", key="another", summary=run["summary"])
    inputs = {k: run[k] for k in ("survey", "placement", "ties", "adjusted", "mosaic")}
    export_report().run({**inputs, **made}, export_report.Params(), context)
    assert small.uri in (tmp_path / "report.html").read_text(encoding="utf-8")
