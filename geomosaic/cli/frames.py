"""`geomosaic frames`: frames out of a drone's video."""

from __future__ import annotations

import shlex
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from geomosaic.cli.options import Quiet, output_option
from geomosaic.errors import InputError, OutputError


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
    from geomosaic.video.subtitles import read_subtitle_tracks, read_subtitles, tracks_readable

    check_regular(video, "give the path of a video")
    folder = output or default_folder(video, "frames")
    if folder.resolve() == Path.cwd():
        raise OutputError("is the current folder", file=folder, fix="choose a new or empty folder with -o")
    if folder.is_dir() and any(folder.iterdir()):
        raise OutputError("the folder holds files", file=folder, fix="choose a new or empty folder with -o")
    there = [p for p in (video.with_suffix(".SRT"), video.with_suffix(".srt")) if p.is_file()]
    positions = [] if srt is None else read_subtitles(srt)
    for found in there if srt is None else ():
        with suppress(InputError):  # a drone without a fix writes subtitles without places
            positions = positions or read_subtitles(found)
    if not positions and tracks_readable():
        positions = read_subtitle_tracks(video)
    with progress(quiet=quiet) as reporter, writing(folder) as part:
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
