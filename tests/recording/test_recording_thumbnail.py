"""Images of a recording, which may be a stranger's."""

from __future__ import annotations

import resource
import struct

import cv2
import numpy as np
import pytest

from geomosaic.recording.file.thumbnail import decoded, thumbnail


def claiming(width_px: int, height_px: int) -> bytes:
    """A JPEG of 16 x 16 px whose head says otherwise."""
    jpeg = bytearray(cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes())
    head = jpeg.index(b"\xff\xc0")
    jpeg[head + 5 : head + 9] = struct.pack(">HH", height_px, width_px)
    return bytes(jpeg)


def test_a_thumbnail_is_decoded_blue_first() -> None:
    red = np.zeros((60, 80, 3), np.uint8)
    red[..., 0] = 200
    found = decoded(thumbnail(red))
    assert found is not None and found.shape == (60, 80, 3)
    assert found[..., 2].mean() > 190 and found[..., 0].mean() < 10


@pytest.mark.parametrize(
    "jpeg", [claiming(30_000, 30_000), claiming(30_000, 8), b"", b"\xff\xd8\xff", b"PNG"]
)
def test_what_claims_to_be_huge_or_is_no_jpeg_takes_no_memory(jpeg: bytes) -> None:
    """600 bytes took 5 GB before."""
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert decoded(jpeg) is None
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb < 200_000
