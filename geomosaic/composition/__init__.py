"""Composition of the mosaic: output grid, seamlines, radiometric balancing, blending, windows."""
