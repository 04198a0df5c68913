"""`geomosaic frames`: frames out of a drone's video."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geomosaic.cli.options import Quiet, output_option
from geomosaic.errors import FileError, InputError, OutputError

if TYPE_CHECKING:
    from geomosaic.pipeline.reporter import Reporter
    from geomosaic.video.subtitles import VideoPosition


def frames(
    video: Annotated[Path, typer.Argument(help="video of a flight (MP4, MOV)", metavar="VIDEO")],
    output: Annotated[
        Path | None, output_option("folder to write to [next to the video: VIDEO-frames]", "FRAMES")
    ] = None,
    srt: Annotated[
        Path | None,
        typer.Option(
            "--srt", help="subtitles with the drone's positions [VIDEO.SRT, else the video's own]",
            metavar="FILE",
        ),
    ] = None,
    overlap: Annotated[
        float,
        typer.Option(
            help="share of a frame that the next one shows again", metavar="SHARE", min=0.3, max=0.95
        ),
    ] = 0.75,
    quiet: Quiet = False,
) -> None:  # fmt: skip
    """Take sharp frames and their positions out of a video.

    Frames are chosen by how far the picture has moved on. pos.csv holds their positions.
    """
    from geomosaic.cli.progress import progress
    from geomosaic.doors.files import check_regular
    from geomosaic.pipeline.files import writing
    from geomosaic.requests.run_request import default_folder
    from geomosaic.video.frames import POSITIONS, VideoOptions, extract_frames
    from geomosaic.video.subtitles import tracks_readable

    check_regular(video, "give the path of a video")
    folder = output or default_folder(video, "frames")
    if folder.resolve() == Path.cwd():
        raise OutputError("is the current folder", file=folder, fix="choose a new or empty folder with -o")
    if folder.exists() and not folder.is_dir():
        raise OutputError("is no folder", file=folder, fix="choose a new or empty folder with -o")
    if folder.is_dir() and any(folder.iterdir()):
        raise OutputError("the folder holds files", file=folder, fix="choose a new or empty folder with -o")
    with progress(quiet=quiet) as reporter:
        positions = _positions(video, srt, reporter)
        with writing(folder) as part:
            part.mkdir()
            names = extract_frames(video, part, VideoOptions(overlap, positions), reporter.progress)
    if quiet:
        return
    print(f"frames     {len(names)} in {folder}")
    pos = ["--pos", str(folder / POSITIONS)] if positions else []
    if not positions:
        print("positions  none: there are no subtitles with positions; the map will have no scale")
        if not tracks_readable():
            print("           subtitles inside a video are read with: pip install 'geomosaic-ortho[video]'")
    print(f"next       {shlex.join(['geomosaic', 'mosaic', str(folder), *pos])}")


def _positions(video: Path, srt: Path | None, reporter: Reporter) -> list[VideoPosition]:
    """From the given subtitles, else from those next to the video, else from a track inside it.

    A file next to the video that cannot be read is not used, with a warning.
    """
    from geomosaic.video.subtitles import image_delay_s, read_subtitle_tracks, read_subtitles, tracks_readable

    if srt is not None:
        return read_subtitles(srt, image_delay_s(video))
    for found in (video.with_suffix(".SRT"), video.with_suffix(".srt")):
        if not found.is_file():
            continue
        try:
            return read_subtitles(found, image_delay_s(video))
        except FileError as error:
            fix = "copy it again, or give another with --srt"
            reporter.warning(f"{found}: {error.problem}; its positions are not used: {fix}")
        except InputError:  # a drone without a fix writes subtitles without positions
            pass
    return read_subtitle_tracks(video) if tracks_readable() else []
