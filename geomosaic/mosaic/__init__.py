"""Output grid, seams, blending, streaming composition."""
