"""Readers that share no code with the writer: JavaScript's reference reader and Rerun's in Rust."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import pytest
from recording_scene import FRAMES, RECIPE, written

from geomosaic.recording import read_recording

_SCRIPT = Path(__file__).parent / "node" / "read_mcap.mjs"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("readers") / "run.mcap")


def test_the_javascript_reader_finds_the_same(scene: Path) -> None:
    """Needs node and `npm install @mcap/core @mcap/support protobufjs` in tests/node or $MCAP_MODULES."""
    node = shutil.which("node")
    folder = Path(os.environ.get("MCAP_MODULES", _SCRIPT.parent))
    if node is None:
        pytest.skip("node isn't installed")
    if not (folder / "node_modules" / "@mcap" / "core").is_dir():
        pytest.skip("no @mcap/core; npm install @mcap/core @mcap/support protobufjs in tests/node")
    environment = {**os.environ, "MCAP_MODULES": f"{folder}/"}
    done = subprocess.run(
        [node, str(_SCRIPT), str(scene)], capture_output=True, text=True, timeout=60, env=environment
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["profile"] == "geomosaic" and found["attachments"]["recipe.yaml"] == RECIPE
    assert found["metadata"]["geomosaic"]["format"] == "1"
    recording = read_recording(scene)
    assert found["counts"] == {name: topic.messages for name, topic in recording.topics.items()}
    assert found["artefactBytes"] == 2_300_001
    offsets = found["first"]["/offsets/adjustment.solve"]
    assert (
        offsets["left"] == list(FRAMES[:2]) and offsets["east_m"][0] == 3.0 and offsets["north_m"][0] == -4.0
    )
    assert offsets["largest_misalignment_m"] == 5.0
    assert found["first"]["/location/observed"]["longitude"] == -91.25
    table = found["first"]["/tables/pairs.adjusted"]
    assert (table["row"], table["other"], table["column"]) == (
        [FRAMES[0]],
        [FRAMES[1]],
        ["rms_m", "tie_points"],
    )
    assert table["value"] == [0.05, 2.0] and table["stage_id"] == "adjustment.solve"
    assert found["first"]["/metrics"]["number"] == 0.5 and found["first"]["/metrics"]["json"] == "0.5"
    step = found["first"]["/iterations/adjustment.solve"]
    assert (step["cost"], step["cost_unit"], step["step_m"]) == (25.0, "m", 1.5)
    assert found["first"]["/outlines/adjusted"]["vertices"] == [3, 4]
    ties = found["first"]["/chips/ties"]
    assert (ties["side_px"], ties["left_x_px"], len(ties["weight"])) == (400, [200.0], 1)


@pytest.fixture
def rerun_reader() -> type:
    chunk = pytest.importorskip("rerun.chunk", reason="Rerun isn't installed")
    return chunk.McapReader  # type: ignore[no-any-return]


def test_reruns_own_reader_finds_the_same(scene: Path, rerun_reader: type) -> None:
    rows: Counter[str] = Counter()
    components: dict[str, set[str]] = {}
    for chunk in rerun_reader(scene).stream():
        if not chunk.is_static:
            rows[chunk.entity_path] += chunk.num_rows
            components.setdefault(chunk.entity_path, set()).update(chunk.to_record_batch().schema.names)
    assert rows == {name: topic.messages for name, topic in read_recording(scene).topics.items()}
    assert "EncodedImage:blob" in components["/images/before"]
    assert "GeoPoints:positions" in components["/location/observed"]
    assert "TextLog:text" in components["/log"]
    assert "geomosaic.TiePoints:message" in components["/tie_points"]


def test_reruns_own_reader_recovers_a_cut_file(scene: Path, rerun_reader: type, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(scene.read_bytes()[:-3000])
    recovered = rerun_reader(path, recover=True).info()
    ours = sum(topic.messages for topic in read_recording(path).topics.values())
    assert recovered.summary_source == "reconstructed" and recovered.message_count >= ours > 10


def test_the_view_is_a_sound_rrd_with_all_streams_on_one_timeline(scene: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="Rerun isn't installed")
    from rerun.chunk import RrdReader

    from geomosaic.recording.view import write_rrd

    path = tmp_path / "out.rrd"
    write_rrd(read_recording(scene), path)
    assert [p.name for p in tmp_path.iterdir()] == ["out.rrd"]
    entities: dict[str, set[str]] = {}
    for chunk in RrdReader(path).stream():
        if not chunk.is_static:
            assert "step" in chunk.timeline_names and "message_log_time" in chunk.timeline_names
            entities.setdefault(chunk.entity_path, set()).update(chunk.to_record_batch().schema.names)
    assert "Scalars:scalars" in entities["/plots/offsets/adjustment.solve"]
    assert "GeoLineStrings:line_strings" in entities["/map/map/footprints"]
    assert "GeoPoints:positions" in entities["/map/frames"]
    assert "/artefacts" not in entities
