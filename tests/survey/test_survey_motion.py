"""What the inertial unit wrote into a frame's tags."""

from __future__ import annotations

import base64
import struct
from pathlib import Path

import numpy as np
import pytest

from geomosaic.survey.exif import Exif
from geomosaic.survey.header import FrameHeader
from geomosaic.survey.motion_tags import UNIT_DELAY_S, turns_of, velocity_of

SAMPLES = 185


def tagged(text: str, velocity: str = "") -> FrameHeader:
    xmp = {"Camera:IMUAngularVelocity": text, "Camera:IMULinearVelocity": velocity}
    return FrameHeader(Path("a.jpg"), 4608, 3456, 3, "uint8", None, Exif(), xmp)


def written(rates: np.ndarray, step_us: int = 1000, begin_us: int = 345_856_829) -> str:
    records = [
        struct.pack("<Q3fI", begin_us + step_us * k, *(float(w) for w in rate), 1)
        for k, rate in enumerate(rates)
    ]
    return base64.b64encode(b"".join(records)).decode()


def test_a_constant_rate_about_each_axis_by_hand() -> None:
    """Forward, right, down of the unit are top, right and view of the image. Rolling to the right by 0.1
    rad/s turns about y, pitching up by 0.2 about x, and heading to the right by 0.3 about -z."""
    turns = turns_of(tagged(written(np.tile([0.1, 0.2, 0.3], (SAMPLES, 1)))))
    assert turns is not None
    assert turns.span_s == pytest.approx(0.184)
    turn, rate = turns.at(np.array([-0.08, 0.0, 0.08]))
    assert turn == pytest.approx(np.outer([-0.08, 0.0, 0.08], [0.2, 0.1, -0.3]), abs=1e-7)
    assert rate == pytest.approx(np.tile([0.2, 0.1, -0.3], (3, 1)), abs=1e-6)


def test_rates_are_written_later_than_they_were() -> None:
    """A knock in the sample 20 ms after the middle one's place, with the delay reported."""
    rates = np.zeros((SAMPLES, 3))
    knock = 92 + round(1000 * UNIT_DELAY_S) + 20
    rates[knock, 0] = 5.0
    turns = turns_of(tagged(written(rates)))
    assert turns is not None
    turned = turns.at(np.array([-0.05, 0.0, 0.014, 0.027, 0.08]))[0][:, 1]
    assert turned == pytest.approx([0.0, 0.0, 0.0, 0.005, 0.005], abs=1e-4)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "no base64!",
        "AAAA",
        written(np.zeros((3, 3))),
        written(np.zeros((SAMPLES, 3)), step_us=0),
        written(np.zeros((SAMPLES, 3)), step_us=200_000),
        written(np.full((SAMPLES, 3), np.nan)),
        written(np.full((SAMPLES, 3), 1e9)),
        written(np.full((SAMPLES, 3), 5.0)),
        written(np.zeros((SAMPLES, 3)))[:-4],
        "A" * 1_000_000,
        "ä" * 32,
    ],
    ids=[
        "none",
        "text",
        "short",
        "few",
        "still",
        "long",
        "nan",
        "wild",
        "spinning",
        "cut",
        "huge",
        "foreign",
    ],
)
def test_samples_that_cant_be(text: str) -> None:
    assert turns_of(tagged(text)) is None


def test_time_that_goes_back() -> None:
    data = bytearray(base64.b64decode(written(np.zeros((SAMPLES, 3)))))
    data[24 * 50 : 24 * 50 + 8] = struct.pack("<Q", 5)
    assert turns_of(tagged(base64.b64encode(bytes(data)).decode())) is None


def test_the_velocity_is_east_north_up() -> None:
    assert velocity_of(tagged("", "0.04,-13.68,-0.57")) == (0.04, -13.68, -0.57)
    assert [velocity_of(tagged("", v)) for v in ("", "1,2", "1,2,nan", "1,2,1e9")] == [None] * 4


def test_how_far_the_record_reaches_is_known_and_one_that_ends_before_the_rows_are_read_is_none() -> None:
    """Rates lag by 42.5 ms: of 184 ms the last 42.5 are missing, of 29 ms all."""
    turns = turns_of(tagged(written(np.tile([0.1, 0.2, 0.3], (SAMPLES, 1)))))
    assert turns is not None and float(turns.recorded_until_s) == pytest.approx(0.092 - 0.0425)
    assert turns_of(tagged(written(np.tile([0.1, 0.2, 0.3], (30, 1))))) is None
