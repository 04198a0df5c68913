"""Folders as cameras, OpenDroneMap and people lay them out; POS files and frames that fit in part."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from small_surveys import mosaic, summary, warned
from survey_files import drone_frame, image, survey_folder, write_jpeg

from geomosaic.doors.files import RUN_MARKER
from geomosaic.errors import FileError, InputError
from geomosaic.pipeline.context import Context
from geomosaic.stages.survey_read import survey_read
from geomosaic.survey.folder import frame_files, frame_folders, unused_images
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.model import Survey
from geomosaic.survey.read import read_survey


def names(folder: Path) -> list[str]:
    """What the frames of a folder are called."""
    return list(frame_files(folder).values())


def touched(*paths: Path) -> None:
    """Empty files, their folders made."""
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def test_frames_on_a_card_are_found_and_what_else_it_holds_is_not(tmp_path: Path) -> None:
    card = tmp_path / "card"
    touched(
        card / "MISC" / "THM" / "DJI_0001.JPG",
        card / "DCIM" / "101MEDIA" / "DJI_0001.JPG",
        card / "DCIM" / "100MEDIA" / "DJI_0010.JPG",
        card / "DCIM" / "100MEDIA" / "DJI_0001.JPG",
        card / "DCIM" / "100MEDIA" / "DJI_0001_mask.tif",
        card / "DCIM" / ".thumbnails" / "1.jpg",
    )
    wanted = ["100MEDIA_DJI_0001.JPG", "DJI_0010.JPG", "101MEDIA_DJI_0001.JPG"]
    assert names(card) == names(card / "DCIM") == wanted
    assert frame_folders(card) == {f"DCIM/10{i}MEDIA": card / "DCIM" / f"10{i}MEDIA" for i in (0, 1)}


def test_folders_of_runs_and_links_are_not_entered(tmp_path: Path) -> None:
    touched(tmp_path / "a" / "one.jpg", tmp_path / "RUN" / "mosaic.tif", tmp_path / "RUN" / RUN_MARKER)
    (tmp_path / "loop").symlink_to(tmp_path)
    assert names(tmp_path) == ["one.jpg"]
    (tmp_path / "b" / "one.jpg").parent.mkdir()
    (tmp_path / "b" / "one.jpg").touch()
    assert names(tmp_path) == ["a_one.jpg", "b_one.jpg"]
    touched(tmp_path / "c" / "a_one.jpg")
    with pytest.raises(InputError, match=r"a_one\.jpg: its name looks like that of another frame"):
        names(tmp_path)


def test_only_what_is_empty_is_called_so(tmp_path: Path) -> None:
    (tmp_path / "notes" / "deep").mkdir(parents=True)
    with pytest.raises(InputError, match=r"no JPEG, TIFF or PNG frames \(1 folder without any\); give"):
        frame_files(tmp_path)
    with pytest.raises(InputError, match=r"\(it is empty\)"):
        frame_files(tmp_path / "notes" / "deep")
    touched(tmp_path / "a.gif", tmp_path / "b.gif", tmp_path / "more" / "c.gif")
    with pytest.raises(InputError, match=r"\(2 \.gif, 2 folders without any\)"):
        frame_files(tmp_path)


def test_png_files_are_frames_where_there_are_no_others(tmp_path: Path) -> None:
    touched(tmp_path / "flight" / "2.png", tmp_path / "flight" / "10.PNG", tmp_path / "flight" / "2_mask.png")
    assert names(tmp_path) == names(tmp_path / "flight") == ["2.png", "10.PNG"]
    touched(tmp_path / "flight" / "photos" / "a.jpg")
    assert names(tmp_path) == ["a.jpg"]


def test_frames_next_to_folders_count_alone_and_it_is_said(tmp_path: Path) -> None:
    folder = survey_folder(tmp_path / "f", 2)
    drone_frame(folder / "small" / "DJI_0001.JPG") if (folder / "small").mkdir() is None else None
    survey = read_survey(SurveyInputs(folder))
    assert [f.name for f in survey.frames] == ["DJI_0001.JPG", "DJI_0002.JPG"]
    (text,) = [w.text for w in survey.warnings if w.code == "frames-in-folders"]
    assert text == (
        "images in folders next to the frames are not used: small; to map those alone, give f/small; "
        "to map all, move them into one folder"
    )


def test_a_projects_preview_is_not_its_only_frame(tmp_path: Path) -> None:
    """As OpenDroneMap's Brighton Beach: the folder itself has fewer images than its folder of them."""
    survey_folder(tmp_path / "beach" / "images", 3)
    write_jpeg(tmp_path / "beach" / "brighton_beach.jpg", image(60, 40))
    survey = read_survey(SurveyInputs(tmp_path / "beach"))
    assert [f.name for f in survey.frames] == [f"DJI_000{i}.JPG" for i in (1, 2, 3)]
    texts = [(w.code, w.text) for w in survey.warnings if "not used" in w.text]
    says = "1 file is not used, as the folder images holds the frames: brighton_beach.jpg"
    assert texts == [("files-not-used", f"{says}; to add them, move them there")]


def test_a_folders_own_frames_count_where_its_home_has_no_more(tmp_path: Path) -> None:
    flight = survey_folder(tmp_path / "flight", 2)
    survey_folder(flight / "DCIM" / "100MEDIA", 2)
    assert names(flight) == ["DJI_0001.JPG", "DJI_0002.JPG"]
    assert frame_folders(flight) == {"": flight}
    touched(flight / "DCIM" / "101MEDIA" / "DJI_0003.JPG")
    assert frame_folders(flight) == {f"DCIM/10{i}MEDIA": flight / "DCIM" / f"10{i}MEDIA" for i in (0, 1)}


def test_a_dem_next_to_the_folder_of_frames_is_no_unused_image(tmp_path: Path) -> None:
    images = survey_folder(tmp_path / "images", 2)
    touched(tmp_path / "dem.tif")
    assert (
        unused_images(tmp_path, frame_files(tmp_path, [tmp_path / "dem.tif"]), [tmp_path / "dem.tif"]) == []
    )
    assert frame_folders(tmp_path, [tmp_path / "dem.tif"]) == {"images": images}


@pytest.mark.parametrize(
    ("others", "says"),
    [
        (("DJI_0001.DNG", "dji_0002.heic", "DJI_0001.SRT", "flight.MRK", "notes.txt", "._DJI_0009.MP4"), ""),
        (
            ("DJI_0003.DNG",),
            "1 file is not used (1 .dng), such as DJI_0003.DNG, .*; to add them, convert them to JPEG",
        ),
        (
            ("DJI_0010.MP4", "DJI_0009.MP4", "DJI_0009.SRT"),
            "2 files are not used (2 .mp4), such as DJI_0009.MP4, .*; to add them, take frames out of the video first: "
            "geomosaic frames FILE -o FRAMES$",
        ),
        (
            ("IMG_7.HEIC", "IMG_7.MOV", "A.ARW"),
            "3 files are not used (1 .heic, 1 .arw, 1 .mov), such as IMG_7.HEIC, .*; to add them, convert them to "
            "JPEG .*; convert raw images to JPEG or TIFF first, .*; take frames out of the video first: ",
        ),
    ],
)
def test_files_that_could_be_frames_are_counted(tmp_path: Path, others: tuple[str, ...], says: str) -> None:
    """But for the same photograph in another format, and files that only go with frames."""
    folder = survey_folder(tmp_path / "f", 2)
    touched(*(folder / name for name in others))
    survey = read_survey(SurveyInputs(folder))
    assert [f.name for f in survey.frames] == ["DJI_0001.JPG", "DJI_0002.JPG"]
    texts = [w.text for w in survey.warnings if w.code == "files-not-used"]
    assert len(texts) == bool(says)
    assert all(re.match(says.replace("(", "\\(").replace(")", "\\)"), text) for text in texts), texts


def project(folder: Path) -> Path:
    """OpenDroneMap's layout, with two frames of equal name in two folders."""
    survey_folder(folder / "images" / "first", 3)
    (folder / "images" / "second").mkdir()
    drone_frame(folder / "images" / "second" / "DJI_0001.JPG", 9.1234567 + 8.1e-4, second=9)
    touched(folder / "odm_orthophoto" / "odm_orthophoto.tif")
    lines = ["first/DJI_0001.JPG 9.1234 48.7654 400", "second/DJI_0001.JPG 9.1243 48.7654 400"]
    (folder / "geo.txt").write_text("\n".join(["EPSG:4326", *lines, "gone.JPG 9.1 48.7 400", ""]))
    return folder


def read(folder: Path, run: Path, **params: object) -> tuple[Survey, list[str]]:
    """The survey as its stage reads it, and the codes of its warnings."""
    given = survey_read.Params.model_validate({"frames": folder, **params})
    survey_read.check(given)
    context = Context(run)
    survey = survey_read().run({}, given, context)["survey"]
    return survey, [w["code"] for w in context.notes.warnings]


def test_a_project_of_opendronemap_is_read_with_its_files(tmp_path: Path) -> None:
    folder = project(tmp_path / "project")
    survey, codes = read(folder, tmp_path / "run")
    sources = {f.name: f.position.source for f in survey.frames}
    assert sources == {
        "first_DJI_0001.JPG": "pos", "DJI_0002.JPG": "exif", "DJI_0003.JPG": "exif",
        "second_DJI_0001.JPG": "pos",
    }  # fmt: skip
    assert {"project-file", "pos-line-without-frame", "pos-frame-without-line"} <= set(codes)
    texts = {w.code: w.text for w in survey.warnings}
    assert (
        "1 of 3 lines name no frame in the folder and are not used: gone.JPG"
        in texts["pos-line-without-frame"]
    )
    assert "no line for 2 of 4 frames: DJI_0002.JPG, DJI_0003.JPG" in texts["pos-frame-without-line"]
    files = survey_read.files(survey_read.Params(frames=folder))
    assert set(files) == {"frames/images/first", "frames/images/second", "pos"}
    other = tmp_path / "other.csv"
    other.write_text("frame,lon,lat\nDJI_0002.JPG,9.12373,48.7654\n")
    assert "project-file" not in read(folder, tmp_path / "run", pos=other)[1]


def test_strictly_every_line_has_a_frame_and_every_frame_a_line(tmp_path: Path) -> None:
    folder = project(tmp_path / "project")
    with pytest.raises(InputError, match=r"geo\.txt: line 4: 'gone\.JPG' is no frame in"):
        read(folder, tmp_path / "run", strict=True)
    (folder / "geo.txt").write_text("EPSG:4326\nfirst/DJI_0001.JPG 9.1234 48.7654 400\n")
    with pytest.raises(InputError, match=r"geo\.txt: no line for 3 of 4 frames: DJI_0002\.JPG"):
        read(folder, tmp_path / "run", strict=True)


def test_a_frame_that_cannot_be_read_is_left_out_and_strictly_an_error(tmp_path: Path) -> None:
    folder = survey_folder(tmp_path / "f", 3)
    (folder / "DJI_0002.JPG").write_text("no image")
    assert [o.name for o in read_survey(SurveyInputs(folder)).left_out] == ["DJI_0002.JPG"]
    with pytest.raises(FileError, match=r"DJI_0002\.JPG: is no JPEG file"):
        read_survey(SurveyInputs(folder, strict=True))


@pytest.mark.proof
def test_a_mosaic_of_frames_in_folders(tmp_path: Path) -> None:
    """Frames of equal names stay apart to the end, and a new one in a folder is not overlooked."""
    from small_surveys import small_survey

    survey = small_survey(tmp_path, lines=1, frames_per_line=4, width_px=320, height_px=240, pos_in="exif")
    (first, second, third, fourth) = sorted(survey.frames.glob("*.jpg"))
    for k, frames in enumerate(((first, second), (third,))):
        (tmp_path / "card" / f"{k}").mkdir(parents=True)
        for i, frame in enumerate(frames):
            frame.rename(tmp_path / "card" / f"{k}" / f"{i}.jpg")
    run = tmp_path / "run"
    assert mosaic(tmp_path / "card", run, "--adjust", "least_squares") == 0
    text = (run / "positions.csv").read_text()
    assert [line.split(",")[0] for line in text.splitlines()[1:]] == ["0_0.jpg", "1.jpg", "1_0.jpg"]
    assert warned(run, "frame-copy") == []
    fourth.rename(tmp_path / "card" / "1" / "2.jpg")
    assert mosaic(tmp_path / "card", run, "--adjust", "least_squares") == 0
    assert summary(run)["frames"]["total"] == 4
