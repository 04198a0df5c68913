"""Frames taken out of a video, and its subtitles."""

from __future__ import annotations

import csv
import struct
import sys
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_surveys import geomosaic, small_survey, summary
from video_scenes import (
    HEIGHT,
    RATE,
    WIDTH,
    east_m,
    numbers_of,
    rows_of,
    texture,
    window_at,
    write_subtitles,
    write_video,
)

from geomosaic.cli.main import main
from geomosaic.errors import FileError, InputError
from geomosaic.video.container import require_video
from geomosaic.video.subtitles import read_subtitle_tracks, read_subtitles

BLURRED = range(40, 400, 3)


def _video(path: Path, moved_px: np.ndarray) -> None:
    """Every third frame after the first forty is blurred."""
    write_video(path, moved_px, BLURRED)


def _subtitles(path: Path, moved_px: np.ndarray) -> None:
    """As DJI's drones write them, with the typing error of one; 0.1 m a px, eastwards."""
    texts = []
    for k, moved in enumerate(moved_px):
        begin, end = (
            f"00:00:{t // 1000:02d},{t % 1000:03d}" for t in (k * 1000 // RATE, (k + 1) * 1000 // RATE)
        )
        lon = 11.0 + 0.1 * moved / (111_320.0 * np.cos(np.radians(48.0)))
        texts.append(
            f'{k + 1}\n{begin} --> {end}\n<font size="28">FrameCnt: {k + 1} [iso: 100] [latitude: 48.000000] '
            f"[longtitude: {lon:.8f}] [rel_alt: 50.100 abs_alt: 512.300] </font>\n\n"
        )
    path.write_text("".join(texts), encoding="utf-8")


def test_sharp_frames_a_quarter_apart_with_their_positions(tmp_path: Path) -> None:
    """300 frames: still for two seconds, then steadily on; 120 px is a quarter of the width."""
    moved_px = np.concatenate([np.zeros(60), np.linspace(0.0, 1440.0, 240)])
    video = tmp_path / "DJI_0042.MP4"
    _video(video, moved_px)
    _subtitles(video.with_suffix(".SRT"), moved_px)
    assert main(["frames", str(video), "-q"]) == 0
    folder = tmp_path / "DJI_0042-frames"
    numbers = numbers_of(folder)
    steps = np.diff(moved_px[numbers])
    assert 10 <= len(numbers) <= 15
    assert steps[:-1].min() >= 0.6 * 120 and steps.max() <= 1.4 * 120
    assert not set(numbers[1:]) & set(BLURRED), "the sharp ones next to them are taken"
    with (folder / "pos.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["frame"] for row in rows] == [f"DJI_0042_{n:06d}.jpg" for n in numbers]
    np.testing.assert_allclose(east_m(rows_of(folder)), 0.1 * moved_px[numbers], atol=0.02)
    assert {(row["altitude_m"], row["relative_altitude_m"]) for row in rows} == {("512.300", "50.100")}


def test_a_frame_lies_between_the_positions_of_two_seconds_and_nowhere_long_after_the_last(
    tmp_path: Path,
) -> None:
    """3 m a second, one subtitle a second, and none after the fifth; the video has ten seconds."""
    video = tmp_path / "a.mp4"
    _video(video, np.linspace(0.0, 1800.0, 10 * RATE, endpoint=False))
    times_s = np.arange(5.0)
    write_subtitles(tmp_path / "a.srt", times_s, 3.0 * times_s)
    assert main(["frames", str(video), "-q"]) == 0
    folder = tmp_path / "a-frames"
    rows, taken = rows_of(folder), numbers_of(folder)
    assert list(rows) == [n for n in taken if n / RATE <= 4.5] and len(rows) < len(taken)
    np.testing.assert_allclose(east_m(rows), [min(3.0 * n / RATE, 12.0) for n in rows], atol=0.01)


def test_next_to_a_gap_a_frame_lies_between_the_positions_at_both_ends(tmp_path: Path) -> None:
    """None is written from 3 s to 8 s; frames in its middle are 2 s from both ends and have none."""
    video = tmp_path / "a.mp4"
    write_video(video, np.linspace(0.0, 1800.0, 10 * RATE, endpoint=False))
    times_s = np.array([0.0, 1.0, 2.0, 3.0, 8.0, 9.0, 10.0])
    write_subtitles(tmp_path / "a.srt", times_s, 3.0 * times_s)
    assert main(["frames", str(video), "-q"]) == 0
    rows, taken = rows_of(tmp_path / "a-frames"), numbers_of(tmp_path / "a-frames")
    assert list(rows) == [n for n in taken if not 5.0 < n / RATE < 6.0] and len(rows) < len(taken)
    assert any(3.5 < n / RATE < 5.0 for n in rows) and any(6.0 < n / RATE < 7.5 for n in rows)
    np.testing.assert_allclose(east_m(rows), [3.0 * n / RATE for n in rows], atol=0.02)


def test_positions_of_another_time_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    video = tmp_path / "a.mp4"
    _video(video, np.linspace(0.0, 960.0, 100))
    write_subtitles(tmp_path / "a.srt", np.array([40.0, 41.0]), np.zeros(2))
    assert main(["frames", str(video), "-q"]) == 2
    assert "no frame was taken while positions were written" in capsys.readouterr().err


def test_frames_of_a_variable_rate_have_the_time_that_the_video_states(tmp_path: Path) -> None:
    """30 frames a second for two seconds, then 10 for eight: 15 in the mean. 40 px and 4 m a second."""
    av = pytest.importorskip("av")
    times_s = np.concatenate([np.arange(60) / 30.0, 2.0 + np.arange(80) / 10.0])
    ground, video = texture(), tmp_path / "a.mp4"
    with av.open(str(video), "w") as file:
        stream = file.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = WIDTH, HEIGHT, "yuv420p", 8_000_000
        stream.codec_context.time_base = Fraction(1, 3000)
        for t in times_s:
            frame = av.VideoFrame.from_ndarray(window_at(ground, 120.0 * t, 200.0), format="bgr24")
            frame.pts, frame.time_base = round(3000 * t), Fraction(1, 3000)
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
    write_subtitles(tmp_path / "a.srt", np.arange(11.0), 12.0 * np.arange(11.0))
    assert main(["frames", str(video), "-q"]) == 0
    rows = rows_of(tmp_path / "a-frames")
    assert len(rows) > 5
    np.testing.assert_allclose(east_m(rows), 12.0 * times_s[list(rows)], atol=0.05)


def test_a_latitude_without_a_longitude_is_no_place(tmp_path: Path) -> None:
    srt = tmp_path / "a.srt"
    srt.write_text("1\n00:00:00,000 --> 00:00:01,000\n[latitude: 48.1] [longitude: n/a]\n\n")
    with pytest.raises(InputError, match="no subtitle has a latitude and a longitude"):
        read_subtitles(srt)


def _with_track(video: Path, srt: Path, out: Path) -> None:
    """The video with its subtitles as a track, after one without positions."""
    av = pytest.importorskip("av")
    with av.open(str(video)) as source, av.open(str(out), "w") as made:
        images = made.add_stream_from_template(source.streams.video[0])
        tracks = [made.add_stream("mov_text") for _ in range(2)]
        for track in tracks:
            track.time_base = track.codec_context.time_base = Fraction(1, 1000)
            track.codec_context.subtitle_header = b"[Script Info]\n"
        for packet in source.demux(source.streams.video[0]):
            if packet.dts is not None:
                packet.stream = images
                made.mux(packet)
        blocks = [block.split("\n", 2) for block in srt.read_text().strip().split("\n\n")]
        for track, texts in zip(tracks, (["hello"] * len(blocks), [b[2] for b in blocks]), strict=True):
            for (_, times, _), words in zip(blocks, texts, strict=True):
                begin, end = (1000 * int(t[6:8]) + int(t[9:]) for t in times.split(" --> "))
                data = words.encode()
                packet = av.Packet(struct.pack(">H", len(data)) + data)
                packet.pts = packet.dts = begin
                packet.duration, packet.time_base, packet.stream = end - begin, Fraction(1, 1000), track
                made.mux(packet)


def test_positions_of_a_track_are_those_of_the_file(tmp_path: Path) -> None:
    moved_px = np.linspace(0.0, 960.0, 100)
    video, srt, out = tmp_path / "a.mp4", tmp_path / "a.srt", tmp_path / "with.mp4"
    _video(video, moved_px)
    _subtitles(srt, moved_px)
    _with_track(video, srt, out)
    track, file = read_subtitle_tracks(out), read_subtitles(srt)
    assert len(track) == len(file) == 100
    for name in ("time_s", "lon_deg", "lat_deg", "height_m", "above_take_off_m"):
        np.testing.assert_allclose(
            [getattr(p, name) for p in track], [getattr(p, name) for p in file], atol=2e-3
        )
    assert [p.lon_deg for p in track] == [p.lon_deg for p in file]
    assert main(["frames", str(out), "-q"]) == 0
    assert main(["frames", str(video), "-q", "--srt", str(srt)]) == 0
    rows = [(tmp_path / f"{n}-frames" / "pos.csv").read_text().splitlines() for n in ("with", "a")]
    assert [r.partition(",")[2] for r in rows[0]] == [r.partition(",")[2] for r in rows[1]]
    assert read_subtitle_tracks(video) == []


def test_without_the_reader_of_tracks_it_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _video(tmp_path / "a.mp4", np.linspace(0.0, 960.0, 100))
    monkeypatch.setitem(sys.modules, "av", None)
    assert main(["frames", str(tmp_path / "a.mp4")]) == 0
    out = capsys.readouterr().out
    assert "positions  none" in out and "pip install 'geomosaic-ortho[video]'" in out


def test_a_mosaic_comes_of_them(tmp_path: Path) -> None:
    moved_px = np.linspace(0.0, 720.0, 75)
    video = tmp_path / "flight.mp4"
    _video(video, moved_px)
    _subtitles(tmp_path / "flight.srt", moved_px)
    frames, run, quick = (
        tmp_path / "frames",
        tmp_path / "run",
        ("--adjust", "least_squares", "--workers", 1, "-q", "--set", "matching.sift.keypoints=600"),
    )
    assert geomosaic("frames", video, "-o", frames, "--overlap", "0.7", "-q") == 0
    assert geomosaic("mosaic", frames, "--pos", frames / "pos.csv", "-o", run, *quick) == 0
    assert 4 < summary(run)["frames"]["tied"] == len(list(frames.glob("*.jpg")))


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("GPS(11.5731,48.1372,19) BAROMETER:45.2", (11.5731, 48.1372, None, 45.2)),
        ("GPS(36.6146,-6.1120,0.0M) BAROMETER:0.3M", (-6.112, 36.6146, None, 0.3)),
        ("F/2.8, SS 320, ISO 100, GPS (-8.1, 52.25, 16), D 24.9m, H 6.0m", (-8.1, 52.25, None, 6.0)),
        ("[latitude: 48,5] [longitude: 11,567] [rel_alt: 1,3 abs_alt: 512,3]", (11.567, 48.5, 512.3, 1.3)),
        ("[latitude : -33.5] [longitude : 151.25] [altitude: 61.5]", (151.25, -33.5, 61.5, None)),
    ],
)
def test_older_drones_subtitles(tmp_path: Path, text: str, found: tuple[float, ...]) -> None:
    path = tmp_path / "a.srt"
    path.write_text(f"1\n00:01:02,500 --> 00:01:03,500\n{text}\n\n2\n00:01:03,500 --> 00:01:04,000\nhello\n")
    (one,) = read_subtitles(path)
    assert (one.lon_deg, one.lat_deg, one.height_m, one.above_take_off_m) == found
    assert one.time_s == 62.5


@pytest.mark.parametrize("name", ["list.mp4", "list.ffconcat", "list.m3u8"])
def test_a_list_of_files_is_no_video(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    """FFmpeg opens what such a list names, whatever its name ends in: files that were not given."""
    _video(tmp_path / "other.mp4", np.linspace(0.0, 400.0, 60))
    texts = {".m3u8": "#EXTM3U\n#EXTINF:2,\nother.mp4\n"}
    path = tmp_path / name
    path.write_text(texts.get(path.suffix, "ffconcat version 1.0\nfile other.mp4\n"))
    assert main(["frames", str(path), "-o", str(tmp_path / "out")]) == 2
    assert "is no video that can be read" in capsys.readouterr().err
    with pytest.raises(FileError, match="is no video"):
        read_subtitle_tracks(path)


@pytest.mark.parametrize(
    ("suffix", "code"),
    [(".mp4", "mp4v"), (".mov", "mp4v"), (".avi", "MJPG"), (".mkv", "mp4v"), (".ts", "mpg2")],
)
def test_containers_of_videos(tmp_path: Path, suffix: str, code: str) -> None:
    path = tmp_path / f"video{suffix}"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), 25, (320, 240))
    for k in range(50):
        writer.write(np.full((240, 320, 3), 3 * k, np.uint8))
    writer.release()
    assert path.stat().st_size > 1000
    require_video(path)


def test_what_is_no_video_or_has_no_positions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.mp4").write_bytes(b"no video")
    assert main(["frames", str(tmp_path / "a.mp4"), "-o", str(tmp_path / "out")]) == 2
    assert "is no video that can be read" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    (tmp_path / "b.srt").write_text("1\n00:00:00,000 --> 00:00:01,000\nhello\n")
    with pytest.raises(InputError, match="no subtitle has a latitude"):
        read_subtitles(tmp_path / "b.srt")
    still = tmp_path / "still.mp4"
    _video(still, np.zeros(40))
    assert main(["frames", str(still), "-o", str(tmp_path / "out")]) == 2
    assert "does not move on" in capsys.readouterr().err
    survey = small_survey(tmp_path / "simulated", lines=1, frames_per_line=2)
    assert main(["frames", str(still), "-o", str(survey.frames)]) == 2
    assert "choose a new or empty folder" in capsys.readouterr().err


def test_subtitles_that_were_found_and_have_no_place(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A drone without a fix writes them; given by --srt they are an error."""
    _video(tmp_path / "a.mp4", np.linspace(0.0, 960.0, 100))
    srt = tmp_path / "a.SRT"
    srt.write_text("1\n00:00:00,000 --> 00:00:01,000\n[latitude: n/a] [longitude: n/a]\n\n")
    assert geomosaic("frames", tmp_path / "a.mp4", "-o", tmp_path / "frames") == 0
    assert "positions  none" in capsys.readouterr().out
    assert geomosaic("frames", tmp_path / "a.mp4", "-o", tmp_path / "again", "--srt", srt) == 2
    assert "leave out --srt" in capsys.readouterr().err


@pytest.mark.parametrize("damage", [b"", b"1\n00:00:\x00\x00\x00", b"<html>not found</html>"])
def test_damaged_subtitles_next_to_the_video_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], damage: bytes
) -> None:
    """Frames are written without positions; given by --srt they are an error."""
    write_video(tmp_path / "a.mp4", np.linspace(0.0, 480.0, 50))
    srt = tmp_path / "a.SRT"
    srt.write_bytes(damage)
    assert main(["frames", str(tmp_path / "a.mp4")]) == 0
    out, err = capsys.readouterr()
    assert "positions  none" in out
    (line,) = [line for line in err.splitlines() if line.startswith("warning")]
    assert line.startswith(f"warning: {srt}: ") and line.endswith("or give another with --srt")
    assert main(["frames", str(tmp_path / "a.mp4"), "-o", str(tmp_path / "b"), "--srt", str(srt)]) == 2
    assert f"{srt}: " in capsys.readouterr().err


@pytest.mark.parametrize("name", ["notes.txt", "a.mp4", "link"])
def test_a_file_in_the_place_of_the_folder_stays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    video, target = tmp_path / "a.mp4", tmp_path / name
    write_video(video, np.linspace(0.0, 480.0, 50))
    (tmp_path / "notes.txt").write_text("precious")
    (tmp_path / "link").symlink_to(tmp_path / "notes.txt")
    before = target.read_bytes()
    assert main(["frames", str(video), "-o", str(target), "-q"]) == 2
    assert f"{target}: is no folder; choose a new or empty folder with -o" in capsys.readouterr().err
    assert target.read_bytes() == before
    assert {p.name for p in tmp_path.iterdir()} == {"a.mp4", "notes.txt", "link"}


def test_a_name_with_a_colon_is_no_protocol(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "2024-05-01T12:30:00.mp4"
    moved_px = np.linspace(0.0, 480.0, 50)
    write_video(tmp_path / name, moved_px)
    write_subtitles(tmp_path / "a.srt", np.arange(3.0), np.arange(3.0))
    monkeypatch.chdir(tmp_path)
    assert main(["frames", name, "-q", "--srt", "a.srt"]) == 0
    assert len(rows_of(tmp_path / "2024-05-01T12:30:00-frames")) > 2
    pytest.importorskip("av")
    assert read_subtitle_tracks(Path(name)) == []
