"""The strips' offsets in the recording: written, read by others, summed up, compared, replayed, drawn."""

from __future__ import annotations

from collections import Counter
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from rich.console import Console

from geomosaic.pipeline.stage_recorder import StageRecorder, replay_calls
from geomosaic.recording import Recorder, read_recording
from geomosaic.recording.file.reader import stage_messages
from geomosaic.recording.file.writer import StageEnd
from geomosaic.recording.inspect.compare import compare
from geomosaic.recording.inspect.difference_tables import show_difference
from geomosaic.recording.inspect.summary import summary
from geomosaic.recording.inspect.tables import show_summary

LINE = np.arange(0, 4000, 8)
DCOL = 0.5 + 0.25 * np.sin(LINE / 300.0)
DLINE = -2.0 + LINE / 4000.0
LABEL = np.where(LINE < 1000, 1, 0) + np.where(LINE >= 3600, 2, 0)


def write(path: Path, pairs: tuple[int, ...] = (0, 2), more: float = 0.0, label: np.ndarray = LABEL) -> Path:
    with Recorder(path, fixed_time=True) as recorder:
        recorder.begin_run("name: strips\n", {"geomosaic": "0.1.0"}, {})
        recorder.stage_started("ccd.offsets", 1, {"method": "joint"}, {})
        for k in pairs:
            sd = np.full(LINE.size, 0.05)
            names = f"ccd{k + 1}.tif", f"ccd{k + 2}.tif"
            recorder.strip_offsets((k, *names), LINE, [DCOL + k, DLINE + more], [sd, 2 * sd], label)
        recorder.log("warning", "CCD 2 is dead", stage="ccd.offsets")
        recorder.stage_finished("ccd.offsets", StageEnd())
    return path


def shown(what: object, how: object) -> str:
    out = StringIO()
    how(what, Console(file=out, width=200))  # type: ignore[operator]
    return out.getvalue()


def test_mcaps_own_reader_finds_them(tmp_path: Path) -> None:
    path = write(tmp_path / "run.mcap")
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        found = [(c.topic, s.name, m) for s, c, _, m in reader.iter_decoded_messages() if "strip" in c.topic]
    assert [(topic, schema) for topic, schema, _ in found] == [
        ("/strip_offsets/0", "geomosaic.StripOffsets"),
        ("/strip_offsets/2", "geomosaic.StripOffsets"),
    ]
    message = found[1][2]
    assert (message.pair, message.left, message.right) == (2, "ccd3.tif", "ccd4.tif")
    assert list(message.line) == LINE.tolist() and list(message.label) == LABEL.tolist()
    np.testing.assert_allclose(message.dcol_px, DCOL + 2, atol=1e-6)
    np.testing.assert_allclose(message.dline_px, DLINE, atol=1e-6)
    assert message.sd_line_px[7] == pytest.approx(0.1) and message.sd_col_px[7] == pytest.approx(0.05)
    assert message.share_bridged == 0.25 and message.share_unreliable == pytest.approx(0.1)


def test_the_summary_and_inspect(tmp_path: Path) -> None:
    short = summary(read_recording(write(tmp_path / "run.mcap")))
    first, second = short["strips"]
    assert (first["stage"], first["pair"], second["pair"], first["lines"]) == ("ccd.offsets", 0, 2, 500)
    assert second["dcol_px"] == pytest.approx([DCOL.min() + 2, DCOL.max() + 2])
    assert first["dline_px"] == pytest.approx([-2.0, -1.002]) and first["largest_sd_px"] == pytest.approx(0.1)
    assert first["share_measured"] == pytest.approx(0.65)
    text = shown(short, show_summary)
    for part in ("ccd3.tif", "-2.00 to -1.00", "65.0 %", "25.0 %", "/strip_offsets/2"):
        assert part in text


def test_equal_and_different_offsets(tmp_path: Path) -> None:
    a = read_recording(write(tmp_path / "a.mcap"))
    assert compare(a, read_recording(write(tmp_path / "b.mcap")))["equal"]
    label = np.where(LINE < 2000, 1, LABEL)
    found = compare(a, read_recording(write(tmp_path / "c.mcap", (0,), 0.125, label)))
    assert not found["equal"]
    changed, gone = found["strips"]
    assert changed["stage"] == "ccd.offsets" and changed["pair"] == 0 and changed["lines"] == [500, 500]
    assert changed["largest_px"] == pytest.approx(0.125) and changed["rms_px"] == pytest.approx(0.125)
    assert changed["share_relabelled"] == pytest.approx(0.25)
    assert gone == {"stage": "ccd.offsets", "pair": 2, "only_in": "a"}
    text = shown(found, show_difference)
    assert "up to 0.125 px" in text and "offsets of pair 2" in text and "25.0 %" in text


def test_a_replay_tells_them_again(tmp_path: Path) -> None:
    """From the recording, and from the spool of a stage taken from the cache."""
    recording = read_recording(write(tmp_path / "a.mcap"))
    stage = StageRecorder(None, tmp_path / "spool")
    stage.strip_offsets((2, "l", "r"), LINE, np.stack([DCOL, DLINE]), np.stack([DCOL, DLINE]), LABEL)
    stage.close()
    with Recorder(tmp_path / "b.mcap", fixed_time=True) as recorder:
        recorder.begin_run("name: strips\n", {"geomosaic": "0.1.0"}, {})
        recorder.stage_started("ccd.offsets", 1, {"method": "joint"}, {})
        for message in stage_messages(recording, 0):
            recorder.copy(*message)
        recorder.stage_finished("ccd.offsets", StageEnd())
        recorder.stage_started("spooled", 1, {}, {})
        replay_calls(tmp_path / "spool", recorder)
    again = read_recording(tmp_path / "b.mcap")
    assert [c.pair for c in again.strips] == [0, 2, 2]
    np.testing.assert_array_equal(again.strips[1].offset_px, recording.strips[1].offset_px)
    np.testing.assert_allclose(again.strips[2].sd_px[:, 1], DLINE, atol=1e-6)
    assert [s["pair"] for s in compare(recording, again)["strips"]] == [2]


def test_the_view_draws_them_over_the_lines(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="Rerun isn't installed")
    from rerun.chunk import RrdReader

    from geomosaic.recording.rerun.view import write_rrd

    path = tmp_path / "out.rrd"
    write_rrd(read_recording(write(tmp_path / "run.mcap")), path)
    rows: Counter[str] = Counter()
    for chunk in RrdReader(path).stream():
        if not chunk.is_static:
            rows[chunk.entity_path] += chunk.num_rows
            assert "line" in chunk.timeline_names
    for pair in (0, 2):
        for name in ("offsets", "interval", "not_measured"):
            assert rows[f"/strips/{pair}/{name}"] == 500
    assert rows["/log"] == 1


BLOCKS = 32 + 64 * np.arange(6.0)
BLOCKS[-1] = 340.5
LEFT = np.array([[0.3, -0.4], [np.nan, np.nan], [0.0, 0.1], [0.6, 0.8], [0.0, 0.0], [-0.2, 0.0]])
FREQUENCY_HZ = np.array([0.5, 1.1, 2.0, 4.7, 9.0, 22.0, 60.0])
ALONG_PX = np.array([0.01, 0.2, 0.02, 0.3, 0.01, 0.05, 0.04])


def write_left(path: Path, left_px: np.ndarray = LEFT) -> Path:
    """What is left of pairs 0 and 2; in pair 2 nothing could be measured."""
    with Recorder(path, fixed_time=True) as recorder:
        recorder.begin_run("name: strips\n", {"geomosaic": "0.1.0"}, {})
        recorder.stage_started("ccd.offsets", 1, {}, {})
        for k in (0, 2):
            sd = np.full(LINE.size, 0.05)
            names = f"ccd{k + 1}.tif", f"ccd{k + 2}.tif"
            recorder.strip_offsets((k, *names), LINE, [DCOL, DLINE], [sd, sd], LABEL)
        recorder.stage_finished("ccd.offsets", StageEnd())
        recorder.stage_started("quality.strips", 2, {}, {})
        for k, px in ((0, left_px), (2, np.full((6, 2), np.nan))):
            names = f"ccd{k + 1}.tif", f"ccd{k + 2}.tif"
            recorder.strip_residuals((k, *names), BLOCKS, px.T, np.full(6, 0.02))
        recorder.jitter("found", FREQUENCY_HZ, 0.5 * ALONG_PX, ALONG_PX)
        recorder.jitter("left", [], [], [])
        recorder.stage_finished("quality.strips", StageEnd())
    return path


def test_mcaps_own_reader_finds_what_is_left(tmp_path: Path) -> None:
    with write_left(tmp_path / "run.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        found = {c.topic: (s.name, m) for s, c, _, m in reader.iter_decoded_messages()}
    schema, message = found["/strip_residuals/0"]
    assert schema == "geomosaic.StripResiduals" and found["/strip_residuals/2"][0] == schema
    assert (message.pair, message.left, message.right) == (0, "ccd1.tif", "ccd2.tif")
    assert list(message.line) == [32, 96, 160, 224, 288, 340]
    np.testing.assert_allclose(message.dcol_px, LEFT[:, 0], atol=1e-6)
    np.testing.assert_allclose(message.dline_px, LEFT[:, 1], atol=1e-6)
    assert message.sd_px[3] == pytest.approx(0.02) and message.stage_index == 1
    schema, message = found["/jitter/found"]
    assert schema == "geomosaic.JitterSpectrum" and found["/jitter/left"][0] == schema
    np.testing.assert_allclose(message.frequency_hz, FREQUENCY_HZ, atol=1e-5)
    np.testing.assert_allclose(message.along_px, ALONG_PX, atol=1e-6)
    np.testing.assert_allclose(message.across_px, 0.5 * ALONG_PX, atol=1e-6)


def test_inspect_tells_what_is_left_and_the_peaks(tmp_path: Path) -> None:
    short = summary(read_recording(write_left(tmp_path / "run.mcap")))
    first, second = short["strip_residuals"]
    assert (first["stage"], first["pair"], first["right"]) == ("quality.strips", 0, "ccd2.tif")
    assert (first["blocks"], first["blocks_measured"]) == (6, 5)
    # Lengths 0.5, 0.1, 1.0, 0.0 and 0.2.
    assert first["rms_px"] == pytest.approx(np.sqrt(1.30 / 5)) and first["largest_px"] == pytest.approx(1.0)
    assert second["blocks_measured"] == 0 and second["rms_px"] is None and second["largest_px"] is None
    found, left = short["jitter"]
    assert (found["stage"], found["what"], left["what"]) == ("quality.strips", "found", "left")
    assert [p["frequency_hz"] for p in found["peaks"]] == pytest.approx([4.7, 1.1, 22.0])
    assert [p["along_px"] for p in found["peaks"]] == pytest.approx([0.3, 0.2, 0.05])
    assert found["peaks"][0]["across_px"] == pytest.approx(0.15) and left["peaks"] == []
    text = shown(short, show_summary)
    for part in ("0.510", "1.000", "unknown", "4.700", "/strip_residuals/2", "/jitter/left"):
        assert part in text


def test_what_is_left_is_compared(tmp_path: Path) -> None:
    a = read_recording(write_left(tmp_path / "a.mcap"))
    assert compare(a, read_recording(write_left(tmp_path / "b.mcap")))["equal"]
    other = LEFT.copy()
    other[2] = 0.3, 0.5
    other[5] = np.nan
    found = compare(a, read_recording(write_left(tmp_path / "c.mcap", other)))
    (changed,) = found["strip_residuals"]
    assert not found["equal"] and found["strips"] == []
    assert (changed["stage"], changed["pair"]) == ("quality.strips", 0)
    assert changed["blocks_measured"] == [5, 4]
    assert changed["rms_px"] == pytest.approx([np.sqrt(1.30 / 5), np.sqrt(1.59 / 4)])
    assert changed["largest_px"] == pytest.approx(0.5)
    text = shown(found, show_difference)
    assert "left in pair 0" in text and "0.630 px RMS of 4 blocks, up to 0.500 px from a's" in text
    gone = compare(a, read_recording(write(tmp_path / "old.mcap")))["strip_residuals"]
    assert gone == [{"stage": "quality.strips", "pair": k, "only_in": "a"} for k in (0, 2)]


def test_what_is_left_is_reported_again(tmp_path: Path) -> None:
    """From a recording, and from a spool."""
    recording = read_recording(write_left(tmp_path / "a.mcap"))
    stage = StageRecorder(None, tmp_path / "spool")
    stage.strip_residuals((4, "l", "r"), BLOCKS, LEFT.T, LEFT[:, 0] ** 2)
    stage.jitter("left", FREQUENCY_HZ, ALONG_PX, 2 * ALONG_PX)
    stage.close()
    with Recorder(tmp_path / "b.mcap", fixed_time=True) as recorder:
        recorder.begin_run("name: strips\n", {"geomosaic": "0.1.0"}, {})
        recorder.stage_started("quality.strips", 2, {}, {})
        for message in stage_messages(recording, 1):
            recorder.copy(*message)
        replay_calls(tmp_path / "spool", recorder)
    again = read_recording(tmp_path / "b.mcap")
    assert [r.pair for r in again.strip_residuals] == [0, 2, 4]
    for r in (again.strip_residuals[0], again.strip_residuals[2]):
        np.testing.assert_allclose(r.residual_px, LEFT, atol=1e-6)
    assert [j.what for j in again.jitter] == ["found", "left", "left"]
    np.testing.assert_allclose(again.jitter[2].along_px, 2 * ALONG_PX, atol=1e-6)


@pytest.mark.parametrize("across", [[0.1], [0.1, np.nan]])
def test_a_damaged_spectrum_is_named_and_left_out(tmp_path: Path, across: list[float]) -> None:
    with Recorder(tmp_path / "a.mcap", fixed_time=True) as recorder:
        recorder.begin_run("name: strips\n", {}, {})
        recorder.stage_started("quality.strips", 2, {}, {})
        recorder.jitter("found", [1.0, 2.0], across, [0.1, 0.2])
        recorder.jitter("left", [1.0, 2.0], [0.1, 0.1], [0.1, 0.2])
    recording = read_recording(tmp_path / "a.mcap")
    assert "is damaged" in recording.problem and [j.what for j in recording.jitter] == ["left"]


def test_the_view_draws_what_is_left_under_the_offsets(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="Rerun isn't installed")
    import rerun.blueprint as rrb
    from rerun.chunk import RrdReader

    from geomosaic.recording.rerun.strip_view import strip_views
    from geomosaic.recording.rerun.view import write_rrd

    recording = read_recording(write_left(tmp_path / "run.mcap"))
    first, second = strip_views(recording)
    assert isinstance(first, rrb.Vertical) and isinstance(second, rrb.TimeSeriesView)
    write_rrd(recording, tmp_path / "out.rrd")
    rows: Counter[str] = Counter()
    for chunk in RrdReader(tmp_path / "out.rrd").stream():
        if not chunk.is_static and "line" in chunk.timeline_names:
            rows[chunk.entity_path] += chunk.num_rows
    assert rows["/strips_left/0"] == 6 and "/strips_left/2" not in rows
