"""Rigs that write a file a band: captures found, bands registered, one mosaic with named bands."""

from __future__ import annotations

import csv
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from mosaic_scenes import CAMERA, make_survey, write_frame
from scipy.spatial.transform import Rotation as Turn
from small_surveys import geomosaic, mosaic, small_survey, summary
from survey_files import exif_block, gps, segment, write_jpeg, xmp_attributes

from geomosaic.composition.bands import stack_bands
from geomosaic.composition.model import OutputGrid
from geomosaic.errors import InputError
from geomosaic.matching.band_registration import Captures, RigPoses, band_poses, register_bands
from geomosaic.pipeline.run_results import load_artefact
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.model import Band
from geomosaic.survey.read import read_survey

TURN = np.array([0.012, -0.02, 0.03])
"""Of the band's camera against the frames' own, rad about its axes: 0.7, 1.1 and 1.7 degrees."""


def rig_xmp(capture: str, band: str, index: int, wavelength: float) -> bytes:
    tags = {
        "CaptureUUID": capture,
        "BandName": band,
        "RigCameraIndex": index,
        "CentralWavelength": wavelength,
    }
    return xmp_attributes("http://pix4d.com/camera/1.0/", "Camera", **tags)


def grey_frame(path: Path, number: int, xmp: bytes = b"") -> None:
    exif = exif_block(
        Make="Maker", Model="Rig", DateTimeOriginal=f"2024:05:17 10:11:{number:02d}",
        FocalLength=Fraction("5.0"), FocalLengthIn35mmFilm=28, **gps(9.1 + 1e-4 * number, 48.7, 412.5),
    )  # fmt: skip
    pixels = np.random.default_rng(number).integers(0, 255, (90, 120, 1), dtype=np.uint8)
    write_jpeg(path, pixels, exif, xmp)


def test_captures_are_found_by_their_tags_whatever_the_names(tmp_path: Path) -> None:
    """The green camera carries the rig though it is not the first; the others follow by wavelength."""
    bands = (("NIR", 3, 790.0), ("Red", 0, 660.0), ("Green", 1, 550.0))
    for capture in range(3):
        for k, (band, index, wavelength) in enumerate(bands):
            if (capture, band) != (2, "Red"):
                xmp = rig_xmp(f"A{capture}", band, index, wavelength)
                grey_frame(tmp_path / f"{k}{capture}x.jpg", capture, xmp)
    survey = read_survey(SurveyInputs(tmp_path))
    (lacking,) = [w.text for w in survey.warnings if w.code == "capture-incomplete"]
    assert "band Red" in lacking and "22x.jpg" in lacking
    assert [f.name for f in survey.frames] == ["20x.jpg", "21x.jpg", "22x.jpg"] and survey.band == "Green"
    assert [(b.name, b.wavelength_nm) for b in survey.other_bands] == [("Red", 660.0), ("NIR", 790.0)]
    red, nir = survey.other_bands
    assert [f and f.name for f in red.frames] == ["10x.jpg", "11x.jpg", None]
    assert [f and f.name for f in nir.frames] == ["00x.jpg", "01x.jpg", "02x.jpg"]
    assert red.frames[1] is not None and red.frames[1].position == survey.frames[1].position


@pytest.mark.parametrize(
    ("namespace", "prefix", "tag"),
    [
        ("http://www.dji.com/drone-dji/1.0/", "drone-dji", "CaptureUUID"),
        ("http://pix4d.com/camera/1.0/", "Camera", "ImageUniqueID"),
    ],
    ids=["Phantom 4 Multispectral", "Sentera"],
)
def test_captures_of_other_makers_are_found(tmp_path: Path, namespace: str, prefix: str, tag: str) -> None:
    for capture in range(2):
        for k, band in enumerate(("Blue", "Green", "NIR")):
            xmp = xmp_attributes("http://pix4d.com/camera/1.0/", "Camera", BandName=band)
            of_capture = f'<rdf:Description xmlns:{prefix}="{namespace}" {prefix}:{tag}="A{capture}"/>'
            xmp = xmp.replace(b"</rdf:RDF>", of_capture.encode() + b"</rdf:RDF>")
            grey_frame(tmp_path / f"DJI_{capture:03d}{k}.jpg", capture, xmp)
    survey = read_survey(SurveyInputs(tmp_path))
    assert len(survey.frames) == 2 and survey.band == "Green"
    assert {b.name for b in survey.other_bands} == {"Blue", "NIR"}


def test_bands_that_no_tag_joins_are_never_mixed(tmp_path: Path) -> None:
    for number, band in enumerate(("Blue", "Green", "Blue", "Green")):
        xmp = xmp_attributes("http://pix4d.com/camera/1.0/", "Camera", BandName=band)
        grey_frame(tmp_path / f"X{number}.jpg", number, xmp)
    with pytest.raises(InputError, match="different bands \\(Blue, Green\\)"):
        read_survey(SurveyInputs(tmp_path))


def test_captures_are_found_by_names_that_end_alike(tmp_path: Path) -> None:
    for capture in range(2):
        for band in (1, 2, 5):
            grey_frame(tmp_path / f"IMG_{capture:04d}_{band}.jpg", capture)
    survey = read_survey(SurveyInputs(tmp_path))
    assert survey.band == "1" and [b.name for b in survey.other_bands] == ["2", "5"]
    assert [f.name for f in survey.frames] == ["IMG_0000_1.jpg", "IMG_0001_1.jpg"]


def test_grey_frames_of_one_camera_are_no_rig(tmp_path: Path) -> None:
    for number in range(3):
        grey_frame(tmp_path / f"IMG_{number:04d}.jpg", number)
    survey = read_survey(SurveyInputs(tmp_path))
    assert len(survey.frames) == 3 and survey.band == "" and survey.other_bands == ()


@pytest.mark.parametrize("name", ["photo_{0:02d}", "run{1}_{0}"])
def test_grey_frames_whose_numbers_end_their_names_are_no_rig(tmp_path: Path, name: str) -> None:
    """Twelve frames of one film, or of three runs, each at a time of its own."""
    for number in range(12):
        grey_frame(
            tmp_path / f"{name.format(number % 4 if '{1}' in name else number, number // 4)}.jpg", number
        )
    survey = read_survey(SurveyInputs(tmp_path))
    assert len(survey.frames) == 12 and survey.other_bands == ()


def test_files_of_captures_without_the_first_band_are_named(tmp_path: Path) -> None:
    for capture in range(3):
        for k, band in enumerate(("Green", "Red")):
            if (capture, band) != (1, "Green"):
                grey_frame(tmp_path / f"{capture}{band}.jpg", capture, rig_xmp(f"A{capture}", band, k, 500.0))
    survey = read_survey(SurveyInputs(tmp_path))
    lost = [w.text for w in survey.warnings if w.code == "capture-incomplete"]
    assert len(survey.frames) == 2 or survey.band == "Red"
    assert survey.band == "Red" or (len(lost) == 1 and "1Red.jpg" in lost[0])


def test_a_copy_and_a_file_without_tags_stop_no_rig(tmp_path: Path) -> None:
    for capture in range(3):
        for k, band in enumerate(("Green", "Red")):
            grey_frame(
                tmp_path / f"DJI_{capture}{k}.jpg", capture, rig_xmp(f"A{capture}", band, k, 550.0 + k)
            )
    grey_frame(tmp_path / "DJI_11 - Copy.jpg", 1, rig_xmp("A1", "Red", 1, 551.0))
    grey_frame(tmp_path / "DJI_30.jpg", 3)
    survey = read_survey(SurveyInputs(tmp_path))
    assert [f.name for f in survey.frames] == ["DJI_00.jpg", "DJI_10.jpg", "DJI_20.jpg"]
    (lacking,) = [w.text for w in survey.warnings if w.code == "capture-incomplete"]
    assert lacking.startswith("2 files are not used") and "DJI_30.jpg" in lacking


def test_bands_that_dji_names_in_its_own_room_are_found(tmp_path: Path) -> None:
    """Mavic 3M, by DJI's M3M Image Processing Guide: band and wavelength are DJI's own properties."""
    for capture in range(2):
        for band, wavelength in (("Red", 650), ("Green", 560)):
            tags = {"CaptureUUID": f"A{capture}", "BandName": band, "CentralWavelength": wavelength}
            xmp = xmp_attributes("http://www.dji.com/drone-dji/1.0/", "drone-dji", **tags)
            grey_frame(tmp_path / f"{capture}{band}.jpg", capture, xmp)
    survey = read_survey(SurveyInputs(tmp_path))
    assert [f.name for f in survey.frames] == ["0Green.jpg", "1Green.jpg"]
    assert survey.band == "Green"
    assert [(b.name, b.wavelength_nm) for b in survey.other_bands] == [("Red", 650.0)]


@pytest.mark.parametrize("tags", ["all", "none", "colour too"])
def test_an_event_of_rtklib_is_a_capture_of_the_rig(tmp_path: Path, tags: str) -> None:
    """By tags, by names, and where the aircraft's colour camera takes part."""
    folder = tmp_path / "rig"
    folder.mkdir()
    events = ["% GPST latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m)"]
    for capture in range(3):
        for k, band in enumerate(("Green", "Red", "NIR")):
            xmp = b"" if tags == "none" else rig_xmp(f"A{capture}", band, k, 550.0)
            grey_frame(folder / f"IMG_000{capture}_{k + 1}.jpg", capture, xmp)
        if tags == "colour too":
            xmp = rig_xmp(f"A{capture}", "RGB", 9, 0.0)
            write_jpeg(folder / f"IMG_000{capture}_0.jpg", np.zeros((9, 12, 3), np.uint8), xmp=xmp)
        place = f"48.8000{capture}1 9.1000{capture}2 50{capture}.25"
        events.append(f"2024/05/17 10:11:0{capture}.364 {place} 1 17 0.03 0.04 0.05")
    (tmp_path / "rig_events.pos").write_text("\n".join(events) + "\n")
    survey = read_survey(SurveyInputs(folder, pos=tmp_path / "rig_events.pos", strict=tags != "colour too"))
    assert [(f.position.lat_deg, f.position.lon_deg) for f in survey.frames] == [
        (48.800001, 9.100002), (48.800011, 9.100012), (48.800021, 9.100022),
    ]  # fmt: skip
    assert [f.position.height_ellipsoidal_m for f in survey.frames] == [500.25, 501.25, 502.25]


@pytest.mark.parametrize("strict", [True, False])
def test_a_pos_file_may_list_all_files_of_a_rig(tmp_path: Path, strict: bool) -> None:
    """Where the frame's own line is missing, that of another band of its capture stands in."""
    folder = tmp_path / "rig"
    folder.mkdir()
    lines = ["frame,lon,lat,height_m,camera"]
    for capture in range(3):
        for k, band in enumerate(("Green", "Red", "NIR")):
            name = f"IMG_000{capture}_{k + 1}.jpg"
            grey_frame(folder / name, capture, rig_xmp(f"A{capture}", band, k, 550.0 + 100.0 * k))
            if (capture, band) != (1, "Green"):
                lines.append(f"{name},{9.1 + 1e-4 * capture + 1e-6 * k:.6f},48.8,500,{band}")
    (tmp_path / "pos.csv").write_text("\n".join(lines) + "\n")
    survey = read_survey(SurveyInputs(folder, pos=tmp_path / "pos.csv", strict=strict))
    assert not {"pos-line-without-frame", "pos-frame-without-line"} & {w.code for w in survey.warnings}
    assert [f.name for f in survey.frames] == ["IMG_0000_1.jpg", "IMG_0001_1.jpg", "IMG_0002_1.jpg"]
    lon = [f.position.lon_deg for f in survey.frames]
    assert lon == pytest.approx([9.1, 9.100101, 9.1002], abs=1e-9)
    assert {f.position.source for f in survey.frames} == {"pos"}


def test_a_band_that_shows_nothing_is_left_as_reported(tmp_path: Path) -> None:
    survey, poses, ground = make_survey(tmp_path / "own", lines=1, per_line=2, bands=1)
    frames = []
    for i, frame in enumerate(survey.frames):
        write_frame(tmp_path / f"{i}.tif", np.full((180, 240, 1), 7.0), "uint8")
        frames.append(replace(frame, path=str(tmp_path / f"{i}.tif")))
    rigged = replace(survey, other_bands=(Band("dark", None, CAMERA, tuple(frames)),))
    (found,) = register_bands(Captures(rigged, poses, [CAMERA] * 2, [True] * 2, ground)).bands
    assert np.array_equal(found.own_from_band, np.eye(3)) and np.isnan(found.after_px)
    turned = band_poses(poses, replace(found, own_from_band=Turn.from_rotvec(TURN).as_matrix()))
    assert turned.rotations[1] == pytest.approx(poses.rotations[1] @ Turn.from_rotvec(TURN).as_matrix())


def test_bands_are_stacked_where_all_are_valid(tmp_path: Path) -> None:
    shape = {
        "driver": "GTiff",
        "width": 600,
        "height": 40,
        "count": 1,
        "dtype": "uint16",
        "crs": "EPSG:32632",
    }
    rasters = []
    for k in range(3):
        rasters.append(tmp_path / f"{k}.tif")
        with (
            rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
            rasterio.open(rasters[-1], "w", transform=rasterio.Affine(1, 0, 5e5, 0, -1, 5e6), **shape) as out,
        ):
            out.write(np.full((1, 40, 600), 100 + k, np.uint16))
            mask = np.full((40, 600), 255, np.uint8)
            mask[k] = 0
            out.write_mask(mask)
    grid = OutputGrid("EPSG:32632", 5e5, 5e6, 1.0, 600, 40)
    stack_bands(rasters, ("Green", "Red", "NIR"), grid, "uint16", tmp_path / "all.tif")
    with rasterio.open(tmp_path / "all.tif") as found:
        assert found.descriptions == ("Green", "Red", "NIR") and found.crs.to_epsg() == 32632
        pixels, valid = found.read(), found.dataset_mask()
    assert pixels[:, 3:].reshape(3, -1).min(axis=1).tolist() == [100, 101, 102]
    assert not valid[:3].any() and valid[3:].all() and not pixels[:, :3].any()


@pytest.mark.proof
def test_a_folder_of_a_rig_becomes_one_mosaic_with_named_bands(tmp_path: Path) -> None:
    """The second camera is turned by known angles: a homography of the first one's images, as negatives, whose
    edges are alike where the greys are opposite."""
    simulated = small_survey(tmp_path / "survey", lines=1, frames_per_line=3)
    folder = tmp_path / "rig"
    folder.mkdir()
    lens = np.array([[500.0, 0, 240.0], [0, 500.0, 180.0], [0, 0, 1.0]])
    axes = np.diag([1.0, -1.0, -1.0])  # of images (right, down, away) from the camera's
    turned = lens @ axes @ Turn.from_rotvec(TURN).as_matrix().T @ axes @ np.linalg.inv(lens)
    rows = list(csv.reader(simulated.pos.read_text().splitlines()))
    for capture, path in enumerate(sorted(simulated.frames.glob("*.jpg"))):
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        other = 255 - cv2.warpPerspective(grey, turned, grey.shape[::-1], flags=cv2.INTER_CUBIC)
        for k, (band, pixels) in enumerate((("Green", grey), ("NIR", other))):
            data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
            packet = b"http://ns.adobe.com/xap/1.0/\0" + rig_xmp(f"A{capture}", band, k, 550.0 + 240.0 * k)
            name = f"{path.stem}_{band}.jpg"
            (folder / name).write_bytes(data[:2] + segment(0xE1, packet) + data[2:])
        rows = [[f"{path.stem}_Green.jpg" if cell == path.name else cell for cell in row] for row in rows]
    with (tmp_path / "pos.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    run = tmp_path / "run"
    assert mosaic(folder, run, "--pos", tmp_path / "pos.csv", "--camera", simulated.camera) == 0
    assert geomosaic("export", "orthos", run) == 0
    run_summary = summary(run)
    assert run_summary["frames"]["tied"] == 3 and run_summary["metrics"]["bands"]["NIR"]["after_px"] < 0.3
    (band,) = load_artefact(run, run_summary, "rig", RigPoses).bands
    assert Turn.from_matrix(band.own_from_band).as_rotvec() == pytest.approx(TURN, abs=5e-4)
    with rasterio.open(run / "mosaic.tif") as found:
        assert found.descriptions == ("Green", "NIR")
        green, nir = found.read().astype(float)
        valid = found.dataset_mask() == 255
    assert np.corrcoef(green[valid], nir[valid])[0, 1] < -0.9
    for name in sorted(path.name for path in (run / "orthos").iterdir()):
        with rasterio.open(run / "orthos" / name) as ortho:
            assert ortho.descriptions == ("Green", "NIR") and ortho.dtypes[0] == "uint8"
            shown, there = ortho.read().astype(float), ortho.dataset_mask() == 255
            assert np.corrcoef(shown[0][there], shown[1][there])[0, 1] < -0.9, name
