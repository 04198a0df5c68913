"""Rays to the ground (flat, DEM, tie surface), footprints, ground sampling distance, the warp itself."""
