"""Interior orientation, lens distortion, exterior orientation, collinearity."""
