"""A run's recording as robotics tools read it: plain mcap, protobuf and Foxglove's schemas alone."""

from __future__ import annotations

import csv
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from recorded_survey import bad_survey

from geomosaic.geodesy.local import LocalFrame


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bad_survey(tmp_path_factory) / "run"


def decoded(path: Path) -> tuple[dict[str, list[Any]], dict[str, list[int]]]:
    """Every message by topic, and its publish time, in one loop."""
    found: defaultdict[str, list[Any]] = defaultdict(list)
    times: defaultdict[str, list[int]] = defaultdict(list)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, value in reader.iter_decoded_messages():
            assert message.publish_time <= message.log_time
            found[channel.topic].append(value)
            times[channel.topic].append(message.publish_time)
    return found, times


def test_poses_points_and_cameras_of_a_run_in_one_loop(run: Path) -> None:
    """Absolute positions of the transforms are those of positions.csv; the ties are as many as in the table."""
    found, _ = decoded(run / "run.mcap")
    with (run / "positions.csv").open() as file:
        exported = {row["frame"]: row for row in csv.DictReader(file)}
    (origin,) = found["/location/origin"]
    assert origin.frame_id == "map"
    work_frame = LocalFrame(origin.longitude, origin.latitude, origin.altitude)
    transforms = {tf.child_frame_id: tf for tf in found["/tf"]}
    assert transforms.keys() == exported.keys() and len(found["/tf"]) == len(exported) == 12
    for name, tf in transforms.items():
        assert tf.parent_frame_id == "map"
        at = work_frame.geodetic_from_enu([tf.translation.x, tf.translation.y, tf.translation.z])
        reported = [float(exported[name][c]) for c in ("lon_deg", "lat_deg", "height_ellipsoidal_m")]
        assert np.abs(at - reported)[:2].max() < 1e-9 and abs(at[2] - reported[2]) < 1e-4
    (flown,) = found["/path"]
    in_order = sorted(found["/tf"], key=lambda tf: tf.timestamp.ToNanoseconds())
    assert [p.position.x for p in flown.poses] == [tf.translation.x for tf in in_order]
    assert [p.position.z for p in flown.poses] == [tf.translation.z for tf in in_order]
    (cameras,) = (topic for topic in found if topic.startswith("/cameras/"))
    assert sorted(c.frame_id for c in found[cameras]) == sorted(transforms)
    assert {fix.frame_id for fix in found["/location/tied"]} <= transforms.keys()
    (cloud,), (table,) = found["/points/ties"], found["/tables/ties.ground"]
    points = np.frombuffer(cloud.data, "<f4").reshape(-1, cloud.point_stride // 4)
    assert cloud.frame_id == "map" and len(points) == len(table.row) > 1000
    columns = dict(zip(table.column, np.array(table.value).reshape(len(table.column), -1), strict=True))
    apart_m = np.hypot(points[:, 0] - columns["east_m"], points[:, 1] - columns["north_m"])
    assert np.median(apart_m) < 0.2, "two rays meet near where the left one meets the ground"
    assert json.loads(found["/metrics"][0].json) is not None


def test_messages_of_frames_have_the_time_of_the_exposure(run: Path) -> None:
    found, times = decoded(run / "run.mcap")
    exposed = {image.frame_id: at for image, at in zip(found["/frames"], times["/frames"], strict=True)}
    for tf, at in zip(found["/tf"], times["/tf"], strict=True):
        assert at == exposed[tf.child_frame_id] == tf.timestamp.ToNanoseconds()
    for both in found["/frames/times"]:
        assert both.captured_ns == exposed[both.frame] < both.recorded_ns
    assert set(times["/points/ties"]) == {min(exposed.values())} and len(set(exposed.values())) == 12
    assert min(times["/stages"]) > max(exposed.values())
