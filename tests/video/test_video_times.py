"""Subtitle tracks, and videos whose images begin later than the video itself."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from video_scenes import HEIGHT, WIDTH, east_m, rows_of, texture, window_at, words_at, write_subtitles

from geomosaic.cli.main import main
from geomosaic.video.subtitles import image_delay_s, read_subtitle_tracks

av = pytest.importorskip("av")
MS = Fraction(1, 1000)
LATE_S = 1.2
"""Of the first image after the sound's begin."""
CUES_S = np.arange(8.0)
M_PER_S, RATE = 5.0, 10


def _track(file: Any, codec: str) -> Any:
    track = file.add_stream(codec)
    track.time_base = track.codec_context.time_base = MS
    track.codec_context.subtitle_header = b"[Script Info]\n"
    return track


def _cue(track: Any, time_s: float, words: str) -> Any:
    data = words.encode()
    head = struct.pack(">H", len(data)) if track.codec_context.name == "mov_text" else b""
    packet = av.Packet(head + data)
    packet.pts = packet.dts = round(1000 * time_s)
    packet.duration, packet.time_base, packet.stream = 900, MS, track
    return packet


def _late_video(path: Path, tracks: Sequence[str]) -> None:
    """Five seconds; the ground moves by 96 px and 5 m a second of the sound. Cues are in the last track."""
    ground = texture()
    with av.open(str(path), "w") as file:
        images = file.add_stream("mpeg4", rate=RATE)
        images.width, images.height, images.pix_fmt, images.bit_rate = WIDTH, HEIGHT, "yuv420p", 4_000_000
        images.codec_context.time_base = MS
        sound = file.add_stream("aac", rate=48000)
        subtitles = [_track(file, codec) for codec in tracks]
        for k in range(300):
            silence = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
            silence.sample_rate, silence.pts = 48000, 1024 * k
            file.mux(sound.encode(silence))
        file.mux(sound.encode())
        for k in range(5 * RATE):
            time_s = LATE_S + k / RATE
            frame = av.VideoFrame.from_ndarray(window_at(ground, 96.0 * time_s, 200.0), format="bgr24")
            frame.pts, frame.time_base = round(1000 * time_s), MS
            file.mux(images.encode(frame))
        file.mux(images.encode())
        for track in subtitles:
            for t in CUES_S:
                file.mux(_cue(track, t, words_at(M_PER_S * t) if track is subtitles[-1] else "hello"))


def _assert_at_their_times(folder: Path) -> None:
    rows = rows_of(folder)
    assert len(rows) > 3
    np.testing.assert_allclose(east_m(rows), [M_PER_S * (LATE_S + n / RATE) for n in rows], atol=0.02)


@pytest.mark.parametrize(("suffix", "codec"), [(".mp4", "mov_text"), (".mkv", "subrip")])
def test_images_that_begin_late_have_the_positions_of_their_times(
    tmp_path: Path, suffix: str, codec: str
) -> None:
    """By a track of the video, and by a file: both count from the begin of the sound."""
    video = tmp_path / f"a{suffix}"
    _late_video(video, [codec, codec])
    assert image_delay_s(video) == pytest.approx(LATE_S, abs=1e-3)
    track = read_subtitle_tracks(video)
    np.testing.assert_allclose([one.time_s for one in track], CUES_S - LATE_S, atol=1e-3)
    assert main(["frames", str(video), "-q"]) == 0
    _assert_at_their_times(tmp_path / "a-frames")
    write_subtitles(tmp_path / "b.srt", CUES_S, M_PER_S * CUES_S)
    command = ["frames", str(video), "-q", "-o", str(tmp_path / "b"), "--srt", str(tmp_path / "b.srt")]
    assert main(command) == 0
    _assert_at_their_times(tmp_path / "b")


def test_without_the_reader_of_tracks_images_begin_with_the_video(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _late_video(tmp_path / "a.mp4", [])
    monkeypatch.setattr("geomosaic.video.subtitles.tracks_readable", lambda: False)
    assert image_delay_s(tmp_path / "a.mp4") == 0.0
    assert image_delay_s(tmp_path / "none.mp4") == 0.0


def test_a_track_that_nothing_decodes_is_passed_over(tmp_path: Path) -> None:
    """As DJI's own or a later format's."""
    video = tmp_path / "a.mkv"
    _late_video(video, ["subrip", "subrip"])
    content = video.read_bytes()
    assert content.count(b"S_TEXT/UTF8") == 2
    video.write_bytes(content.replace(b"S_TEXT/UTF8", b"S_TEXT/NONE", 1))
    with av.open(str(video)) as file:
        assert [track.codec_context is None for track in file.streams.subtitles] == [True, False]
    assert len(read_subtitle_tracks(video)) == len(CUES_S)
    video.write_bytes(content.replace(b"S_TEXT/UTF8", b"S_TEXT/NONE"))
    assert read_subtitle_tracks(video) == []
    assert main(["frames", str(video), "-q"]) == 0
    assert not (tmp_path / "a-frames" / "pos.csv").exists()
