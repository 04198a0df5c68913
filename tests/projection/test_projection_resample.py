"""A frame's pixels at places between them."""

import numpy as np

from geomosaic.projection.resample import resample


def test_a_column_of_more_places_than_one_call_takes_is_resampled() -> None:
    """cv2.remap takes 32,766; a frame that sees far over sloping ground has more nodes of tones."""
    places = 70_001
    pixels = np.arange(200, dtype=np.float32)[None, :, None] + np.zeros((50, 200, 1), np.float32)
    cols = np.linspace(10.0, 150.0, places, dtype=np.float32)[:, None]
    found = resample(pixels, cols, np.full((places, 1), 20.0, np.float32), "bilinear")
    assert found.shape == (places, 1, 1)
    assert np.abs(found[:, 0, 0] - (cols[:, 0] - 0.5)).max() < 0.04  # of 32nds of a pixel
