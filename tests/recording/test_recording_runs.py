"""What a run records of itself: where it was when it ended, what it was given, and how much for whom."""

from __future__ import annotations

import getpass
import io
import json
import os
import platform
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pipeline_toy import recipe_file, registry
from recording_scene import RECIPE

from geomosaic.cli.main import main
from geomosaic.errors import GeomosaicError
from geomosaic.geodesy.local import LocalFrame
from geomosaic.pipeline.artefact_reader import texts_in
from geomosaic.pipeline.recipe import load_recipe
from geomosaic.pipeline.run_options import RunOptions
from geomosaic.pipeline.runner import run
from geomosaic.recording import Recorder, artefact_data, messages, read_recording
from geomosaic.recording.file.fingerprints import altered_artefacts
from geomosaic.recording.file.levels import LEVELS, RecordOptions
from geomosaic.recording.file.privacy import Privacy
from geomosaic.recording.file.run_kinds import Metric, Progress
from geomosaic.recording.file.writer import StageEnd
from geomosaic.requests.option import option_of
from geomosaic.requests.run_request import RunRequest


def run_toys(folder: Path, *overrides: str, **options: Any) -> Path:
    folder.mkdir(exist_ok=True)
    path = folder / "recipe.yaml"
    recipe = load_recipe(path if path.exists() else recipe_file(folder), registry(), overrides)
    run(recipe, folder / "run", RunOptions(**options))
    return folder / "run"


_KILLED = """
import sys
from pathlib import Path
sys.path[:0] = {tests!r}
from test_recording_runs import run_toys
run_toys(Path({folder!r}), "toy.power.delay_s=0.7")
"""


def test_a_killed_run_says_where_it_was_and_is_kept_with_the_next(tmp_path: Path) -> None:
    script = _KILLED.format(tests=sys.path, folder=str(tmp_path))
    process = subprocess.Popen([sys.executable, "-c", script])
    recording = tmp_path / "run" / "run.mcap"
    deadline = time.monotonic() + 60.0
    beats: list[Any] = []
    while not any(b.done for b in beats) and time.monotonic() < deadline:
        time.sleep(0.1)
        if recording.exists() and recording.stat().st_size > 500:
            beats = [Progress.FromString(data) for _, _, data in messages(recording, "geomosaic.Progress")]
    process.kill()
    assert process.wait() == -9
    assert (beats[-1].stage_id, beats[-1].text, beats[-1].total) == ("toy.power", "powers", 4)
    assert 1 <= beats[-1].done <= 4 and beats[-1].memory_bytes > 10e6
    last = read_recording(recording).stages[-1]
    assert (last.stage_id, last.finished) == ("toy.power", False)
    before = recording.read_bytes()
    folder = run_toys(tmp_path)
    assert (folder / "run.unfinished.mcap").read_bytes() == before
    assert read_recording(folder / "run.mcap").whole
    run_toys(tmp_path)
    assert (folder / "run.unfinished.mcap").read_bytes() == before, (
        "a finished run replaces no unfinished one"
    )


def test_a_failed_run_is_kept_with_the_next(tmp_path: Path) -> None:
    with pytest.raises(GeomosaicError):
        run_toys(tmp_path, "toy.read.offset_m=12")
    run_toys(tmp_path)
    assert read_recording(tmp_path / "run" / "run.unfinished.mcap").warnings[-1].level == "error"


def test_a_run_tells_where_it_ran_on_what(tmp_path: Path) -> None:
    recording = read_recording(run_toys(tmp_path) / "run.mcap")
    environment = recording.environment
    assert environment["command"][0] == Path(sys.argv[0]).name and environment["command"][1:] == sys.argv[1:]
    assert environment["machine"]["processors"] == os.cpu_count()
    assert (environment["host"], environment["user"]) == (platform.node(), getpass.getuser())
    (entry,) = recording.manifest.values()
    assert list(entry["bytes"]) == list(entry["files"]) and min(entry["bytes"].values()) > 0
    sums = {
        m.name: m for m in (Metric.FromString(d) for _, _, d in messages(recording.path, "geomosaic.Metric"))
    }
    assert (sums["toy.largest"].number, sums["toy.largest"].stage_id) == (16.0, "toy.power")
    assert json.loads(sums["frames"].json) == {"total": 4, "tied": 3, "placed": 1, "rejected": 0}


def test_what_the_cache_gives_records_its_figures_again(tmp_path: Path) -> None:
    def metrics() -> list[bytes]:
        return [data for _, _, data in messages(tmp_path / "run" / "run.mcap", "geomosaic.Metric")]

    run_toys(tmp_path)
    first = metrics()
    run_toys(tmp_path)
    assert metrics() == first


def test_the_level_off_leaves_no_recording_not_even_an_older_one(tmp_path: Path) -> None:
    folder = run_toys(tmp_path)
    assert (folder / "run.mcap").exists()
    run_toys(tmp_path, record=RecordOptions("off"))
    assert not (folder / "run.mcap").exists() and (folder / "run.json").exists()


def test_a_private_recording_names_no_folder_user_or_host_anywhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inside = tmp_path / "Anna's flights"
    words = [
        "mosaic",
        "her flights/frames",
        "-o",
        "her flights\\run",
        "--pos=her flights/p.csv",
        "--private",
        "/",
    ]
    monkeypatch.setattr(sys, "argv", ["bin/geomosaic", *words])
    recording = read_recording(run_toys(inside, record=RecordOptions(private=True)) / "run.mcap")
    texts = [recording.recipe_yaml, json.dumps([recording.environment, recording.manifest])]
    texts += [json.dumps([s.params, s.notes]) for s in recording.stages]
    texts += [line.text for line in recording.log]
    texts += [t for a in recording.artefacts for t in texts_in(artefact_data(recording, a))]
    assert not [t for t in texts if str(tmp_path) in t or "flights" in t or str(Path.home()) + "/" in t]
    assert not {"host", "user", "folder"} & set(recording.environment)
    assert recording.environment["command"][:6] == [
        *("geomosaic", "mosaic", "frames", "-o", "run", "--pos=p.csv")
    ]
    assert not altered_artefacts(recording), "what was taken out counts in the fingerprints"
    given = [mark for s in recording.stages for mark in s.outputs.values()]
    assert all(mark in given for s in recording.stages for mark in s.inputs.values())


def test_places_are_moved_together(tmp_path: Path) -> None:
    path, places = tmp_path / "run.mcap", [(7.5, 51.25, 120.0), (7.51, 51.26, 150.0)]
    ring = [[lon, lat] for lon, lat, _ in (*places, places[0])]
    shape = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    with Recorder(path, privacy=Privacy(places=True)) as recorder:
        recorder.begin_run("crs: EPSG:25832\n", {}, {})
        recorder.stage_started("a", 1, {"crs": "EPSG:25832"}, {})
        for place in places:
            recorder.location("f", place, (1.0, 1.0, 1.0), "tied")
        recorder.geojson("/footprints/placed", [shape])
        recorder.artefact("a", "survey", "t", "ab" * 20, io.BytesIO(b"places"))
        holes = {"count": 1, "largest": [{"easting_m": 306197.5, "northing_m": 4545388.25, "area_m2": 2.5}]}
        recorder.metric("mosaic.holes", holes)
        recorder.stage_finished("a", StageEnd(seconds=0.0, notes={"metrics": {"mosaic": {"holes": holes}}}))
    for schema in ("geomosaic.Metric", "geomosaic.StageEvent"):
        assert b"306197" not in b"".join(d for _, _, d in messages(path, schema))
    assert read_recording(path).metrics["mosaic.holes"]["largest"][0]["area_m2"] == 2.5
    from foxglove_schemas_protobuf.GeoJSON_pb2 import GeoJSON
    from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix

    fixes = [LocationFix.FromString(d) for _, _, d in messages(path, "foxglove.LocationFix")]
    moved = np.array([(f.longitude, f.latitude, f.altitude) for f in fixes])
    assert np.abs(moved[:, :2] - np.array(places)[:, :2]).max() > 0.02
    there, here = LocalFrame(*moved[0]), LocalFrame(*places[0])
    assert np.allclose(there.enu_from_geodetic(*moved[1]), here.enu_from_geodetic(*places[1]), atol=1e-6)
    (collection,) = (
        json.loads(GeoJSON.FromString(d).geojson) for _, _, d in messages(path, "foxglove.GeoJSON")
    )
    corners = np.array(collection["features"][0]["geometry"]["coordinates"][0])
    assert np.allclose(corners[0], moved[0, :2], atol=1e-3) and len(corners) == 3
    recording = read_recording(path)
    assert "EPSG" not in recording.recipe_yaml + str(recording.stages) and not recording.artefacts


class _Canvas:
    """Takes what is drawn, and remembers where."""

    def __init__(self) -> None:
        self.entities: list[str] = []

    def log(self, entity: str, drawn: object, static: bool = False) -> None:
        self.entities.append(entity)

    def set_time(self, timeline: str, **at: object) -> None:
        pass

    def reset_time(self) -> None:
        pass


def test_a_view_follows_a_recording_as_it_grows_and_ends_with_its_run(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="Rerun isn't installed")
    from geomosaic.recording.rerun.live_run import follow

    recorder, canvas = Recorder(tmp_path / "run.mcap"), _Canvas()
    recorder.begin_run(RECIPE, {}, {})
    recorder.stage_started("a", 1, {}, {})
    seen: list[list[str]] = []

    def alive() -> bool:
        """The run goes on only after what it wrote was drawn."""
        seen.append(list(canvas.entities))
        if len(seen) == 2:
            recorder.log("info", "first line", stage="a")
            recorder.stage_finished("a", StageEnd(seconds=0.1))
            recorder.stage_started("b", 1, {}, {})
        return len(seen) < 8

    shown = follow(tmp_path / "run.mcap", canvas, alive)
    assert [s.stage_id for s in shown.stages] == ["a", "b"] and shown.stages[1].ended_ns == 0
    assert "/stages_drawn/bars" in seen[1] and "/log" not in seen[1]
    assert "/log" in seen[-1], "drawn before the run ended"
    assert canvas.entities.count("/log") == 1, "each line once"
    recorder.close()


def test_a_viewer_that_is_not_there_makes_no_difference(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GEOMOSAIC_LIVE", "rerun+http://127.0.0.1:1/proxy")
    began = time.monotonic()
    folder = run_toys(tmp_path, record=RecordOptions(live=True))
    assert read_recording(folder / "run.mcap").whole
    assert time.monotonic() - began < 20.0


def test_a_program_that_ends_before_its_viewer_says_nothing_of_it(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="Rerun isn't installed")
    script = (
        "from pathlib import Path; from geomosaic.recording.rerun.live import watched\n"
        f"with watched(Path({str(tmp_path / 'run.mcap')!r}), live=True): pass"
    )
    environment = {**os.environ, "GEOMOSAIC_LIVE": "rerun+http://127.0.0.1:1/proxy"}
    command = [sys.executable, "-X", "dev", "-c", script]
    said = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert (said.returncode, said.stdout, said.stderr) == (0, "", "")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--record", "ful"], "unknown level of --record 'ful'; did you mean 'full'?"),
        (["--record", "off", "--live"], "--live shows what is recorded; leave out --record off"),
    ],
)
def test_wrong_options_end_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], says: str
) -> None:
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text("name: none\nstages: [{stage: simulate.frames}]\n")
    assert main(["run", str(recipe), "-o", str(tmp_path / "run"), *options]) == 2
    assert says in capsys.readouterr().err and not (tmp_path / "run").exists()


def test_the_levels_are_those_that_the_help_names() -> None:
    (record,) = (its for its in fields(RunRequest) if its.name == "record")
    assert option_of(record).metavar == "|".join(LEVELS)
