"""The report's section on what was solved: numbers, words and images with values known by hand."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from defusedxml.ElementTree import fromstring
from report_survey import made_up_run
from solved_block import ALONE, solved_block
from test_report_page import Page

from geomosaic.adjustment.model import ImageResiduals, SharedUnknowns
from geomosaic.camera.interior import Camera
from geomosaic.projection.ground import GroundSurface
from geomosaic.report.frames import FramesReport, render_report
from geomosaic.report.plots import Axis, histogram
from geomosaic.report.solved_figures import (
    ground_reason,
    residual_fields,
    solved_names,
    strong_correlations,
    unknown_name,
    unknown_tables,
)
from geomosaic.report.solved_plots import correlation_map, image_vectors
from geomosaic.report.svg import COLOURS

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def solved():
    return solved_block()


def shared() -> SharedUnknowns:
    correlation = np.eye(5)
    correlation[1, 2] = correlation[2, 1] = -0.88
    correlation[0, 4] = correlation[4, 0] = 0.71
    correlation[0, 1] = correlation[1, 0] = 0.69
    correlation[3] = correlation[:, 3] = np.nan
    return SharedUnknowns(
        of=("lens", "lens", "lens", "lens", "platform"),
        names=("focal_length_px", "k1", "k2", "principal_row_px", "gps_lag_s"),
        given=np.array([1000.0, -0.02, 0.0, 297.0, 0.0]),
        found=np.array([1005.4595, -0.0218102, 0.0031113, 297.0, 0.2017]),
        sd=np.array([4.9616, 0.0041546, 0.0315238, np.nan, 0.0112]),
        correlation=correlation,
        fixed=np.array([False, False, False, True, False]),
    )


def test_every_number_says_what_was_given_and_found_with_its_deviation():
    (lens, rows), (platform, lag) = unknown_tables(shared())
    assert (lens, platform) == ("lens", "platform")
    f, k1, k2, row = rows
    assert (f.name, f.given, f.found, f.change, f.sd, f.change_sd, f.undetermined) == (
        "focal length [px]", "1000.0", "1005.5", "+5.5 (+0.55 %)", "5.0", "+1.1", False,
    )  # fmt: skip
    assert (k1.name, k1.given, k1.found, k1.change, k1.sd, k1.change_sd) == (
        "k1", "-0.0200", "-0.0218", "-0.0018", "0.0042", "-0.4",
    )  # fmt: skip
    assert (k2.found, k2.sd) == ("0.003", "0.032")
    assert (row.name, row.given, row.found, row.undetermined) == (
        "principal point, row [px]",
        "297",
        "",
        True,
    )
    assert (lag[0].name, lag[0].found, lag[0].change_sd) == ("GPS lag [s]", "0.202", "+18.0")
    assert unknown_name("boresight_roll_deg") == ("boresight roll", "°")
    assert unknown_name("lever_arm_forward_m") == ("lever arm forward", "m")


def test_strong_correlations_come_first_and_fixed_numbers_not_at_all():
    names, correlation = solved_names(shared())
    assert names == ["focal length", "k1", "k2", "GPS lag"]
    assert strong_correlations(names, correlation) == [
        ("k1", "k2", -0.88), ("focal length", "GPS lag", 0.71),
    ]  # fmt: skip
    two = replace(shared(), of=("left", "left", "right", "right", "platform"), names=("k1", "k2", "k1", "k2", "gps_lag_s"))  # fmt: skip
    assert solved_names(two)[0] == ["left: k1", "left: k2", "right: k1", "platform: GPS lag"]


@pytest.mark.parametrize(
    ("kind", "relief_px", "asked", "reason"),
    [
        ("dem", None, "auto", "a DEM was given"),
        ("tie_surface", 3.23, "auto",
         "relief moves points by 3.2 px at the mosaic's resolution, more than half a pixel"),
        ("flat", 0.31, "auto",
         "relief moves points by 0.31 px at the mosaic's resolution, not more than half a pixel"),
        ("flat", 0.31, "flat", "chosen by parameter"),
        ("tie_surface", 0.2, "auto",
         "relief moves points by 0.2 px at the mosaic's resolution, but images or positions and attitudes contradict level "
         "ground"),
        ("flat", 0.7, "auto",
         "chosen by parameter, though relief moves points by 0.7 px at the mosaic's resolution"),
        ("flat", None, "auto", "no DEM was given; images and attitudes agree with level ground"),
    ],
)  # fmt: skip
def test_the_ground_has_a_reason(solved, kind, relief_px, asked, reason):
    figures = {} if relief_px is None else {"ground_relief_px": relief_px}
    surface = GroundSurface(kind, 0.0, 0.0, 1.0, np.zeros((1, 1)))
    adjusted = replace(solved.adjusted, ground=surface, figures=figures)
    assert ground_reason(adjusted, asked) == reason


def test_a_lens_fault_shows_also_where_half_of_the_images_were_turned(solved):
    """Residuals of 2 px to the right in the image's left third, as the sensor lay; none elsewhere."""
    survey, rng = solved.survey, np.random.default_rng(4)
    m = 8000
    frame = rng.integers(0, 8, m)
    sensor = rng.uniform([0.0, 0.0], [800.0, 600.0], (m, 2))
    fault = np.where(sensor[:, :1] < 800.0 / 3.0, [2.0, 0.0], [0.0, 0.0]) + rng.normal(0.0, 0.3, (m, 2))
    turned = tuple(2 if i % 2 else 0 for i in range(8))
    half = (frame % 2 == 1)[:, None]
    weight = np.ones(m)
    weight[:50], fault[:50] = 0.0, 500.0
    seen = ImageResiduals(
        frame, np.where(half, [800.0, 600.0] - sensor, sensor), np.where(half, -fault, fault), weight
    )
    (field,) = residual_fields(survey, turned, seen, 0.3)
    assert field.camera == survey.cameras[0] and field.observations == m
    assert field.scatter_px == pytest.approx(0.3 * np.sqrt(2.0 / (m / 192)), rel=0.1)
    left, right = field.at_px[:, 0] < 240.0, field.at_px[:, 0] > 300.0
    assert left.sum() == 5 * 12 and right.sum() >= 10 * 12, "16 x 12 cells, 50 px wide"
    np.testing.assert_allclose(field.mean_px[left], np.tile([2.0, 0.0], (60, 1)), atol=0.3)
    np.testing.assert_allclose(field.mean_px[right], 0.0, atol=0.3)


def test_few_observations_make_few_cells_and_other_cameras_none(solved):
    other = replace(solved.survey, cameras=(*solved.survey.cameras, Camera("b", 9, 9, 9.0, 4.5, 4.5)))
    at = np.array([[10.0, 10.0], [790.0, 10.0]])
    seen = ImageResiduals(np.array([0, 1]), at, np.ones((2, 2)), np.ones(2))
    (field,) = residual_fields(other, (), seen, 0.3)
    assert len(field.at_px) == 0 and np.isnan(field.scatter_px)
    plot = image_vectors((800, 600), np.column_stack([field.at_px, field.mean_px]), label="l", principal_px=(402.0, 297.0), scatter_px=field.scatter_px)  # fmt: skip
    assert "nan" not in plot and fromstring(plot).tag == f"{SVG}svg"


def test_cells_of_the_correlation_map_are_as_full_as_their_correlation():
    names, correlation = solved_names(shared())
    root = fromstring(correlation_map(names, correlation, label="l"))
    cells = [r for r in root.iter(f"{SVG}rect") if r.find(f"{SVG}title") is not None]
    assert len(cells) == 16
    reported = {c.find(f"{SVG}title").text: c for c in cells}
    assert (reported["2, 3: -0.88"].get("fill"), reported["2, 3: -0.88"].get("fill-opacity")) == (
        COLOURS[0],
        "0.88",
    )
    assert (reported["1, 4: +0.71"].get("fill"), reported["1, 4: +0.71"].get("fill-opacity")) == (
        COLOURS[1],
        "0.71",
    )
    words = [t.text for t in root.iter(f"{SVG}text")]
    assert words.count("-.88") == 2 and words.count(".69") == 2
    large = correlation_map([f"n{i}" for i in range(50)], np.eye(50), label="l")
    assert "the first 40 of 50" in large and "n41" not in large


def test_arrows_over_an_image_point_down_for_growing_rows():
    at = np.array([[100.0, 150.0], [700.0, 150.0]])
    plot = image_vectors((800, 600), np.column_stack([at, [[0.0, 0.02], [0.02, 0.0]]]), label="l", principal_px=(402.0, 297.0), scatter_px=0.004)  # fmt: skip
    root = fromstring(plot)
    arrows = [p for p in root.iter(f"{SVG}path") if p.get("stroke") == COLOURS[0]]
    down, right = ([float(v) for v in re.findall(r"-?[\d.]+", p.get("d"))][:4] for p in arrows[:2])
    assert down[3] - down[1] == pytest.approx(48.0, abs=0.1) and down[2] == down[0]
    assert right[2] - right[0] == pytest.approx(48.0, abs=0.1) and right[3] == right[1]
    assert right[0] - down[0] == pytest.approx(600.0 * 0.8, abs=0.1), "480 px for 600 rows"
    assert "arrow: 0.02 px (drawn 3\u202f000 times larger)" in plot and "by chance: 0.00400\u00a0px" in plot


def test_the_marked_value_stands_at_its_place():
    root = fromstring(histogram([0.0, 1.0, 2.0] * 50, Axis("x"), label="l", mark=("σ = 1", 1.0)))
    (line,) = [e for e in root.iter(f"{SVG}line") if e.get("stroke") == COLOURS[1]]
    assert float(line.get("x1")) == pytest.approx((66.0 + 704.0) / 2)
    assert "σ = 1" in [t.text for t in root.iter(f"{SVG}text")]


def test_the_page_of_a_bundle_says_what_was_solved(solved, tmp_path):
    run = made_up_run(tmp_path, with_comparison=False)
    fixed = solved.adjusted.shared.fixed.copy()
    fixed[list(solved.adjusted.shared.names).index("k3")] = True
    adjusted = replace(solved.adjusted, shared=replace(solved.adjusted.shared, fixed=fixed))
    summary = {**run["summary"], "metrics": {"ground": {"kind": "flat", "reason": "chosen by <b>parameter"}}}
    html = render_report(FramesReport(
        survey=solved.survey, placement=solved.placement, ties=solved.ties, adjusted=adjusted,
        mosaic=solved.mosaic, mosaic_file=run["mosaic_file"], summary=summary,
    ))  # fmt: skip
    page = Page(html)
    words = " ".join(page.words.split())
    for wanted in (
        "Ground: flat ground (chosen by <b>parameter)", "What all frames share", "plain, 800 × 600 px",
        "k30fixed: not determined by this block, kept as given", "Correlations", "by chance:",
        "σ = 0.2", "means of 1 994 observations",
    ):  # fmt: skip
        assert wanted in words, wanted
    assert "cameras" not in {a.get("id") for _, a in page.tags}, "said once"
    assert not re.search(r"\bnan\b", html)
    row = next(r for r in re.findall(r"<tr data-row=.*?</tr>", html) if f"00{ALONE}.jpg" in r)
    own_m = float(np.hypot(*solved.adjusted.poses.positions_sd_m[ALONE, :2]))
    assert row.count(f"{own_m:.2f}\u00a0m") == 1, "placed: both axes of its prediction"


def test_methods_without_a_covariance_still_say_on_what_ground(tmp_path):
    page = Page(render_report(FramesReport(**made_up_run(tmp_path, with_comparison=False))))
    words = " ".join(page.words.split())
    assert "Ground: flat ground (no DEM was given; images and attitudes agree with level ground)" in words
    assert "What all frames share" not in words and "Correlations" not in words
    assert "cameras" in {a.get("id") for _, a in page.tags}
