"""RPCs of scenes across the 180 degree meridian."""

import numpy as np
import pytest

from geomosaic.camera.rpc import fit_rpc


def seen(lon_from_deg, lat_deg, height_m):
    """Cols and lines (n, 2) of a slanted image of ground at longitudes from its middle."""
    col = 5000.0 + 40000.0 * lon_from_deg + 3000.0 * lat_deg + 0.1 * height_m
    line = 4000.0 - 45000.0 * lat_deg + 2000.0 * lon_from_deg**2 - 0.05 * height_m
    return np.stack([col, line], axis=-1)


@pytest.mark.parametrize("middle_deg", [105.0, 179.97, -179.97])
def test_a_scene_across_the_180_degree_meridian_is_as_good_as_any_other(middle_deg):
    """Longitudes from -180 to 180, as GDAL and the geodesy of this package give them."""
    lon, lat, height = (
        a.ravel()
        for a in np.meshgrid(np.linspace(-0.1, 0.1, 9), np.linspace(-0.08, 0.08, 9), [0.0, 500.0, 1e3])
    )
    turned = (lon + middle_deg + 180.0) % 360.0 - 180.0
    ground = np.stack([turned, lat, height], axis=-1)
    image = seen(lon, lat, height)
    rpc, worst_px = fit_rpc(ground, image)
    assert worst_px < 1e-3
    assert rpc.offset[3] == pytest.approx(middle_deg, abs=1e-6)
    assert rpc.scale[3] == pytest.approx(0.1, abs=1e-6)
    assert np.abs(rpc.image_from_ground(ground) - image).max() < 1e-3
    further = ground + np.array([360.0, 0.0, 0.0])
    assert np.abs(rpc.image_from_ground(further) - image).max() < 1e-3
