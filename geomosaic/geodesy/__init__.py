"""The Earth: ellipsoid radii, geodetic, ECEF and local ENU coordinates, map CRS, heights."""
