"""What users get wrong: exit 2, one line with file and fix, nothing half-written; or the best mosaic."""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
import yaml
from small_surveys import geomosaic, mosaic, small_survey, summary, warned

from geomosaic.pipeline.run_folder import MARKER
from geomosaic_simulate.survey import SimulatedSurvey

FINAL = {"mosaic.tif", "sources.tif", "layers.gpkg", "positions.csv", "report.html", "run.json"}
QUICK = ("--adjust", "least_squares")
SIZE = {"width_px": 160, "height_px": 120, "ground_pixel_m": 0.2}


@pytest.fixture(scope="session")
def line(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    """One line of four frames of 32 m x 24 m with pos.csv, cameras.json and tags."""
    return small_survey(tmp_path_factory.mktemp("line"), lines=1, seed=11, **SIZE)


@pytest.fixture(scope="session")
def tagged(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    """Two frames with everything in their tags."""
    folder = tmp_path_factory.mktemp("tagged")
    return small_survey(folder, lines=1, frames_per_line=2, pos_in="exif", seed=12, **SIZE)


@pytest.fixture
def survey(line: SimulatedSurvey, tmp_path: Path) -> Survey:
    """A copy of the line to spoil."""
    return Survey(line, tmp_path)


class Survey:
    """A survey that a test may spoil, and the command on it."""

    def __init__(self, made: SimulatedSurvey, folder: Path) -> None:
        self.frames, self.run = folder / "frames", folder / "run"
        self.pos, self.camera, self.ortho = folder / "pos.csv", folder / "cameras.json", made.ortho
        shutil.copytree(made.frames, self.frames)
        shutil.copy(made.camera, self.camera)
        if made.pos:
            shutil.copy(made.pos, self.pos)

    def mosaic(self, *more: object) -> int:
        """The mosaic with the files next to the frames."""
        quick = () if "--adjust" in more else QUICK
        return mosaic(self.frames, self.run, "--pos", self.pos, "--camera", self.camera, *quick, *more)

    def frame(self, number: int) -> Path:
        """A frame, counted from 1."""
        return sorted(self.frames.iterdir())[number - 1]

    def rows(self) -> list[dict[str, str]]:
        """The POS file."""
        with self.pos.open(encoding="utf-8", newline="") as file:
            return list(csv.DictReader(file))

    def write(self, rows: list[dict[str, str]]) -> None:
        """Another POS file."""
        with self.pos.open("w", encoding="utf-8", newline="") as file:
            table = csv.DictWriter(file, list(rows[0]))
            table.writeheader()
            table.writerows(rows)

    def change(self, i: int, **values: object) -> None:
        """Other values in one row of the POS file."""
        rows = self.rows()
        rows[i] |= {k: str(v) for k, v in values.items()}
        self.write(rows)


Refused = Callable[..., str]


@pytest.fixture
def refused(capfd: pytest.CaptureFixture[str]) -> Refused:
    """Checks a failure: exit 2, one line with every word asked for, no result in the run folder."""

    def check(code: int, run: Path, *words: object) -> str:
        err = capfd.readouterr().err
        lines = [ln for ln in err.splitlines() if not ln.startswith(("[", "warning: "))]
        assert code == 2, err
        assert len(lines) == 1, err
        (text,) = lines
        assert text.startswith("geomosaic: ") and "Traceback" not in err
        for word in words:
            assert str(word) in text
        assert any(w in text for w in ("; ", "did you mean", "must be")), "names no fix"
        if run.is_dir():
            assert not FINAL & {p.name for p in run.iterdir()}
            assert {p.name for p in run.iterdir()} <= {MARKER, "run.mcap", "work"}
        return text

    return check


def test_an_empty_folder(tmp_path: Path, refused: Refused) -> None:
    (tmp_path / "frames").mkdir()
    code = mosaic(tmp_path / "frames", tmp_path / "run")
    refused(code, tmp_path / "run", tmp_path / "frames", "no JPEG, TIFF or PNG frames", "give the folder")


def test_a_folder_that_is_not_there_and_one_that_is_a_file(tmp_path: Path, refused: Refused) -> None:
    code = mosaic(tmp_path / "nowhere", tmp_path / "run")
    refused(code, tmp_path / "run", tmp_path / "nowhere")
    file = tmp_path / "file.jpg"
    file.write_bytes(b"x")
    refused(mosaic(file, tmp_path / "run"), tmp_path / "run", file)


@pytest.mark.parametrize(
    "content", [b"I am a text file.\n", b"", b"\xff\xd8\xff\xe0", b"MM\x00*" + b"\0" * 40]
)
@pytest.mark.parametrize("name", ["notes.jpg", "notes.TIF"])
def test_a_file_that_is_no_image(survey: Survey, refused: Refused, content: bytes, name: str) -> None:
    """Alone it is refused; among good frames it is left out (see test_damaged_frames.py)."""
    for frame in survey.frames.iterdir():
        frame.unlink()
    (survey.frames / name).write_bytes(content)
    refused(survey.mosaic(), survey.run, survey.frames / name, "take it out of the folder")


def test_a_truncated_jpeg_alone(survey: Survey, refused: Refused) -> None:
    frame = survey.frame(3)
    for other in sorted(survey.frames.iterdir()):
        if other != frame:
            other.unlink()
    survey.write(survey.rows()[2:3])
    frame.write_bytes(frame.read_bytes()[: frame.stat().st_size * 2 // 3])
    refused(survey.mosaic(), survey.run, frame, "damaged", "remature end", "copy it again")


def test_a_frame_without_tags_among_few(tagged: SimulatedSurvey, tmp_path: Path) -> None:
    """It gets a lens to begin with, named once; the images decide."""
    frames = tmp_path / "frames"
    shutil.copytree(tagged.frames, frames)
    bare = sorted(frames.iterdir())[1]
    cv2.imwrite(str(bare), cv2.imread(str(bare)))
    assert mosaic(frames, tmp_path / "run", *QUICK) == 0
    assert_lens_assumed(tmp_path / "run")


def assert_lens_assumed(run: Path) -> None:
    """One warning that names what was assumed and the option that gives it."""
    assumed = [w for w in summary(run)["warnings"] if w["code"] == "focal-length-assumed"]
    assert len(assumed) == 1
    assert "--camera" in assumed[0]["text"]


def test_no_focal_length(survey: Survey) -> None:
    for frame in survey.frames.iterdir():
        cv2.imwrite(str(frame), cv2.imread(str(frame)))
    assert mosaic(survey.frames, survey.run, "--pos", survey.pos, *QUICK) == 0
    assert_lens_assumed(survey.run)


def test_a_pos_file_without_a_column(survey: Survey, refused: Refused) -> None:
    rows = survey.rows()
    for row in rows:
        del row["lat_deg"]
    survey.write(rows)
    refused(survey.mosaic(), survey.run, survey.pos, "latitude", "name it one of")


def test_a_latitude_of_95(survey: Survey, refused: Refused) -> None:
    survey.change(2, lat_deg=95)
    refused(survey.mosaic(), survey.run, survey.pos, "line 4", "latitude 95", "correct it")


def test_a_receiver_without_a_fix(survey: Survey, refused: Refused) -> None:
    survey.change(2, lat_deg=0, lon_deg=0)
    refused(survey.mosaic(), survey.run, survey.pos, "line 4", "both 0", "take the line")


def test_a_frame_on_another_continent(survey: Survey, refused: Refused) -> None:
    """Left out before the ground is made for all that lies between; strictly, refused."""
    survey.change(1, lat_deg=3)
    strictly = survey.mosaic("--strict")
    refused(strictly, survey.run, survey.frame(2), "km from the middle", "correct its position")
    assert survey.mosaic("--set", "adjustment.solve.method=none") == 0
    assert warned(survey.run, "frame-far-away") == ["F0002.jpg"]


def test_a_frame_100_km_away(survey: Survey, refused: Refused) -> None:
    survey.change(1, lat_deg=float(survey.rows()[1]["lat_deg"]) + 0.9)
    refused(survey.mosaic(), survey.run, "F0002.jpg", "km", "check its position")


def test_results_among_the_frames(survey: Survey, refused: Refused) -> None:
    """Inside the folder of frames is well; in the folder itself the next run would take the mosaic in."""
    before = {p.name for p in survey.frames.iterdir()}
    (survey.frames.parent / "link").symlink_to(survey.frames)
    for output in (survey.frames, survey.frames.parent / "link", survey.frames / "deeper" / ".."):
        code = mosaic(survey.frames, output, "--pos", survey.pos, "--camera", survey.camera)
        refused(code, survey.run, survey.frames, "another output folder")
        assert {p.name for p in survey.frames.iterdir()} == before
    survey.run = survey.frames / "run"
    assert survey.mosaic() == 0 == survey.mosaic()
    assert summary(survey.run)["frames"]["total"] == 4


def test_frames_in_the_cache(survey: Survey, refused: Refused) -> None:
    """RUN/work is tidied at the end of a run: frames there would be deleted."""
    frames = survey.run / "work" / "frames"
    frames.parent.mkdir(parents=True)
    survey.frames.rename(frames)
    refused(mosaic(frames, survey.run), survey.run, frames, "another output folder")
    assert len(list(frames.iterdir())) == 4


@pytest.mark.parametrize(
    ("option", "name", "content", "words"),
    [
        ("--pos", "track.gpx", '<?xml version="1.0"?>\n<gpx><trk><trkseg/></trk></gpx>', "a GPX track"),
        ("--pos", "a.csv", "\ufeff<kml xmlns='http://www.opengis.net/kml/2.2'/>", "a KML file"),
        ("--pos", "a.json", '{"type": "FeatureCollection", "features": []}', "a GeoJSON file"),
        ("--pos", "a.txt", '[{"frame": "F0001.jpg"}]', "a JSON file"),
        ("--pos", "a.xlsx", "PK\x03\x04\0\0", "an archive or a spreadsheet"),
        ("--pos", "huge.csv", "frame,lon_deg,lat_deg\n", "too large"),
        ("--pos", "folder", None, "is no regular file but a folder"),
        ("--gcp", "folder", None, "is no regular file but a folder"),
        ("--camera", "folder", None, "is no regular file but a folder"),
        ("--camera", "c.yaml", "a: [1\n", "c.yaml"),
        ("--dem", "dem.tif", "no raster", "no raster file"),
        ("--reference", "true.tif", "no raster", "no raster file"),
        ("--reference", "folder", None, "no raster file"),
        ("--crs", "EPSG:99999999", None, "99999999"),
    ],
)
def test_files_of_another_kind_are_named_before_anything_is_made(
    survey: Survey, refused: Refused, option: str, name: str, content: str | None, words: str
) -> None:
    file = survey.run.with_name(name)
    if name == "folder":
        file.mkdir()
    elif content is not None:
        file.write_text(content)
    if name == "huge.csv":
        os.truncate(file, 129 << 20)
    refused(mosaic(survey.frames, survey.run, option, file if file.exists() else name), survey.run, words)
    assert not survey.run.exists()


def test_names_with_blanks_and_umlauts_and_a_relative_path(
    survey: Survey, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "Über Öl"
    survey.frames.rename(folder)
    for frame in sorted(folder.iterdir()):
        frame.rename(folder / f"Bild ü {frame.name[:-4]}.JPEG")
    survey.write([r | {"frame": f"Bild ü {r['frame'][:-4]}.JPEG"} for r in survey.rows()])
    monkeypatch.chdir(tmp_path)
    run = Path("läuft hier")
    assert mosaic(Path("Über Öl"), run, "--pos", "pos.csv", "--camera", "cameras.json", *QUICK) == 0
    assert summary(run)["frames"]["tied"] == 4


def test_frames_of_one_position(survey: Survey) -> None:
    """Positions that say nothing of where the frames lie to each other; the overlaps do."""
    first = survey.rows()[0]
    survey.write([r | {k: first[k] for k in ("lon_deg", "lat_deg")} for r in survey.rows()])
    assert survey.mosaic() == 0
    assert summary(survey.run)["frames"]["tied"] == 4
    _filled(survey, 0.8, 1.15, frames=1.9)


def test_a_frame_twice_in_the_pos_file(survey: Survey, refused: Refused) -> None:
    survey.write([*survey.rows(), survey.rows()[1]])
    refused(survey.mosaic(), survey.run, survey.pos, "F0002.jpg", "line 3", "line 6", "remove one")


def test_a_name_that_matches_no_file(survey: Survey, refused: Refused) -> None:
    survey.change(0, frame="G0001.jpg")
    strictly = survey.mosaic("--set", "survey.read.strict=true")
    refused(strictly, survey.run, survey.pos, "line 2", "G0001.jpg", "did you mean F0001.jpg?")


def test_a_frame_without_a_line(survey: Survey, refused: Refused) -> None:
    survey.write(survey.rows()[:3])
    refused(
        survey.mosaic("--set", "survey.read.strict=true"), survey.run, survey.pos, "F0004.jpg", "add lines"
    )


def test_heights_below_the_ground(survey: Survey, refused: Refused) -> None:
    """Of one frame it is set by the images; of all, the ground is what is wrong."""
    survey.change(3, height_ellipsoidal_m=-200)
    refused(survey.mosaic("--set", "projection.ground.height_m=5200"), survey.run, "below the ground")
    assert survey.mosaic("--set", "projection.ground.height_m=520") == 0
    assert warned(survey.run, "height-implausible") == ["F0004.jpg"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"stage": "matching.shift"}, ("unknown stage", "did you mean 'matching.sift'?")),
        ({"params": {"ration": 0.7}}, ("ration", "ratio")),
        ({"params": {"ratio": 7.0}}, ("ratio", "7")),
        ({"params": "ratio"}, ("params",)),
    ],
)
def test_a_wrong_recipe(survey: Survey, refused: Refused, change: dict[str, object], words: object) -> None:
    stages = [
        {"stage": "survey.read", "params": {"frames": str(survey.frames)}},
        *({"stage": s} for s in ("projection.ground", "placement.pos")),
        {"stage": "matching.sift", **change},
    ]
    recipe = survey.run.with_name("recipe.yaml")
    recipe.write_text(yaml.safe_dump({"stages": stages}))
    refused(geomosaic("run", recipe, "-o", survey.run), survey.run, recipe, *words)
    assert not survey.run.exists()


def test_a_wrong_option(survey: Survey, refused: Refused) -> None:
    refused(survey.mosaic("--gsd", "-1"), survey.run, "gsd")
    refused(survey.mosaic("--adjust", "bundel"), survey.run, "bundel", "bundle")
    refused(survey.mosaic("--crs", "EPSG:99999999"), survey.run, "99999999")
    refused(survey.mosaic("--set", "matching.sift.rato=0.8"), survey.run, "rato", "ratio")


def test_a_dem_that_does_not_cover_the_survey(survey: Survey, refused: Refused) -> None:
    dem = survey.run.with_name("dem.tif")
    with rasterio.open(
        dem, "w", driver="GTiff", width=50, height=40, count=1, dtype="float32", crs="EPSG:32632",
        transform=rasterio.Affine(10.0, 0.0, 500_000.0, 0.0, -10.0, 5_200_000.0),
    ) as tiff:  # fmt: skip
        tiff.write(np.full((1, 40, 50), 500.0, np.float32))
    refused(survey.mosaic("--dem", dem, "--dem-offset", 0), survey.run, dem, "4 of 4 frames", "km")
    dem.write_text("no raster")
    refused(survey.mosaic("--dem", dem), survey.run, dem)


def test_an_output_folder_that_cannot_be_written(survey: Survey, refused: Refused) -> None:
    blocked = survey.run.with_name("file")
    blocked.write_text("in the way")
    code = mosaic(survey.frames, blocked / "run", "--pos", survey.pos, "--camera", survey.camera)
    refused(code, survey.run, blocked)
    code = mosaic(survey.frames, blocked, "--pos", survey.pos, "--camera", survey.camera)
    refused(code, survey.run, blocked)
    assert blocked.read_text() == "in the way"


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_an_output_folder_without_permission(survey: Survey, refused: Refused) -> None:
    survey.run.mkdir(mode=0o500)
    refused(survey.mosaic(), survey.run, survey.run)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 1.2 MB."""
    if not shutil.which("mount") or os.geteuid() != 0:
        pytest.skip("only root can mount a small disk")
    folder = tmp_path / "disk"
    folder.mkdir()
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1200k", "tmpfs", str(folder)], capture_output=True, text=True
    )
    if made.returncode:
        pytest.skip(f"can't mount a small disk here: {made.stderr.strip()}")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.mark.parametrize("ballast_kb", [0, 800, 1150])
def test_a_full_disk(survey: Survey, small_disk: Path, refused: Refused, ballast_kb: int) -> None:
    """Full in the first stage, or while pixels are written."""
    (small_disk / "ballast").write_bytes(bytes(ballast_kb << 10))
    survey.run = small_disk / "run"
    refused(survey.mosaic(), survey.run, small_disk, "o space left on", "free some")


# Surveys that are poor, not wrong: the best possible mosaic, and a word.


def test_one_frame(survey: Survey) -> None:
    for frame in sorted(survey.frames.iterdir())[1:]:
        frame.unlink()
    survey.write(survey.rows()[:1])
    assert survey.mosaic("--adjust", "bundle") == 0
    assert summary(survey.run)["frames"] == {"total": 1, "tied": 0, "placed": 1, "rejected": 0}
    _shows_the_ground(survey, frames=1)


def test_two_frames(survey: Survey) -> None:
    for frame in sorted(survey.frames.iterdir())[2:]:
        frame.unlink()
    survey.write(survey.rows()[:2])
    assert survey.mosaic("--adjust", "bundle") == 0
    assert summary(survey.run)["frames"] == {"total": 2, "tied": 2, "placed": 0, "rejected": 0}
    _shows_the_ground(survey, frames=1.3)


def test_frames_that_do_not_overlap(survey: Survey) -> None:
    """The first and the last frame of a line, 200 m put between them, and the last mirrored. A tenth of its
    ground is the first's, which is found again in spite of the 200 m."""
    for number in (3, 2):
        survey.frame(number).unlink()
    mirrored = cv2.flip(cv2.imread(str(survey.frames / "F0004.jpg")), 1)
    cv2.imwrite(str(survey.frames / "F0004.jpg"), mirrored)
    first, _, _, last = survey.rows()
    last["lat_deg"] = str(float(last["lat_deg"]) + 200.0 / 111_200.0)
    survey.write([first, last])
    assert survey.mosaic("--adjust", "bundle") == 0
    assert summary(survey.run)["frames"] == {"total": 2, "tied": 0, "placed": 2, "rejected": 0}
    assert warned(survey.run, "no-tie-points") == ["F0001.jpg", "F0004.jpg"]


def test_frames_of_water(survey: Survey) -> None:
    """Nothing to see: every frame where its position says, each named."""
    rng = np.random.default_rng(5)
    for frame in survey.frames.iterdir():
        sea = np.array([90.0, 70.0, 40.0]) + rng.normal(0.0, 1.0, (120, 160, 1))
        cv2.imwrite(str(frame), sea.round().astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 90])
    assert survey.mosaic("--adjust", "bundle", "--set", "projection.ground.height_m=520") == 0
    assert summary(survey.run)["frames"] == {"total": 4, "tied": 0, "placed": 4, "rejected": 0}
    assert warned(survey.run, "no-tie-points") == [f"F000{i}.jpg" for i in range(1, 5)]
    texts = [w["text"] for w in summary(survey.run)["warnings"] if w["code"] == "no-tie-points"]
    assert all("its image has little contrast): placed by its position" in text for text in texts)
    _filled(survey, low=0.9, high=1.1, frames=2.0)


def test_swapped_longitude_and_latitude(
    tagged: SimulatedSurvey, survey: Survey, tmp_path: Path, refused: Refused
) -> None:
    """Seen by the range, or by the frames' own GPS where both orders are possible."""
    rows = survey.rows()
    for row in rows:
        row["lon_deg"], row["lat_deg"] = row["lat_deg"], "111.3"
    survey.write(rows)
    refused(survey.mosaic(), survey.run, survey.pos, "swapped", "exchange")

    pos = tmp_path / "swapped.csv"
    truth = list(csv.DictReader(tagged.positions.read_text().splitlines()))
    lines = [f"{r['frame']},{r['lat_deg']},{r['lon_deg']},{r['height_ellipsoidal_m']}" for r in truth]
    pos.write_text("\n".join(["frame,lon_deg,lat_deg,height_ellipsoidal_m", *lines]))
    code = mosaic(tagged.frames, tmp_path / "run", "--pos", pos)
    refused(code, tmp_path / "run", pos, "swapped", "exchange")


def test_control_points_in_a_wrong_crs(survey: Survey, refused: Refused) -> None:
    gcp = survey.run.with_name("gcp.csv")
    gcp.write_text("name,x,y,height_ellipsoidal_m,image,col,row\nA,671200,5330000,520,F0001.jpg,100,100\n")
    refused(survey.mosaic("--gcp", gcp), survey.run, gcp, "coordinate reference system")
    gcp.write_text("EPSG:32633\n671200 5330000 520 100 100 F0001.jpg A\n")
    refused(survey.mosaic("--gcp", gcp), survey.run, gcp, "'A'", "km", "coordinate reference")
    gcp.write_text("EPSG:banana\n671200 5330000 520 100 100 F0001.jpg A\n")
    refused(survey.mosaic("--gcp", gcp), survey.run, gcp)


def test_control_points_outside_every_frame(survey: Survey, refused: Refused) -> None:
    """On the ground: named in a warning. In the image: wrong."""
    lon, lat = (float(survey.rows()[0][k]) for k in ("lon_deg", "lat_deg"))
    gcp = survey.run.with_name("gcp.csv")
    header = "name,lon_deg,lat_deg,height_ellipsoidal_m,image,col,row\n"
    gcp.write_text(f"{header}far,{lon + 0.01},{lat},520,F0001.jpg,100,100\n")
    assert survey.mosaic("--gcp", gcp) == 0
    texts = [w["text"] for w in summary(survey.run)["warnings"] if w["code"] == "control-outside"]
    assert len(texts) == 1 and texts[0].startswith("1 of 1 control and check points") and "far" in texts[0]
    shutil.rmtree(survey.run)
    gcp.write_text(f"{header}A,{lon},{lat},520,F0001.jpg,3200,100\n")
    refused(survey.mosaic("--gcp", gcp), survey.run, gcp, "'A'", "F0001.jpg", "160 x 120", "--gcp-optional")


def test_a_camera_file_for_another_frame_size(survey: Survey, refused: Refused) -> None:
    cameras = json.loads(survey.camera.read_text())
    for camera in cameras.values():
        camera["width"], camera["height"] = 4000, 2250
    survey.camera.write_text(json.dumps(cameras))
    refused(survey.mosaic(), survey.run, survey.camera, "4000 x 2250", "160 x 120")


def _shows_the_ground(survey: Survey, frames: float) -> None:
    _filled(survey, 0.9, 1.15, frames)


def _filled(survey: Survey, low: float, high: float, frames: float) -> None:
    """The mosaic's area in frames of 32 m x 24 m, and every byte a valid COG's."""
    with rasterio.open(survey.run / "mosaic.tif") as tiff:
        area = (tiff.dataset_mask() > 0).sum() * tiff.transform.a**2 / (32.0 * 24.0)
    assert low * frames < area < high * frames
