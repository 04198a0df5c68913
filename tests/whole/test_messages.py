"""Messages lead out of the fault: what they propose works, in the words that the user typed."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
import typer
from affine import Affine
from message_texts import WITH_FIX, Message, messages
from small_surveys import geomosaic, small_survey

from geomosaic.cli.app import build_app
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.pipeline.registry import installed
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.read import check_survey_files, read_survey
from geomosaic_simulate.survey import SimulatedSurvey

DRY = "--dry-run"
ACTION = re.compile(
    r"(?<![\w-])--[a-z]|\b(nothing to do|give|check|correct|fly|name|rename|remove|copy|add|put|mark|measure|map"
    r"|make|shift|convert|compare|take (it|them|its files) out)\b"
)
"""What a warning asks for: an option, or something to do."""
NOTICES = {
    "camera-assumed": "which lens the tags give; the adjustment estimates it",
    "control-unused": "ends with the fix of the error that it would be without --gcp-optional",
    "model-chosen": "which model of the lens and the shutter fits the images best; it is used",
    "position-by-xmp": "which of two tags is used: the finer one",
    "readout-by-model": "what is known of the camera's shutter; the adjustment estimates it",
    "readout-by-tag": "what the tags state of the camera's shutter; it is used",
}
"""Warnings for the record, and why nobody has to do anything."""
PRIVATE = re.compile(
    r"\b(mend(s|ed|ing)?|held|told|tells?|believed?|believes|beside|hears?|heard|accused?|excused?|laid|lay"
    r"|doubted|unrest|swing|calmed|vouch\w*|righted|settled|bears? out|docs/\S*)\b",
    re.IGNORECASE,
)
WORDS = 25
FIXED_ABOVE = ("camera/rpc.py", "geodesy/crs_names.py", "pipeline/params.py", "requests/option.py")
"""Whose callers add what to do, or whose texts state what is wanted."""
STORED = (
    "pipeline/artefact_reader.py",
    "pipeline/artefacts.py",
    "pipeline/context.py",
    "pipeline/stage_recorder.py",
)
"""Of results that cannot be read: whoever reads them adds what to do."""


@pytest.fixture(scope="module")
def texts() -> list[Message]:
    """All messages of the package."""
    return messages()


def test_there_are_many(texts: list[Message]) -> None:
    assert len(texts) > 550 and len({m.code for m in texts if m.kind == "warning"}) > 110


def test_parameters_are_named_as_they_are_typed(texts: list[Message]) -> None:
    ids = "|".join(map(re.escape, installed().ids()))
    bare = re.compile(rf"(?<!--set )\b(?:{ids})\.\w+")
    assert not [(m.where, t) for m in texts for t in (*m.texts, *m.fixes) if bare.search(t)]


def test_no_message_has_a_private_word_or_needs_the_docs(texts: list[Message]) -> None:
    assert not [(m.where, t) for m in texts for t in (*m.texts, *m.fixes) if PRIVATE.search(t)]


def test_every_error_of_what_was_given_says_what_to_do(texts: list[Message]) -> None:
    lacking = [
        m.where
        for m in texts
        if m.kind in WITH_FIX and not m.has_fix and not any("must be" in text for text in m.texts)
    ]
    assert not [where for where in lacking if not where.startswith((*FIXED_ABOVE, *STORED))]


def test_every_warning_says_what_to_do(texts: list[Message]) -> None:
    warnings = [m for m in texts if m.kind == "warning" and m.code and m.code not in NOTICES]
    assert not [(m.where, m.code, t) for m in warnings for t in m.texts if not ACTION.search(t)]
    assert NOTICES.keys() <= {m.code for m in texts}


def test_sentences_are_short(texts: list[Message]) -> None:
    clauses = [
        (m.where, clause)
        for m in texts
        for text in (*m.texts, *m.fixes)
        for clause in re.split(r"[.;:] ", text)
    ]
    assert not [(where, clause) for where, clause in clauses if len(clause.split()) > WORDS]


def test_every_option_that_a_message_names_is_one(texts: list[Message]) -> None:
    named = {
        flag
        for m in texts
        for text in (*m.texts, *m.fixes)
        for flag in re.findall(r"(?<![\w-])--[a-z][a-z-]+", re.sub(r"\([^)]*\)|pyproj .*", "", text))
    }
    known = {"--set"}
    for group in ((), ("export",), ("simulate",)):
        commands = [typer.main.get_command(build_app(group))]
        while commands:
            command = commands.pop()
            commands += list(getattr(command, "commands", {}).values())
            known |= {flag for p in command.params for flag in (*p.opts, *p.secondary_opts)}
    assert named <= known, named - known


@pytest.fixture(scope="session")
def kenya(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    """Four frames in UTM zone 37 south, with their positions in tags."""
    folder = tmp_path_factory.mktemp("kenya")
    place = {"lon_deg": 38.0, "lat_deg": -3.0}
    return small_survey(folder, lines=1, width_px=160, height_px=120, pos_in="exif", seed=5, **place)


def message(capfd: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The one line of a command that ends with 2."""
    capfd.readouterr()
    assert geomosaic(*arguments) == 2
    (line,) = [ln for ln in capfd.readouterr().err.splitlines() if not ln.startswith("[")]
    return line


def in_map(survey: SimulatedSurvey) -> list[tuple[str, float, float]]:
    """Names, eastings and northings of the frames."""
    frames = read_survey(SurveyInputs(survey.frames)).frames
    to_map = MapProjection("EPSG:32737")
    return [
        (f.name, *to_map.map_from_geodetic(f.position.lon_deg, f.position.lat_deg).tolist()) for f in frames
    ]


def test_the_proposed_code_of_a_pos_file_is_that_of_the_frames_and_works(
    kenya: SimulatedSurvey, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    pos = tmp_path / "pos.csv"
    rows = "".join(f"{name},{x:.3f},{y:.3f}\n" for name, x, y in in_map(kenya))
    pos.write_text("frame,x,y\n" + rows, encoding="utf-8")
    line = message(capfd, "mosaic", kenya.frames, "--pos", pos, DRY)
    found = re.search(r"(--pos-crs), such as (EPSG:\d+)", line)
    assert found is not None and found[2] == "EPSG:32737", line
    check_survey_files(SurveyInputs(kenya.frames, pos=pos, pos_crs=found[2]))


def test_the_proposed_code_of_control_works_in_the_first_line(
    kenya: SimulatedSurvey, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    gcp, ((name, x, y), *_) = tmp_path / "points.csv", in_map(kenya)
    text = f"name,x,y,height,image,col,row\np,{x:.3f},{y:.3f},0,{name},80,60\n"
    gcp.write_text(text, encoding="utf-8")
    line = message(capfd, "mosaic", kenya.frames, "--gcp", gcp, DRY)
    found = re.search(r"in the first line of the --gcp file, such as (EPSG:\d+)", line)
    assert found is not None and found[1] == "EPSG:32737", line
    assert line.endswith(", or give it with --pos-crs"), line
    check_survey_files(SurveyInputs(kenya.frames, gcp=gcp, pos_crs=found[1]))
    gcp.write_text(f"{found[1]}\n{text}", encoding="utf-8")
    check_survey_files(SurveyInputs(kenya.frames, gcp=gcp))


def test_the_proposed_code_of_the_map_works(
    kenya: SimulatedSurvey, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    line = message(capfd, "mosaic", kenya.frames, "--crs", "EPSG:4326", DRY)
    found = re.search(r"--crs.*such as (EPSG:\d+)", line)
    assert found is not None and found[1] == "EPSG:32737", line
    check_survey_files(SurveyInputs(kenya.frames, crs=found[1]))


def test_the_geoid_that_the_message_names_serves_where_it_is_put(
    kenya: SimulatedSurvey, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """`geomosaic geoid fetch` writes to PROJ's own folder of the user; here a made-up grid is put there."""
    dem, ((_, x, y), *_) = tmp_path / "dem.tif", in_map(kenya)
    shape = {"width": 200, "height": 200, "count": 1, "dtype": "float32"}
    place = {"crs": "EPSG:32737+3855", "transform": Affine(10, 0, x - 1000, 0, -10, y + 1000)}
    with rasterio.open(dem, "w", driver="GTiff", **shape, **place) as tiff:
        tiff.write(np.full((1, 200, 200), 500.0, np.float32))
    home = tmp_path / "home"
    home.mkdir()
    environment = {**os.environ, "PROJ_USER_WRITABLE_DIRECTORY": str(home)}
    script = (
        "import sys; from pathlib import Path; from geomosaic.survey.read import read_survey; "
        "from geomosaic.survey.inputs import SurveyInputs; "
        "frames, dem, *offset = sys.argv[1:]; "
        "offset_m = float(offset[0]) if offset else None; "
        "read_survey(SurveyInputs(Path(frames), dem=Path(dem), dem_offset_m=offset_m))"
    )

    def run(*more: str) -> tuple[int, str]:
        asked = [sys.executable, "-c", script, str(kenya.frames), str(dem), *more]
        done = subprocess.run(asked, env=environment, capture_output=True, text=True, check=False)
        return done.returncode, done.stderr

    code, line = run()
    found = re.search(r"--dem-offset METRES, or install it: geomosaic geoid fetch (\S+\.tif)", line)
    assert code == 1 and found is not None, line
    grid = {"crs": "EPSG:4979", "transform": Affine(1, 0, 35, 0, -1, 0), "dtype": "float32", "count": 1}
    with rasterio.open(home / found[1], "w", driver="GTiff", width=6, height=6, **grid) as tiff:
        tiff.write(np.full((1, 6, 6), -20.0, np.float32))
        tiff.update_tags(TYPE="VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL", AREA_OR_POINT="Point")
        tiff.update_tags(1, DESCRIPTION="geoid_undulation", UNITTYPE="metre")
    assert run()[0] == 0, run()[1]
    (home / found[1]).unlink()
    assert run("-20")[0] == 0


@pytest.mark.parametrize(
    ("files", "advice"),
    [
        (("DSC0001.ARW", "DSC0002.ARW"), "convert raw images to JPEG or TIFF"),
        (("DJI_0001.MP4", "DJI_0001.SRT"), "take frames out of the video first: geomosaic frames"),
        (("notes.txt",), "give the folder that holds the frames"),
    ],
)
def test_a_folder_of_other_files_says_what_makes_frames_of_them(
    files: tuple[str, ...], advice: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "DCIM"
    folder.mkdir()
    for name in files:
        (folder / name).write_bytes(b"\0" * 64)
    assert f"; {advice}" in message(capfd, "mosaic", folder, DRY)
    assert f"; {advice}" in message(capfd, "mosaic", tmp_path, DRY)
