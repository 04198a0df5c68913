"""Marks of control points: where they are expected, what is written, and whom the page's server answers."""

from __future__ import annotations

import csv
import http.client
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from marking_scene import MarkingScene, marking_scene, write_frames
from target_survey import with_target

from geomosaic.camera.rotation import Rotation
from geomosaic.errors import InputError, OutputError
from geomosaic.geodesy.mapcrs import LOCAL_CRS
from geomosaic.marking.marked_points import LIST, TABLE, read_points, save_points
from geomosaic.marking.oriented_frames import OrientedFrames
from geomosaic.marking.page_server import PageServer
from geomosaic.marking.predicted_places import predicted_places
from geomosaic.marking.session import MarkingSession
from geomosaic.marking.target_refinement import refined
from geomosaic.projection.ground import flat_ground
from geomosaic.survey.control import read_control
from geomosaic.survey.model import ControlPoint
from geomosaic.survey.names import FrameNames

ROVER = "name,lon_deg,lat_deg,height_ellipsoidal_m\n"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> MarkingScene:
    made = marking_scene(tmp_path_factory.mktemp("frames"))
    write_frames(made)
    return made


def rover(folder: Path, points: tuple[ControlPoint, ...]) -> Path:
    lines = [f"{p.name},{p.lon_deg:.10f},{p.lat_deg:.10f},{p.height_ellipsoidal_m:.4f}\n" for p in points]
    path = folder / "rover.csv"
    path.write_text(ROVER + "".join(lines))
    return path


def off_px(scene: MarkingScene, points: tuple[ControlPoint, ...]) -> np.ndarray:
    """How far predicted places are from the true ones, where there is no mark."""
    names = [frame.name for frame in scene.frames.frames]
    found = predicted_places(scene.frames, points).image_px
    return np.array([
        np.linalg.norm(found[names.index(name), k] - at)
        for k, point in enumerate(points)
        for name, at in scene.true_px[point.name].items()
        if name not in [image[0] for image in point.images]
    ])  # fmt: skip


def test_predicted_places_improve_with_each_mark(scene: MarkingScene) -> None:
    without = np.median(off_px(scene, scene.points))
    one = np.median(off_px(scene, scene.marked(1, of=1)))
    some = np.median(off_px(scene, scene.marked(2, of=3)))
    assert without > 40.0
    assert one < 0.75 * without
    assert some < 0.35 * without


def test_a_frame_with_three_marks_shows_the_others_within_pixels(scene: MarkingScene) -> None:
    marked = scene.marked(9, of=5)
    count = {f.name: sum(f.name in [i[0] for i in p.images] for p in marked) for f in scene.frames.frames}
    names = [frame.name for frame in scene.frames.frames]
    found = predicted_places(scene.frames, marked).image_px
    left = [
        np.linalg.norm(found[names.index(name), k] - at)
        for k, point in enumerate(marked)
        for name, at in scene.true_px[point.name].items()
        if count[name] >= 3 and not point.images
    ]
    assert len(left) > 3 and np.median(left) < 5.0


def test_a_wrong_mark_is_farther_off_than_expected(scene: MarkingScene) -> None:
    sure = replace(scene.frames, pose_sd=np.tile([0.5, 0.5, 0.5, 0.003, 0.003, 0.003], (8, 1)))
    known = replace(sure, poses=scene.true_poses)
    points = scene.marked(9)
    assert not predicted_places(known, points).suspect
    name, col, row = points[4].images[0]
    wrong = (
        *points[:4],
        replace(points[4], images=((name, col + 60.0, row), *points[4].images[1:])),
        *points[5:],
    )
    found = predicted_places(known, wrong)
    frame = [f.name for f in scene.frames.frames].index(name)
    assert (4, frame) in found.suspect
    assert found.off_px[4, frame] > 40.0
    rough = tuple(replace(point, sd_horizontal_m=3.0) for point in wrong)
    assert not predicted_places(known, rough).suspect, "by a handheld receiver a metre is no mistake"


def test_the_frames_of_a_point_begin_with_that_which_shows_it_in_the_middle(
    scene: MarkingScene, tmp_path: Path
) -> None:
    state = MarkingSession(scene.frames, scene.points, tmp_path).state()
    for of in state["points"]:
        away = [np.hypot(f["predicted"][0] / 900 - 0.5, f["predicted"][1] / 600 - 0.5) for f in of["frames"]]
        assert len(away) >= 2
        assert away == sorted(away)


def test_what_is_saved_is_read_as_the_same_marks(scene: MarkingScene, tmp_path: Path) -> None:
    points = scene.marked(3)
    points = (replace(points[0], check=True), replace(points[1], sd_assumed=True), *points[2:])
    save_points(tmp_path, points, "EPSG:32632")
    names = FrameNames(f.name for f in scene.frames.frames)
    table, listed = (read_control(tmp_path / file, names).points for file in (TABLE, LIST))
    assert [p.name for p in listed] == ["CHK-T1", *(p.name for p in points[1:])]
    assert [p.name for p in table] == [p.name for p in points]
    for a, b, c in zip(points, table, listed, strict=True):
        assert a.check == b.check == c.check
        assert (a.sd_horizontal_m, a.sd_assumed) == (b.sd_horizontal_m, b.sd_assumed) or a.sd_assumed
        for other in (b, c):
            assert [i[0] for i in other.images] == [i[0] for i in a.images]
            np.testing.assert_allclose([i[1:] for i in other.images], [i[1:] for i in a.images], atol=1e-3)
            np.testing.assert_allclose([other.lon_deg, other.lat_deg], [a.lon_deg, a.lat_deg], atol=1e-8)
            assert other.height_ellipsoidal_m == pytest.approx(a.height_ellipsoidal_m, abs=1e-3)


def test_marks_and_kinds_survive_a_restart(scene: MarkingScene, tmp_path: Path) -> None:
    given = rover(tmp_path, scene.points)
    points, _ = read_points(given, tmp_path, scene.frames)
    session = MarkingSession(scene.frames, points, tmp_path)
    session.mark(2, 3, (101.5, 202.25))
    session.mark(2, 4, (300.0, 10.0))
    session.mark(2, 4, None)
    session.set_kind(5, True)
    again, _ = read_points(given, tmp_path, scene.frames)
    assert again == session.points
    assert again[2].images == (("F03.jpg", 101.5, 202.25),)
    assert [p.check for p in again] == [k == 5 for k in range(7)]


def test_marks_in_frames_that_are_not_there_are_not_dropped(scene: MarkingScene, tmp_path: Path) -> None:
    given = rover(tmp_path, scene.points)
    save_points(tmp_path, (replace(scene.points[0], images=(("elsewhere.jpg", 3.0, 4.0),)),), "EPSG:32632")
    with pytest.raises(InputError, match="1 marks in images that are not in the folder"):
        read_points(given, tmp_path, scene.frames)


def test_points_that_cannot_be_read_are_errors_and_marks_of_other_frames_are_named(
    scene: MarkingScene, tmp_path: Path
) -> None:
    given = tmp_path / "rover.csv"
    for text, said in (
        (ROVER, "header and no lines"),
        ("name,x,y,height\nA,400000,5650000,5\n", "first line of the --points file"),
    ):
        given.write_text(text)
        with pytest.raises(InputError, match=said):
            read_points(given, tmp_path, scene.frames)
    points, _ = read_points(given, tmp_path, scene.frames, crs="EPSG:32632")
    assert [points[0].lon_deg, points[0].lat_deg] == pytest.approx([7.575069, 50.992885], abs=1e-6)
    given.write_text("name,lon_deg,lat_deg,height,image,col,row\nA,7.0,51.0,100,other.jpg,5,6\n")
    points, notes = read_points(given, tmp_path, scene.frames)
    assert not points[0].images and any("1 marks are in images" in note.text for note in notes)


def test_frames_without_any_position_are_listed_and_marked(scene: MarkingScene, tmp_path: Path) -> None:
    local = replace(scene.frames, survey=replace(scene.frames.survey, map_crs=LOCAL_CRS))
    points, _ = read_points(rover(tmp_path, scene.points), tmp_path, local)
    session = MarkingSession(local, points, tmp_path)
    session.mark(0, 1, (5.0, 6.0))
    state = session.state()["points"]
    assert [[f["frame"] for f in of["frames"]] for of in state] == [[*range(8)]] * 7
    assert {f["predicted"] for of in state for f in of["frames"]} == {None}
    assert [p["at"] for p in session.survey()["points"]] == [None] * 7
    assert (tmp_path / LIST).read_text().startswith("EPSG:32632\n")
    assert read_points(tmp_path / "rover.csv", tmp_path, local)[0] == session.points


def without_place(scene: MarkingScene, adjusted: bool = True) -> OrientedFrames:
    """The frames of a run without positions: related to each other, turned, enlarged and elsewhere."""
    turn, scale, shift_m = (
        Rotation.from_yaw_pitch_roll(0.7, -np.pi / 2.0 + 0.03, 0.02).matrix,
        0.4,
        [30.0, 5.0, 2.0],
    )
    level = Rotation.from_yaw_pitch_roll(0.0, -np.pi / 2.0, 0.0).matrix
    turn = turn @ level.T
    poses = tuple(
        replace(
            p, position_m=scale * turn @ p.position_m + shift_m, rotation=Rotation(turn @ p.rotation.matrix)
        )
        for p in scene.true_poses
    )
    ground = flat_ground(scene.frames.survey.work_frame, 102.0, 200.0)
    survey = replace(scene.frames.survey, map_crs=LOCAL_CRS)
    return replace(scene.frames, survey=survey, poses=poses, ground=ground, adjusted=adjusted)


def median_off_px(
    scene: MarkingScene, frames: OrientedFrames, points: tuple[ControlPoint, ...], k: int
) -> float:
    """Of a point's predicted places from the true ones, where there is no mark; NaN where none is predicted."""
    found = predicted_places(frames, points).image_px
    names, marked = [frame.name for frame in frames.frames], [image[0] for image in points[k].images]
    true = {f: at for f, at in scene.true_px[points[k].name].items() if f not in marked}
    return float(np.median([np.linalg.norm(found[names.index(f), k] - at) for f, at in true.items()]))


def test_marks_place_points_in_a_run_without_positions(scene: MarkingScene, tmp_path: Path) -> None:
    frames = without_place(scene)
    assert np.isnan(predicted_places(frames, scene.points).image_px).all()
    own = scene.marked(2, of=1)
    assert median_off_px(scene, frames, own, 0) < 1.0
    assert np.isnan(median_off_px(scene, frames, own, 1))
    two, three = scene.marked(2, of=2), scene.marked(2, of=3)
    others = range(3, len(scene.points))
    rough = np.median([median_off_px(scene, frames, two, k) for k in others])
    fine = np.median([median_off_px(scene, frames, three, k) for k in others])
    assert rough < 100.0
    assert fine < 5.0
    state = MarkingSession(frames, three, tmp_path).state()["points"]
    assert all(f["predicted"] for of in state for f in of["frames"] if not f["mark"])
    assert min(len(of["frames"]) for of in state) < len(frames.frames)
    assert not np.isfinite(predicted_places(without_place(scene, adjusted=False), three).image_px).any()


def test_a_wrong_mark_without_positions_is_farther_off_than_expected(scene: MarkingScene) -> None:
    points, frames = scene.marked(9), without_place(scene)
    assert not predicted_places(frames, points).suspect
    name, col, row = points[4].images[0]
    images = ((name, col + 60.0, row + 60.0), *points[4].images[1:])
    found = predicted_places(frames, (*points[:4], replace(points[4], images=images), *points[5:]))
    frame = [f.name for f in frames.frames].index(name)
    assert (4, frame) in found.suspect
    assert found.off_px[4, frame] > 40.0


def test_a_place_outside_the_frame_is_no_mark(scene: MarkingScene, tmp_path: Path) -> None:
    session = MarkingSession(scene.frames, scene.points, tmp_path)
    for at in ((-1.0, 5.0), (5.0, 601.0), (float("nan"), 5.0)):
        with pytest.raises(InputError, match="outside"):
            session.mark(0, 0, at)
    assert not (tmp_path / TABLE).exists()


def test_a_mark_is_refined_to_the_target_s_centre(scene: MarkingScene, tmp_path: Path) -> None:
    session = MarkingSession(scene.frames, scene.points, tmp_path)
    off = []
    for k, point in enumerate(scene.points):
        for name, (col, row) in scene.true_px[point.name].items():
            frame = int(name[1:3])
            assert session.mark(k, frame, (col + 1.8, row - 1.2), refine=True) == ""
            (found,) = (i[1:] for i in session.points[k].images if i[0] == name)
            off.append(np.hypot(found[0] - col, found[1] - row))
    assert max(off) < 0.3 and np.median(off) < 0.1


def test_without_a_corner_nothing_is_refined(scene: MarkingScene, tmp_path: Path) -> None:
    session = MarkingSession(scene.frames, scene.points, tmp_path)
    assert "stays where it is" in session.mark(0, 0, (13.0, 21.0), refine=True)
    assert session.points[0].images == (("F00.jpg", 13.0, 21.0),)
    assert refined(np.full((200, 200), 90, np.uint8), 100.0, 100.0) is None
    there = np.full((200, 200, 3), 90, np.uint8)
    with_target(there, 100.3, 99.8)
    assert refined(there[..., 0], 100.3 + 5.5, 99.8 + 5.5) is None


@contextmanager
def served(session: MarkingSession) -> Iterator[PageServer]:
    with PageServer(session) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def asked(
    server: PageServer, path: str, method: str = "GET", body: object = None, **headers: str
) -> tuple[int, bytes]:
    """Status and content. headers: with _ for -."""
    line = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=20)
    line.putrequest(method, path, skip_host="Host" in headers)
    data = b"" if body is None else body if isinstance(body, bytes) else json.dumps(body).encode()
    sent = {"Content-Type": "application/json", "Content-Length": str(len(data))} if body is not None else {}
    for name, value in {**sent, **{k.replace("_", "-"): v for k, v in headers.items()}}.items():
        line.putheader(name, value)
    line.endheaders(data)
    answer = line.getresponse()
    content = answer.read()
    if answer.status == 200:
        assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
    line.close()
    return answer.status, content


def test_only_who_knows_the_token_is_answered(scene: MarkingScene, tmp_path: Path) -> None:
    with served(MarkingSession(scene.frames, scene.points, tmp_path)) as server:
        own = f"/{server.token}"
        assert server.server_address[0] == "127.0.0.1"
        for path in ("", "marking.js", "survey", "state", "tile/0/1/0/0"):
            assert asked(server, f"{own}/{path}")[0] == 200
            for wrong in (
                f"/{path}",
                f"/x{own[1:]}/{path}",
                f"{own[:-1]}/{path}",
                f"/{'0' * len(own[1:])}/{path}",
            ):
                assert asked(server, wrong)[0] == 403
        assert asked(server, own)[0] == 403
        change = {"point": 0, "frame": 0, "at": [5, 5], "refine": False}
        assert asked(server, "/mark", "POST", change)[0] == 403
        assert not (tmp_path / TABLE).exists()


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:PORT", "127.0.0.1", "127.0.0.1:1", "[::1]:PORT", ""]
)
def test_another_host_is_refused(scene: MarkingScene, tmp_path: Path, host: str) -> None:
    with served(MarkingSession(scene.frames, scene.points, tmp_path)) as server:
        named = host.replace("PORT", str(server.server_port))
        change = {"point": 0, "frame": 0, "at": [5, 5], "refine": False}
        assert asked(server, f"/{server.token}/state", Host=named)[0] == 403
        assert asked(server, f"/{server.token}/mark", "POST", change, Host=named)[0] == 403
        assert asked(server, f"/{server.token}/state", Host=f"localhost:{server.server_port}")[0] == 200
        assert not (tmp_path / TABLE).exists()


def test_another_page_changes_nothing(scene: MarkingScene, tmp_path: Path) -> None:
    with served(MarkingSession(scene.frames, scene.points, tmp_path)) as server:
        own, change = f"/{server.token}/mark", {"point": 0, "frame": 0, "at": [5, 5], "refine": False}
        assert asked(server, own, "POST", change, Origin="http://evil.example")[0] == 403
        assert asked(server, own, "POST", change, Content_Type="text/plain")[0] in (400, 403)
        assert not (tmp_path / TABLE).exists()
        status, content = asked(server, own, "POST", change, Origin=f"http://{server.hosts[0]}")
        assert status == 200 and json.loads(content)["points"][0]["frames"][-1]["mark"] == [5, 5]
        rows = list(csv.DictReader((tmp_path / TABLE).read_text().splitlines()))
        assert [(r["image"], r["col"], r["row"]) for r in rows if r["image"]] == [
            ("F00.jpg", "5.000", "5.000")
        ]


@pytest.mark.parametrize(
    "path",
    ["../page_server.py", "..%2fpage_server.py", "page_server.py", "/etc/passwd", "tile/../../etc/passwd", "tile/99/1/0/0",
     "tile/-1/1/0/0", "tile/0/3/0/0", "tile/0/1/9/9", "tile/0/1/0/0/0", "tile/F00.jpg/1/0/0", "tile/0/1/0/99999999999999999999",
     "marking.js/..", "./marking.js", "%6darking.js", "survey/"],
)  # fmt: skip
def test_no_path_leads_out_of_the_page(scene: MarkingScene, tmp_path: Path, path: str) -> None:
    with served(MarkingSession(scene.frames, scene.points, tmp_path)) as server:
        assert asked(server, f"/{server.token}/{path}")[0] == 404


@pytest.mark.parametrize(
    "body",
    [{}, [], 3, {"point": 99, "frame": 0, "at": None, "refine": False}, {"point": 0, "frame": -1, "at": [1, 1], "refine": False},
     {"point": 0, "frame": 0, "at": [1], "refine": False}, {"point": 0, "frame": 0, "at": ["x", 2], "refine": False}, b"{", b" " * 5000],
)  # fmt: skip
def test_what_is_no_mark_is_an_error_and_changes_nothing(
    scene: MarkingScene, tmp_path: Path, body: object
) -> None:
    with served(MarkingSession(scene.frames, scene.points, tmp_path)) as server:
        status, content = asked(server, f"/{server.token}/mark", "POST", body)
        assert status == 400 and json.loads(content)["error"]
        assert asked(server, f"/{server.token}/state")[0] == 200
    assert not (tmp_path / TABLE).exists()


def test_a_folder_that_takes_nothing_is_reported(scene: MarkingScene, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    session = MarkingSession(scene.frames, scene.points, tmp_path / "taken")
    with served(session) as server:
        body = {"point": 0, "frame": 0, "at": [5, 5], "refine": False}
        status, content = asked(server, f"/{server.token}/mark", "POST", body)
    assert status == 500 and "taken" in json.loads(content)["error"]
    assert not session.points[0].images


def test_tiles_are_the_frame_s_own_pixels(scene: MarkingScene, tmp_path: Path) -> None:
    tiles = MarkingSession(scene.frames, scene.points, tmp_path).tiles
    whole = cv2.imread(scene.frames.frames[0].path)
    for across, width in ((0, 512), (1, 388)):
        tile = cv2.imdecode(np.frombuffer(tiles.tile(0, 1, across, 0), np.uint8), cv2.IMREAD_COLOR)
        assert tile.shape == (512, width, 3)
        assert np.abs(tile.astype(int) - whole[:512, 512 * across : 512 * across + width]).mean() < 2.5
    assert tiles.tile(0, 4, 0, 0) and tiles.tile(0, 1, 2, 0) is None


def test_files_that_are_not_its_own_are_not_replaced(scene: MarkingScene, tmp_path: Path) -> None:
    """The file of points itself may lie where marks are saved, and OpenDroneMap's list of another program."""
    points = rover(tmp_path, scene.points)
    (tmp_path / LIST).write_text("EPSG:32632\n1 2 3 4 5 a.jpg gcp\n")
    with pytest.raises(OutputError, match="-o") as error:
        read_points(points, tmp_path, scene.frames)
    assert error.value.file == str(tmp_path / LIST)
    points.rename(tmp_path / TABLE)
    with pytest.raises(OutputError, match="-o") as error:
        read_points(tmp_path / TABLE, tmp_path, scene.frames)
    assert error.value.file == str(tmp_path / TABLE)
