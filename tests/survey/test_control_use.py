"""Control that cannot be used ends the run, unless it is optional; points of which some cannot be used are named."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from small_surveys import geomosaic, mosaic, small_survey, summary, warned

import geomosaic as gm
from geomosaic.errors import InputError
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.model import Survey
from geomosaic.survey.read import read_survey
from geomosaic_simulate.survey import SimulatedSurvey

FIX = "or add --gcp-optional to go on without control points"


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    """Six tagged frames of 320 x 240 with four control points and two check points."""
    size = {"width_px": 320, "height_px": 240, "height_above_ground_m": 40.0}
    return small_survey(
        tmp_path_factory.mktemp("control"),
        lines=2,
        frames_per_line=3,
        control_points=6,
        pos_in="exif",
        **size,
    )


@pytest.fixture
def lines(flown: SimulatedSurvey) -> list[list[str]]:
    """Fields of gcp_list.txt's marks: x, y, height, col, row, image, name."""
    return [line.split() for line in Path(str(flown.gcp_list)).read_text().splitlines()[1:]]


@pytest.fixture
def odm(flown: SimulatedSurvey, tmp_path: Path) -> Callable[[list[list[str]]], Path]:
    """A gcp_list.txt of lines."""
    crs = Path(str(flown.gcp_list)).read_text().splitlines()[0]

    def write(lines: list[list[str]]) -> Path:
        path = tmp_path / "gcp_list.txt"
        path.write_text("\n".join([crs, *(" ".join(line) for line in lines), ""]))
        return path

    return write


@pytest.fixture
def rover(flown: SimulatedSurvey, tmp_path: Path) -> Path:
    """A rover's table: six points without image marks."""
    with Path(str(flown.control)).open(newline="") as file:
        points = {row["name"]: row for row in csv.DictReader(file)}
    columns = ("name", "lon_deg", "lat_deg", "height_ellipsoidal_m")
    path = tmp_path / "rover.csv"
    path.write_text(
        "\n".join([",".join(columns), *(",".join(p[c] for c in columns) for p in points.values())])
    )
    return path


def refused(flown: SimulatedSurvey, gcp: Path) -> str:
    """The one line of a file that is refused."""
    with pytest.raises(InputError) as caught:
        read_survey(SurveyInputs(flown.frames, gcp=gcp))
    text = str(caught.value)
    assert caught.value.exit_code == 2 and text.startswith(f"{gcp}: ") and text.endswith(FIX)
    return text


def gone_on(flown: SimulatedSurvey, gcp: Path) -> str:
    """The warning of the same file where it is optional."""
    survey = read_survey(SurveyInputs(flown.frames, gcp=gcp, gcp_optional=True))
    (text,) = texts(survey, "control")
    assert survey.control == () and warnings(survey, "control-unused") == [text]
    assert text.startswith(f"{gcp.name}: ") and "the map is made without these points" in text
    return text


def texts(survey: Survey, code: str) -> list[str]:
    return [w.text for w in survey.warnings if w.code.startswith(code)]


def warnings(survey: Survey, code: str) -> list[str]:
    return [w.text for w in survey.warnings if w.code == code]


def test_files_that_can_be_used_are_used_without_a_word(flown: SimulatedSurvey) -> None:
    for gcp in (flown.gcp_list, flown.control):
        survey = read_survey(SurveyInputs(flown.frames, gcp=gcp))
        assert len(survey.control) == 6 and all(p.images for p in survey.control)
        assert texts(survey, "control") == []
        assert read_survey(SurveyInputs(flown.frames, gcp=gcp, gcp_optional=True)).control == survey.control


def test_a_rovers_file_without_image_marks(flown: SimulatedSurvey, rover: Path) -> None:
    said = "none of its 6 points has an image mark, so none can be found in the images"
    assert (
        f"{said}; mark them with geomosaic control, or give image, col and row in the --gcp file"
        in refused(flown, rover)
    )
    assert said in gone_on(flown, rover)


@pytest.mark.parametrize("table", [False, True])
def test_images_that_are_not_in_the_survey(
    flown: SimulatedSurvey, lines: list[list[str]], odm: Callable[..., Path], table: bool, tmp_path: Path
) -> None:
    gcp, marks = odm([[*line[:5], line[5].replace("F", "DJI_"), line[6]] for line in lines]), len(lines)
    if table:
        gcp = tmp_path / "points.csv"
        gcp.write_text(Path(str(flown.control)).read_text().replace(",F0", ",DJI_0"))
    said = f"all {marks} image marks of its 6 points are in images that are not in the survey "
    names = re.search(re.escape(said) + r"\((.*?)\); give the folder of these images", refused(flown, gcp))
    assert names is not None and names[1].startswith("DJI_000") and re.search(r" and \d more$", names[1])
    assert said in gone_on(flown, gcp)


def test_all_marks_outside_their_images(
    flown: SimulatedSurvey, lines: list[list[str]], odm: Callable[..., Path]
) -> None:
    """Pixels of images twelve times as large."""
    gcp = odm([[*line[:3], f"{400 + 12 * float(line[3]):.1f}", *line[4:]] for line in lines])
    said = f"{len(lines)} of {len(lines)} image marks lie outside their images, the first of point '{lines[0][6]}'"
    text = refused(flown, gcp)
    assert said in text and "(320 x 240 pixels); correct or remove them in the --gcp file" in text
    assert said in gone_on(flown, gcp)


def test_marks_of_larger_images_are_no_slips(
    flown: SimulatedSurvey, lines: list[list[str]], odm: Callable[..., Path]
) -> None:
    """Twice as large: those that happen to lie inside are wrong as well."""
    double = [[*line[:3], *(f"{2 * float(v):.1f}" for v in line[3:5]), *line[5:]] for line in lines]
    outside = sum(float(line[3]) > 320.0 or float(line[4]) > 240.0 for line in double)
    assert 0.1 * len(lines) < outside < len(lines)
    assert f"{outside} of {len(lines)} image marks lie outside" in refused(flown, odm(double))


def test_all_points_far_from_the_survey(
    flown: SimulatedSurvey, lines: list[list[str]], odm: Callable[..., Path]
) -> None:
    gcp = odm([[f"{float(line[0]) + 30_000.0:.3f}", *line[1:]] for line in lines])
    text = refused(flown, gcp)
    assert "all 6 points with image marks lie far from the frames" in text
    assert "km from their middle; check the coordinate reference system" in text
    assert "all 6 points" in gone_on(flown, gcp)


def test_points_of_which_some_cannot_be_used_are_one_line(
    flown: SimulatedSurvey, lines: list[list[str]], odm: Callable[..., Path]
) -> None:
    names = list(dict.fromkeys(line[6] for line in lines))
    slip = next(k for k, line in enumerate(lines) if line[6] == names[2])
    changed = [[*line[:5], "gone.jpg", line[6]] if line[6] == names[0] else line for line in lines]
    changed = [
        [*line[:3], "900", *line[4:]] if k == slip else line
        for k, line in enumerate(changed)
        if line[6] != names[2] or k == slip
    ]
    survey = read_survey(SurveyInputs(flown.frames, gcp=odm(changed)))
    absent = sum(line[6] == names[0] for line in lines)
    assert warnings(survey, "control-points-unused") == [
        f"gcp_list.txt: 2 of 6 points are not used ({names[0]}, {names[2]}): "
        "1 marked only in images that are not in the survey, 1 marked only outside the images; "
        "mark them with geomosaic control if they matter"
    ]
    marks = f"of {len(changed)} image marks"
    assert warnings(survey, "control-image-missing") == [
        f"gcp_list.txt: {absent} {marks} are in images that are not in the survey (gone.jpg) and are not used: "
        "give the folder of those images, or remove the marks"
    ]
    (outside,) = warnings(survey, "control-mark-outside")
    assert outside.startswith(
        f"gcp_list.txt: 1 {marks} lie outside their images and are not used, the first "
    )
    used = {p.name for p in survey.control if p.images}
    assert used == set(names) - {names[0], names[2]} and len(texts(survey, "control")) == 3


def test_many_points_without_marks_among_marked_ones_are_counted(
    flown: SimulatedSurvey, rover: Path, tmp_path: Path
) -> None:
    """Only check points are marked: no control holds the map."""
    kept = [line for line in Path(str(flown.control)).read_text().splitlines() if ",control," not in line]
    rows = [f"R{k},control,{line.split(',', 1)[1]},0.02,0.02,,," for k, line in enumerate(
        rover.read_text().splitlines()[1:])]  # fmt: skip
    gcp = tmp_path / "mixed.csv"
    gcp.write_text("\n".join([*kept, *rows]))
    (text,) = texts(read_survey(SurveyInputs(flown.frames, gcp=gcp)), "control")
    assert text == (
        "mixed.csv: 6 of 8 points are not used (R0, R1, R2 and 3 more): 6 without an image mark; "
        "only check points are left, so that none corrects the map; mark them with geomosaic control if they "
        "matter"
    )


def test_without_positions_too_few_points_leave_a_local_frame(
    tmp_path: Path, lines: list[list[str]], odm: Callable[..., Path]
) -> None:
    bare = small_survey(
        tmp_path / "bare", lines=1, frames_per_line=2, pos_in="csv", width_px=320, height_px=240
    )
    one = odm([line for line in lines if line[6] == lines[0][6] and line[5] in ("F0001.jpg", "F0002.jpg")])
    with pytest.raises(InputError, match=f"1 control point is measured in the images.*{FIX}"):
        read_survey(SurveyInputs(bare.frames, gcp=one))
    survey = read_survey(SurveyInputs(bare.frames, gcp=one, gcp_optional=True))
    assert survey.control == () and survey.map_crs == read_survey(SurveyInputs(bare.frames)).map_crs
    assert {"control-unused", "local-frame"} <= {w.code for w in survey.warnings}


def test_the_command_its_dry_run_and_inspect_say_the_same(
    flown: SimulatedSurvey, rover: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, quick = tmp_path / "run", ("--adjust", "least_squares", "--gcp", rover)
    for more in ((), ("--dry-run",)):
        assert mosaic(flown.frames, run, *quick, *more) == 2
        (line,) = [text for text in capsys.readouterr().err.splitlines() if text.startswith("geomosaic: ")]
        assert f"{rover}: none of its 6 points has an image mark" in line and line.endswith(FIX)
        assert not run.exists()
    assert mosaic(flown.frames, run, *quick, "--gcp-optional", "--dry-run", "--json", "-q") == 0
    planned = [w for w in json.loads(capsys.readouterr().out)["warnings"] if w["code"] == "control-unused"]
    assert gm.mosaic(
        flown.frames, run, gcp=rover, gcp_optional=True, adjust="least_squares", workers=1
    ).warnings == summary(run)["warnings"]  # fmt: skip
    assert [w for w in summary(run)["warnings"] if w["code"].startswith("control")] == planned
    assert warned(run, "control-unused") == [""]
    assert geomosaic("inspect", run) == 0
    assert "none of its 6 points has an image mark" in " ".join(capsys.readouterr().out.split())
