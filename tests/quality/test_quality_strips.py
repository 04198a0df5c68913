"""The check of the strips' offsets: known errors are found, clouds aren't taken for errors, spectra are true."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from geomosaic.ccd.model import BRIDGED, MEASURED, UNRELIABLE, PairOffsets, StripOffsets
from geomosaic.ccd.overlaps import Strips
from geomosaic.export.offsets_csv import read_true_offsets
from geomosaic.pipeline.context import Context
from geomosaic.pipeline.stage_recorder import StageRecorder
from geomosaic.quality.jitter import Spectrum, jitter_spectrum, peaks_by_bin, residual_spectrum
from geomosaic.quality.strip_figures import misplacement_rate, scene_errors, segment_rms, strip_figures
from geomosaic.quality.strips import StripQuality, confirmed, misplacement, quality_metrics
from geomosaic.recording import Recorder, read_recording
from geomosaic.stages.quality_strips import quality_strips
from geomosaic.survey.strips import read_geometry
from geomosaic_simulate.strip_overlaps import SimulatedPair, simulate_overlaps, strips_in_memory
from geomosaic_simulate.strip_plan import StripPlan
from geomosaic_simulate.strips import simulate_strips

SEPARATION = 2114.0
Change = Callable[[int, np.ndarray], tuple[np.ndarray | float, np.ndarray | float]]


def scene(**plan: object) -> tuple[Strips, tuple[SimulatedPair, ...]]:
    geometry, pairs = simulate_overlaps(StripPlan(**{"ccds": 3, "lines": 5200, "seed": 3} | plan))  # type: ignore[arg-type]
    return strips_in_memory(geometry, [(p.left, p.right) for p in pairs]), pairs


def offsets_of(
    pairs: tuple[SimulatedPair, ...], change: Change | None = None, thin: float = 1.0
) -> StripOffsets:
    """True offsets plus a change of (dcol, dline) of each pair's lines; lines under cloud are bridged."""
    out = []
    for p in pairs:
        truth, n = p.truth, len(p.truth.dcol_px)
        dcol, dline = change(truth.pair, np.arange(n, dtype=np.float64)) if change else (0.0, 0.0)
        cloudy = np.maximum(truth.cloud_left, truth.cloud_right) > thin
        label = np.where(cloudy, BRIDGED, MEASURED).astype(np.uint8)
        sd = np.full(n, 0.05)
        out.append(PairOffsets(truth.pair, truth.dcol_px + dcol, truth.dline_px + dline, sd, 2 * sd, label))
    return StripOffsets("truth", tuple(out))


def checked(strips: Strips, offsets: StripOffsets) -> StripQuality:
    return misplacement(strips, offsets, lambda done, total: None)


@pytest.fixture(scope="module")
def clean() -> tuple[Strips, tuple[SimulatedPair, ...]]:
    return scene()


def test_true_offsets_leave_nothing(clean: tuple[Strips, tuple[SimulatedPair, ...]]) -> None:
    reports: list[tuple[int, int]] = []
    strips, pairs = clean
    quality = misplacement(strips, offsets_of(pairs), lambda done, total: reports.append((done, total)))
    assert reports[-1] == (10400, 10400) and sorted(reports) == reports
    assert quality.figures.rms_px < 0.02 and quality.figures.worst_line_px < 0.06
    assert not quality.misplaced and quality.figures.share_above == 0.0
    # Both rows have the same ground on all lines but the separation's.
    assert quality.lines == pytest.approx(2 * (5200 - SEPARATION), abs=20)
    assert quality.unmeasured_lines < 64 and quality.other_lines == 0
    for p in quality.pairs:
        assert np.abs(np.nanmean(p.residual_px, axis=0)).max() < 0.005
        assert p.share_of_labels == (1.0, 0.0, 0.0)


@pytest.mark.parametrize("error", [(0.3, -0.2), (-0.7, 1.6), (3.0, 6.0), (-5.0, -10.0)])
def test_a_known_error_is_found_with_its_sign(
    clean: tuple[Strips, tuple[SimulatedPair, ...]], error: tuple[float, float]
) -> None:
    """Pair 0 is of side +1, pair 1 of side -1; its error is another one."""
    strips, pairs = clean
    factor = {0: 1.0, 1: -0.5}
    quality = checked(strips, offsets_of(pairs, lambda k, t: (factor[k] * error[0], factor[k] * error[1])))
    for p in quality.pairs:
        wanted = -factor[p.pair] * np.array(error)
        known = np.isfinite(p.residual_px[:, 0])
        assert known.sum() >= 44
        assert np.abs(p.residual_px[known] - wanted).max() < 0.25
        assert np.abs(np.nanmedian(p.residual_px, axis=0) - wanted).max() < 0.01
    assert quality.misplaced == (np.hypot(*error) > 1.0)


def test_a_misplaced_stretch_is_found_where_it_is(clean: tuple[Strips, tuple[SimulatedPair, ...]]) -> None:
    """A bump of 2 px in dline at lines 1300 to 1700 of pair 0: segments 2 and 3, and nowhere else."""
    strips, pairs = clean

    def bump(pair: int, line: np.ndarray) -> tuple[float, np.ndarray]:
        return 0.0, 2.0 * ((line >= 1300) & (line < 1700)) * (pair == 0)

    quality = checked(strips, offsets_of(pairs, bump))
    first, second = quality.pairs
    truth = segment_rms(np.stack([np.zeros(5200), bump(0, np.arange(5200.0))[1]], axis=1))
    assert first.segments_px[2:4] == pytest.approx(truth[2:4], abs=0.2)
    assert np.nanmax(np.delete(first.segments_px, [2, 3])) < 0.05 and np.nanmax(second.segments_px) < 0.05
    assert quality.misplaced and quality.figures.share_above == pytest.approx(400 / quality.lines, rel=0.2)
    metrics = quality_metrics(quality)
    assert metrics["misplaced"] is True and metrics["share_measured"] == 1.0
    assert metrics["pairs"][0]["worst_segment_px"] == pytest.approx(truth.max(), abs=0.2)  # type: ignore[index]


def test_clouds_that_the_labels_know_are_not_misplacement() -> None:
    strips, pairs = scene(cloud_cover=0.3, wind_m_per_s=40.0, seed=5)
    quality = checked(strips, offsets_of(pairs, thin=0.02))
    assert not quality.misplaced and quality.figures.worst_segment_px < 0.2
    assert quality.other_lines > 0.15 * quality.lines
    # What the bridged lines show is reported too: the clouds' own motion, or a method that doesn't trust itself.
    assert quality.others.lines > 0 and quality.others.share_above > 0.5
    assert quality_metrics(quality)["others_share_above_1px"] == pytest.approx(quality.others.share_above)
    assert quality.figures.lines + quality.unmeasured_lines + quality.other_lines == quality.lines
    unlabelled = checked(strips, offsets_of(pairs, thin=1.0))
    assert unlabelled.misplaced, "the same clouds, had the labels called them measured"


def test_misplacement_of_lines_called_bridged_is_reported_too(
    clean: tuple[Strips, tuple[SimulatedPair, ...]],
) -> None:
    """One offset for all lines, labelled bridged but for a tenth: as an old chain would have it."""
    strips, pairs = clean
    offsets = offsets_of(pairs, lambda k, t: (0.0, 3.0 * (t % 1280 > 128)))
    labelled = [replace(p, label=(np.arange(5200) % 1280 > 128).astype(np.uint8)) for p in offsets.pairs]
    quality = checked(strips, StripOffsets("x", tuple(labelled)))
    assert not quality.misplaced and quality.figures.share_above < 0.1
    assert quality.others.rms_px == pytest.approx(3.0, abs=0.1) and quality.others.share_above > 0.95
    assert quality.others.lines > 0.9 * quality.other_lines


def test_what_cannot_be_measured_is_said_to_be_so(clean: tuple[Strips, tuple[SimulatedPair, ...]]) -> None:
    _, pairs = clean
    geometry = StripPlan(ccds=3, lines=5200, seed=3).geometry()
    noise = np.random.default_rng(7)
    edges = [
        tuple(noise.integers(200, 260, e.shape).astype(np.uint16) for e in (p.left, p.right)) for p in pairs
    ]
    quality = checked(strips_in_memory(geometry, edges), offsets_of(pairs))  # type: ignore[arg-type]
    assert quality.figures.lines < 0.02 * quality.lines and quality.unmeasured_lines > 0.98 * quality.lines
    assert not quality.misplaced
    flat = [tuple(np.full(e.shape, 1023, np.uint16) for e in (p.left, p.right)) for p in pairs]
    quality = checked(strips_in_memory(geometry, flat), offsets_of(pairs))  # type: ignore[arg-type]
    assert quality.figures.lines == 0 and np.isnan(quality.figures.rms_px)
    assert quality.misplaced is None, "nothing is known, neither that it is in place"
    metrics = quality_metrics(quality)
    assert metrics["rms_px"] is None and metrics["misplaced"] is None


def test_shares_of_labels_are_of_the_pairs_that_have_common_lines() -> None:
    """CCD 2 is so short that neither of its neighbours has any of its ground; pair 2 has lines 0 to 3086."""
    strips, pairs = scene(ccds=4, short="2:2000")
    *apart, offsets = offsets_of(pairs).pairs
    label = offsets.label.copy()
    label[:1543] = BRIDGED
    quality = checked(strips, StripOffsets("x", (*apart, replace(offsets, label=label))))
    assert quality.misplaced is False
    assert [bool(np.isnan(p.share_of_labels).all()) for p in quality.pairs] == [True, True, False]
    metrics = quality_metrics(quality)
    assert metrics["share_measured"] == pytest.approx(0.5, abs=0.01) and metrics["share_unreliable"] == 0.0
    none = quality_metrics(StripQuality(quality.pairs[:2], strip_figures([]), 0, 0, 0))
    assert none["share_measured"] is None and none["misplaced"] is None


def test_a_dead_ccd_and_a_short_strip_leave_the_rest() -> None:
    strips, pairs = scene(ccds=4, dead="4", short="2:4000")
    there = tuple(p for p in pairs if p.truth.pair in strips.pairs)
    quality = checked(strips, offsets_of(there))
    assert [p.pair for p in quality.pairs] == [0, 1]
    assert [p.lines for p in quality.pairs] == [5200, 4000]
    assert quality.figures.rms_px < 0.03 and not quality.misplaced


def test_figures_of_errors() -> None:
    error = np.zeros((1024, 2))
    error[:512] = 0.3, -0.4
    error[512:640] = 3.0, 4.0
    error[900:] = np.nan
    figures = strip_figures([error, np.full((10, 2), np.nan)])
    assert figures.lines == 900 and figures.worst_line_px == 5.0
    assert figures.rms_px == pytest.approx(np.sqrt((512 * 0.25 + 128 * 25) / 900))
    assert figures.worst_segment_px == pytest.approx(np.sqrt(128 * 25 / 388)) and figures.misplaced
    assert figures.share_above == pytest.approx(128 / 900)
    assert figures.p95_px == 5.0
    few = strip_figures([np.where(np.arange(1024)[:, None] % 512 < 31, 3.0, np.full((1024, 2), np.nan))])
    assert few.lines == 62 and few.misplaced is None, "31 lines do not make a segment's root mean square"
    assert strip_figures([]).misplaced is None


def test_errors_against_the_truth() -> None:
    geometry = StripPlan(ccds=3, lines=5200).geometry()
    n = 5200
    zero, sd = np.zeros(n), np.full(n, 0.1)
    label = np.zeros(n, np.uint8)
    label[:3000] = UNRELIABLE
    error = np.zeros(n)
    error[3080:3085] = 2.0
    # Side +1: lines up to 5200 - 2114 = 3086 are common; side -1: those from 2114 on.
    offsets = StripOffsets(
        "x",
        (PairOffsets(0, zero, error, sd, sd, label), PairOffsets(1, error + 0.15, zero, sd, 2 * sd, label)),
    )
    truth = {0: np.zeros((n, 2)), 1: np.zeros((n, 2))}
    found = scene_errors(offsets, truth, geometry)
    assert found.figures.lines == 2 * 3086
    assert found.measured_above == 10 and found.measured_worst_px == pytest.approx(2.15)
    assert found.coverage[0] == pytest.approx((3086 + 3081) / 6172)
    assert found.coverage[1] == pytest.approx((3081 + 3086) / 6172)
    assert found.share_of_labels == pytest.approx(((86 + 2200) / 6172, 0.0, (3000 + 886) / 6172))
    assert not found.figures.misplaced, "five lines do not make a segment's root mean square"
    rate = misplacement_rate([False, False, False, True])
    assert (rate.scenes, rate.misplaced, rate.rate) == (4, 1, 0.25) and rate.low < 0.05 < 0.69 < rate.high
    assert rate.unknown == 0
    assert misplacement_rate([False, None, False, False, True, None]) == replace(rate, unknown=2)
    none = misplacement_rate([None])
    assert np.isnan(none.rate) and (none.scenes, none.unknown) == (0, 1)
    assert np.isnan(misplacement_rate([]).rate)


def test_a_sine_is_read_off_the_spectrum() -> None:
    rate, n = 3272.4, 16384
    t = np.arange(n) / rate
    dline = 0.3 * np.sin(2 * np.pi * 4.7 * t + 1.0) + 0.05 * np.sin(2 * np.pi * 22.0 * t) + 3.0 * t + 7.0
    dcol = 0.12 * np.cos(2 * np.pi * 1.9 * t) - 2.0
    sd, label = np.full(n, 0.1), np.zeros(n, np.uint8)
    offsets = StripOffsets("x", tuple(PairOffsets(k, dcol, dline, sd, sd, label) for k in range(3)))
    spectrum = jitter_spectrum(offsets, rate)
    assert spectrum.frequency_hz.max() <= 100.0
    peak = int(np.argmax(spectrum.along_px))
    assert spectrum.frequency_hz[peak] == pytest.approx(4.7, abs=0.05)
    assert spectrum.along_px[peak] == pytest.approx(0.3, rel=0.01)
    high = spectrum.frequency_hz > 15.0
    peak = int(np.argmax(np.where(high, spectrum.along_px, 0.0)))
    assert spectrum.frequency_hz[peak] == pytest.approx(22.0, abs=0.05)
    assert spectrum.along_px[peak] == pytest.approx(0.05, rel=0.01)
    peak = int(np.argmax(spectrum.across_px))
    assert spectrum.frequency_hz[peak] == pytest.approx(1.9, abs=0.05)
    assert spectrum.across_px[peak] == pytest.approx(0.12, rel=0.02)


def test_a_sine_left_in_the_strips_is_read_off_the_residuals(
    clean: tuple[Strips, tuple[SimulatedPair, ...]],
) -> None:
    strips, pairs = clean
    rate = strips.geometry.line_rate_hz

    def sine(pair: int, line: np.ndarray) -> tuple[float, np.ndarray]:
        return 0.0, 0.3 * np.sin(2 * np.pi * 9.0 * line / rate)

    spectrum = residual_spectrum(checked(strips, offsets_of(pairs, sine)), rate)
    peak = int(np.argmax(spectrum.along_px))
    assert spectrum.frequency_hz[peak] == pytest.approx(9.0, abs=0.3)
    assert spectrum.along_px[peak] == pytest.approx(0.3, rel=0.1)
    assert spectrum.across_px.max() < 0.03
    silent = residual_spectrum(checked(strips, offsets_of(pairs)), rate)
    assert max(silent.along_px.max(), silent.across_px.max()) < 0.02
    assert residual_spectrum(StripQuality((), strip_figures([]), 512, 0, 0), rate).frequency_hz.size == 0


def test_the_bins_keep_the_peaks() -> None:
    frequency = np.arange(2000) * 0.05
    along, across = np.full(2000, 0.001), np.full(2000, 0.002)
    along[94], across[440], along[441] = 0.3, 0.04, 0.05
    along[0] = 9.0
    binned = peaks_by_bin(Spectrum(frequency, across, along))
    assert 30 < len(binned.frequency_hz) <= 60 and (np.diff(binned.frequency_hz) > 0.0).all()
    assert binned.frequency_hz[0] == pytest.approx(0.05)
    at = int(np.argmax(binned.along_px))
    assert binned.frequency_hz[at] == pytest.approx(4.7) and binned.along_px[at] == 0.3
    at = int(np.argmax(binned.across_px))
    assert binned.frequency_hz[at] == pytest.approx(22.05)
    assert (binned.across_px[at], binned.along_px[at]) == (0.04, 0.05)
    # Two bins of a decade and a half each, about sqrt(0.05 * 99.95).
    two = peaks_by_bin(Spectrum(frequency, across, along), most=2)
    assert two.along_px.tolist() == [0.001, 0.3] and two.across_px.tolist() == [0.002, 0.04]
    alone = peaks_by_bin(Spectrum(frequency[:2], across[:2], along[:2]))
    assert alone.frequency_hz.tolist() == [0.05]
    for few in (0, 1):
        assert peaks_by_bin(Spectrum(frequency[:few], across[:few], along[:few])).along_px.size == 0


def test_the_stage_tells_segments_spectra_and_what_is_left(tmp_path: Path) -> None:
    """A sine of 0.4 px at 9 Hz is left in pair 0, a shift of 0.5 px in pair 2; CCD 5 is dead."""
    plan = StripPlan(seed=4, ccds=5, width_px=256, lines=3200, row_separation_lines=700, dead="5")
    files = simulate_strips(tmp_path / "scene", plan, scene=False)
    geometry = read_geometry(files.geometry)
    pairs = []
    for k, truth in read_true_offsets(files.true_offsets, geometry).items():
        n = len(truth)
        error = {0: 0.4 * np.sin(2 * np.pi * 9.0 * np.arange(n) / geometry.line_rate_hz), 2: 0.5}.get(k, 0.0)
        sd, label = np.full(n, 0.1), np.full(n, MEASURED, np.uint8)
        pairs.append(PairOffsets(k, truth[:, 0], truth[:, 1] + error, sd, sd, label))
    stage = quality_strips()
    with Recorder(tmp_path / "run.mcap", fixed_time=True) as recorder:
        recorder.begin_run("name: strips\n", {}, {})
        recorder.stage_started(stage.id, stage.version, {}, {})
        context = Context(tmp_path / "run", stage_id=stage.id, recorder=StageRecorder(recorder))
        inputs = {"strips": geometry, "offsets": StripOffsets("x", tuple(pairs))}
        quality = stage.run(inputs, stage.Params(), context)["strip_quality"]
    metrics = context.notes.metrics
    reported = metrics["misplacement"]["pairs"]
    assert [p["pair"] for p in reported] == [0, 1, 2] and metrics["misplacement"]["misplaced"] is False
    assert all(len(p["segments_px"]) == 7 for p in reported)
    # The right strip of pair 0 has the ground of the left one 700 lines later, that of pair 1 700 earlier.
    assert reported[0]["segments_px"][6] is None and reported[1]["segments_px"][0] is None
    assert reported[0]["segments_px"][2] == pytest.approx(0.4 / np.sqrt(2), abs=0.06)
    assert reported[2]["segments_px"][2] == pytest.approx(0.5, abs=0.02)
    assert max(v for v in reported[2]["segments_px"] if v is not None) == reported[2]["worst_segment_px"]
    left = metrics["jitter"]["left"]
    at = int(np.argmax(left["along_px"]))
    assert left["frequency_hz"][at] == pytest.approx(9.0, abs=0.6)
    # Root mean square over three pairs, of which one has it.
    assert left["along_px"][at] == pytest.approx(0.4 / np.sqrt(3), rel=0.2)
    found = metrics["jitter"]["found"]
    assert found.keys() == left.keys() == {"frequency_hz", "across_px", "along_px"}
    assert 20 < len(found["frequency_hz"]) == len(found["along_px"]) == len(found["across_px"]) <= 60
    recording = read_recording(tmp_path / "run.mcap")
    names = [(r.pair, r.left, r.right) for r in recording.strip_residuals]
    assert names == [(k, f"ccd{k + 1}.tif", f"ccd{k + 2}.tif") for k in range(3)]
    assert np.nanmedian(recording.strip_residuals[2].residual_px[:, 1]) == pytest.approx(-0.5, abs=0.02)
    np.testing.assert_allclose(
        recording.strip_residuals[1].residual_px, quality.pairs[1].residual_px, atol=1e-6
    )
    assert recording.strip_residuals[0].line[:2].tolist() == [32, 96]
    assert [j.what for j in recording.jitter] == ["found", "left"]
    np.testing.assert_allclose(recording.jitter[1].along_px, left["along_px"], atol=1e-5)


def test_a_block_that_stands_alone_is_no_misplacement() -> None:
    residual = np.array(
        [[0.1, 0.0], [0.0, 9.0], [np.nan, np.nan], [2.0, 0.0], [2.3, 0.1], [0.2, 0.0], [5.0, 0.0]]
    )
    kept = np.isfinite(confirmed(residual)).all(axis=1)
    assert kept.tolist() == [True, False, False, True, True, True, False]
    np.testing.assert_array_equal(confirmed(residual)[kept], residual[kept])


@pytest.mark.parametrize("overlap_px", [16, 24, 29])
def test_narrow_overlaps_are_checked(overlap_px: int) -> None:
    """No patch of 28 px fits, so an error of 2 px passed as unknown."""
    strips, pairs = scene(overlap_px=overlap_px, read_px=overlap_px + 6, mounting_px=0.0, width_px=256)
    quality = checked(strips, offsets_of(pairs, lambda k, t: (0.0, 2.0 * (k == 0))))
    first, second = (np.nanmedian(p.residual_px, axis=0) for p in quality.pairs)
    assert first == pytest.approx([0.0, -2.0], abs=0.05) and second == pytest.approx([0.0, 0.0], abs=0.05)
    assert quality.unmeasured_lines < 0.3 * quality.lines
    assert quality.misplaced is True
